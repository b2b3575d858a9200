"""Advice on the next motion, in words: candidates from both arms' joints, or, without kinematics, from the picture.

Joints stay within their limits and near to what the recording shows, since nobody has seen what is beyond; the shaft
stays in the field of view. Without kinematics (an observations file) the instrument swings about its RCM and slides
along its shaft; the laparoscope swings about a pivot behind the camera on the viewing axis, slides along that axis and
rolls about it: what an arm with a remote centre can do to a 0 degree endoscope, near enough to tell which motion is
worth making. The estimate that predicts all this is the present one.
"""

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.cameras import Camera
from rmis_calib.geometry.rigid import rigid_from_rotation_translation, rigid_inverse
from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.io import Recording
from rmis_calib.pipeline.answer.result import used_motions
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.arms.offset_unknowns import estimated_offsets
from rmis_calib.pipeline.motions.observations import problem_of
from rmis_calib.pipeline.words import joined
from rmis_calib.results import INSTRUMENT_BASE
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Problem, Solution, SolveStatus
from rmis_calib.solver.assess.next_motion import Advice, advise, measured_alike
from rmis_calib.solver.observability import NextMotion, Observability, Verdict
from rmis_calib.solver.settings import AdviceSettings

VIEW_MARGIN = 0.05
"""Part of the picture's width and height that is left free on every side: the estimate is not exact."""
_BORDER_SAMPLES = 33
_PLACES_ALONE, _PLACES_OF_TWO = 9, 5
"""Readings tried of each joint that moves alone, and of each of two that move together."""
_CHANGED = {"rad": 0.005, "mm": 0.25}
"""A smaller change of a reading is none."""
_PREDICTS = (SolveStatus.CONVERGED, SolveStatus.SINGULAR, SolveStatus.MAX_ITERATIONS, SolveStatus.STALLED)
"""How a solve must have ended for its estimate to predict anything."""
PIVOT_BEHIND_MM = 120.0
"""Assumed distance of the laparoscope's trocar behind the camera."""
WHERE = (
    "near the last motion (an observations file holds no joints, so motions are described as the right image shows "
    "them; a motion of the laparoscope counts only if its arm is logged)"
)
_LEAST_ACROSS = 0.5
"""Sine to the shaft below which a direction of the picture is none in which the tip could swing."""
_SIDES = {
    "to the right": (1.0, 0.0, 0.0),
    "to the left": (-1.0, 0.0, 0.0),
    "down": (0.0, 1.0, 0.0),
    "up": (0.0, -1.0, 0.0),
    "away from the camera": (0.0, 0.0, 1.0),
    "towards the camera": (0.0, 0.0, -1.0),
}
"""Directions in `camera_right`."""
_TURNS = {
    "to the right": (0.0, 1.0, 0.0),
    "to the left": (0.0, -1.0, 0.0),
    "up": (1.0, 0.0, 0.0),
    "down": (-1.0, 0.0, 0.0),
    "clockwise": (0.0, 0.0, 1.0),
    "anticlockwise": (0.0, 0.0, -1.0),
}
"""Axes in `camera_right` (y points down) about which the view turns that way."""
_PARTS = (0.5, 1.0)
"""Parts of the reach that are tried."""
Words = tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Candidates:
    """Motions to choose from.

    Attributes:
        problem: their poses, and what the cameras would measure (`measured_alike`).
        effort: number of things that move.
        words: what to do for each.
        joints: (m, j) readings, where the joints are known.
        columns: their names.
    """

    problem: Problem
    effort: Int[Tensor, " m"]
    words: tuple[str, ...]
    joints: np.ndarray | None = None
    columns: tuple[str, ...] = ()


def may_advise(solution: Solution, config: CalibrationConfig) -> bool:
    """Whether there is an estimate that predicts what a motion would tell, and advice is wanted."""
    predicts = solution.posterior is not None and SolveStatus(int(solution.status)) in _PREDICTS
    return predicts and config.solver.advice.motions > 0


