"""Advice on the next motion, in words: candidates from both arms' joints, or, without kinematics, from the picture.

Joints stay within their limits and near to what the recording shows, since nobody has seen what is beyond; the shaft
stays in the field of view. The estimate that predicts all this is the present one.
"""

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.cameras import Camera
from rmis_calib.io import Recording
from rmis_calib.pipeline.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.offset_unknowns import estimated_offsets
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Problem, Solution, SolveStatus
from rmis_calib.solver.assess.next_motion import Advice, advise, measured_alike
from rmis_calib.solver.observability import Verdict
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


def advice_record(
    solution: Solution,
    candidates: Candidates,
    view: Float[Tensor, "c 4"],
    config: CalibrationConfig,
    where: str,
) -> dict[str, Any]:
    """`advice` (sentences) and `next_motions` (the same as values) of `observability` in a result.

    Args:
        solution: one trial of which `may_advise` is true.
        candidates: motions to choose from.
        view: field of view of each camera (`advise`).
        config: of the estimate.
        where: to what the candidates were limited, to end the advice with.
    """
    if solution.posterior is None:
        return {}
    point = solution.observability.working_point_mm[0]
    reported = solution.covariance.reshape(6, 6)
    advice = advise(candidates.problem, solution.posterior, point, view, config.solver, candidates.effort, reported)
    trusted = solution.observability.describe().verdict is Verdict.TRUSTWORTHY
    general = () if trusted else solution.observability.remedies()
    return {
        "advice": _sentences(solution, candidates, advice, where) + [f"In general: {words}." for words in general],
        "next_motions": [_values(candidates, advice, step) for step in range(len(advice.chosen))],
    }


def _sentences(solution: Solution, candidates: Candidates, advice: Advice, where: str) -> list[str]:
    if not len(advice.chosen):
        return [f"The present estimate predicts no motion {where} that would keep the shaft in view."]
    _, name = solution.observability.describe().directions[0]
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


def _values(candidates: Candidates, advice: Advice, step: int) -> dict[str, Any]:
    index = int(advice.chosen[step])
    joints = None
    if candidates.joints is not None:
        joints = dict(zip(candidates.columns, candidates.joints[index].tolist(), strict=True))
    return {
        "words": candidates.words[index],
        "joints": joints,
        "weakest_sigma_mm": float(advice.weakest_mm[step + 1]),
        "working_point_sigma_mm": float(advice.point_mm[step + 1]),
    }


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
    joint_offset, clock_s = estimated_offsets(solution, unknowns.columns, problem.arm_T_rcm)
    logged = unknowns.readings_of_motions(clock_s).cpu().numpy()
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


def joined(parts: list[str]) -> str:
    """Parts of a sentence as a list in words."""
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]


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
        f"within the joint limits, at most {settings.reach_deg:g} deg and {settings.reach_mm:g} mm outside of the "
        "readings of the recording"
    )
