"""Joint offsets and clock of an observations file: the same answer as with the kinematics at hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from measured_from_truth import SMALL, observations_from_truth

import data_synth
import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.errors import ObservationsError
from rmis_calib.geometry.rotations import rotation_angle
from rmis_calib.pipeline.answer.estimation import estimate_with_kinematics
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.arms.offset_unknowns import FileUnknowns, estimated_offsets
from rmis_calib.pipeline.arms.poses import motion_poses
from rmis_calib.solver import Problem

CLOCK_S = 0.12
ALWAYS = parse_config({"clock_search_s": 0.3, "solver": {"unknowns": {"joint_offsets": "always"}}})


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """Solved with the kinematics; and the observations as `calibrate` writes them, read back from a file."""
    folder = tmp_path_factory.mktemp("offsets")
    config = {
        "motions": 60,
        "seed": 8,
        "camera": {"width_px": 160, "height_px": 120, "right": SMALL, "left": None},
        "motion": {"kind": "smooth", "frame_rate_hz": 4.0, "joint_rate_hz": 100.0},
        # Noise of a robot (the default): of joints without any, the levels of a few micrometres are ambiguous.
        "noise": {"clock_offset_s": CLOCK_S, "joint_offset_deg": 0.3},
    }
    data_synth.write_recording(folder / "recording", data_synth.load_synth_config(config))
    recording = rc.load_recording(folder / "recording", clock_offset_s=0.0)
    poses = motion_poses(recording)
    unknowns = KinematicUnknowns(recording, poses.frames, "cpu")
    solution, _ = estimate_with_kinematics(
        observations_from_truth(folder / "recording", recording, poses), ALWAYS, unknowns
    )
    offsets = estimated_offsets(solution, unknowns.columns, poses.rcm_s_end_mm)
    there, _ = unknowns.motion_poses(poses.frames, *offsets)
    seen = replace(observations_from_truth(folder / "recording", recording, there), **unknowns.displacements(*offsets))
    seen.save(folder / "observations.npz")
    return solution, rc.ShaftObservations.load(folder / "observations.npz"), unknowns, folder / "recording"


def test_the_file_gives_the_answer_of_the_kinematics(solved):
    first, seen, unknowns, _ = solved
    again = rc.solve(seen, ALWAYS, throw=False)
    turn = rotation_angle(again.camera_right_T_arm.R @ first.camera_right_T_arm[:3, :3].mT)
    shift = torch.linalg.vector_norm(again.camera_right_T_arm.t - first.camera_right_T_arm[:3, 3])
    assert float(torch.rad2deg(turn)) < 2e-3  # the stated tolerance: 0.002 deg and 0.005 mm
    assert float(shift) < 5e-3
    sigma = first.covariance.diagonal().sqrt().numpy()  # a correlation of 1e-4 is no number to compare by ratio
    both = (C / np.outer(sigma, sigma) for C in (again.covariance, first.covariance.numpy()))
    np.testing.assert_allclose(*both, rtol=0.0, atol=2e-3)
    offsets = first.nuisances["joint_offset"]
    for column, value, sigma in zip(unknowns.columns, offsets.value, offsets.sigma, strict=True):
        record = again.nuisances[f"joint_offset {column.rpartition('_')[0]}"]
        assert record.value == pytest.approx(float(value), abs=0.02 * float(sigma) + 1e-9)
        assert record.unit == column.rpartition("_")[2]
    assert again.nuisances["clock"].value == pytest.approx(CLOCK_S, abs=0.01)


def test_offsets_of_the_file_are_those_of_the_truth_or_held(solved):
    _, seen, unknowns, path = solved
    again = rc.solve(seen, ALWAYS, throw=False)
    truth = yaml.safe_load((path / "ground_truth.yaml").read_text())["joint_offsets"]
    records = [again.nuisances[f"joint_offset {column.rpartition('_')[0]}"] for column in unknowns.columns]
    free = [not record.held for record in records]
    assert any(free)
    for column, record, is_free in zip(unknowns.columns, records, free, strict=True):
        assert not is_free or abs(record.value - truth[column]) < 4.0 * record.sigma


def test_first_order_displacement_is_that_of_the_kinematics(solved):
    _, seen, unknowns, path = solved
    recording = rc.load_recording(path, clock_offset_s=0.0)
    poses = motion_poses(recording)
    base = Problem.from_observations(seen).flatten_batch()
    step = torch.full((1, len(unknowns.columns)), 2e-4, dtype=torch.float64)
    at = torch.as_tensor(seen.unknown_at)
    joints, (offset_s, rate) = at[:-2], at[-2:].tolist()
    moved = (offset_s + 1e-3, rate + 1e-4)  # 0.75 ms at the ends
    file = FileUnknowns(seen, "cpu").at(base, joints + step, torch.tensor([moved], dtype=torch.float64))
    there, _ = unknowns.motion_poses(poses.frames, joints + step[0], moved)

    def point(T, v, s):
        return (T[..., :3, :3] @ (v * s[..., None])[..., None])[..., 0] + T[..., :3, 3]

    for s in (0.0, 100.0):
        # The file displaces the shaft as a rigid body: slides along it change the frame instead of s_end.
        along = torch.full_like(there.rcm_s_end_mm, s)
        a = point(file.arm_T_rcm[0], file.rcm_v_axis[0], file.rcm_s_end_mm[0] - 100.0 + along)
        b = point(there.arm_T_rcm, there.rcm_v_axis, there.rcm_s_end_mm - 100.0 + along)
        assert float((a - b).norm(dim=-1).max()) < 2e-3  # second order of the steps, times a lever of 200 mm


def test_what_is_asked_for_and_not_in_the_file_is_named(solved):
    _, seen, _, _ = solved
    bare = replace(seen, unknown_names=None, unknown_displacement=None, unknown_at=None)
    with pytest.raises(ObservationsError, match="unknown_names, unknown_displacement and unknown_at with joints"):
        rc.solve(bare, ALWAYS)
    never = parse_config({"solver": {"unknowns": {"joint_offsets": "never", "clock": False}}})
    assert not any("joint_offset" in name for name in rc.solve(seen, never, throw=False).nuisances)


def test_an_offset_of_no_effect_changes_nothing(solved):
    """Pictures taken at rest: the clock's effect is rounding, 1e-25 of anything."""
    _, seen, _, _ = solved
    config = parse_config({"solver": {"unknowns": {"joint_offsets": "never"}}})
    displacement = 1e-25 * np.random.default_rng(0).standard_normal((seen.n_motions, 1, 6))
    names, at = np.array(["clock_s"]), np.array([2e-15])
    still = rc.solve(
        replace(seen, unknown_names=names, unknown_displacement=displacement, unknown_at=at), config, throw=False
    )
    bare = rc.solve(replace(seen, unknown_names=None, unknown_displacement=None, unknown_at=None), config, throw=False)
    np.testing.assert_allclose(still.covariance, bare.covariance, rtol=1e-6)
    np.testing.assert_allclose(still.camera_right_T_arm.matrix, bare.camera_right_T_arm.matrix, atol=1e-8)
    assert still.nuisances["clock"].held


