"""What does not fit is named before weak motion, and its likely causes in the order of the evidence."""

import csv
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

import data_synth
import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.pipeline.checks.misfit import SignedResiduals, misfit_message, shown_causes, traces
from rmis_calib.pipeline.checks.suppositions import suppositions
from rmis_calib.results import Motions, Nuisance
from rmis_calib.solver.observability import Observability

N = 120
CLOCK, PLACE, SWAPPED = "the clock or the frame rate", "focal length, crop or lens", "look swapped"


def residuals(seed: int, clock_s: float = 0.0, lens: float = 0.0, noise_px: float = 0.3) -> SignedResiduals:
    generator = np.random.default_rng(seed)
    velocity = generator.normal(0.0, 40.0, N)
    uv = generator.uniform(-0.4, 0.4, (N, 2))
    px = clock_s * velocity + lens * (uv[:, 0] ** 2 + uv[:, 1] ** 2 - 0.1) + generator.normal(0.0, noise_px, N)
    return SignedResiduals(px, velocity, uv)


@pytest.mark.parametrize("seed", range(5))
def test_each_cause_is_told_from_its_trace(seed) -> None:
    assert traces(residuals(seed, clock_s=0.1))[0].startswith(CLOCK)
    assert traces(residuals(seed, lens=40.0))[0].startswith(PLACE)
    assert traces(residuals(seed)) == []


def test_pictures_show_swapped_cameras_and_repeats() -> None:
    assert shown_causes(0.02, 0) == shown_causes(None, 0) == []
    assert SWAPPED in shown_causes(-0.02, 0)[0] and "mirrored" in shown_causes(-0.02, 0)[0]
    assert shown_causes(-0.02, 7)[0].startswith("7 pictures repeat the one before")


def test_the_stronger_trace_comes_first() -> None:
    strong_clock = traces(residuals(0, clock_s=0.2, lens=70.0))
    assert [cause[:9] for cause in strong_clock] == [CLOCK[:9], PLACE[:9]]
    strong_lens = traces(residuals(0, clock_s=0.03, lens=60.0))
    assert strong_lens[0].startswith(PLACE)


@pytest.mark.parametrize(("mm", "deg", "told"), [(0.08, 0.03, False), (2.5, 0.03, True), (0.08, 0.9, True)])
def test_only_a_noise_that_no_robot_has_is_quoted(mm, deg, told) -> None:
    """Small levels beside another cause would say that the joints fit well."""
    result = rc.CalibrationResult(
        status="weak",
        message="weak: the cameras disagree",
        method="joint",
        camera_right_T_arm=None,
        camera_left_T_camera_right=None,
        covariance=None,
        observability=Observability(),
        motions=Motions(np.zeros(0, dtype=bool), (), None),
        nuisances={
            "noise kinematics_mm": Nuisance(mm, None, "mm"),
            "noise kinematics_rad": Nuisance(np.deg2rad(deg), None, "rad"),
        },
    )
    message = misfit_message(result, ["the cameras look swapped"])
    assert ("as if the joints were noisy" in message) == told
    assert "Likely: the cameras look swapped. (the cameras disagree)" in message


def test_without_velocities_or_with_a_few_motions_nothing_is_made_up() -> None:
    few = residuals(0, clock_s=0.1)
    still = replace(few, velocity_px_s=np.full(N, np.nan))
    assert traces(still) == []
    short = SignedResiduals(few.px[:5], few.velocity_px_s[:5], few.uv[:5])
    assert traces(short) == []


@pytest.fixture(scope="module")
def smooth(tmp_path_factory):
    """Continuous pictures of both arms in motion."""
    config = data_synth.load_synth_config("demo")
    motion = replace(config.motion, kind="smooth", speed=3.0, joint_rate_hz=200.0)
    output = replace(config.output, pictures="images")
    config = replace(config, motions=48, seed=3, motion=motion, output=output)
    return data_synth.write_recording(tmp_path_factory.mktemp("smooth") / "recording", config)


def calibrated(folder, **unknowns):
    solver = {"unknowns": unknowns, "advice": {"motions": 0}, "bias_correction": False}
    return rc.calibrate(rc.load_recording(folder), parse_config({"solver": solver}), throw=False)


