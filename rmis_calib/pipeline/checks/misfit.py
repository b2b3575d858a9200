"""Why pictures and joints do not fit each other: likely causes, in the order of what the residuals say.

A model that does not fit shows as noise larger than any robot's and camera's. Told as weak motion ("the laparoscope did
not move") it would send people to record again what is wrong in a file.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.cameras import Camera, corrected_point
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.arms.found_offsets import poses_at_motions
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.checks.stereo_order import looks_swapped, median_inverse_depth
from rmis_calib.pipeline.checks.suppositions import Supposing, fitting_causes
from rmis_calib.pipeline.motions.association import Choice
from rmis_calib.pipeline.motions.observations import ANOTHER_INSTRUMENT
from rmis_calib.results import CalibrationResult
from rmis_calib.solver import MotionReason, SolveStatus
from rmis_calib.vision import FrameReason, ShaftDetections

_MM, _RAD, _LINE = "noise kinematics_mm", "noise kinematics_rad", "noise line"
TOO_NOISY = {_MM: 2.0, _RAD: 0.012, _LINE: 6.0}
"""Estimated levels beyond those of robots and pictures that are used as they should be: mm, rad (0.7 deg), and times
the nominal noise of a line."""
_CONTRADICTS = (MotionReason.OUTLIER.sentence, ANOTHER_INSTRUMENT)
EXPLAINS = 0.2
"""Share of the residuals' variance from which something is named as a cause."""
_LEAST = 8
"""Fewest motions that causes are told from."""
VELOCITY_STEP_S = 0.01
"""Time from which the velocity of the shaft in the picture is told."""
MOST_CAUSES = 3
"""Causes named of failed tests."""
_LIKELY, _THEN = ". Likely: ", "; then: "
_OTHERWISE = "a joint's sign, unit or order, the base of an arm, or a joint log of another recording"
_TELLING = (SolveStatus.CONVERGED, SolveStatus.SINGULAR, SolveStatus.NON_FINITE)
"""How a solve can end that says nothing against the model by itself."""


def with_misfit_named(
    run: CalibrationRun,
    config: CalibrationConfig,
    plainly: Callable[[], CalibrationRun],
    with_clock: Callable[[], CalibrationRun],
    supposing: Supposing,
) -> CalibrationRun:
    """The run; a result that is not trustworthy as pictures and joints do not fit says so first, with the causes.

    Args:
        run: to look at.
        config: of the calibration.
        plainly: solves the same with the cameras as given: where nothing fits, corrections of cameras hide the cause.
        with_clock: solves the same with the clock as an unknown.
        supposing: solves the same with another recording's joints and robot (None: as they are) and with few unknowns,
            and where the second argument is true, quickly.
    """
    result, solution = run.result, run.solution
    if solution is None or result.camera_right_T_arm is None or result.trustworthy:
        return run
    misfit = SolveStatus(int(solution.status)) not in _TELLING or is_misfit(result)
    if not misfit and (result.tests is None or not result.tests.failed):
        return run
    causes = _shown(run)
    tried = _of_clock(config, with_clock) if misfit else []
    if not tried and config.solver.method == "joint":
        tried = fitting_causes(run, supposing, _noise, config.device, only_tests_fail=not misfit)
    if misfit:
        causes = [*causes, *(tried or _traces(run, config, plainly))] or [_OTHERWISE]
        message = misfit_message(result, causes)
    else:
        causes = [*causes, *tried, *(() if result.tests is None else result.tests.causes)][:MOST_CAUSES]
        head = result.message.partition(_LIKELY)[0]
        message = f"{head}{_LIKELY.lstrip('.') if head.endswith('?') else _LIKELY}{_THEN.join(causes)}"
    tests = None if result.tests is None else replace(result.tests, causes=tuple(causes))
    return replace(run, result=replace(result, message=message, tests=tests))


def _of_clock(config: CalibrationConfig, with_clock: Callable[[], CalibrationRun]) -> list[str]:
    """That another clock makes everything fit, where the clock is no unknown so far: the surest trace of it."""
    if config.solver.unknowns.clock:
        return []
    run = with_clock()
    if run.solution is None or int(run.solution.status) != SolveStatus.CONVERGED or is_misfit(run.result):
        return []
    offset_s = run.result.kinematic_offsets.clock[0]
    return [f"the clock or the frame rate: with the clock moved by {offset_s:+.3f} s they fit"]


