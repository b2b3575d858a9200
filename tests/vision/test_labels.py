"""The labels of the real frames hold together: contours of one cylinder each, ends between them, no frame left out."""

import csv
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
FRAMES = ROOT.parent / "shared" / "data" / "frames"
WITHOUT_SHAFT = {"frames/cholec_hook/frame_28920_endo.png", "frames/cholec_hook/frame_28930_endo.png"}


@pytest.fixture(scope="module")
def rows() -> list[dict[str, str]]:
    with (ROOT / "tests/vision/labels.csv").open() as file:
        return list(csv.DictReader(file))


def contours(row: dict[str, str]) -> np.ndarray:
    return np.array([[[float(row[f"{e}{p}_{x}_px"]) for x in "uv"] for p in "12"] for e in "ab"])


def test_kinds_and_frames(rows):
    assert Counter(row["kind"] for row in rows) == {"shaft": 108, "stub": 7, "sleeve": 15, "strut": 30}
    recorded = Counter(row["file"].split("/")[0] for row in rows if row["kind"] == "shaft")
    assert recorded == {
        "frames": 46, "recode_recording": 15, "cwru_jul23": 14,
        "thrust_recording": 12, "berkeley_b_psm2_mono": 11, "ucsd_easy": 10,
    }  # fmt: skip


def test_contours_are_of_one_cylinder(rows):
    for row in rows:
        edges = contours(row)
        length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=-1)
        (ua, va), (ub, vb) = (edges[:, 1] - edges[:, 0]) / length[:, None]
        width = abs(np.cross(np.append([ua, va], 0.0), np.append(edges[1].mean(0) - edges[0].mean(0), 0.0))[2])
        where = f"{row['file']} {row['half']} {row['kind']}"
        assert ua * ub + va * vb > np.cos(np.radians(15.0)), where  # perspective: the widest opens by 12.6 deg
        assert 15.0 < width < 190.0 and length.min() > 10.0, where
        assert 0.0 < float(row["sigma_px"]) <= 5.0, where


def test_ends_lie_between_the_contours_on_the_tip_side(rows):
    for row in (row for row in rows if row["kind"] in ("shaft", "stub")):
        edges, end = contours(row), np.array([float(row["end_u_px"]), float(row["end_v_px"])])
        direction = edges[:, 1] - edges[:, 0]
        normal = np.stack([direction[:, 1], -direction[:, 0]], -1) / np.linalg.norm(direction, axis=-1, keepdims=True)
        signed = np.einsum("ei,ei->e", end - edges[:, 0], normal)
        assert signed[0] * signed[1] < 0.0, row["file"]
        assert abs(abs(signed[0]) - abs(signed[1])) < 1.0, row["file"]  # on the axis: as far from either contour
        if row["kind"] == "shaft":  # a stub's second contour was labelled beyond the end
            assert (end - edges[:, 1].mean(0)) @ direction.sum(0) > 0.0, row["file"]


def test_no_frame_is_left_out(rows):
    if not FRAMES.is_dir():
        pytest.skip("real frames are absent (../shared/data beside the checkout)")
    pictures = {f"frames/{path.parent.name}/{path.name}" for path in FRAMES.glob("*/*.png") if "_mask" not in path.name}
    halves = {(row["file"], row["half"]) for row in rows if row["kind"] == "shaft"}
    stereo = {name for name in pictures if "phantom_stereo" in name}
    assert {(name, half) for name in stereo for half in ("left", "right")} <= halves
    assert {(name, "") for name in pictures - stereo - WITHOUT_SHAFT} <= halves
