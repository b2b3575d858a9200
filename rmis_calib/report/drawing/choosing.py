"""Which motions a report shows: the worst, typical and rejected ones, spread over the places of the shaft's end."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rmis_calib.geometry.rigid import transform_points
from rmis_calib.pipeline.answer.result import TOO_FEW
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.vision import FrameReason

_APART = 0.1
"""Least distance of two of the worst motions, as a part of the spread of all: neighbours have the same cause."""


@dataclass(frozen=True)
class ShownMotions:
    """Numbers of motions to show, best explained first.

    Attributes:
        worst: used ones with the largest residuals, the largest first.
        typical: used ones whose residual is near the median.
        rejected: by reason, most frequent first.
    """

    worst: tuple[int, ...]
    typical: tuple[int, ...]
    rejected: dict[str, tuple[int, ...]]


def choose_motions(run: CalibrationRun, worst: int, typical: int, rejected_each: int) -> ShownMotions:
    """Motions of a calibration to show, so many of each kind at most."""
    frames, motions = run.poses.frames, run.result.motions
    place = transform_points(
        run.poses.arm_T_rcm, run.poses.rcm_v_axis * run.poses.rcm_s_end_mm[:, None]
    ).cpu().numpy()  # fmt: skip
    used, reasons = motions.used[frames], np.array(motions.reasons, dtype=object)[frames]
    residual = largest_residual(run)
    bad = worst_apart(np.where(used, residual, np.nan), place, worst)
    usual = typical_spread(np.where(used, residual, np.nan), place, typical, bad)
    if not used.any():  # nothing was solved: what was usable
        usual = farthest_apart(np.flatnonzero(reasons == TOO_FEW), place, typical)
    counts = sorted(motions.rejected_by_reason.items(), key=lambda item: (-item[1], item[0]))
    rejected = {
        reason: farthest_apart(np.flatnonzero(~used & (reasons == reason)), place, rejected_each)
        for reason, _ in counts
        if reason not in (TOO_FEW, FrameReason.LEFT_OUT.sentence)
    }
    return ShownMotions(bad, usual, {reason: shown for reason, shown in rejected.items() if shown})


def largest_residual(run: CalibrationRun) -> Float[np.ndarray, " m"]:
    """The larger distance of the contours from the prediction, of both cameras, px; NaN where not measured."""
    sides = [run.result.residuals.get(f"contour_{view.side}") for view in run.views]
    known = [entry.by_motion[run.poses.frames] for entry in sides if entry is not None]
    if not known:
        return np.full(len(run.poses.frames), np.nan)
    return np.fmax.reduce(known)


def worst_apart(residual: Float[np.ndarray, " m"], place: Float[np.ndarray, "m 3"], count: int) -> tuple[int, ...]:
    """The largest residuals, each away from those before it; NaN is none."""
    known = np.flatnonzero(np.isfinite(residual))
    if not len(known):
        return ()
    least = _APART * float(np.linalg.norm(place[known].std(0)))
    chosen: list[int] = []
    for index in known[np.argsort(-residual[known], kind="stable")].tolist():
        if len(chosen) == count:
            break
        if all(np.linalg.norm(place[index] - place[other]) >= least for other in chosen):
            chosen.append(index)
    return tuple(chosen)


def typical_spread(
    residual: Float[np.ndarray, " m"], place: Float[np.ndarray, "m 3"], count: int, without: Sequence[int]
) -> tuple[int, ...]:
    """Of the middle half of the residuals, places far apart."""
    known = np.isfinite(residual)
    if not known.any():
        return ()
    low, high = np.percentile(residual[known], [25, 75])
    middle: Bool[np.ndarray, " m"] = known & (residual >= low) & (residual <= high)
    middle[list(without)] = False
    return farthest_apart(np.flatnonzero(middle), place, count)


def farthest_apart(among: np.ndarray, place: Float[np.ndarray, "m 3"], count: int) -> tuple[int, ...]:
    """Indices out of `among`, each as far as can be from those before it; the first is the nearest to their mean."""
    if not len(among) or count < 1:
        return ()
    points = place[among]
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmin())]
    gap = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(among)):
        chosen.append(int(np.where(np.isin(np.arange(len(among)), chosen), -1.0, gap).argmax()))
        gap = np.minimum(gap, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return tuple(int(among[index]) for index in chosen)
