"""Observations to the answer: the solver's tensors turned into a result with frames, units and a status."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, overload

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import CalibrationFailed, InputError
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io import ShaftObservations
from rmis_calib.pipeline.device import require_device
from rmis_calib.pipeline.file_unknowns import FileUnknowns, file_unknowns
from rmis_calib.pipeline.next_motion import advice_record, may_advise, seen_view
from rmis_calib.pipeline.next_pose import WHERE, pose_candidates
from rmis_calib.pipeline.offset_unknowns import OffsetUnknowns, estimated_offsets
from rmis_calib.results import JOINT_OFFSET, STATUS_SENTENCES, CalibrationResult, Motions, Status
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Problem, Solution, SolveStatus
from rmis_calib.solver import solve as solve_problem
from rmis_calib.solver.estimate.relinearise import scan_clock
from rmis_calib.solver.observability import Observability
from rmis_calib.solver.own_measurement import Measurement
from rmis_calib.solver.solution import AlternativeModel, Nuisance
from rmis_calib.solver.status import MotionReason

COARSE_CLOCK_STEP_S, CLOCK_STEP_S = 0.1, 0.02
"""Spacing of the clock offsets that are tried, first everywhere, then near the best: motion hardly turns within
0.1 s, and motion within 0.02 s stays inside one linearisation."""
CLEARLY_BETTER = 0.5
"""Part of the disagreement at the recording's own clock below which another clock offset is believed. A camera that
looks only when the arms rest sees no clock, and its scan has a flat minimum."""
STRONG_EVIDENCE = 3.0
"""Log of the odds, 20 to 1, that the data must give for joint offsets to be estimated (Kass & Raftery 1995: strong)."""
MIXED_SHARE = 0.1
"""Part of a joint's offset that must lie in the unseen combinations for the joint to be named with them."""
OTHER_TOOL_MM = 25.0
"""Distance of the shaft's end from its nominal place that no wrist explains: the metal of one is 5 to 20 mm long."""
TOO_FAR_SIGMA = 4.0
"""An unknown estimated this many prior sigmas from its nominal value says that the model does not fit the data."""


@overload
def solve(
    observations: ShaftObservations,
    config: CalibrationConfig | None = None,
    *,
    throw: bool = True,
    measurements: Sequence[Measurement] = (),
    differentiable: Literal[False] = False,
) -> CalibrationResult: ...


@overload
def solve(
    observations: ShaftObservations | Mapping[str, Any],
    config: CalibrationConfig | None = None,
    *,
    measurements: Sequence[Measurement] = (),
    differentiable: Literal[True],
) -> Solution: ...


def solve(
    observations: ShaftObservations | Mapping[str, Any],
    config: CalibrationConfig | None = None,
    *,
    throw: bool = True,
    measurements: Sequence[Measurement] = (),
    differentiable: bool = False,
) -> CalibrationResult | Solution:
    """Estimate `camera_right_T_arm` from observations.

    Args:
        observations: N motions in the keys of DESIGN.md 6.2; with `differentiable` also a mapping of these keys to
            tensors, with any leading batch of trials.
        config: method, measurements to use, noise, thresholds; the defaults when None.
        throw: raise when the result is not trustworthy; otherwise its `status` and `message` say so.
        measurements: of your own, which `joint` uses beside the observations'.
        differentiable: return the solver's tensors, of which `camera_right_T_arm` and `covariance` pass gradients to
            the tensors of the observations (`solver.solve` says what they include). Joint and clock offsets are then
            not estimated, and nothing is raised for trials without a trustworthy answer: `status` and `verdict` say so.
    Raises:
        CalibrationFailed: no trustworthy result (with `throw`); its `result` holds what there is.
        InsufficientDataError: too few motions.
        ObservationsError: something is asked for that the observations do not tell.
    """
    config = config or CalibrationConfig()
    require_device(config.device)
    if differentiable:
        keys = observations if isinstance(observations, Mapping) else vars(observations)
        problem = Problem.from_arrays(keys, device=config.device).only(*config.measurements).with_own(measurements)
        return solve_problem(problem, config.solver, differentiable=True)
    if not isinstance(observations, ShaftObservations):
        raise InputError(
            where="observations",
            expected="ShaftObservations (a mapping with `differentiable`)",
            found=type(observations),
        )
    unknowns = file_unknowns(observations, config.solver, config.device)
    if unknowns is None:
        solution, notes = estimate(observations, config, measurements), ()
    else:
        solution, notes = estimate_with_kinematics(observations, config, unknowns, measurements=measurements)
    motions = Motions(*used_motions(solution))
    residuals, columns = residuals_normalised(solution, motions.used), () if unknowns is None else unknowns.columns
    for item in measurements:
        if item.name in solution.residual_own:
            by_motion = solution.residual_own[item.name].cpu().numpy()
            residuals[item.name] = residual_record(by_motion, item.unit, motions.used)
    result = make_result(solution, motions, residuals, config, columns, notes)
    advice = _advice(solution, motions, observations, config, unknowns)
    result = replace(result, observability=result.observability | advice)
    if throw:
        raise_unless_trustworthy(result)
    return result


