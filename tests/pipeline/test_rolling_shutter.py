"""Rows that are read one after the other: points are put to one instant, and head points are predicted at their own."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import data_synth
import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.geometry.cameras import Camera
from rmis_calib.pipeline.arms.poses import row_delay_s
from rmis_calib.pipeline.calibration import run_calibration

QUICK = parse_config({"solver": {"advice": {"motions": 0}, "bias_correction": False, "groups": 0}})
READOUT_S = 0.02


@pytest.fixture(scope="module")
def rolling(tmp_path_factory):
    """Arms in quick motion, seen by cameras that take 20 ms to read a picture, and say so."""
    config = data_synth.load_synth_config("demo")
    motion = replace(config.motion, kind="smooth", speed=3.0, joint_rate_hz=200.0)
    camera = replace(config.camera, readout_s=READOUT_S, readout_told=True)
    noise = replace(config.noise, kinematics_mm=0.0, kinematics_deg=0.0)
    output = replace(config.output, pictures="images")
    config = replace(config, motions=28, seed=3, motion=motion, camera=camera, noise=noise, output=output)
    folder = data_synth.write_recording(tmp_path_factory.mktemp("rolling") / "recording", config)
    recording = rc.load_recording(folder)
    return folder, recording, run_calibration(recording, QUICK)


def test_delays_run_from_the_first_row_to_the_last() -> None:
    camera = Camera.from_values(500.0, 500.0, 300.0, 200.0, image_size=(401, 600))
    v_px = torch.tensor([0.0, 200.0, 400.0, torch.nan, 900.0], dtype=torch.float64)
    # By hand: the middle row of 401 is row 200; rows outside of the picture are not read later than its last.
    assert row_delay_s(camera, v_px, 0.01).tolist() == pytest.approx([-0.005, 0.0, 0.005, 0.0, 0.005])


def test_the_joints_are_read_with_the_middle_row(rolling) -> None:
    folder, recording, _ = rolling
    height = recording.right.size[0]
    assert recording.rolling_shutter_s == pytest.approx(READOUT_S * (height - 1) / height)
    # The generator's frame times are those of the middle rows.
    np.testing.assert_allclose(recording.joint_times_s, np.load(folder / "truth.npz")["frame_times_s"], atol=1e-9)


def test_points_are_moved_to_where_they_were_when_the_middle_row_was_read(rolling) -> None:
    folder, _, run = rolling
    truth = np.load(folder / "truth.npz")
    for view, choice in zip(run.views, run.choices, strict=True):
        rows, taken = torch.arange(len(choice.candidate)), choice.taken.numpy()
        contour = view.at(run.poses.frames).contour_xy[rows, choice.candidate].double().numpy()[taken]

        def off_px(name, contour=contour, side=view.side, taken=taken):
            n = truth[f"{side}_{name}"][run.poses.frames][taken]
            n = n / np.linalg.norm(n[..., :2], axis=-1, keepdims=True)
            return 700.0 * ((contour * n[:, :, None, :2]).sum(-1) + n[:, :, None, 2])

        at_middle, as_read = off_px("n_contour"), off_px("n_contour_read")
        assert np.sqrt((at_middle**2).mean()) < 0.1
        assert np.sqrt((as_read**2).mean()) > 5 * np.sqrt((at_middle**2).mean())  # what was measured


@pytest.mark.parametrize("side", ["right", "left"])
def test_labelled_head_points_are_moved_as_well(rolling, side) -> None:
    """By what lies, in the generator's truth, between where the point was with its own row and with the middle one."""
    folder, recording, run = rolling
    truth, camera, frames = np.load(folder / "truth.npz"), getattr(recording.stereo, side), run.poses.frames

    def xy(uv):
        return camera.undistort_points(torch.as_tensor(uv))[0].numpy()

    labels, points = np.full((recording.n_frames, 2), np.nan), recording.head_points
    labels[points.frames] = xy(getattr(points, f"uv_{side}"))
    moved_px = 700.0 * (getattr(run.observations, f"head_{side}") - labels[frames])
    expected_px = 700.0 * (xy(truth[f"{side}_head_uv"]) - xy(truth[f"{side}_head_uv_read"]))[frames]
    seen = np.isfinite(moved_px).all(-1)
    assert seen.sum() > 20
    assert np.abs(expected_px[seen]).max() > 0.1
    np.testing.assert_allclose(moved_px[seen], expected_px[seen], atol=0.02)


def test_the_answer_is_that_of_the_shaft_and_evaluate_says_the_same(rolling) -> None:
    folder, recording, run = rolling
    result = run.result
    assert any("Rows are read within 20 ms" in note for note in result.notes)
    found = rc.evaluate(result, folder)
    assert found.head_point_error_px is not None and result.head_point_error_px is not None
    assert found.head_point_error_px["right"].median == pytest.approx(result.head_point_error_px["right"].median)
    at_once = replace(QUICK, picture_errors=replace(QUICK.picture_errors, readout_sigma_s=0.0))
    ignored = rc.calibrate(replace(recording, rolling_shutter_s=0.0), at_once, throw=False)
    worse = rc.evaluate(ignored, folder)
    assert found.translation_error_mm is not None and worse.translation_error_mm is not None
    assert found.translation_error_mm < 0.4 * worse.translation_error_mm
    assert worse.head_point_error_px is not None
    assert found.head_point_error_px["right"].median < 0.4 * worse.head_point_error_px["right"].median


def test_rows_that_nobody_tells_of_are_found_in_the_data(rolling) -> None:
    """The generator reads 480 rows in 20 ms, one focal length (700 px) in 29 ms."""
    folder, recording, _ = rolling
    result = rc.calibrate(replace(recording, rolling_shutter_s=0.0), QUICK, throw=False)
    focal_rows = float(recording.stereo.right.focal) / recording.right.size[0]
    found = result.nuisances["readout"]
    assert found.sigma is not None and abs(found.value - READOUT_S * focal_rows) < 4.0 * found.sigma < 0.01
    measured = rc.evaluate(result, folder)
    assert measured.error_sigmas is not None and measured.error_sigmas < 4.49