def with_next_motions(run: CalibrationRun, config: CalibrationConfig) -> CalibrationRun:
    """The run with the motions in its result that would help most."""
    if run.observations is None or run.solution is None or not may_advise(run.solution, config):
        return run
    problem = at_found_setup(problem_of(run.observations, config).flatten_batch(), run.solution)
    used, _ = used_motions(run.solution)
    unknowns = KinematicUnknowns(run.recording, run.poses.frames, config.device)
    settings, seed = config.solver.advice, config.solver.seed
    candidates = joint_candidates(run.recording, unknowns, problem, run.solution, used, settings, seed=seed)
    stereo = run.recording.stereo
    cameras = [camera for camera in (stereo.right, stereo.left) if camera is not None][: problem.n_cameras]
    view = torch.stack([camera_view(camera) for camera in cameras]).to(config.device)
    limits = limits_in_words(settings)
    observability = with_advice(run.result.observability, run.solution, candidates, view, config, limits)
    return replace(run, result=replace(run.result, observability=observability))


def with_advice(
    observability: Observability,
    solution: Solution,
    candidates: Candidates,
    view: Float[Tensor, "c 4"],
    config: CalibrationConfig,
    where: str,
) -> Observability:
    """With `advice` (sentences) and `next_motions` (the same as values).

    Args:
        observability: of the result.
        solution: one trial of which `may_advise` is true.
        candidates: motions to choose from.
        view: field of view of each camera (`advise`).
        config: of the estimate.
        where: to what the candidates were limited, to end the advice with.
    """
    if solution.posterior is None:
        return observability
    point = solution.observability.working_point_mm[0]
    reported = solution.covariance.reshape(6, 6)
    advice = advise(candidates.problem, solution.posterior, point, view, config.solver, candidates.effort, reported)
    trusted = observability.verdict is Verdict.TRUSTWORTHY
    general = () if trusted else solution.observability.remedies()
    return replace(
        observability,
        advice=(*_sentences(solution, candidates, advice, where), *(f"In general: {words}." for words in general)),
        next_motions=tuple(_next_motion(candidates, advice, step) for step in range(len(advice.chosen))),
    )


def _sentences(solution: Solution, candidates: Candidates, advice: Advice, where: str) -> list[str]:
    if not len(advice.chosen):
        return [f"The present estimate predicts no motion {where} that would keep the shaft in view."]
    name = solution.observability.describe().directions[0].words
    sigma = [_mm(value) for value in advice.weakest_mm.tolist()]
    out = []
    for step, index in enumerate(advice.chosen.tolist()):
        what = candidates.words[index]
        if step == 0:
            out.append(
                f"First {what}. Predicted: the weakest direction, {name}, shrinks from {sigma[0]} to "
                f"{sigma[1]} (1 sigma at the working point)."
            )
        else:
            out.append(f"Then {what}: {sigma[step + 1]} in the weakest direction.")
    return [*out, f"These motions stay {where}, with the shaft in view as far as the present estimate can tell."]


def _mm(value: float) -> str:
    """Two digits, as in the report."""
    if value > 1e3:
        return "more than 1 m"
    return f"{value:.{max(1 - math.floor(math.log10(max(value, 1e-4))), 0)}f} mm"


def _next_motion(candidates: Candidates, advice: Advice, step: int) -> NextMotion:
    index = int(advice.chosen[step])
    joints = None
    if candidates.joints is not None:
        joints = dict(zip(candidates.columns, candidates.joints[index].tolist(), strict=True))
    return NextMotion(
        words=candidates.words[index],
        joints=joints,
        weakest_sigma_mm=float(advice.weakest_mm[step + 1]),
        working_point_sigma_mm=float(advice.point_mm[step + 1]),
    )


