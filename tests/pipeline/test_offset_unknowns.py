"""Joint and clock offsets: derivatives against finite displacements, and recovery of what the generator put in."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from measured_from_truth import SMALL, observations_from_truth

import data_synth
import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.geometry.rigid import rigid_inverse
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.pipeline.answer.estimation import estimate_with_kinematics
from rmis_calib.pipeline.answer.offsets import _about_offsets, _clock_start
from rmis_calib.pipeline.arms import kinematic_unknowns
from rmis_calib.pipeline.arms.found_offsets import poses_at
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.arms.poses import motion_poses
from rmis_calib.results import KinematicOffsets
from rmis_calib.solver.solution import Nuisance

CLOCK_S = 0.72


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """A continuous recording, its joints on a clock 0.72 s from the pictures'; small pictures: only truth is used."""
    path = tmp_path_factory.mktemp("moving") / "recording"
    config = {
        "motions": 240,
        "seed": 8,
        "camera": {"width_px": 160, "height_px": 120, "right": SMALL, "left": None},
        "motion": {"kind": "smooth", "frame_rate_hz": 20.0, "joint_rate_hz": 100.0},
        "noise": {"kinematics_mm": 0.0, "kinematics_deg": 0.0, "clock_offset_s": CLOCK_S, "joint_offset_deg": 0.3},
    }
    data_synth.write_recording(path, data_synth.load_synth_config(config))
    return path


def test_derivative_is_the_displacement_of_the_shaft(moving):
    recording = rc.load_recording(moving)
    poses = motion_poses(recording)
    unknowns = KinematicUnknowns(recording, poses.frames, "cpu")
    problem = rc_problem(observations_from_truth(moving, recording, poses))
    sigma = unknowns.prior_sigma(parse_config({}).solver.unknowns)
    zero = torch.zeros(1, len(sigma), dtype=torch.float64)
    here = unknowns.linearised(problem, zero, torch.zeros(1, 2, dtype=torch.float64), sigma)
    for joint in range(len(sigma)):
        step = 1e-4 * torch.eye(len(sigma), dtype=torch.float64)[joint]
        there, _ = unknowns.motion_poses(poses.frames, step)
        T, moved = here.arm_T_rcm[0], there.arm_T_rcm
        omega = matrix_to_rotvec((rigid_inverse(T) @ moved)[:, :3, :3])
        shift = (T[:, :3, :3].mT @ (moved - T)[:, :3, 3:])[..., 0]
        v = here.rcm_v_axis[0]
        omega = omega + torch.linalg.cross(v, there.rcm_v_axis - v)
        shift = shift + v * (there.rcm_s_end_mm - here.rcm_s_end_mm[0])[:, None]
        expected = torch.cat([omega, shift], dim=-1) / 1e-4
        # A forward difference is wrong by step times half the second derivative: 1e-4 of the size of the displacement.
        torch.testing.assert_close(
            here.joint_derivative[0, :, :, joint], expected, atol=1e-3 * float(expected.abs().max()), rtol=0.0
        )


def test_parts_of_a_recording_give_the_same_as_the_whole(moving, monkeypatch):
    recording = rc.load_recording(moving)
    poses = motion_poses(recording)
    unknowns = KinematicUnknowns(recording, poses.frames, "cpu")
    zero, clock = (torch.zeros(2, width, dtype=torch.float64) for width in (len(unknowns.columns), 2))
    derivative = unknowns.joint_derivative(zero, clock)
    arm_T_rcm = unknowns.motion_poses(poses.frames, zero[0])[0].arm_T_rcm
    monkeypatch.setattr(kinematic_unknowns, "_AT_ONCE", 100)
    torch.testing.assert_close(unknowns.joint_derivative(zero, clock), derivative, rtol=1e-9, atol=1e-9)
    again = unknowns.motion_poses(poses.frames, zero[0])[0].arm_T_rcm
    torch.testing.assert_close(again, arm_T_rcm, rtol=1e-12, atol=1e-12)


def test_motions_outside_of_the_log_are_not_known(moving):
    recording = rc.load_recording(moving, clock_offset_s=0.0)
    poses = motion_poses(recording)
    unknowns = KinematicUnknowns(recording, poses.frames, "cpu")
    late_s = float(recording.joints.timestamps_s[-1] - recording.frame_times_s[poses.frames[-4]])
    zero = torch.zeros(len(unknowns.columns), dtype=torch.float64)
    _, known = unknowns.motion_poses(poses.frames, zero, (late_s, 0.0))
    assert known.tolist() == [True] * (len(poses.frames) - 3) + [False] * 3


def rc_problem(observations):
    from rmis_calib.solver import Problem

    return Problem.from_observations(observations).flatten_batch()


