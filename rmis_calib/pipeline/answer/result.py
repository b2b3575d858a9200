"""The solver's tensors turned into a result with frames, units and a status."""

from dataclasses import replace

import numpy as np
import torch

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io import Recording
from rmis_calib.pipeline.answer.ends_record import about_ends, ends_of
from rmis_calib.pipeline.answer.motion_names import NUMBERED, MotionNames
from rmis_calib.pipeline.answer.setup_record import (
    about_compliance,
    about_setup,
    given_way,
    instrument_base_of,
    setup_of,
)
from rmis_calib.pipeline.answer.tests_in_words import about_neighbours, told_tests
from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.pipeline.motions.association import Choice
from rmis_calib.pipeline.motions.observations import reasons_for
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.pipeline.words import words_of
from rmis_calib.results import (
    INTRINSICS,
    JOINT_OFFSET,
    STATUS_SENTENCES,
    CalibrationResult,
    Change,
    ClockJump,
    Consistency,
    GroupShift,
    Information,
    Motions,
    Nuisance,
    Residual,
    Shift,
    Status,
    Tests,
)
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Solution, SolveStatus, Verdict
from rmis_calib.solver.observability import Observability
from rmis_calib.solver.status import MotionReason
from rmis_calib.solver.test_list import ANSWER, CLOCK, HALVES, TIME_STEP

JOINTS_UNKNOWN = "the joint log does not cover this time"
TOO_FEW = "usable, but there are too few"
OTHER_TOOL_MM = 25.0
"""Distance of the shaft's end from its nominal place that no wrist explains: the metal of one is 5 to 20 mm long."""
CORRECTED = 1.0
"""Correction of a camera in prior sigmas from which it is said."""
WORTH_SAYING = 1.25
"""Growth of sigma by disagreeing groups from which it is said."""
OF_ONE_RECORDING = ("clock", "clock_rate", "readout", "end_gap", "joint_offset", "rcm_offset", "setup")
"""Unknowns that another recording of the same set-up need not share."""
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
        *_about_tool(solution),
        *about_ends(solution),
        *about_groups(consistency, names),
        *about_neighbours(tests),
        *about_cameras(solution),
        *about_setup(solution, frame, config.solver.unknowns),
        *about_compliance(solution),
    )
    finite = bool(torch.isfinite(solution.camera_right_T_arm).all())
    covariance = solution.covariance.cpu().numpy()
    stereo = solution.camera_left_T_camera_right
    return CalibrationResult(
        status=status,
        message=message,
        method=solution.method,
        camera_right_T_arm=_transform("camera_right", frame, solution.camera_right_T_arm) if finite else None,
        camera_left_T_camera_right=None if stereo is None else _transform("camera_left", "camera_right", stereo),
        covariance=covariance if np.isfinite(covariance).all() else None,
        observability=replace(observability, sentences=(*observability.sentences, *notes)),
        motions=motions,
        residuals=residuals,
        nuisances=_nuisances(solution, joint_columns),
        consistency=consistency,
        tests=tests,
        setup=setup_of(solution),
        instrument_base=instrument_base_of(solution),
        ends=ends_of(solution),
        information=_information(solution),
        config=config.to_dict(),
    )