def joint_candidates(
    recording: Recording,
    unknowns: KinematicUnknowns,
    problem: Problem,
    solution: Solution,
    used: Bool[np.ndarray, " m"],
    settings: AdviceSettings,
    seed: int,
) -> Candidates:
    """Motions of one joint, of two, and of any number, about the last motion of the recording that was used.

    Args:
        recording: for the robot's limits.
        unknowns: kinematics of the motions.
        problem: what was solved, one trial.
        solution: its answer, whose joint and clock offsets the kinematics are evaluated at.
        used: whether each motion was used.
        settings: how far joints may go.
        seed: of the random ones.
    """
    joint_offset, clock = estimated_offsets(solution, unknowns.columns, problem.arm_T_rcm)
    logged = unknowns.readings_of_motions(clock).cpu().numpy()
    low, high = joint_box(recording, unknowns.columns, logged, settings)
    home = logged[np.flatnonzero(used)[-1] if used.any() else -1]
    free = np.flatnonzero(unknowns.moves_shaft().cpu().numpy())
    readings = _readings(home, low, high, free, settings.candidates, np.random.default_rng(seed))
    base = measured_alike(problem.flatten_batch(), len(readings))
    at = unknowns.resting_at(base, torch.as_tensor(readings).to(joint_offset), joint_offset)
    units = np.array([_CHANGED[split_joint_column(column)[1]] for column in unknowns.columns])
    changed = np.abs(readings - home) > units
    pairs = zip(readings, changed, strict=True)
    words = tuple(_joint_words(unknowns.columns, home, row, moved) for row, moved in pairs)
    return Candidates(at, torch.as_tensor(changed.sum(1)), words, readings, unknowns.columns)


def joint_box(
    recording: Recording, columns: tuple[str, ...], logged: Float[np.ndarray, "m j"], settings: AdviceSettings
) -> tuple[Float[np.ndarray, " j"], Float[np.ndarray, " j"]]:
    """Least and greatest reading of each joint: what was logged, widened by the reach, within the robot's limits."""
    reach = {"rad": np.deg2rad(settings.reach_deg), "mm": settings.reach_mm}
    wide = np.array([reach[split_joint_column(column)[1]] for column in columns])
    joints = recording.robot.joints(*recording.robot.arms)
    least = np.array([-np.inf if joints[column].min is None else joints[column].min for column in columns])
    greatest = np.array([np.inf if joints[column].max is None else joints[column].max for column in columns])
    return np.clip(logged.min(0) - wide, least, greatest), np.clip(logged.max(0) + wide, least, greatest)


def _readings(
    home: Float[np.ndarray, " j"],
    low: Float[np.ndarray, " j"],
    high: Float[np.ndarray, " j"],
    free: np.ndarray,
    count: int,
    generator: np.random.Generator,
) -> Float[np.ndarray, "m j"]:
    """Candidates within the box: each free joint alone, every two on a grid, and any at random."""
    home = np.clip(home, low, high)
    alone = low[free, None] + (high - low)[free, None] * np.linspace(0.0, 1.0, _PLACES_ALONE)
    two = low[free, None] + (high - low)[free, None] * np.linspace(0.0, 1.0, _PLACES_OF_TWO)
    groups = []
    for i, joint in enumerate(free):
        group = np.tile(home, (_PLACES_ALONE, 1))
        group[:, joint] = alone[i]
        groups.append(group)
    for (i, first), (j, second) in combinations(enumerate(free), 2):
        group = np.tile(home, (_PLACES_OF_TWO**2, 1))
        group[:, first], group[:, second] = (x.ravel() for x in np.meshgrid(two[i], two[j]))
        groups.append(group)
    group = np.tile(home, (count, 1))
    moving = generator.uniform(size=(count, len(free))) < generator.uniform(0.3, 1.0, (count, 1))
    group[:, free] = np.where(moving, generator.uniform(low[free], high[free], moving.shape), group[:, free])
    return np.concatenate([*groups, group])


def _joint_words(columns: tuple[str, ...], home: np.ndarray, readings: np.ndarray, changed: np.ndarray) -> str:
    moves = []
    for column, before, after, moved in zip(columns, home, readings, changed, strict=True):
        if moved:
            name, unit = split_joint_column(column)
            before, after, unit = (before, after, "mm") if unit == "mm" else (*np.rad2deg((before, after)), "deg")
            moves.append(f"{name} from {before:.1f} to {after:.1f} {unit}")
    if not moves:
        return "repeat the last motion of the recording"
    rest = "" if len(moves) == len(columns) else " (other joints as at the end of the recording)"
    return f"move {joined(moves)}{rest}"


