"""The solver's tensors turned into a result with frames, units and a status."""

from dataclasses import replace

import numpy as np
import torch

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io import Recording
from rmis_calib.pipeline.answer.motion_names import NUMBERED, MotionNames
from rmis_calib.pipeline.answer.records.consistency import about_groups, consistency_of, size_of
from rmis_calib.pipeline.answer.records.ends import about_ends, about_tool, ends_of
from rmis_calib.pipeline.answer.records.setup import about_compliance, about_setup, instrument_base_of, setup_of
from rmis_calib.pipeline.answer.records.tests_in_words import about_neighbours, told_tests
from rmis_calib.pipeline.answer.records.unknowns import about_cameras, information_of, nuisances_of
from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.pipeline.motions.association import Choice
from rmis_calib.pipeline.motions.observations import reasons_for
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.pipeline.words import words_of
from rmis_calib.results import STATUS_SENTENCES, CalibrationResult, Motions, Residual, Status, Tests
from rmis_calib.solver import Solution, SolveStatus, Verdict
from rmis_calib.solver.observability import Observability
from rmis_calib.solver.status import MotionReason
from rmis_calib.solver.test_list import ANSWER, CLOCK, HALVES, TIME_STEP

JOINTS_UNKNOWN = "the joint log does not cover this time"
TOO_FEW = "usable, but there are too few"
TOO_FAR_SIGMA = 4.0
"""An unknown estimated this many prior sigmas from its nominal value says that the model does not fit the data."""


def make_result(
    solution: Solution,
    motions: Motions,
    residuals: dict[str, Residual],
    config: CalibrationConfig,
    joint_columns: tuple[str, ...] = (),
    notes: tuple[str, ...] = (),
    frame: str | None = None,
    names: MotionNames = NUMBERED,
) -> CalibrationResult:
    """The result of one solve (no trial batch); `joint_columns` name its joint offsets, `notes` join what is said of
    the data, `frame` is what the motions call `arm` (default: what the solution calls it), `names` are the motions'."""
    frame = frame or solution.frame
    tests = told_tests(solution, joint_columns, names)
    status, message = judge(solution, tests)
    consistency = consistency_of(solution)
    observability = solution.observability.describe()
    notes = (
        *notes,
        *about_tool(solution),
        *about_ends(solution),
        *about_groups(consistency, names),
        *about_neighbours(tests),
        *about_cameras(solution),
        *about_setup(solution, frame, config.solver.unknowns),
        *about_compliance(solution),
    )
    usable = int(solution.status) != SolveStatus.NO_CAMERA and bool(torch.isfinite(solution.camera_right_T_arm).all())
    covariance = solution.covariance.cpu().numpy()
    stereo = solution.camera_left_T_camera_right
    return CalibrationResult(
        status=status,
        message=message,
        method=solution.method,
        camera_right_T_arm=_transform("camera_right", frame, solution.camera_right_T_arm) if usable else None,
        camera_left_T_camera_right=None if stereo is None else _transform("camera_left", "camera_right", stereo),
        covariance=covariance if usable and np.isfinite(covariance).all() else None,
        observability=replace(observability, sentences=(*observability.sentences, *notes)),
        motions=motions,
        residuals=residuals,
        nuisances=nuisances_of(solution, joint_columns),
        consistency=consistency,
        tests=tests,
        setup=setup_of(solution),
        instrument_base=instrument_base_of(solution),
        ends=ends_of(solution),
        information=information_of(solution),
        config=config.to_dict(),
    )


def judge(solution: Solution, tests: Tests | None) -> tuple[Status, str]:
    """Status and its one line: a solve that did not work first, then a model that does not fit, then tests that fail,
    then sight."""
    status = SolveStatus(int(solution.status))
    verdict = Verdict.of(solution.observability.verdict[0])
    strange = _strange_unknown(solution)
    if status is not SolveStatus.CONVERGED:
        why = f"{STATUS_SENTENCES['solver_failed']}: {status.sentence}"
        return "solver_failed", f"{why}; {strange}" if strange else why
    if strange:
        return "weak", f"{STATUS_SENTENCES['weak']}: {strange}"
    if tests is not None and tests.failed:
        return "weak", _about_failed(solution, tests)
    name: Status = "ok" if verdict is Verdict.TRUSTWORTHY else verdict.value
    return name, f"{STATUS_SENTENCES[name]}: {solution.observability.describe().sentences[0]}"


