"""Observations to the answer: `rc.solve`, and the solve that every calibration shares."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, overload

import numpy as np
import torch

from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import CalibrationFailed, InputError
from rmis_calib.io import ShaftObservations
from rmis_calib.pipeline.answer.advice.next_motions import may_advise, seen_view, with_advice
from rmis_calib.pipeline.answer.advice.pose_candidates import WHERE, pose_candidates
from rmis_calib.pipeline.answer.offsets import estimate_with_kinematics
from rmis_calib.pipeline.answer.records.residuals import residual_of, residuals_normalised
from rmis_calib.pipeline.answer.result import make_result, used_motions
from rmis_calib.pipeline.arms.offset_unknowns import FileUnknowns, estimated_offsets, file_unknowns
from rmis_calib.pipeline.device import require_device
from rmis_calib.pipeline.motions.observations import problem_of
from rmis_calib.results import CalibrationResult, Motions
from rmis_calib.solver import Problem, Solution
from rmis_calib.solver import solve as solve_problem
from rmis_calib.solver.observability import Observability
from rmis_calib.solver.own_measurement import Measurement


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
        observations: N motions in the keys of docs/observations.md; with `differentiable` also a mapping of these
            keys to tensors, with any leading batch of trials.
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
    used, reasons = used_motions(solution)
    motions = Motions(used, tuple(reasons.tolist()))
    residuals, columns = residuals_normalised(solution, motions.used), () if unknowns is None else unknowns.columns
    for item in measurements:
        if item.name in solution.residual_own:
            by_motion = solution.residual_own[item.name].cpu().numpy()
            residuals[item.name] = residual_of(by_motion, item.unit, motions.used)
    result = make_result(solution, motions, residuals, config, columns, notes)
    advice = _advised(result.observability, solution, motions, observations, config, unknowns)
    result = replace(result, observability=advice)
    if throw:
        raise_unless_trustworthy(result)
    return result


def _advised(
    observability: Observability,
    solution: Solution,
    motions: Motions,
    observations: ShaftObservations,
    config: CalibrationConfig,
    unknowns: FileUnknowns | None,
) -> Observability:
    """With the motions that would help most, as the picture shows them."""
    if not may_advise(solution, config) or not motions.used.any():
        return observability
    problem = problem_of(observations, config).flatten_batch()
    if unknowns is not None:
        joint_offset, clock = estimated_offsets(solution, unknowns.columns, problem.radius_mm)
        at_clock = problem.radius_mm.new_tensor([clock])
        problem = unknowns.linearised(problem, joint_offset[None], at_clock, torch.zeros_like(joint_offset))
    last = int(np.flatnonzero(motions.used)[-1])
    candidates = pose_candidates(problem, solution, last, config.solver.advice)
    return with_advice(observability, solution, candidates, seen_view(problem), config, WHERE)


def estimate(
    observations: ShaftObservations, config: CalibrationConfig, measurements: Sequence[Measurement] = ()
) -> Solution:
    """Run the configured solver on the configured kinds of measurement, and on the user's own."""
    return solve_problem(problem_of(observations, config).with_own(measurements), config.solver)


def raise_unless_trustworthy(result: CalibrationResult) -> None:
    """Turn a result that did not pass its own checks into an exception that carries it.

    Raises:
        CalibrationFailed: always, unless the status is `ok`.
    """
    if not result.trustworthy:
        raise CalibrationFailed(result.message, result)
