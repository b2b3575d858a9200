"""Joint estimates made into solutions: status, reasons, covariance, set-up and shaft ends."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.geometry.rigid import rigid_exp, rigid_from_rotation_translation, rigid_inverse, rigid_log
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.solver.assess.causes import causes_of
from rmis_calib.solver.assess.clock_jump import find_clock_jump
from rmis_calib.solver.assess.evidence import Evidence
from rmis_calib.solver.assess.groups import check_groups
from rmis_calib.solver.assess.instrument_base import instrument_base
from rmis_calib.solver.assess.left_out import reported
from rmis_calib.solver.assess.nuisances import nuisances_of
from rmis_calib.solver.assess.observability import observability_of
from rmis_calib.solver.assess.residual_tests import answer_tests, fit_tests
from rmis_calib.solver.assess.residuals_by_motion import residuals_by_motion
from rmis_calib.solver.estimate.map_estimate import MapEstimate
from rmis_calib.solver.estimate.noise_levels import COMPONENTS
from rmis_calib.solver.estimate.on_graph import attach
from rmis_calib.solver.estimate.outliers import REJECTED
from rmis_calib.solver.model.motion_covariance import NoiseModel
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import SolverSettings
from rmis_calib.solver.solution import AlternativeModel, GroupCheck, Posterior, SetupEstimate, Solution
from rmis_calib.solver.status import MotionReason, SolveStatus

MIN_CHEIRALITY = 0.5
MAX_CHI2_PER_DOF = 3.0
"""Past this the model is wrong (swapped cameras, another rig), and no larger noise level makes it right."""


def joint_solution(
    fit: MapEstimate,
    settings: SolverSettings,
    evidence: Evidence,
    alternative: AlternativeModel | None = None,
) -> Solution:
    """Solution of the joint estimate; its covariance allows for unknowns that were left out, and for the alternative
    model."""
    measured, state = fit.model.measured, fit.state
    C = fit.covariance[:, :6, :6]
    status, reason, excess = _judge(fit)
    C = C * excess.clamp_min(1.0)[:, None, None]  # too small noise levels would make sigma too small (Birge 1932)
    groups = check_groups(fit, settings.groups)
    C = groups.grown(C)
    jump = find_clock_jump(fit, excess, groups)
    tests = answer_tests(groups, jump, measured.motions).joined(fit_tests(fit, settings))
    causes = causes_of(fit, groups, jump, excess) if bool(tests.against.any()) else {}
    setup = _setup(fit, excess, groups, evidence)
    for name in evidence.doubt.keys() - {"setup"}:
        C = C + evidence.doubt[name][:, :6, :6]
    if alternative is not None:
        C = _mixed(C, state.R, state.t, alternative)
    camera_right_T_arm, base = rigid_from_rotation_translation(state.R, state.t), None
    if "setup" in evidence.doubt:
        base = instrument_base(fit.problem, camera_right_T_arm, C)
        C = C + evidence.doubt["setup"]
    distance = (fit.distance2 / measured.rows_ok.sum(0).clamp_min(1)).sqrt()
    uses = (measured.has_contours, measured.has_ends, measured.has_heads)
    left = rigid_from_rotation_translation(state.stereo_R, state.stereo_t) if measured.cameras == 2 else None
    shown = residuals_by_motion(measured, state)
    return Solution(
        method="joint",
        camera_right_T_arm=camera_right_T_arm,
        camera_left_T_camera_right=left,
        covariance=C,
        status=status,
        cheirality=fit.cheirality,
        iterations=fit.steps,
        chi2_per_dof=excess,
        distance=torch.where(measured.rows_ok.any(0), distance, torch.nan),
        reason=reason,
        noise={name: getattr(fit.model.noise, name).sqrt() for name in COMPONENTS},
        nuisances=nuisances_of(fit, settings),
        bias=fit.bias[:, :6],
        groups=groups,
        clock_jump=jump,
        tests=tests,
        causes=causes,
        setup=setup,
        instrument_base=base,
        evidence=evidence.chance,
        doubt={name: doubt[:, :6, :6] for name, doubt in evidence.doubt.items()},
        history=fit.history,
        observability=observability_of(fit.problem, state.R, state.t, C, fit.model.noise, uses, settings),
        posterior=_posterior(fit, excess.clamp_min(1.0)),
        residual_lines=shown.lines,
        residual_ends=shown.ends,
        residual_heads=shown.heads,
        residual_own=shown.own,
        ends=_ends(fit),
    )


def _ends(fit: MapEstimate) -> Int[Tensor, "b 3 3"]:
    """Ends by kind and place (`Solution.ends`), without those of pictures that were rejected."""
    problem, rows = fit.problem, fit.model.measured
    kept = torch.zeros_like(problem.end_measured)
    second = torch.zeros_like(kept)
    if rows.has_ends:
        kept, second = rows.end_ok.transpose(0, 1), (rows.end_second > 0).transpose(0, 1)
    used = kept & (fit.weight > REJECTED).transpose(0, 1)
    places = torch.stack((used & ~second, used & second, problem.end_measured & ~kept), -1)
    kind = problem.end_kind
    kinds = torch.stack((torch.isnan(kind), kind == 0, kind == 1), -1)
    return torch.einsum("bcnk,bcnp->bkp", kinds.double(), places.double()).round().long()


def joint_on_graph(solution: Solution, problem: Problem, fit: MapEstimate, settings: SolverSettings) -> Solution:
    """The solution with its transforms and covariance as functions of the problem's tensors.

    Args:
        problem: what `fit` is the estimate of, on the graph.
    """
    found = attach(problem, fit, settings)
    rows = fit.model.measured.keep(fit.weight > REJECTED).rows_ok.sum((0, 2))
    excess = found.chi2 / (rows - 6.0).clamp_min(1.0)
    covariance = found.covariance[:, :6, :6] * excess.clamp_min(1.0)[:, None, None]
    left = solution.camera_left_T_camera_right
    if solution.groups is not None:
        covariance = solution.groups.grown(covariance)
    for doubt in solution.doubt.values():
        covariance = covariance + doubt.detach()
    return replace(
        solution,
        camera_right_T_arm=rigid_from_rotation_translation(found.state.R, found.state.t),
        camera_left_T_camera_right=None
        if left is None
        else rigid_from_rotation_translation(found.state.stereo_R, found.state.stereo_t),
        covariance=covariance,
    )


def _setup(
    fit: MapEstimate, excess: Float[Tensor, " b"], groups: GroupCheck, evidence: Evidence
) -> SetupEstimate | None:
    """The set-up that was estimated, and the joint covariance, grown like that of the transform, with its doubts."""
    at = fit.problem.laparoscope_base_T_instrument_base
    if "setup" not in fit.model.layout.blocks or at is None:
        return None
    b, index = len(excess), reported(fit.model.layout)
    estimate = at @ rigid_exp(fit.state.setup)
    # From a perturbation on the right, in `instrument_base`, to one on the left.
    turn = torch.zeros(b, 12, 12, dtype=at.dtype, device=at.device)
    turn[:, :6, :6] = groups.growth
    turn[:, 6:9, 6:9] = turn[:, 9:, 9:] = groups.inflation[:, None, None] * estimate[:, :3, :3]
    covariance = fit.covariance[:, index][:, :, index] * excess.clamp_min(1.0)[:, None, None]
    covariance = turn @ covariance @ turn.mT
    turn[:, :6, :6] = torch.eye(6, dtype=at.dtype, device=at.device)
    turn[:, 6:9, 6:9] = turn[:, 9:, 9:] = estimate[:, :3, :3]
    for doubt in evidence.doubt.values():
        covariance = covariance + turn @ doubt @ turn.mT
    stated = fit.problem.setup_stated
    known = torch.full_like(at, torch.nan) if stated is None else stated
    is_known = torch.isfinite(known).flatten(1).all(-1)
    away = rigid_log(rigid_inverse(torch.where(is_known[:, None, None], known, estimate)) @ estimate)
    return SetupEstimate(
        laparoscope_base_T_instrument_base=estimate,
        covariance=covariance,
        from_stated=torch.where(is_known[:, None], away, torch.nan),
    )


def _mixed(
    C: Float[Tensor, "b 6 6"], R: Float[Tensor, "b 3 3"], t: Float[Tensor, "b 3"], alternative: AlternativeModel
) -> Float[Tensor, "b 6 6"]:
    """Covariance about this estimate when the alternative model is right with its probability (Bayesian model
    averaging: Hoeting et al. 1999)."""
    T = alternative.camera_right_T_arm.reshape(-1, 4, 4)
    gap = torch.cat((matrix_to_rotvec(T[:, :3, :3] @ R.mT), T[:, :3, 3] - t), dim=-1)
    weight = alternative.probability.reshape(-1, 1, 1)
    return (1.0 - weight) * C + weight * (alternative.covariance.reshape(-1, 6, 6) + gap[:, :, None] * gap[:, None])


def _posterior(fit: MapEstimate, excess: Float[Tensor, " b"]) -> Posterior:
    """The fit with all variances `excess` times as large, without what holds for its own poses alone."""
    noise = NoiseModel(**{name: value * excess for name, value in vars(fit.model.noise).items()})
    layout, information = fit.model.layout, fit.information
    if "compliance" in layout.blocks:  # of these poses alone, and the last block: eliminated
        kept = layout.blocks["compliance"].start
        blocks = {name: part for name, part in layout.blocks.items() if name != "compliance"}
        layout = replace(layout, blocks=blocks, sigma=layout.sigma[:, :kept])
        between = information[:, :kept, kept:]
        others = torch.linalg.solve(information[:, kept:, kept:], between.mT)
        information = information[:, :kept, :kept] - between @ others
    return Posterior(fit.state, layout, noise, information / excess[:, None, None])


def _judge(fit: MapEstimate) -> tuple[Int[Tensor, " b"], Int[Tensor, "b n"], Float[Tensor, " b"]]:
    """Status, what became of each motion, and chi^2 per degree of freedom."""
    rows, used = fit.model.measured, fit.weight > REJECTED
    measured = rows.rows_seen > 0
    good = (used & measured).any(0)
    reason = torch.where(good, MotionReason.USED, MotionReason.OUTLIER)
    reason = torch.where(good & (measured & ~used).any(0), MotionReason.OUTLIER_ONE_CAMERA, reason)
    reason = torch.where(measured.any(0), reason, MotionReason.NOT_MEASURED)
    # By camera: with swapped videos one camera alone fits perfectly, and the other one not at all.
    kept = torch.where(measured.any(-1), (used & measured).sum(-1) / measured.sum(-1).clamp_min(1), 1.0).amin(0)
    excess = fit.chi2 / (rows.keep(used).rows_ok.sum((0, 2)) - 6.0).clamp_min(1.0)
    status = fit.status
    for wrong, code in (
        (fit.cheirality < MIN_CHEIRALITY, SolveStatus.BEHIND_CAMERA),
        (kept < 0.5, SolveStatus.INCONSISTENT),
        (excess > MAX_CHI2_PER_DOF, SolveStatus.MISFIT),
    ):
        status = torch.where(wrong & (status == SolveStatus.CONVERGED), code, status)
    # A correction of the points' scale beyond that turns the camera inside out: nothing can be predicted with it.
    inside_out = (fit.state.intrinsics[..., 0] <= -1.0).any(-1)
    status = torch.where(inside_out, int(SolveStatus.NO_CAMERA), status)
    return status, reason, excess