def camera_view(camera: Camera) -> Float[Tensor, "4"]:
    """Least x, least y, greatest x, greatest y of the upright rectangle inside of the undistorted picture, less a
    margin."""
    height, width = camera.image_size
    size = torch.tensor([width - 1.0, height - 1.0], dtype=torch.float64)
    part = torch.linspace(VIEW_MARGIN, 1.0 - VIEW_MARGIN, _BORDER_SAMPLES, dtype=torch.float64)
    least, greatest = [], []
    for axis in (0, 1):
        uv = (part[:, None] * size).repeat(2, 1, 1)  # (side, samples, 2): both sides across this axis
        uv[0, :, axis], uv[1, :, axis] = VIEW_MARGIN * size[axis], (1.0 - VIEW_MARGIN) * size[axis]
        xy, valid = camera.undistort_points(uv)
        least.append(torch.where(valid, xy[..., axis], -torch.inf)[0].amax())
        greatest.append(torch.where(valid, xy[..., axis], torch.inf)[1].amin())
    return torch.stack([*least, *greatest])


def seen_view(problem: Problem) -> Float[Tensor, "c 4"]:
    """The same of each camera, as far as measured points of lines, ends and heads reach; for observations without
    cameras."""
    kinds = (problem.axis_xy, problem.contour_xy, problem.end_xy, problem.head_xy)
    points = torch.cat([xy[0].flatten(1, -2) for xy in kinds], dim=1)  # (c, points, 2)
    known = torch.isfinite(points)
    least = torch.where(known, points, torch.inf).amin(1)
    return torch.cat((least, torch.where(known, points, -torch.inf).amax(1)), dim=-1)


def limits_in_words(settings: AdviceSettings) -> str:
    """To what joint candidates are limited."""
    return (
        f"within the joint limits, at most {settings.reach_deg:g} deg and {settings.reach_mm:g} mm outside "
        "the range of the recording"
    )


def pose_candidates(problem: Problem, solution: Solution, motion: int, settings: AdviceSettings) -> Candidates:
    """What the instrument, the laparoscope and both can do from one motion on.

    Args:
        problem: what was solved, with one trial axis of length 1.
        solution: its answer.
        motion: index of the motion to start from.
        settings: how far to go.
    """
    camera_right_T_arm, problem = solution.camera_right_T_arm.reshape(4, 4), at_found_setup(problem, solution)
    arm_T_rcm, v = problem.arm_T_rcm[0, motion], problem.rcm_v_axis[0, motion]
    swings = _swings(camera_right_T_arm[:3, :3] @ arm_T_rcm[:3, :3], v, math.radians(settings.reach_deg))
    slides = _slides(problem, settings.reach_mm)
    moves = _laparoscope_moves(camera_right_T_arm, settings)
    # The first of each is to do nothing; all three together are no motion.
    triples = [(i, j, k) for i in range(len(swings)) for j in range(len(slides)) for k in range(len(moves))][1:]
    words = [(*swings[i][0], *slides[j][0], *moves[k][0]) for i, j, k in triples]
    turn = torch.stack([swings[i][1] for i, _, _ in triples])
    slide_mm = torch.tensor([slides[j][1] for _, j, _ in triples], dtype=v.dtype, device=v.device)
    steps = torch.stack([moves[k][1] for _, _, k in triples])
    like = measured_alike(problem, len(triples), motion)
    turned_v = turn @ v
    poses = rigid_inverse(steps) @ arm_T_rcm  # seen from the arm where it is then
    at = replace(
        like,
        arm_T_rcm=poses[None],
        rcm_v_axis=turned_v[None],
        laparoscope_base_T_arm=None
        if problem.laparoscope_base_T_arm is None
        else (problem.laparoscope_base_T_arm[0, motion] @ steps)[None],
        clock_derivative=None if like.clock_derivative is None else torch.zeros_like(like.clock_derivative),
        rcm_s_end_mm=like.rcm_s_end_mm + slide_mm,
        rcm_p_head=(turn @ problem.rcm_p_head[0, motion] + slide_mm[:, None] * turned_v)[None],
    )
    return Candidates(at, torch.tensor([len(parts) for parts in words]), tuple(joined(list(parts)) for parts in words))