def _noise(result: CalibrationResult) -> float:
    """Sum of the estimated levels, each in its limit; infinite where pictures and joints do not fit."""
    if is_misfit(result):
        return np.inf
    return sum(float(result.nuisance(name)) / limit for name, limit in TOO_NOISY.items())


def _traces(run: CalibrationRun, config: CalibrationConfig, plainly: Callable[[], CalibrationRun]) -> list[str]:
    """Causes that leave a trace in the residuals; arguments as for `with_misfit_named`."""
    if any(any(run.result.intrinsic_correction(view.side)) for view in run.views):
        plain = plainly()
        run = run if plain.solution is None or plain.result.camera_right_T_arm is None else plain
    unknowns = KinematicUnknowns(run.recording, run.poses.frames, config.device)
    moved = None
    if unknowns.has_clock:
        at = poses_at_motions(unknowns, run.poses, run.result.kinematic_offsets, VELOCITY_STEP_S)
        moved = replace(run, poses=at)
    parts = []
    for view, choice in zip(run.views, run.choices, strict=True):
        now = run.predicted_contours(view)
        if now is not None and view.camera is not None:
            later = None if moved is None else moved.predicted_contours(view)
            off = run.result.intrinsic_correction(view.side)
            found = view.at(run.poses.frames)
            parts.append(signed_residuals(found, choice, now, later, VELOCITY_STEP_S, view.camera, off))
    return traces(joined_residuals(parts)) if parts else []


def _shown(run: CalibrationRun) -> list[str]:
    """Causes that the pictures show whatever the estimate is."""
    found = [view.at(run.poses.frames) for view in run.views]
    depth = median_inverse_depth(run.recording.stereo.camera_left_T_camera_right, found, run.choices)
    repeated = sum(reason == FrameReason.REPEATED.sentence for reason in run.result.motions.reasons)
    return shown_causes(depth, repeated)


def shown_causes(inverse_depth: float | None, repeated: int) -> list[str]:
    """The same in words.

    Args:
        inverse_depth: of the shaft in both cameras (`median_inverse_depth`), 1/mm; None where they do not tell it.
        repeated: pictures that repeat the one before although the joints moved.
    """
    causes = []
    if repeated:
        causes.append(f"{repeated} pictures repeat the one before (a frame grabber that stalls)")
    if looks_swapped(inverse_depth):
        causes.append("the left and the right pictures look swapped, or each is mirrored")
    return causes


def misfit_message(result: CalibrationResult, causes: list[str]) -> str:
    """The result's message with the misfit first, its likely causes, and only then what else was to be said."""
    levels = {name: result.nuisance(name) for name in TOO_NOISY}
    mm, rad = levels[_MM], levels[_RAD]
    size = ""
    if mm > TOO_NOISY[_MM] or rad > TOO_NOISY[_RAD]:
        size = f" (as if the joints were noisy by {mm:.2g} mm and {np.rad2deg(rad):.2g} deg)"
    likely = _THEN.join(causes)
    head, _, rest = result.message.partition(": ")
    rest = rest.partition(": are the cameras swapped")[0].partition(_LIKELY)[0]
    return f"{head}: pictures and joints do not fit each other{size}. Likely: {likely}. ({rest})"


@dataclass(frozen=True)
class SignedResiduals:
    """Lateral distance of the measured axis from the predicted one, one entry a motion and camera.

    Attributes:
        px: signed, positive right of the predicted line.
        velocity_px_s: of the predicted line across itself; NaN where the joints' velocity is not known.
        uv: (n, 2) where it was measured, from the principal point, in focal lengths.
    """

    px: Float[np.ndarray, " n"]
    velocity_px_s: Float[np.ndarray, " n"]
    uv: Float[np.ndarray, "n 2"]