def edited_joints(folder, change) -> None:
    """Rewrite joints.csv with `change(header, rows)` of its texts."""
    with (folder / "joints.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    rows = change(header, rows)
    with (folder / "joints.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


@pytest.mark.slow
def test_a_wrong_clock_is_called_a_wrong_clock(smooth, tmp_path) -> None:
    folder = shutil.copytree(smooth, tmp_path / "recording")
    description = yaml.safe_load((folder / "recording.yaml").read_text())
    (folder / "recording.yaml").write_text(yaml.safe_dump(description | {"clock_offset_s": 0.35}))
    result = calibrated(folder, clock=False)
    assert not result.trustworthy
    assert "pictures and joints do not fit each other" in result.message and f"Likely: {CLOCK}" in result.message
    assert "did not move" not in result.message
    found = calibrated(folder)  # half of the motions would be lost at +0.65 s, and the rest agree with anything
    assert found.trustworthy
    assert found.kinematic_offsets.clock_s == pytest.approx(-0.35, abs=0.005)
    assert found.motions.used.all()


@pytest.mark.slow
def test_swapped_cameras_are_called_swapped(smooth, tmp_path) -> None:
    folder = shutil.copytree(smooth, tmp_path / "recording")
    (folder / "right").rename(folder / "other")
    (folder / "left").rename(folder / "right")
    (folder / "other").rename(folder / "left")
    result = calibrated(folder)
    assert not result.trustworthy
    assert result.message.partition("Likely: ")[2].startswith("the left and the right pictures look swapped")


def turned(header, rows):
    column = header.index("instrument.yaw_rad")
    return [[repr(-float(x)) if i == column else x for i, x in enumerate(row)] for row in rows]


@pytest.mark.slow
def test_what_makes_joints_and_pictures_fit_is_named(smooth, tmp_path) -> None:
    folder = shutil.copytree(smooth, tmp_path / "recording")
    edited_joints(folder, turned)
    result = calibrated(folder)
    assert not result.trustworthy and "pictures and joints do not fit each other" in result.message
    assert result.message.partition("Likely: ")[2].startswith("the sign of instrument.yaw")


@pytest.mark.slow
def test_a_joint_that_turns_the_other_way_is_named_where_only_tests_of_residuals_fail(shared_data, tmp_path) -> None:
    """One camera that stands still: either sign, or a mirror, explains everything but the contours' shape."""
    folder = shutil.copytree(shared_data / "recode_recording", tmp_path / "recording")
    edited_joints(folder, turned)
    result = rc.calibrate(rc.load_recording(folder), throw=False)
    assert not result.trustworthy
    causes = result.message.partition("Likely: ")[2]
    assert "the sign of instrument.yaw, or mirrored pictures" in causes


def test_each_supposition_changes_one_statement_back(smooth) -> None:
    recording = rc.load_recording(smooth)
    tried = {each.cause: each.recording for each in suppositions(recording, is_continuous=False)}
    arms = ("laparoscope", "instrument")
    for arm in arms:
        for joint, sign in (("yaw_rad", -1), ("pitch_rad", -1), ("insertion_mm", -1)):
            column = recording.joints.columns.index(f"{arm}.{joint}")
            words = f"the sign of {arm}.{joint.rpartition('_')[0]}"
            other = next(each for cause, each in tried.items() if cause.startswith(words))
            changed = recording.joints.values.copy()
            changed[:, column] *= sign
            np.testing.assert_array_equal(other.joints.values, changed)
    later = next(each for cause, each in tried.items() if "the joints of 1 picture later" in cause)
    before, _ = recording.joints_at_frames("instrument")
    after, known = later.joints_at_frames("instrument")
    np.testing.assert_allclose(after[:-1][known[:-1]], before[1:][known[:-1]], rtol=1e-12)
    assert known[:-1].all() and not known[-1]
    yaw, pitch = (recording.joints.columns.index(f"instrument.{name}_rad") for name in ("yaw", "pitch"))
    other = next(each for cause, each in tried.items() if cause.startswith("instrument.yaw and instrument.pitch are"))
    np.testing.assert_array_equal(other.joints.values[:, [yaw, pitch]], recording.joints.values[:, [pitch, yaw]])
    bases = [recording.robot.arms[arm].base_T_arm_base for arm in arms]
    exchanged_bases = next(each for cause, each in tried.items() if cause.startswith("the bases"))
    assert all(
        exchanged_bases.robot.arms[arm].base_T_arm_base is base for arm, base in zip(arms, bases[::-1], strict=True)
    )


@pytest.mark.slow
def test_frozen_pictures_are_left_out_and_said(smooth, tmp_path) -> None:
    folder = shutil.copytree(smooth, tmp_path / "recording")
    for side in ("right", "left"):
        files = sorted((folder / side).iterdir())
        for number in range(16, 34):
            shutil.copy(files[15], files[number])
    result = calibrated(folder)
    reason = "the picture repeats the one before although the joints moved"
    frozen = [i for i, why in enumerate(result.motions.reasons) if why == reason]
    assert set(range(19, 34)) <= set(frozen) <= set(range(16, 34))
    assert not result.motions.used[frozen].any()
    assert any("pictures repeat the one before although the joints moved (frames " in note for note in result.notes)


@pytest.mark.slow
def test_arms_at_rest_may_show_the_same_picture_again(smooth, tmp_path) -> None:
    folder = shutil.copytree(smooth, tmp_path / "recording")
    edited_joints(folder, lambda header, rows: [[row[0], *rows[0][1:]] for row in rows])
    for side in ("right", "left"):
        files = sorted((folder / side).iterdir())
        for path in files[1:]:
            shutil.copy(files[0], path)
    result = calibrated(folder)
    assert not any("repeat" in note for note in result.notes)