def test_clock_offset_is_found_from_most_of_a_second_away(moving):
    recording = rc.load_recording(moving, clock_offset_s=0.0)
    poses = motion_poses(recording)
    unknowns = KinematicUnknowns(recording, poses.frames, "cpu")
    observations = observations_from_truth(moving, recording, poses)
    solution, _ = estimate_with_kinematics(observations, parse_config({}), unknowns)
    clock = solution.nuisances["clock"]
    assert float(clock.value) == pytest.approx(CLOCK_S, abs=0.01)
    assert not bool(clock.held)
    again, _ = estimate_with_kinematics(observations, parse_config({}), unknowns, (float(clock.value), 0.0))
    moved = again.camera_right_T_arm[:3, 3] - solution.camera_right_T_arm[:3, 3]
    assert float(moved.norm()) < 0.05 * float(solution.translation_sigma_mm)  # what ends relinearisation
    assert float((again.nuisances["clock"].value - clock.value).abs()) < 0.05 * float(clock.sigma)


def test_the_clock_is_searched_for_whatever_the_answer_may_use(moving):
    recording = rc.load_recording(moving, clock_offset_s=0.0)
    poses = motion_poses(recording)
    unknowns = KinematicUnknowns(recording, poses.frames, "cpu")
    config, like = parse_config({"measurements": ["contours"]}), torch.zeros(len(unknowns.columns), dtype=torch.float64)
    start_s, rate = _clock_start(observations_from_truth(moving, recording, poses), config, unknowns, like)
    assert start_s == pytest.approx(CLOCK_S, abs=0.03)
    assert rate == 0.0


def test_what_the_transform_absorbs_of_joint_offsets_is_said():
    """Two joints of which only the sum shows, one that shows nothing, and a wrist's that moves nothing."""
    columns = ("laparoscope.yaw_rad", "instrument.yaw_rad", "laparoscope.insertion_mm", "instrument.wrist_rad")
    value = torch.zeros(4, dtype=torch.float64)
    unseen = torch.zeros(4, 4, dtype=torch.float64)
    unseen[:2, :2] = torch.tensor([[0.5, -0.5], [-0.5, 0.5]])
    unseen[2, 2] = 1.0
    held = torch.tensor([False, False, True, True])
    offsets = Nuisance(value, value + 1e-3, "rad or mm", held, value, unseen)
    said = _about_offsets(offsets, unseen, torch.tensor([True, True, True, False]), columns, "")
    assert "those of laparoscope.insertion cannot be separated from the transform" in said
    assert "a combination of those of laparoscope.yaw, instrument.yaw cannot be separated from the transform" in said
    assert "wrist" not in said


@pytest.mark.parametrize("wrong", [0.01, -0.03])
def test_a_frame_rate_that_is_written_wrong_is_found(moving, wrong):
    """12 s: 3 % is 0.18 s at either end, beside an offset of 0.72 s."""
    recording = rc.load_recording(moving, clock_offset_s=0.0)
    times_s = recording.frame_times_s
    stretched = replace(recording, frame_times_s=times_s[0] + (times_s - times_s[0]) * (1.0 + wrong))
    poses = motion_poses(stretched)
    unknowns = KinematicUnknowns(stretched, poses.frames, "cpu")
    config = parse_config({"solver": {"unknowns": {"joint_offsets": "never"}, "bias_correction": False}})
    solution, notes = estimate_with_kinematics(observations_from_truth(moving, stretched, poses), config, unknowns)
    rate = solution.nuisances["clock_rate"]
    # By hand: written times pass 1 + wrong as fast as the joints'.
    assert float(rate.value) == pytest.approx(1.0 / (1.0 + wrong) - 1.0, abs=5e-4)
    assert "frame rate written wrong" in notes[0]
    # One function for all who predict: at the offsets found, the joints are read when they were.
    found = KinematicOffsets({}, float(solution.nuisances["clock"].value), (0.0, 0.0), None, float(rate.value))
    at = poses_at(stretched, found)
    true = motion_poses(rc.load_recording(moving, clock_offset_s=CLOCK_S))
    both = np.isin(true.frames, at.frames)
    gap = true.arm_T_rcm[both] - at.arm_T_rcm[np.isin(at.frames, true.frames)]
    assert float(gap[:, :3, 3].abs().max()) < 0.3  # 5 ms at 60 mm/s


def test_joint_offsets_are_found_within_their_sigmas_or_held(moving):
    recording = rc.load_recording(moving, clock_offset_s=CLOCK_S)
    poses = motion_poses(recording)
    unknowns = KinematicUnknowns(recording, poses.frames, "cpu")
    observations = observations_from_truth(moving, recording, poses)
    config = parse_config({"solver": {"unknowns": {"joint_offsets": "always", "clock": False}}})
    solution, _ = estimate_with_kinematics(observations, config, unknowns)
    offsets = solution.nuisances["joint_offset"]
    truth = yaml.safe_load((moving / "ground_truth.yaml").read_text())["joint_offsets"]
    expected = torch.tensor([truth[column] for column in unknowns.columns], dtype=torch.float64)
    free = ~offsets.held
    assert bool(free.any())
    assert bool(((offsets.value - expected).abs() < 4.0 * offsets.sigma)[free].all())