def at_found_setup(problem: Problem, solution: Solution) -> Problem:
    """The problem, with one trial axis, at the set-up of its answer."""
    if solution.frame == INSTRUMENT_BASE and problem.laparoscope_base_T_arm is not None:
        return problem.in_instrument_base()
    if solution.setup is None:
        return problem
    return problem.at_setup(solution.setup.laparoscope_base_T_instrument_base.reshape(1, 4, 4))


def _swings(
    camera_right_R_rcm: Float[Tensor, "3 3"], v: Float[Tensor, "3"], reach_rad: float
) -> list[tuple[Words, Float[Tensor, "3 3"]]]:
    """Turns of the shaft about its RCM, in `rcm`, by where its tip goes in the picture."""
    out: list[tuple[Words, Tensor]] = [((), torch.eye(3, dtype=v.dtype, device=v.device))]
    for side, direction in _SIDES.items():
        axis = torch.linalg.cross(v, camera_right_R_rcm.mT @ v.new_tensor(direction))
        if float(axis.norm()) < _LEAST_ACROSS:
            continue
        for part in _PARTS:
            words = f"swing the instrument's tip {math.degrees(part * reach_rad):.3g} deg {side}"
            out.append(((words,), rotvec_to_matrix(part * reach_rad * axis / axis.norm())))
    return out


def _slides(problem: Problem, reach_mm: float) -> list[tuple[Words, float]]:
    """Ways along the shaft, mm; none where nothing in the pictures would show them."""
    out: list[tuple[Words, float]] = [((), 0.0)]
    if bool(torch.isfinite(problem.end_xy).any()) or bool(torch.isfinite(problem.head_xy).any()):
        for part in _PARTS:
            out.append(((f"insert the instrument by {part * reach_mm:.3g} mm",), part * reach_mm))
            out.append(((f"withdraw the instrument by {part * reach_mm:.3g} mm",), -part * reach_mm))
    return out


def _laparoscope_moves(
    camera_right_T_arm: Float[Tensor, "4 4"], settings: AdviceSettings
) -> list[tuple[Words, Float[Tensor, "4 4"]]]:
    """Places of `arm` after moves of the laparoscope, in `arm` before them."""
    pivot = camera_right_T_arm.new_tensor((0.0, 0.0, -PIVOT_BEHIND_MM))
    eye = torch.eye(3, dtype=pivot.dtype, device=pivot.device)
    camera_right_T_moved: list[tuple[Words, Tensor]] = [((), torch.eye(4).to(pivot))]
    for part in _PARTS:
        for side, axis in _TURNS.items():
            R = rotvec_to_matrix(math.radians(part * settings.reach_deg) * pivot.new_tensor(axis))
            words = f"turn the laparoscope's view {part * settings.reach_deg:.3g} deg {side}"
            camera_right_T_moved.append(((words,), rigid_from_rotation_translation(R, pivot - R @ pivot)))
        for verb, sign in (("insert", 1.0), ("withdraw", -1.0)):
            shift = pivot.new_tensor((0.0, 0.0, sign * part * settings.reach_mm))
            words = f"{verb} the laparoscope by {part * settings.reach_mm:.3g} mm"
            camera_right_T_moved.append(((words,), rigid_from_rotation_translation(eye, shift)))
    arm_T_camera_right = rigid_inverse(camera_right_T_arm)
    return [(words, arm_T_camera_right @ moved @ camera_right_T_arm) for words, moved in camera_right_T_moved]
