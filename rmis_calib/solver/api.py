"""One call from a problem to a solution."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.errors import InputError, InsufficientDataError, ObservationsError
from rmis_calib.geometry.rigid import rigid_from_rotation_translation
from rmis_calib.solver.competition import cheirality
from rmis_calib.solver.design import motion_information, thin
from rmis_calib.solver.initialise import COLLAPSED_MM, collapsed, find_candidates
from rmis_calib.solver.joint import JointFit, solve_joint
from rmis_calib.solver.measurements import END, HEAD, LINE, Packed, pack
from rmis_calib.solver.normal import NoiseModel, accumulate
from rmis_calib.solver.observability import Degeneracy, Sight, look, recognise
from rmis_calib.solver.paper import average, empirical_covariance, influence, solve_paper
from rmis_calib.solver.problem import MIN_MOTIONS, Problem
from rmis_calib.solver.relinearise import Kinematics, solve_relinearised
from rmis_calib.solver.residuals import State, residual_rows
from rmis_calib.solver.settings import SolverSettings, UnknownSettings
from rmis_calib.solver.solution import MotionReason, Nuisance, Solution, SolveStatus
from rmis_calib.solver.statistics import LineStatistics
from rmis_calib.solver.unknowns import TRANSLATION_SIGMA_MM, UNITS, Nominal, initial_state, make_layout
from rmis_calib.solver.variance import assumed_noise

MIN_CHEIRALITY = 0.5
CHECKED_MOTIONS = 256
MAX_CHI2_PER_DOF = 3.0
"""Past this the model is wrong (swapped cameras, another rig), and no larger noise level makes it right."""
SHOWN_MOTIONS = 4096
"""Motions from which the degenerate cases are recognised, and on which the scatter of the two-step methods is measured; longer recordings are sampled evenly."""


def solve(
    problem: Problem, settings: SolverSettings | None = None, method: str | None = None, kinematics: Kinematics | None = None
) -> Solution:
    """Estimates `camera_right_T_arm` of every trial.

    Args:
        problem: any leading trial batch.
        settings: defaults when absent.
        method: overrides the settings' method.
        kinematics: evaluates both arms at joint and clock offsets (relinearise.py); with it, `joint` iterates on them.

    Raises:
        ObservationsError: values that are not finite where they must be, or rotations that are not rotations.
        InsufficientDataError: too few measured lines in some trial.
    """
    settings = settings or SolverSettings()
    method = method or settings.method
    flat = problem.flatten_batch()
    _check(flat)
    if method == "joint":
        index, kept = None, 1.0
        if settings.thin_to is not None and settings.thin_to < flat.n_motions:
            index, kept = _informative(flat, settings, settings.thin_to)
            flat = flat.select_motions(index)
        fit = solve_joint(flat, settings) if kinematics is None else solve_relinearised(flat, settings, kinematics)
        solution = _joint_solution(fit, settings)
        if index is not None:
            solution = replace(_spread(solution, index, problem.n_motions), information_kept=kept)
        return _shaped(solution, problem.batch_shape)
    statistics = LineStatistics.from_problem(flat)
    if bool((statistics.count.sum(-1) < MIN_MOTIONS).any()):
        raise InsufficientDataError(where="axis lines", expected=f"at least {MIN_MOTIONS}", found=int(statistics.count.sum(-1).min()))
    stride = max(1, flat.n_motions // SHOWN_MOTIONS)
    part = flat.select_motions(slice(None, None, stride)) if stride > 1 else flat
    if method == "paper":
        R_each, t_each = solve_paper(statistics)
        R, t = average(R_each, t_each)
        shares = torch.stack([influence(part, R_each[:, c], t_each[:, c], (c,)) for c in range(flat.n_cameras)]).mean(0)
    else:
        R, t, _ = find_candidates(statistics, settings.grid, settings.minima).best()
        shares = influence(part, R, t, tuple(range(flat.n_cameras)))
    return _shaped(_two_step_solution(flat, R, t, empirical_covariance(shares) * (part.n_motions / flat.n_motions), settings, method), problem.batch_shape)


def _informative(flat: Problem, settings: SolverSettings, count: int) -> tuple[Int[Tensor, " k"], float]:
    """The motions that `thin_to` keeps, by their information at the estimate of an even sample.

    Raises:
        InputError: a batch of trials, whose motions cannot be chosen together.
    """
    if flat.n_trials != 1:
        raise InputError(where="thin_to", expected="a single trial", found=f"{flat.n_trials} trials")
    first = solve_joint(flat.select_motions(slice(None, None, max(1, flat.n_motions // max(count, CHECKED_MOTIONS)))), settings)
    packed = pack(flat, settings.noise)
    information = torch.cat(
        [
            motion_information(packed.narrow(slice(None), slice(n, n + settings.chunk)), first.state, first.layout, first.noise)[0]
            for n in range(0, flat.n_motions, settings.chunk)
        ]
    )
    return thin(information, torch.diag(first.layout.sigma[0].square().reciprocal()), count)


def _spread(solution: Solution, index: Int[Tensor, " k"], n: int) -> Solution:
    """The solution of some motions with its per-motion values at their places among all `n`; the others are marked as thinned."""

    def spread(value: Tensor, empty: float | int) -> Tensor:
        out = torch.full((*value.shape[:-1], n), empty, dtype=value.dtype, device=value.device)
        out[..., index] = value
        return out

    names = ("residual_lines", "residual_ends", "residual_heads", "distance")
    values = {name: spread(getattr(solution, name), torch.nan) for name in names}
    return replace(solution, reason=spread(solution.reason, int(MotionReason.THINNED)), **values)


def _check(problem: Problem) -> None:
    poses = problem.arm_T_rcm
    if not bool(torch.isfinite(poses).all()):
        raise ObservationsError(where="arm_T_rcm", expected="finite poses", found="NaN or infinity")
    for name, R in (("arm_T_rcm", poses[..., :3, :3]), ("camera_left_T_camera_right", problem.camera_T_camera_right[..., :3, :3])):
        gap = float((R @ R.mT - torch.eye(3, dtype=R.dtype, device=R.device)).abs().max())
        handed = (torch.linalg.cross(R[..., 0], R[..., 1]) * R[..., 2]).sum(-1)  # LU of a million 3x3 takes a second
        if not gap < 1e-5 or not bool((handed > 0).all()):
            raise ObservationsError(where=name, expected="rotations (orthonormal, determinant +1)", found=f"a deviation of {gap:.2g}")


def _two_step_solution(flat: Problem, R: Tensor, t: Tensor, covariance: Tensor, settings: SolverSettings, method: str) -> Solution:
    """Solution of `paper` and `global`, which use the axis lines alone."""
    axis_only = flat.only("axis")
    covariance = covariance + _unseen_depth(flat, R, t)
    packed = pack(axis_only, settings.noise)
    noise, _ = assumed_noise(flat, settings.noise)
    state = initial_state(Nominal.of(axis_only), R, t)
    front = cheirality(packed, state, torch.ones_like(packed.line_ok[0]))
    status = torch.where(front < MIN_CHEIRALITY, SolveStatus.BEHIND_CAMERA, SolveStatus.CONVERGED)
    status = torch.where(torch.isfinite(covariance).all(-1).all(-1) & torch.isfinite(t).all(-1), status, SolveStatus.NON_FINITE)
    seen = packed.line_ok.any(0).any(0)
    excess = _chi2_per_dof(axis_only, state, noise, settings)
    status = torch.where((excess > MAX_CHI2_PER_DOF) & (status == SolveStatus.CONVERGED), SolveStatus.MISFIT, status)
    sight = _sight(axis_only, R, t, covariance, noise, (False, False, False), settings)
    static = (sight.degeneracy & Degeneracy.STATIC_LAPAROSCOPE) > 0
    # A two-step estimate from a laparoscope that stands still is biased by more than its scatter shows (DESIGN.md, section 3).
    sight = replace(sight, verdict=torch.where(static, sight.verdict.clamp_min(1), sight.verdict))
    return Solution(
        method=method,
        camera_right_T_arm=rigid_from_rotation_translation(R, t),
        camera_left_T_camera_right=flat.camera_T_camera_right[:, 1] if flat.n_cameras == 2 else None,
        covariance=covariance,
        status=status,
        cheirality=front,
        iterations=torch.zeros_like(status),
        chi2_per_dof=excess,
        distance=torch.full_like(seen, torch.nan, dtype=t.dtype),
        reason=torch.where(seen, MotionReason.USED, MotionReason.NOT_MEASURED),
        noise={},
        nuisances={},
        bias=torch.zeros_like(covariance[..., 0]),
        sight=sight,
        **_residuals(packed, state),
    )


def _chi2_per_dof(problem: Problem, state: State, noise: NoiseModel, settings: SolverSettings) -> Float[Tensor, " b"]:
    """Weighted squared residuals over degrees of freedom, on a few hundred motions: a fit in the wrong basin shows here where the cheirality does not."""
    part = problem.select_motions(slice(None, None, max(1, problem.n_motions // CHECKED_MOTIONS)))
    packed = pack(part, settings.noise)
    layout = make_layout(Nominal.of(part), packed, state, UnknownSettings(stereo=False), settings.noise)
    normal = accumulate(packed, state, layout, noise, settings.chunk)
    prior = layout.prior(state)
    return (normal.chi2 - (prior[0].square() * prior[1]).sum(-1)) / (normal.rows - 6.0).clamp_min(1.0)


def _unseen_depth(flat: Problem, R: Tensor, t: Tensor) -> Float[Tensor, "b 6 6"]:
    """Variance along the ray of the RCM where the lines of one camera do not tell its distance; zero elsewhere."""
    p = flat.arm_T_rcm[..., :3, 3] @ R.mT + t[:, None]
    centred = p - p.mean(-2, keepdim=True)
    nearly_static = centred.norm(dim=-1).mean(-1) < COLLAPSED_MM
    unseen = collapsed(p) | (nearly_static if flat.n_cameras == 1 else torch.zeros_like(nearly_static))
    ray = torch.nn.functional.normalize(p.mean(-2), dim=-1)
    block = TRANSLATION_SIGMA_MM**2 * ray[:, :, None] * ray[:, None]
    return torch.nn.functional.pad(torch.where(unseen[:, None, None], block, 0.0), (3, 0, 3, 0))


def _joint_solution(fit: JointFit, settings: SolverSettings) -> Solution:
    """Solution of the joint estimate."""
    packed, state = fit.packed, fit.state
    C = fit.covariance[:, :6, :6]
    seen = (packed.rows_ok.any(0))
    used = fit.weight > 0.5
    measured = torch.stack([packed.rows_ok[[i for i, rc in enumerate(packed.row_camera) if rc == c]].any(0) for c in range(packed.cameras)])
    good = (used & measured).any(0)
    reason = torch.where(~seen, MotionReason.NOT_MEASURED, torch.where(good, MotionReason.USED, MotionReason.OUTLIER))
    reason = torch.where(good & (measured & ~used).any(0), MotionReason.OUTLIER_ONE_CAMERA, reason)
    kept = (used & measured).sum((0, 2)) / measured.sum((0, 2)).clamp_min(1)
    status = torch.where((fit.cheirality < MIN_CHEIRALITY) & (fit.status == SolveStatus.CONVERGED), SolveStatus.BEHIND_CAMERA, fit.status)
    status = torch.where((kept < 0.5) & (status == SolveStatus.CONVERGED), SolveStatus.INCONSISTENT, status)
    dof = (packed.keep(used).rows_ok.sum((0, 2)) - 6.0).clamp_min(1.0)
    excess = fit.chi2 / dof
    status = torch.where((excess > MAX_CHI2_PER_DOF) & (status == SolveStatus.CONVERGED), SolveStatus.MISFIT, status)
    C = C * excess.clamp_min(1.0)[:, None, None]  # noise levels that are too small would make sigma too small (Birge 1932)
    distance = (fit.distance2 / packed.rows_ok.sum(0).clamp_min(1)).sqrt()
    left = rigid_from_rotation_translation(state.stereo_R, state.stereo_t) if packed.cameras == 2 else None
    return Solution(
        method="joint",
        camera_right_T_arm=rigid_from_rotation_translation(state.R, state.t),
        camera_left_T_camera_right=left,
        covariance=C,
        status=status,
        cheirality=fit.cheirality,
        iterations=fit.steps,
        chi2_per_dof=excess,
        distance=torch.where(seen, distance, torch.nan),
        reason=reason,
        noise={name: getattr(fit.noise, name).sqrt() for name in ("line", "end", "head", "kinematics_mm", "kinematics_rad")},
        nuisances=_nuisances(fit, settings),
        bias=fit.bias[:, :6],
        history=fit.history,
        sight=_sight(fit.problem, state.R, state.t, C, fit.noise, (packed.has_contours, packed.has_ends, packed.has_heads), settings),
        **_residuals(packed, state),
    )


def _nuisances(fit: JointFit, settings: SolverSettings) -> dict[str, Nuisance]:
    """Every estimated unknown beside the transform."""
    deviation, _ = fit.layout.prior(fit.state)
    sigma = fit.covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
    out = {}
    for name, part in fit.layout.blocks.items():
        if name in ("rotation", "translation"):
            continue
        value = fit.state.radius[:, None] if name == "radius" else deviation[:, part]
        held = sigma[:, part] > settings.unknowns.held_ratio * fit.layout.sigma[:, part]
        out[name] = Nuisance(value=value, sigma=sigma[:, part], unit=UNITS[name], held=held, pull=deviation[:, part] / fit.layout.sigma[:, part])
    return out


def _sight(
    problem: Problem, R: Tensor, t: Tensor, C: Tensor, noise: NoiseModel, uses: tuple[bool, bool, bool], settings: SolverSettings
) -> Sight:
    if problem.n_motions > SHOWN_MOTIONS:
        problem = problem.select_motions(slice(None, None, problem.n_motions // SHOWN_MOTIONS))
    first = look(problem, R, t, C, settings.verdict, torch.zeros_like(t[:, 0], dtype=torch.int64))
    distance = torch.linalg.vector_norm(first.working_point_mm, dim=-1)
    flags = recognise(problem, noise.kinematics_mm.sqrt(), noise.kinematics_rad.sqrt(), uses, settings.noise, distance)
    return replace(first, degeneracy=flags)


def _residuals(packed: Packed, state: State) -> dict[str, Float[Tensor, "b c n"]]:
    """Root mean square of each kind's residuals, per camera and motion; a long recording in parts."""
    step = max(1, 8 * SHOWN_MOTIONS // packed.trials)
    parts = [_residuals_of(packed.narrow(slice(None), slice(n, n + step)), state) for n in range(0, packed.motions, step)]
    return {name: torch.cat([part[name] for part in parts], dim=-1) for name in parts[0]}


def _residuals_of(packed: Packed, state: State) -> dict[str, Float[Tensor, "b c n"]]:
    r = residual_rows(packed, state)
    kinds, cameras = packed.row_kind, packed.row_camera
    out = {}
    for name, kind in (("residual_lines", LINE), ("residual_ends", END), ("residual_heads", HEAD)):
        per_camera = []
        for c in range(packed.cameras):
            rows = [i for i in range(len(kinds)) if kinds[i] == kind and cameras[i] == c]
            count = packed.rows_ok[rows].sum(0)
            rms = (r[rows].square().sum(0) / count.clamp_min(1)).sqrt()
            per_camera.append(torch.where(count > 0, rms, torch.nan))
        out[name] = torch.stack(per_camera, dim=1)
    return out


def _shaped(solution: Solution, batch: torch.Size) -> Solution:
    """The solution with the problem's own batch shape."""

    def shaped(value: Any) -> Any:
        if isinstance(value, Tensor):
            return value.reshape((*batch, *value.shape[1:]))
        if isinstance(value, dict):
            return {key: shaped(item) for key, item in value.items()}
        if isinstance(value, Nuisance):
            return Nuisance(shaped(value.value), shaped(value.sigma), value.unit, shaped(value.held), shaped(value.pull))
        return value

    names = [name for name in vars(solution) if name not in ("sight", "history")]
    return replace(solution, **{name: shaped(getattr(solution, name)) for name in names})