def _about_tool(solution: Solution) -> tuple[str, ...]:
    """Whether the shaft ends so far from where the tool's table says that it is another tool's."""
    end = solution.nuisances.get("end_offset")
    if end is None:
        return ()
    offset, sigma = float(end.value.reshape(-1)[0]), float(end.sigma.reshape(-1)[0])
    if abs(offset) - 3.0 * sigma < OTHER_TOOL_MM:
        return ()
    where = "beyond" if offset > 0 else "before"
    return (
        f"The shaft ends {abs(offset):.0f} mm {where} the place given by the tool's table: does the table belong "
        "to another tool (the wrists of S/Si and Classic instruments are 50 mm apart), or is the length of a wrist "
        "missing?",
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


def residuals_normalised(solution: Solution, used: np.ndarray) -> dict[str, Residual]:
    """Residuals per kind and camera in normalised image units, for observations without a camera."""
    return {
        name: residual_of(by_motion, "1e-3 of the focal length", used)
        for name, by_motion in residual_arrays(solution, 1e3, 1e3).items()
    }


def residual_arrays(solution: Solution, scale_right: float, scale_left: float) -> dict[str, np.ndarray]:
    """(N,) residuals of each kind and camera, times the camera's scale (its focal length turns them into px)."""
    scales = (("right", scale_right), ("left", scale_left))
    arrays = {}
    for name, kind in (("contour", "lines"), ("end", "ends"), ("head", "heads")):
        values = getattr(solution, f"residual_{kind}").cpu().numpy()
        for row, (side, scale) in zip(values, scales, strict=False):
            if np.isfinite(row).any():
                arrays[f"{name}_{side}"] = row * scale
    return arrays


def residual_of(by_motion: np.ndarray, unit: str, used: np.ndarray) -> Residual:
    """Median and root mean square over the used motions, with the value of every motion that was measured."""
    known = by_motion[np.isfinite(by_motion) & used]
    median = float(np.median(known)) if len(known) else None
    rms = float(np.sqrt(np.mean(known**2))) if len(known) else None
    return Residual(unit, median, rms, by_motion)


def _nuisances(solution: Solution, joint_columns: tuple[str, ...]) -> dict[str, Nuisance]:
    """Every other unknown with its sigma, and the noise levels that were used."""
    found: dict[str, Nuisance] = {}
    for name, nuisance in solution.nuisances.items():
        if name == "setup":  # has a record of its own
            continue
        if name == "compliance":
            bend_rad, shift_mm = given_way(nuisance)
            found["compliance bend"] = Nuisance(bend_rad, None, "rad rms")
            found["compliance shift"] = Nuisance(shift_mm, None, "mm rms")
            continue
        values, sigmas, held = (item.reshape(-1).tolist() for item in (nuisance.value, nuisance.sigma, nuisance.held))
        for index, (value, sigma, is_held) in enumerate(zip(values, sigmas, held, strict=True)):
            key = name if len(values) == 1 else f"{name}[{index}]"
            unit = nuisance.unit
            if name == "intrinsics":
                what, unit = list(INTRINSICS.items())[index % len(INTRINSICS)]
                key = f"{what} {('right', 'left')[index // len(INTRINSICS)]}"
            if name == "joint_offset":
                joint, unit = split_joint_column(joint_columns[index])
                key = f"{JOINT_OFFSET}{joint}"
            found[key] = Nuisance(value, sigma, unit, is_held)
    for name, level in solution.noise.items():
        found[f"noise {name}"] = Nuisance(float(level), None, _noise_unit(name))
    return found


def consistency_of(solution: Solution) -> Consistency | None:
    """Groups of neighbouring motions and halves against each other; None without groups."""
    groups, jump = solution.groups, solution.clock_jump
    if groups is None or groups.count == 0 or bool((groups.group < 0).all()):
        return None
    numbers = groups.group.reshape(-1).cpu().numpy()
    sizes = np.bincount(numbers[numbers >= 0], minlength=groups.count).tolist()
    without = [
        GroupShift(*_size(shift), sigmas, motions=motions)
        for shift, sigmas, motions in zip(groups.shift[0], groups.sigmas[0].tolist(), sizes, strict=True)
    ]
    return Consistency(
        inflation=float(groups.inflation),
        group_by_motion=numbers,
        groups=tuple(without),
        halves=Shift(*_size(groups.halves[0]), float(groups.halves_sigmas)),
        change=Change(*_size(groups.change[0]), float(groups.change_sigmas), before_motion=int(groups.change_at)),
        clock_jump=None if jump is None else ClockJump(float(jump.jump_s), float(jump.sigmas), int(jump.at)),
    )


def _size(shift: torch.Tensor) -> tuple[float, float]:
    """Angle in degrees and distance in mm of a (6,) difference of two transforms."""
    return float(torch.rad2deg(shift[:3].norm())), float(shift[3:].norm())


def about_groups(consistency: Consistency | None, names: MotionNames = NUMBERED) -> tuple[str, ...]:
    """Whether parts of the data disagree by more than noise, in words."""
    if consistency is None or (consistency.inflation or 1.0) < WORTH_SAYING:
        return ()
    worst = int(np.argmax([group.sigmas or 0.0 for group in consistency.groups]))
    group = consistency.groups[worst]
    number = consistency.group_by_motion
    return (
        "Groups of neighbouring motions disagree by more than noise explains, so all sigmas were multiplied by "
        f"{consistency.inflation:.1f}. The {names.some(number == worst, number >= 0)} disagree most: without them the "
        f"answer moves by {group.rotation_deg:.2g} deg, {group.translation_mm:.2g} mm.",
    )


def about_cameras(solution: Solution) -> tuple[str, ...]:
    """Corrections of the cameras that are larger than their priors, in words."""
    found = solution.nuisances.get("intrinsics")
    if found is None:
        return ()
    said = []
    for camera, (values, pulls) in enumerate(
        zip(found.value.reshape(-1, 4).tolist(), found.pull.reshape(-1, 4).tolist(), strict=True)
    ):
        focal, x, y, lens = values
        parts = [
            (pulls[0], f"the focal length by {-100.0 * focal:+.1f} %"),
            (max(pulls[1], pulls[2], key=abs), f"the principal point by {-100.0 * x:+.2f}, {-100.0 * y:+.2f} % of it"),
            (pulls[3], f"k1 by {-lens:+.3f}"),
        ]
        changed = [words for pull, words in parts if abs(pull) > CORRECTED]
        if changed:
            said.append(f"of the {('right', 'left')[camera]} camera {', '.join(changed)}")
    if not said:
        return ()
    return (f"The data suggest corrected cameras: {'; '.join(said)}. The transform goes with them.",)


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
    rotation_deg, translation_mm = _size(gap)
    return f"{rotation_deg:.2g} deg, {translation_mm:.2g} mm"


def _information(solution: Solution) -> Information | None:
    """The information on the transform and on what recordings share, the other unknowns eliminated."""
    posterior = solution.posterior
    if posterior is None or not bool(torch.isfinite(posterior.information).all()):
        return None
    layout = posterior.layout
    deviation, weight = (item.reshape(-1) for item in layout.prior(posterior.state))
    names = [
        name if part.stop - part.start == 1 else f"{name}[{index}]"
        for name, part in layout.blocks.items()
        for index in range(part.stop - part.start)
    ]
    is_kept = torch.tensor([name.partition("[")[0] not in OF_ONE_RECORDING for name in names])
    kept, gone = is_kept.nonzero()[:, 0], (~is_kept).nonzero()[:, 0]
    H = posterior.information.reshape(len(names), len(names)).cpu()
    matrix = H[kept][:, kept] - H[kept][:, gone] @ torch.linalg.solve(H[gone][:, gone], H[gone][:, kept])
    shared = kept[6:]
    # The posterior's information, priors included, is divided by what the residuals exceed the noise by.
    excess = float(solution.chi2_per_dof.clamp_min(1.0))
    prior = torch.cat([weight.new_zeros(6), weight[shared] / excess]).cpu()
    away = torch.cat([weight.new_zeros(6), deviation[shared]]).cpu()
    return Information(
        shared_names=tuple(names[index] for index in shared.tolist()),
        shared_prior_sigma=weight[shared].rsqrt().cpu().numpy(),
        matrix=(matrix - torch.diag(prior)).numpy(),
        vector=(matrix @ away).numpy(),
    )


def _noise_unit(name: str) -> str:
    return name.rpartition("_")[2] if name.endswith(("_mm", "_rad", "_deg")) else "x nominal"


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


def residuals_px(recording: Recording, poses: MotionPoses, solution: Solution, used: np.ndarray) -> dict[str, Residual]:
    """Residuals of each kind and camera in pixels, by frame."""
    left = recording.stereo.left
    arrays = residual_arrays(
        solution, float(recording.stereo.right.focal), float(left.focal) if left is not None else 1.0
    )
    found = {}
    for name, by_motion in arrays.items():
        by_frame = np.full(recording.n_frames, np.nan)
        by_frame[poses.frames] = by_motion
        found[name] = residual_of(by_frame, "px", used)
    return found


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