def _strange_unknown(solution: Solution) -> str:
    """The unknown that is furthest from its nominal value, in words, when it is further than its prior allows."""
    # A lens model wrong by a tenth of a pixel is no reason for doubt: that is what `edge_bias` is there to take.
    # What an arm gives way is said in its own words (`about_compliance`).
    expected = ("edge_bias", "compliance")
    unknowns = {name: item for name, item in solution.nuisances.items() if name not in expected}
    pulls = {name: float(nuisance.pull.abs().max()) for name, nuisance in unknowns.items()}
    worst = max(pulls, key=lambda name: pulls[name], default="")
    if not worst or pulls[worst] <= TOO_FAR_SIGMA:
        return ""
    if worst == "intrinsics":
        return (
            f"focal length, centre or lens of a camera are estimated {pulls[worst]:.0f} prior sigmas from what the "
            "file says: is the file for another image size, a crop or without the lens model, or is the clock off?"
        )
    where = f"the {worst.replace('_', ' ')} is estimated {pulls[worst]:.0f} prior sigmas from its nominal value"
    return f"{where}: are the cameras swapped, is a unit or a file wrong, or the clock off?"


def used_motions(solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """(N,) whether each motion of the solve was used, and why not; empty for one used without reservation."""
    codes = solution.reason.cpu().numpy()
    reasons = words_of(solution.reason, [reason.sentence for reason in MotionReason])
    reasons[codes == MotionReason.USED] = ""
    return np.isin(codes, (MotionReason.USED, MotionReason.OUTLIER_ONE_CAMERA)), reasons


def _about_failed(solution: Solution, tests: Tests) -> str:
    """The clearest of the failed tests, how many more fail, and the likely causes."""
    worst, more = tests.failed[0], len(tests.failed) - 1
    groups, jump, size = solution.groups, solution.clock_jump, f"{worst.statistic:+.1f} sigmas"
    if (worst.kind, worst.over) == (CLOCK, TIME_STEP) and jump is not None:
        size = f"{float(jump.jump_s):+.3f} s"
    elif worst.kind == ANSWER and groups is not None:
        size = f"{_apart((groups.halves if worst.over == HALVES else groups.change)[0])} apart"
    rest = f", and {more} more tests fail" if more > 1 else ", and one more test fails" if more else ""
    causes = "; then: ".join(tests.causes)
    return f"The residuals are not what the model says: {worst.words} ({size}){rest}. Likely: {causes}"


def _apart(gap: torch.Tensor) -> str:
    rotation_deg, translation_mm = size_of(gap)
    return f"{rotation_deg:.2g} deg, {translation_mm:.2g} mm"


def _transform(dst: str, src: str, matrix: torch.Tensor) -> RigidTransform:
    return RigidTransform(dst, src, matrix.detach().cpu())


def motions_of(
    recording: Recording,
    views: tuple[View, ...],
    poses: MotionPoses,
    choices: tuple[Choice, ...],
    solution: Solution | None,
) -> Motions:
    """Used and rejected frames, each rejected one with its first reason."""
    by_view = np.stack([reasons_for(view, poses, choice) for view, choice in zip(views, choices, strict=True)])
    seen = (by_view == "").any(axis=0)
    solved, said = (False, TOO_FEW) if solution is None else used_motions(solution)
    used = np.zeros(recording.n_frames, dtype=bool)
    used[poses.frames] = seen & solved
    reasons = np.full(recording.n_frames, JOINTS_UNKNOWN, dtype=object)
    reasons[poses.frames] = np.where(seen, said, by_view[0])
    return Motions(used, tuple(reasons.tolist()), recording.frame_times_s)


def insufficient_data(config: CalibrationConfig, motions: Motions, why: str) -> CalibrationResult:
    """The result of a recording with too few usable motions to solve; `why` tells how many there are."""
    return CalibrationResult(
        status="insufficient_data",
        message=f"{STATUS_SENTENCES['insufficient_data']}: {why}",
        method=config.solver.method,
        camera_right_T_arm=None,
        camera_left_T_camera_right=None,
        covariance=None,
        observability=Observability(Verdict.UNOBSERVABLE, (why,)),
        motions=motions,
        config=config.to_dict(),
    )