def is_misfit(result: CalibrationResult) -> bool:
    """Whether the noise that explains the residuals is no noise of a robot and a camera, or most motions contradict."""
    levels = {name: result.nuisance(name) for name in TOO_NOISY}
    if any(value > TOO_NOISY[name] for name, value in levels.items()):
        return True
    contradicting = sum(reason in _CONTRADICTS for reason in result.motions.reasons)
    return contradicting > int(result.motions.used.sum())


def traces(residuals: SignedResiduals) -> list[str]:
    """Causes that leave a trace in the residuals of all motions and cameras that measured the shaft, in words, the most
    likely first."""
    causes = []
    u, v = residuals.uv.T
    by = {
        "the clock or the frame rate: residuals grow with the speed of the shaft in the picture": (
            residuals.velocity_px_s[:, None]
        ),
        "focal length, crop or lens: residuals depend on the place in the picture": (
            np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
        ),
    }
    left = residuals.px
    while by:  # each next cause must explain what those before it leave
        fits = {words: _explained(left, columns) for words, columns in by.items()}
        best = max(fits, key=lambda words: fits[words][0])
        share, left = fits[best]
        if share <= EXPLAINS:
            break
        causes.append(best)
        del by[best]
    return causes


def signed_residuals(
    found: ShaftDetections,
    choice: Choice,
    predicted: Float[Tensor, "m 2 3"],
    predicted_later: Float[Tensor, "m 2 3"] | None,
    later_s: float,
    camera: Camera,
    off: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> SignedResiduals:
    """Residuals of one camera.

    Args:
        found: detections of the motions.
        choice: the candidate that was taken.
        predicted: contour planes.
        predicted_later: the same `later_s` later; None where the joints' velocity is not known.
        later_s: seconds.
        camera: for its focal length.
        off: correction of the camera that the prediction counts on.
    """
    rows = torch.arange(len(choice.candidate), device=choice.candidate.device)
    middle = found.axis_xy[rows, choice.candidate.clamp_min(0)].double().mean(1)  # (m, 2)
    x, y = middle.unbind(-1)
    middle = torch.stack(corrected_point(x, y, *off), dim=-1)
    focal = float(camera.focal)
    now = _distance(predicted, middle)
    velocity = torch.full_like(now, torch.nan)
    if predicted_later is not None:
        velocity = -(_distance(predicted_later, middle) - now) / later_s
    taken = (choice.taken & torch.isfinite(now)).cpu().numpy()
    return SignedResiduals(
        px=(focal * now).cpu().numpy()[taken],
        velocity_px_s=(focal * velocity).cpu().numpy()[taken],
        uv=middle.cpu().numpy()[taken],
    )


def joined_residuals(parts: list[SignedResiduals]) -> SignedResiduals:
    """Those of all cameras."""
    return SignedResiduals(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def _distance(planes: Float[Tensor, "m 2 3"], xy: Float[Tensor, "m 2"]) -> Float[Tensor, " m"]:
    """Signed distance of points from the predicted axis, the bisector of both contour planes, in the image."""
    axis = planes.sum(1)
    value = axis[:, 0] * xy[:, 0] + axis[:, 1] * xy[:, 1] + axis[:, 2]
    return value / torch.linalg.vector_norm(axis[:, :2], dim=-1).clamp_min(1e-12)


def _explained(values: Float[np.ndarray, " n"], by: Float[np.ndarray, "n k"]) -> tuple[float, Float[np.ndarray, " n"]]:
    """Share of the variance of values that a linear function explains beyond what chance does (adjusted R^2), and what
    it leaves of each; nothing is explained where too few are known."""
    known = np.isfinite(values) & np.isfinite(by).all(1)
    y, X = values[known], by[known]
    n, k = X.shape
    if n < max(_LEAST, 3 * k) or not np.ptp(y):
        return 0.0, values
    # A wild motion must not decide: what lies beyond three quartile ranges is drawn in.
    low, high = np.percentile(y, [25, 75])
    y = y.clip(low - 3 * (high - low), high + 3 * (high - low))
    rest = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    total = float(((y - (y.mean() if k > 1 else 0.0)) ** 2).mean())
    left = np.full_like(values, np.nan)
    left[known] = rest
    return max(0.0, 1.0 - float((rest**2).mean()) / total * (n - 1) / max(n - k - 1, 1)), left
