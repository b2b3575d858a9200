"""Advice in words: within the joints' limits, in the field of view, and true when it is followed."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from measured_from_truth import SMALL, observations_from_truth
from pydantic import TypeAdapter

import data_synth
import rmis_calib as rc
from data_synth.scene import build_scene
from data_synth.settings import SceneSettings
from rmis_calib.config import parse_config
from rmis_calib.pipeline.answer.advice.joint_candidates import joint_box, joint_candidates
from rmis_calib.pipeline.answer.advice.next_motions import camera_view, seen_view, with_advice
from rmis_calib.pipeline.answer.estimation import estimate, problem_of
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.arms.poses import motion_poses
from rmis_calib.solver.assess.observability import assess
from rmis_calib.solver.observability import Observability

SIGMA_PX = 0.2
CONFIG = parse_config(
    {"picture_errors": {"edge_bias_px": 0.0}, "solver": {"bias_correction": False, "advice": {"candidates": 200}}}
)


def written(path, laparoscope="static", motions=14):
    """A recording of small motions with small pictures: only its truth is used."""
    config = {
        "motions": motions,
        "seed": 3,
        "camera": {"width_px": 160, "height_px": 120, "right": SMALL, "left": None},
        "motion": {"laparoscope": laparoscope, "rotation_range_deg": 2.0, "translation_range_mm": 4.0},
        "noise": {"kinematics_mm": 0.0, "kinematics_deg": 0.0},
    }
    data_synth.write_recording(path, data_synth.load_synth_config(config))
    return path


@pytest.fixture(scope="module")
def weak(tmp_path_factory):
    """Recording, its kinematics and what a detector would measure in it."""
    path = written(tmp_path_factory.mktemp("weak") / "recording")
    recording = rc.load_recording(path)
    poses = motion_poses(recording)
    return (
        recording,
        KinematicUnknowns(recording, poses.frames, "cpu"),
        observations_from_truth(path, recording, poses, SIGMA_PX),
    )


def advised(weak, config=CONFIG):
    recording, unknowns, seen = weak
    solution = estimate(seen, config)
    problem = problem_of(seen, config)
    used = np.ones(problem.n_motions, dtype=bool)
    candidates = joint_candidates(recording, unknowns, problem, solution, used, config.solver.advice, seed=0)
    view = camera_view(recording.stereo.right)[None]
    seen = solution.observability.describe()
    return candidates, with_advice(seen, solution, candidates, view, config, "within reach"), solution


def test_motions_stay_within_reach_and_limits(weak):
    recording, unknowns, _ = weak
    logged = unknowns.readings_of_motions().numpy()
    settings = CONFIG.solver.advice
    low, high = joint_box(recording, unknowns.columns, logged, settings)
    mm = np.array([column.endswith("_mm") for column in unknowns.columns])
    reach = np.where(mm, 30.0, np.deg2rad(15.0))
    np.testing.assert_allclose(low, logged.min(0) - reach)
    np.testing.assert_allclose(high, logged.max(0) + reach)
    name = unknowns.columns[-1]
    limited = with_limits(recording, name, 150.0, 170.0)
    low, high = joint_box(limited, unknowns.columns, logged, settings)
    assert (low[-1], high[-1]) == (150.0, 170.0)
    candidates, record, _ = advised((limited, *weak[1:]))
    assert candidates.joints is not None
    low, high = joint_box(limited, unknowns.columns, logged, settings)
    assert bool(((candidates.joints >= low - 1e-9) & (candidates.joints <= high + 1e-9)).all())
    assert all(150.0 <= motion.joints[name] <= 170.0 for motion in record.next_motions)


def with_limits(recording, column, least, greatest):
    """The recording with a robot whose joint has limits."""
    arms = dict(recording.robot.arms)
    arm = arms["instrument"]
    joints = tuple(
        replace(joint, min=least, max=greatest) if f"instrument.{joint.name}_{joint.unit}" == column else joint
        for joint in arm.joints
    )
    robot = replace(recording.robot, arms=arms | {"instrument": replace(arm, joints=joints)})
    return replace(recording, robot=robot)


def test_readings_keep_the_shaft_in_the_true_camera(weak):
    """The advised readings, put into the independent kinematics."""
    _, record, _ = advised(weak)
    scene = build_scene(SceneSettings())
    for motion in record.next_motions:
        readings = np.array(list(motion.joints.values()))
        shaft = scene.instrument.shaft(readings[3:])
        base_T_camera = scene.laparoscope.tool(readings[:3]) @ np.linalg.inv(scene.camera_right_T_arm)
        camera_T_rcm = np.linalg.inv(base_T_camera) @ shaft.base_T_rcm
        s = np.linspace(0.0, shaft.rcm_s_end_mm + scene.shaft_end_offset_mm, 200)
        q = camera_T_rcm[:3, 3] + s[:, None] * (camera_T_rcm[:3, :3] @ shaft.rcm_v_axis)
        uv = q[:, :2] / q[:, 2:] * 175.0 + np.array([80.0, 60.0])
        inside = (q[:, 2] > 0.0) & ((uv >= 0.0) & (uv <= np.array([159.0, 119.0]))).all(axis=1)
        assert inside.mean() * s[-1] > 10.0


def test_words_name_joints_readings_and_what_is_gained(weak):
    candidates, record, solution = advised(weak)
    first, motion = record.advice[0], record.next_motions[0]
    assert solution.observability.describe().directions[0].words in first
    assert candidates.joints is not None
    index = candidates.words.index(motion.words)
    assert motion.words in first
    assert list(motion.joints.values()) == candidates.joints[index].tolist()
    moves = re.findall(r"(laparoscope|instrument)\.(\w+) from (-?[\d.]+) to (-?[\d.]+) (deg|mm)", first)
    assert moves
    for arm, joint, _, after, unit in moves:
        value = motion.joints[f"{arm}.{joint}_{'mm' if unit == 'mm' else 'rad'}"]
        assert float(after) == pytest.approx(value if unit == "mm" else np.rad2deg(value), abs=0.06)
    sigmas = [motion.weakest_sigma_mm for motion in record.next_motions]
    assert sigmas[0] < 0.5 * solution.observability.describe().directions[0].sigma_at_working_point_mm
    assert sigmas == sorted(sigmas, reverse=True)
    json.dumps(TypeAdapter(Observability).dump_python(record, mode="json"), allow_nan=False)


def test_axis_lines_of_a_still_laparoscope_need_the_laparoscope_to_move(weak):
    """Without a radius the instrument alone can never tell the translation along the view."""
    config = parse_config({"measurements": ["axis"], "solver": {"advice": {"motions": 1}}})
    _, record, solution = advised(weak, config)
    assert "STATIC_LAPAROSCOPE" in solution.observability.describe().named_cases
    assert all("laparoscope." in motion.words for motion in record.next_motions)
    assert "In general: move the laparoscope's arm as well, with its joints logged." in record.advice


def test_an_observations_file_gets_advice_as_the_picture_shows_it(weak):
    result = rc.solve(weak[2], CONFIG, throw=False)
    advice = result.observability.advice
    assert re.search(r"(swing|insert|withdraw|turn) the (instrument|laparoscope)", advice[0])
    assert any("holds no joints" in sentence for sentence in advice)
    assert all(motion.joints is None for motion in result.observability.next_motions)
    again = type(result).from_dict(json.loads(json.dumps(result.to_dict(), allow_nan=False)))
    assert again.observability.advice == advice


def test_no_advice_where_none_is_wanted_or_no_estimate_predicts(weak):
    quiet = parse_config({"picture_errors": {"edge_bias_px": 0.0}, "solver": {"advice": {"motions": 0}}})
    assert not rc.solve(weak[2], quiet, throw=False).observability.advice
    two_step = parse_config({"solver": {"method": "global"}})
    assert not rc.solve(weak[2], two_step, throw=False).observability.advice


def test_views_of_a_camera_and_of_measurements(weak):
    camera = weak[0].stereo.right
    x0, y0, x1, y1 = camera_view(camera).tolist()
    # 5 per cent of 159 px and of 119 px on every side, over f = 175 px, about (80, 60).
    np.testing.assert_allclose([x0, x1], [(0.05 * 159 - 80) / 175, (0.95 * 159 - 80) / 175])
    np.testing.assert_allclose([y0, y1], [(0.05 * 119 - 60) / 175, (0.95 * 119 - 60) / 175])
    barrel = replace(camera, distortion=torch.tensor([-0.3, 0.1, 0.0, 0.0, 0.0], dtype=torch.float64))
    assert camera_view(barrel)[0] < x0  # a barrel picture shows more
    problem = problem_of(weak[2], CONFIG).flatten_batch()
    least, greatest = seen_view(problem)[0, :2], seen_view(problem)[0, 2:]
    points = torch.as_tensor(weak[2].contour_right).flatten(0, 2)
    assert bool((least <= points.amin(0)).all() & (greatest >= points.amax(0)).all())


def test_motions_advised_together_are_distinct(weak):
    """A motion that shrinks the most twice over is still one motion to whoever moves the arms."""
    config = parse_config(
        {
            "picture_errors": {"edge_bias_px": 0.0},
            "solver": {"bias_correction": False, "advice": {"candidates": 200, "motions": 5}},
        }
    )
    _, record, _ = advised(weak, config)
    words = [motion.words for motion in record.next_motions]
    assert len(words) > 1
    assert len(set(words)) == len(words)


def test_the_number_in_words_is_the_number_in_the_bar(weak):
    """The bar shows the result's own sigmas (`observability.directions`), the sentence must start from the first."""
    recording, unknowns, seen = weak
    solution = estimate(seen, CONFIG)
    allowance = 0.3**2 * torch.eye(6, dtype=torch.float64)  # as for joint offsets that nobody saw
    allowance[:3, :3] *= 1e-4
    used = np.ones(len(seen.arm_T_rcm), dtype=bool)
    problem = problem_of(seen, CONFIG)
    X, covariance = solution.camera_right_T_arm[None], solution.covariance[None] + allowance
    verdict, degeneracy = CONFIG.solver.verdict, solution.observability.degeneracy
    allowed = assess(problem.flatten_batch(), X[:, :3, :3], X[:, :3, 3], covariance, verdict, degeneracy)
    widened = replace(solution, covariance=covariance[0], observability=allowed)
    candidates = joint_candidates(recording, unknowns, problem, widened, used, CONFIG.solver.advice, seed=0)
    view = camera_view(recording.stereo.right)[None]
    for case in (solution, widened):
        record = with_advice(case.observability.describe(), case, candidates, view, CONFIG, "within reach")
        bar = case.observability.describe().directions[0].sigma_at_working_point_mm
        said = re.search(r"shrinks from ([\d.]+) mm to ([\d.]+) mm", record.advice[0])
        assert said is not None, record.advice[0]
        assert float(said[1]) == pytest.approx(bar, rel=0.06)
        assert float(said[2]) == pytest.approx(record.next_motions[0].weakest_sigma_mm, rel=0.06)