def test_the_table_of_another_tool_is_named(solved):
    """Wrists of two families of instruments are about 50 mm apart: the ends of the shaft tell."""
    _, seen, _, _ = solved
    other = replace(seen, rcm_s_end_mm=seen.rcm_s_end_mm + 50.0)

    def sentences(observations):
        return rc.solve(observations, throw=False).observability.sentences

    assert any("mm before the place" in words and "another tool" in words for words in sentences(other))
    assert not any("another tool" in words for words in sentences(seen))


def test_what_the_robot_states_of_its_encoders_wins(solved, tmp_path):
    """Exact encoders are believed; others have the prior that is stated, in the recording and in the file alike."""
    _, seen, unknowns, path = solved
    recording = rc.load_recording(path, clock_offset_s=CLOCK_S)
    arms = {
        name: replace(arm, joints=tuple(replace(joint, offset_sigma=0.002) for joint in arm.joints))
        for name, arm in recording.robot.arms.items()
    }
    stated = replace(recording, robot=replace(recording.robot, arms=arms))
    told = KinematicUnknowns(stated, motion_poses(stated).frames, "cpu")
    settings = parse_config({}).solver.unknowns
    moves = told.moves_shaft()
    assert bool((told.prior_sigma(settings)[moves] == 0.002).all())
    assert bool((unknowns.prior_sigma(settings)[moves] > 0.005).all())
    zero = torch.zeros(len(told.columns), dtype=torch.float64)
    replace(seen, **told.displacements(zero)).save(tmp_path / "told.npz")
    read = FileUnknowns(rc.ShaftObservations.load(tmp_path / "told.npz"), "cpu")
    torch.testing.assert_close(read.stated_sigma, told.stated_sigma)
    exact = replace(seen, unknown_sigma=np.zeros(len(seen.unknown_names)))
    believed = rc.solve(exact, parse_config({"clock_search_s": 0.3}), throw=False)
    never = rc.solve(
        seen, parse_config({"clock_search_s": 0.3, "solver": {"unknowns": {"joint_offsets": "never"}}}), throw=False
    )
    np.testing.assert_allclose(believed.covariance, never.covariance, rtol=1e-9)
    assert not any(name.startswith("joint_offset") for name in believed.nuisances)