def _advice(
    solution: Solution,
    motions: Motions,
    observations: ShaftObservations,
    config: CalibrationConfig,
    unknowns: FileUnknowns | None,
) -> dict[str, Any]:
    """What motion would help most, as the picture shows it."""
    if not may_advise(solution, config) or not motions.used.any():
        return {}
    problem = problem_of(observations, config).flatten_batch()
    if unknowns is not None:
        joint_offset, clock_s = estimated_offsets(solution, unknowns.columns, problem.radius_mm)
        clock = problem.radius_mm.new_tensor([clock_s])
        problem = unknowns.linearised(problem, joint_offset[None], clock, torch.zeros_like(joint_offset))
    last = int(np.flatnonzero(motions.used)[-1])
    candidates = pose_candidates(problem, solution, last, config.solver.advice)
    return advice_record(solution, candidates, seen_view(problem), config, WHERE)


def estimate(
    observations: ShaftObservations, config: CalibrationConfig, measurements: Sequence[Measurement] = ()
) -> Solution:
    """Run the configured solver on the configured kinds of measurement, and on the user's own."""
    return solve_problem(problem_of(observations, config).with_own(measurements), config.solver)


def estimate_with_kinematics(
    observations: ShaftObservations,
    config: CalibrationConfig,
    unknowns: OffsetUnknowns,
    clock_s: float | None = None,
    measurements: Sequence[Measurement] = (),
) -> tuple[Solution, tuple[str, ...]]:
    """The same with constant joint offsets, and the clock offset, among the unknowns of `joint`; and what was decided
    about the offsets, in sentences.

    A combination of offsets that the data cannot tell from the transform (its sigma stays at its prior) is held at
    zero: its prior would else be counted as uncertainty of a transform that absorbs it anyway. With `auto` all offsets
    are left out unless there is strong evidence of them; the covariance then allows for the other possibility.

    Args:
        observations: N motions.
        config: method, measurements to use, noise, unknowns.
        unknowns: the kinematics as a function of the offsets.
        clock_s: clock offset found before, to start from; None: that of the unknowns, else it is searched for.
        measurements: of the user's own.
    """
    base = problem_of(observations, config).with_own(measurements).flatten_batch()
    asked = config.solver.unknowns
    sigma = unknowns.prior_sigma(asked)
    if asked.joint_offsets == "never":
        sigma = sigma * 0.0
    if clock_s is None:
        clock_s = unknowns.clock_at_s
    if clock_s is None:
        clock_s = 0.0
        if asked.clock and unknowns.has_clock:
            # Whatever is measured: the axis lines tell the clock even where the answer does not use them.
            lines = Problem.from_observations(observations, device=config.device).only("axis").flatten_batch()
            clock_s = _clock_start(lines, unknowns, config.clock_search_s, sigma)
    clock_at = sigma.new_full((1,), clock_s)

    def solve_with(
        sigma: torch.Tensor, alternative: AlternativeModel | None = None, seen: torch.Tensor | None = None
    ) -> Solution:
        def kinematics(joint_offset: torch.Tensor, clock_s: torch.Tensor) -> Problem:
            problem = unknowns.linearised(base, joint_offset, clock_s, sigma)
            if seen is None or problem.joint_derivative is None:
                return problem
            return replace(problem, joint_derivative=problem.joint_derivative @ seen)

        start = kinematics(torch.zeros_like(sigma)[None], clock_at)
        return solve_problem(start.take_trials(0), config.solver, kinematics=kinematics, alternative=alternative)

    solution = solve_with(sigma)
    if "joint_offset" not in solution.nuisances:
        return solution, ()
    offsets, moves = solution.nuisances["joint_offset"], sigma > 0
    unseen = offsets.unseen
    if bool(offsets.held.all()):
        return solve_with(sigma * 0.0), (_about_offsets(offsets, unseen, moves, unknowns.columns, 0.0),)
    if bool((unseen[moves][:, moves] != 0).any()):
        solution = solve_with(sigma, seen=_without_directions(unseen, sigma))
        offsets = solution.nuisances["joint_offset"]
    belief = offsets.log_odds_nominal.new_tensor(asked.joint_offset_belief)
    probability = torch.sigmoid(torch.logit(belief) - offsets.log_odds_nominal)
    note = _about_offsets(offsets, unseen, moves, unknowns.columns, float(probability))
    if asked.joint_offsets == "always" or bool(offsets.log_odds_nominal < -STRONG_EVIDENCE):
        return solution, (note,)
    return solve_with(sigma * 0.0, AlternativeModel(solution.camera_right_T_arm, solution.covariance, probability)), (
        note,
    )


