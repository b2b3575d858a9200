"""Drawings and angles of cameras, against angles computed by hand."""

import math
from pathlib import Path

import cv2
import pytest
import yaml

from rmis_calib.cli import main
from rmis_calib.geometry import Camera
from rmis_calib.io.stereo import read_stereo
from rmis_calib.report.equipment import field_of_view_deg


def test_field_of_view_of_a_pinhole_and_a_fisheye() -> None:
    # The picture reaches 50 px either side of its centre: 2 atan(50 / 50) = 90 deg; a fisheye draws 1 rad at 50 px.
    numbers = (50.0, 100.0, 49.5, 39.5)
    pinhole = Camera.from_values(*numbers, image_size=(80, 100))
    assert field_of_view_deg(pinhole) == pytest.approx((90.0, 2 * math.degrees(math.atan(0.4))))
    fisheye = Camera.from_values(*numbers, [0.0] * 4, image_size=(80, 100), model="equidistant")
    assert field_of_view_deg(fisheye) == pytest.approx((2 * math.degrees(1.0), 2 * math.degrees(0.4)))


def test_cameras_show_prints_a_stereo_yaml_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "seq.txt"
    source.write_text(
        "Width: 1280\nHeight: 1024\nCamera-0-F: 1084 1085\nCamera-0-C: 580 506\nCamera-0-K: 0.1 0 0 0 0\n"
        "Camera-1-F: 1083 1082\nCamera-1-C: 680 505\nCamera-1-K: 0 0 0 0 0\nExtrinsic-Omega: 0 0 0\n"
        "Extrinsic-T: -4.35 0 0\n"
    )
    assert main(["cameras", "show", str(source)]) == 0
    shown = capsys.readouterr().out
    assert "# baseline 4.350 mm" in shown and "# left: plumb_bob, field of view" in shown
    copy = tmp_path / "stereo.yaml"
    copy.write_text(shown)
    assert yaml.safe_load(shown)["camera_left_T_camera_right"][0][3] == 4.35
    assert read_stereo(copy).to_dict() == read_stereo(source).to_dict()
    picture = cv2.imread(str(tmp_path / "seq_cameras.png"))
    assert picture is not None and picture.std() > 1.0


def test_cameras_show_refuses_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "a.json"
    source.write_text("{}")
    assert main(["cameras", "show", str(source)]) == 2
    assert "expected an image size in the file" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    assert main(["cameras"]) == 2
    assert "expected one of cameras show, found nothing" in capsys.readouterr().err
