"""Candidates for the next motion by the joints of both arms.

Joints stay within their limits and near to what the recording shows, since nobody has seen what is beyond.
"""

from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float

from rmis_calib.io import Recording
from rmis_calib.pipeline.answer.advice.candidates import Candidates
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.arms.offset_unknowns import estimated_offsets
from rmis_calib.pipeline.words import joined
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Problem, Solution
from rmis_calib.solver.assess.next_motion import measured_alike
from rmis_calib.solver.settings import AdviceSettings

_PLACES_ALONE, _PLACES_OF_TWO = 9, 5
"""Readings tried of each joint that moves alone, and of each of two that move together."""
_CHANGED = {"rad": 0.005, "mm": 0.25}
"""A smaller change of a reading is none."""


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


def limits_in_words(settings: AdviceSettings) -> str:
    """To what joint candidates are limited."""
    return (
        f"within the joint limits, at most {settings.reach_deg:g} deg and {settings.reach_mm:g} mm outside "
        "the range of the recording"
    )