def _without_directions(unseen: Float[Tensor, "j j"], sigma: Float[Tensor, " j"]) -> Float[Tensor, "j j"]:
    """Matrix that, multiplied to the derivatives of the kinematics, leaves the unseen combinations without effect."""
    eye = torch.eye(len(sigma), dtype=sigma.dtype, device=sigma.device)
    return sigma[:, None] * (eye - unseen) / torch.where(sigma > 0, sigma, 1.0)


def _about_offsets(
    offsets: Nuisance, unseen: torch.Tensor, moves: torch.Tensor, columns: tuple[str, ...], probability: float
) -> str:
    """Whether the encoders have offsets, what would not show, and what is part of the transform.

    Args:
        offsets: the estimated ones.
        unseen: projection onto the combinations that the data do not see, in units of the priors.
        moves: which joints move the shaft; the others (the wrist's) are no part of anything.
        columns: name of each joint, with its unit.
        probability: that there are offsets at all.
    """
    names = [split_joint_column(column)[0] for column in columns]
    sigmas, held, shares = offsets.sigma.tolist(), offsets.held.tolist(), unseen.diagonal().tolist()
    joints = zip(names, columns, sigmas, held, shares, moves.tolist(), strict=True)
    visible = [joint for *joint, moved in joints if moved]
    hidden = ", ".join(name for name, _, _, is_held, _ in visible if is_held)
    if all(is_held for _, _, _, is_held, _ in visible):
        return f"Constant joint offsets cannot be told from the transform here, and are part of it ({hidden})."
    mixed = [name for name, _, _, is_held, share in visible if not is_held and share > MIXED_SHARE]
    seen = ", ".join(f"{name} {_shown(sigma, column)}" for name, column, sigma, is_held, _ in visible if not is_held)
    note = f"Constant joint offsets are {100.0 * probability:.0f} % probable; the data see them to 1 sigma of {seen}"
    if hidden:
        note += f"; those of {hidden} cannot be told from the transform and are part of it"
    if len(mixed) > 1:
        note += f"; a combination of those of {', '.join(mixed)} cannot be told from the transform and is part of it"
    return f"{note}."


