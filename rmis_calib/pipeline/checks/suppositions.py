"""Causes found by trying: the same pictures solved with one statement of the files changed. What then fits is named.

A joint that turns the other way leaves residuals that depend on the place in the picture, as a wrong focal length does:
no pattern tells one from the other, but only one of them fits once it is mended.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from rmis_calib.io import JointLog, Recording
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.results import CalibrationResult

MOST_TRIED = 3
"""Causes that are tried in full, and named."""
MENDED, CLOSER = 0.5, 0.8
"""Part of the distance between pictures and joints that may be left of it when a cause is put right: where they did not
fit at all, and where they do but for tests of residuals."""
ALIKE = 1.5
"""Causes that leave at most this times the noise of the best cannot be told from it: in the pictures of one camera that
stands still, the sign of either rotation of the instrument, and a mirror."""
Supposing = Callable[[Recording | None, bool], CalibrationRun]
"""Solves the same with another recording's joints and robot (None: as they are), and if asked quickly."""

_LEAST_RAD, _LEAST_MM = 0.01, 1.0
"""A joint that moves less than this tells nothing of its sign."""
_STEPS = (1, -1, 2, -2)
"""Pictures by which a log of poses may be out of step with them."""


@dataclass(frozen=True, eq=False)
class Supposition:
    """What could be wrong in the files, and the recording with it put right."""

    cause: str
    recording: Recording


def fitting_causes(
    run: CalibrationRun,
    supposing: Supposing,
    noise_of: Callable[[CalibrationResult], float],
    device: str,
    only_tests_fail: bool = False,
) -> list[str]:
    """What makes everything fit once it is put right, and what cannot be told from it.

    Args:
        run: in which pictures and joints do not fit, or tests of residuals fail.
        supposing: solves the same otherwise.
        noise_of: how large the estimated noise of a result is; infinite where pictures and joints do not fit in it.
        device: where kinematics are evaluated.
        only_tests_fail: pictures and joints fit as they are. Then a cause has to let all tests pass: what brings them a
            little nearer only may be chance.
    """
    is_continuous = KinematicUnknowns(run.recording, run.poses.frames, device).has_clock
    tried = [(each, supposing(each.recording, True)) for each in suppositions(run.recording, is_continuous)]
    enough_px = (CLOSER if only_tests_fail else MENDED) * _apart_px(supposing(None, True))
    # Corrections of cameras and bases far beyond their priors can bring the contours together too: weak ones come last.
    found = sorted(
        (not other.result.trustworthy, _apart_px(other), each.cause, each.recording)
        for each, other in tried
        if _told(other) and _apart_px(other) <= enough_px
    )
    mended = [(cause, supposing(recording, False)) for _, _, cause, recording in found[:MOST_TRIED]]
    noise = {
        cause: noise_of(other.result)
        for cause, other in mended
        if (other.result.trustworthy if only_tests_fail else _told(other))
    }
    noise = {cause: level for cause, level in noise.items() if np.isfinite(level)}
    return sorted(
        (cause for cause in noise if noise[cause] <= ALIKE * min(noise.values())), key=lambda cause: noise[cause]
    )


def _apart_px(run: CalibrationRun) -> float:
    """Median distance of contours or axes from their prediction, over both cameras; infinite without any."""
    names = ("contour", "axis")
    medians = [value.median for name, value in run.result.residuals.items() if name.startswith(names)]
    return float(np.mean(np.array(medians, dtype=float))) if medians else np.inf


def _told(run: CalibrationRun) -> bool:
    """Whether there is an answer: what the data do not determine fits anything."""
    return run.result.status in ("ok", "weak")


def suppositions(recording: Recording, is_continuous: bool) -> Iterator[Supposition]:
    """What people get wrong about joints and arms, each put right by itself.

    Args:
        recording: as it was read.
        is_continuous: the joint log has velocities; the clock is then searched elsewhere.
    """
    yield from _signs(recording)
    yield from _exchanged_joints(recording)
    if not is_continuous:
        yield from _out_of_step(recording)
    yield from _exchanged_bases(recording)


def _signs(recording: Recording) -> Iterator[Supposition]:
    for column in _moving_columns(recording):
        values = recording.joints.values.copy()
        values[:, recording.joints.columns.index(column)] *= -1.0
        name = column.rpartition("_")[0]
        mirrored = ", or mirrored pictures" if column.endswith("_rad") else ""
        yield Supposition(f"the sign of {name}{mirrored}: turned round it fits", _with_values(recording, values))


def _exchanged_joints(recording: Recording) -> Iterator[Supposition]:
    """Two neighbouring rotations in each other's place."""
    columns = [column for column in _moving_columns(recording) if column.endswith("_rad")]
    for one, other in pairwise(columns):
        if one.partition(".")[0] != other.partition(".")[0]:
            continue
        i, j = (recording.joints.columns.index(column) for column in (one, other))
        values = recording.joints.values.copy()
        values[:, [i, j]] = values[:, [j, i]]
        names = " and ".join(column.rpartition("_")[0] for column in (one, other))
        yield Supposition(f"{names} are exchanged: the other way round they fit", _with_values(recording, values))


def _out_of_step(recording: Recording) -> Iterator[Supposition]:
    """Readings that belong to the picture before or after: one was lost, or one row too many was written."""
    readings, known = recording.joints.at(recording.joint_times_s)
    times_s, values = recording.joint_times_s[known], readings[known]
    for step in _STEPS:
        if len(times_s) <= abs(step):
            continue
        at, of = (times_s[:-step], values[step:]) if step > 0 else (times_s[-step:], values[:step])
        which = f"{abs(step)} picture{'s' if abs(step) > 1 else ''} {'later' if step > 0 else 'earlier'}"
        log = JointLog(at, recording.joints.columns, of, recording.joints.max_gap_s)
        cause = f"pictures and joints are out of step: with the joints of {which} they fit"
        yield Supposition(cause, replace(recording, joints=log))


def _exchanged_bases(recording: Recording) -> Iterator[Supposition]:
    laparoscope, instrument = recording.laparoscope_arm, recording.instrument_arm
    arms = recording.robot.arms
    if laparoscope is None or arms[laparoscope].base_T_arm_base is None or arms[instrument].base_T_arm_base is None:
        return
    exchanged = {
        laparoscope: replace(arms[laparoscope], base_T_arm_base=arms[instrument].base_T_arm_base),
        instrument: replace(arms[instrument], base_T_arm_base=arms[laparoscope].base_T_arm_base),
    }
    robot = replace(recording.robot, arms={**arms, **exchanged})
    cause = f"the bases of {laparoscope} and {instrument} are exchanged: the other way round they fit"
    yield Supposition(cause, replace(recording, robot=robot))


def _moving_columns(recording: Recording) -> list[str]:
    """Joints that move the laparoscope or the instrument's shaft, as far as they moved."""
    instrument = recording.instrument_arm
    columns = list(recording.robot.columns(instrument)[: recording.robot.arms[instrument].shaft_frame])
    if recording.laparoscope_arm is not None:
        columns = [*recording.robot.columns(recording.laparoscope_arm), *columns]
    ranges = dict(zip(recording.joints.columns, np.ptp(recording.joints.values, axis=0), strict=True))
    return [name for name in columns if ranges[name] > (_LEAST_RAD if name.endswith("_rad") else _LEAST_MM)]


def _with_values(recording: Recording, values: Float[np.ndarray, "t j"]) -> Recording:
    return replace(recording, joints=replace(recording.joints, values=values))