def _shown(sigma: float, column: str) -> str:
    return f"{np.rad2deg(sigma):.2g} deg" if split_joint_column(column)[1] == "rad" else f"{sigma:.2g} mm"


def _clock_start(base: Problem, unknowns: OffsetUnknowns, reach_s: float, like: torch.Tensor) -> float:
    """Clock offset at which axis lines and joints agree best; 0 unless another one is clearly better."""

    def scan(centre_s: float, half_s: float, step_s: float) -> tuple[float, torch.Tensor]:
        count = 2 * round(half_s / step_s) + 1
        offsets = centre_s + torch.linspace(-half_s, half_s, count).to(like)
        return scan_clock(lambda joint, clock: unknowns.at(base, joint, clock), len(like), offsets)

    coarse_s, coarse = scan(0.0, reach_s, COARSE_CLOCK_STEP_S)
    best_s, fine = scan(coarse_s, COARSE_CLOCK_STEP_S, CLOCK_STEP_S)
    better = min(float(coarse.min()), float(fine.min())) < CLEARLY_BETTER * float(coarse[len(coarse) // 2])
    return best_s if better else 0.0


def problem_of(observations: ShaftObservations, config: CalibrationConfig) -> Problem:
    """The configured kinds of measurement as the solver's tensors."""
    return Problem.from_observations(observations, device=config.device).only(*config.measurements)


def raise_unless_trustworthy(result: CalibrationResult) -> None:
    """Turn a result that did not pass its own checks into an exception that carries it.

    Raises:
        CalibrationFailed: always, unless the status is `ok`.
    """
    if not result.trustworthy:
        raise CalibrationFailed(result.message, result)


def make_result(
    solution: Solution,
    motions: Motions,
    residuals: dict[str, dict[str, Any]],
    config: CalibrationConfig,
    joint_columns: tuple[str, ...] = (),
    notes: tuple[str, ...] = (),
) -> CalibrationResult:
    """The result of one solve (no trial batch); `joint_columns` name its joint offsets, `notes` join what is said of
    the data."""
    status, message = judge(solution)
    finite = bool(torch.isfinite(solution.camera_right_T_arm).all())
    covariance = solution.covariance.cpu().numpy()
    stereo = solution.camera_left_T_camera_right
    return CalibrationResult(
        status=status,
        message=message,
        method=solution.method,
        camera_right_T_arm=_transform("camera_right", "arm", solution.camera_right_T_arm) if finite else None,
        camera_left_T_camera_right=None if stereo is None else _transform("camera_left", "camera_right", stereo),
        covariance=covariance if np.isfinite(covariance).all() else None,
        observability=observability_record(solution.observability.describe(), (*notes, *_about_tool(solution))),
        motions=motions,
        residuals=residuals,
        nuisances=_nuisance_records(solution, joint_columns),
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
        f"The shaft ends {abs(offset):.0f} mm {where} the place that the tool's table tells: does the table belong "
        "to another tool (the wrists of S/Si and Classic instruments are 50 mm apart), or is a wrist's length missing?",
    )


def judge(solution: Solution) -> tuple[Status, str]:
    """Status and its one line: a solve that did not work first, then a model that does not fit, then sight."""
    status = SolveStatus(int(solution.status))
    observability = solution.observability.describe()
    strange = _strange_unknown(solution)
    if status is not SolveStatus.CONVERGED:
        why = f"{STATUS_SENTENCES['solver_failed']}: {status.sentence}"
        return "solver_failed", f"{why}; {strange}" if strange else why
    if strange:
        return "weak", f"{STATUS_SENTENCES['weak']}: {strange}"
    names: dict[str, Status] = {"trustworthy": "ok", "weak": "weak", "unobservable": "unobservable"}
    name = names[observability.verdict.value]
    return name, f"{STATUS_SENTENCES[name]}: {observability.sentence}"


def _strange_unknown(solution: Solution) -> str:
    """The unknown that is furthest from its nominal value, in words, when it is further than its prior allows."""
    # A lens model wrong by a tenth of a pixel is no reason for doubt: that is what `edge_bias` is there to take.
    unknowns = {name: item for name, item in solution.nuisances.items() if name != "edge_bias"}
    pulls = {name: float(nuisance.pull.abs().max()) for name, nuisance in unknowns.items()}
    worst = max(pulls, key=lambda name: pulls[name], default="")
    if not worst or pulls[worst] <= TOO_FAR_SIGMA:
        return ""
    where = f"the {worst.replace('_', ' ')} is estimated {pulls[worst]:.0f} prior sigmas from its nominal value"
    return f"{where}: are the cameras swapped, is a unit or a file wrong, or the clock off?"


def used_motions(solution: Solution) -> tuple[np.ndarray, tuple[str, ...]]:
    """(N,) whether each motion of the solve was used, and why not."""
    codes = [MotionReason(int(code)) for code in solution.reason.cpu()]
    used = np.array([code in (MotionReason.USED, MotionReason.OUTLIER_ONE_CAMERA) for code in codes])
    return used, tuple("" if code is MotionReason.USED else code.sentence for code in codes)


def residuals_normalised(solution: Solution, used: np.ndarray) -> dict[str, dict[str, Any]]:
    """Residuals per kind and camera in normalised image units, for observations without a camera."""
    return {
        name: residual_record(by_motion, "1e-3 of the focal length", used)
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


def residual_record(by_motion: np.ndarray, unit: str, used: np.ndarray) -> dict[str, Any]:
    """Median and root mean square over the used motions, with the value of every motion that was measured."""
    known = by_motion[np.isfinite(by_motion) & used]
    median = float(np.median(known)) if len(known) else None
    rms = float(np.sqrt(np.mean(known**2))) if len(known) else None
    return {"unit": unit, "median": median, "rms": rms, "by_motion": by_motion}


def observability_record(observability: Observability, notes: tuple[str, ...] = ()) -> dict[str, Any]:
    """What the data can and cannot see, as plain values."""
    return {
        "verdict": observability.verdict.value,
        "sentences": [observability.sentence, *notes],
        "working_point_mm": list(observability.working_point_mm),
        "working_point_sigma_mm": observability.working_point_sigma_mm,
        "directions": [
            {"sigma_at_working_point_mm": sigma, "words": words} for sigma, words in observability.directions
        ],
        "named_cases": list(observability.degeneracies),
    }


def _nuisance_records(solution: Solution, joint_columns: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Every other unknown with its sigma, and the noise levels that were used."""
    records: dict[str, dict[str, Any]] = {}
    for name, nuisance in solution.nuisances.items():
        values, sigmas, held = (item.reshape(-1).tolist() for item in (nuisance.value, nuisance.sigma, nuisance.held))
        for index, (value, sigma, is_held) in enumerate(zip(values, sigmas, held, strict=True)):
            key = name if len(values) == 1 else f"{name}[{index}]"
            unit = nuisance.unit
            if name == "joint_offset":
                joint, unit = split_joint_column(joint_columns[index])
                key = f"{JOINT_OFFSET}{joint}"
            records[key] = {"value": value, "sigma": sigma, "unit": unit, "held": is_held}
    for name, level in solution.noise.items():
        records[f"noise {name}"] = {"value": float(level), "sigma": None, "unit": _noise_unit(name)}
    return records


def _noise_unit(name: str) -> str:
    return name.rpartition("_")[2] if name.endswith(("_mm", "_rad", "_deg")) else "x nominal"


def _transform(dst: str, src: str, matrix: torch.Tensor) -> RigidTransform:
    return RigidTransform(dst, src, matrix.detach().cpu())
