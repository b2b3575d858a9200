"""One call from a problem to a solution."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.errors import InputError, InsufficientDataError, ObservationsError
from rmis_calib.geometry.rigid import rigid_from_rotation_translation
from rmis_calib.solver.assess.assemble import joint_on_graph, joint_solution
from rmis_calib.solver.assess.evidence import CHANCE, weigh
from rmis_calib.solver.assess.information import motion_information, select_d_optimal
from rmis_calib.solver.assess.left_out import freed
from rmis_calib.solver.assess.observability import SHOWN_MOTIONS
from rmis_calib.solver.assess.two_step import CHECKED_MOTIONS, two_step_solution
from rmis_calib.solver.estimate.map_estimate import map_estimate
from rmis_calib.solver.estimate.relinearise import Kinematics, solve_relinearised, start_of
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.observation_arrays import MIN_MOTIONS
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import Method, SolverSettings
from rmis_calib.solver.solution import AlternativeModel, Solution, concatenate, take_solved
from rmis_calib.solver.start.candidates import best_candidate
from rmis_calib.solver.start.line_statistics import LineStatistics
from rmis_calib.solver.start.paper import average, empirical_covariance, influence, solve_paper, votes
from rmis_calib.solver.status import MotionReason
from rmis_calib.solver.tensors import map_tensors, spans

GROUP_MOTIONS = 32768
"""Motions (times trials) that are solved together: a batch of trials is cut into groups whose tensors stay in the
cache, and in which nobody waits for a trial that takes more steps."""


def solve(
    problem: Problem,
    settings: SolverSettings | None = None,
    method: Method | None = None,
    kinematics: Kinematics | None = None,
    alternative: AlternativeModel | None = None,
    differentiable: bool = False,
) -> Solution:
    """Estimates `camera_right_T_arm` of every trial.

    Args:
        problem: any leading trial batch.
        settings: defaults when absent.
        method: overrides the settings' method.
        kinematics: evaluates both arms at joint and clock offsets (relinearise.py); with it, `joint` iterates on them.
        alternative: the answer of another model, which the covariance of `joint` then allows for.
        differentiable: whether `camera_right_T_arm`, `camera_left_T_camera_right` and `covariance` pass gradients to
            the problem's tensors. They are those of the whole solve, by implicit differentiation at the answer
            (estimate/on_graph.py), noise levels and bias correction included; held are the choices that jump: which
            measurements are outliers, which basin was taken, which motions are kept, by how much the covariance
            grows as groups of motions disagree, and what it allows for besides (`Solution.doubt`). All motions are on
            the graph at once: about 100 kB each in `joint`. Gradients of trials that did not converge mean nothing.

    Raises:
        InputError: `differentiable` together with `kinematics` or `alternative`.
        ObservationsError: values that are not finite where they must be, or rotations that are not rotations.
        InsufficientDataError: too few measured lines in some trial.
    """
    settings = settings or SolverSettings()
    if differentiable and (kinematics is not None or alternative is not None):
        raise InputError(
            where="differentiable", expected="a solve without kinematics of offsets", found="one with them"
        )
    settings = with_setup(settings, problem, method or settings.method)
    flat, frame = problem.flatten_batch(), "arm"
    if settings.unknowns.setup == "free" and bool(flat.laparoscope_stands_still.all()):
        flat, frame, kinematics = flat.in_instrument_base(), "instrument_base", None
        settings = replace(settings, unknowns=replace(settings.unknowns, setup="known"))
    with torch.inference_mode(not differentiable):  # no graph is kept: a fifth of the time of 1,728 motions
        solution = _solve_groups(flat, settings, method or settings.method, kinematics, alternative)
    return replace(_shaped(solution, problem.batch_shape), frame=frame)


def _solve_groups(
    flat: Problem,
    settings: SolverSettings,
    method: Method,
    kinematics: Kinematics | None,
    alternative: AlternativeModel | None,
) -> Solution:
    """All trials, in groups where they are many."""
    _check(flat)
    count = max(1, GROUP_MOTIONS // flat.n_motions)
    alone = kinematics is not None or alternative is not None or settings.thin_to is not None
    if flat.n_trials <= count or alone:
        return _solve_by_evidence(flat, settings, method, kinematics, alternative)
    groups = [_solve_by_evidence(flat.take_trials(part), settings, method) for part in spans(flat.n_trials, count)]
    return concatenate(groups)


def _solve_by_evidence(
    flat: Problem,
    settings: SolverSettings,
    method: Method,
    kinematics: Kinematics | None = None,
    alternative: AlternativeModel | None = None,
) -> Solution:
    """Trials that are solved together; where the data ask for an unknown that was left out, they are solved again with
    it, that of least chance first."""
    solution = _solve_flat(flat, settings, method, kinematics, alternative)
    if not solution.evidence:
        return solution
    names = list(solution.evidence)
    chances_of = torch.stack([solution.evidence[name] / CHANCE[name] for name in names])
    which = torch.where(chances_of.amin(0) < 1.0, chances_of.argmin(0), -1)
    if bool((which < 0).all()):
        return solution
    parts, order = [], []
    for number, name in enumerate([None, *names]):
        index = torch.nonzero(which == number - 1)[:, 0]
        if not len(index):
            continue
        part = take_solved(solution, index)
        if name is not None:
            with_it = replace(settings, unknowns=freed(settings.unknowns, name))
            again = _solve_by_evidence(flat.take_trials(index), with_it, method, kinematics, alternative)
            part = replace(again, evidence=part.evidence)
        parts.append(part)
        order.append(index)
    return take_solved(concatenate(parts), torch.cat(order).argsort())


def _solve_flat(
    flat: Problem,
    settings: SolverSettings,
    method: Method,
    kinematics: Kinematics | None = None,
    alternative: AlternativeModel | None = None,
) -> Solution:
    """Trials that are solved together, checked before. Outside of inference mode, on the graph of the problem."""
    if method != "joint":
        return _solve_two_step(flat, settings, method)
    chosen, index, kept, on_graph = flat, None, 1.0, not torch.is_inference_mode_enabled()
    with torch.no_grad():
        if settings.thin_to is not None and settings.thin_to < flat.n_motions:
            index, kept = _informative(flat, settings, settings.thin_to)
            chosen = flat.select_motions(index)
        if kinematics is None and settings.unknowns.setup == "known":
            fit = map_estimate(chosen.detach(), settings)
        else:
            own = _of_motions(kinematics, index)
            fit = solve_relinearised(start_of(chosen.detach(), settings, own), settings, own)
        solution = joint_solution(fit, settings, weigh(fit, settings), alternative)
    if on_graph:
        attached = flat if index is None else flat.select_motions(index)
        if settings.unknowns.setup != "known":
            attached = attached.at_setup(fit.problem.chains[1])
        solution = joint_on_graph(solution, attached, fit, settings)
    return solution if index is None else replace(_spread(solution, index, flat.n_motions), information_kept=kept)


def _solve_two_step(flat: Problem, settings: SolverSettings, method: Method) -> Solution:
    """`paper` and `global`."""
    R, t, covariance = _two_step_estimate(flat, settings, method)
    with torch.no_grad():
        solution = two_step_solution(flat.detach(), R.detach(), t.detach(), covariance.detach(), settings, method)
    if torch.is_inference_mode_enabled():
        return solution
    unseen = solution.covariance - covariance.detach()  # what the lines do not tell
    return replace(solution, camera_right_T_arm=rigid_from_rotation_translation(R, t), covariance=covariance + unseen)


def _two_step_estimate(
    flat: Problem, settings: SolverSettings, method: str
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], Float[Tensor, "b 6 6"]]:
    """Rotation, then translation, from sums over the axis lines; and the scatter of both."""
    statistics = LineStatistics.from_problem(flat)
    fewest = int(statistics.count.sum(-1).min())
    if fewest < MIN_MOTIONS:
        raise InsufficientDataError(where="axis lines", expected=f"at least {MIN_MOTIONS}", found=fewest)
    stride = max(1, flat.n_motions // SHOWN_MOTIONS)
    part = flat.select_motions(slice(None, None, stride)) if stride > 1 else flat
    if method == "paper":
        R_each, t_each = solve_paper(statistics)
        weight = votes(statistics.count)
        R, t = average(R_each, t_each, weight)
        shares = influence(part, R_each, t_each, weight)
    else:
        R, t = best_candidate(statistics, settings.grid, settings.minima)
        shares = influence(part, R[:, None], t[:, None])
    return R, t, empirical_covariance(shares) * (part.n_motions / flat.n_motions)


def with_setup(settings: SolverSettings, problem: Problem, method: Method) -> SolverSettings:
    """The settings with what becomes of the set-up: `free` wherever nothing states it, and a prior where the
    observations say how well it is known (of a laparoscope that stands still, such a prior tells less than nothing
    stated: the instrument's base in the camera).

    Raises:
        ObservationsError: it is to be an unknown, and the laparoscope's own kinematics are not told.
        InputError: it must be an unknown, and the method has none.
    """
    asked = settings.unknowns.setup
    if problem.setup_stated is None:
        if asked != "known":
            raise ObservationsError(
                where=f"solver.unknowns.setup: {asked}", expected="laparoscope_base_T_arm of every motion", found="none"
            )
        return settings
    stated = torch.isfinite(problem.setup_stated).flatten(-2).all(-1)
    chosen = asked if bool(stated.all()) else "free"
    if chosen == "known" and bool(((problem.noise.setup_mm > 0) | (problem.noise.setup_rad > 0)).any()):
        chosen = "free" if bool(problem.laparoscope_stands_still.all()) else "prior"
    if chosen != "known" and method != "joint":
        raise InputError(
            where="method",
            expected="joint, where the set-up (laparoscope_base_T_instrument_base) is an unknown",
            found=method,
        )
    return replace(settings, unknowns=replace(settings.unknowns, setup=chosen))


def _of_motions(kinematics: Kinematics | None, index: Int[Tensor, " k"] | None) -> Kinematics | None:
    """The kinematics of some motions alone."""
    if index is None or kinematics is None:
        return kinematics
    return lambda *at: kinematics(*at).select_motions(index)


def _informative(flat: Problem, settings: SolverSettings, count: int) -> tuple[Int[Tensor, " k"], float]:
    """The motions that `thin_to` keeps, by their information at the estimate of an even sample.

    Raises:
        InputError: a batch of trials, whose motions cannot be chosen together.
    """
    if flat.n_trials != 1:
        raise InputError(where="thin_to", expected="a single trial", found=f"{flat.n_trials} trials")
    first = map_estimate(
        flat.select_motions(slice(None, None, max(1, flat.n_motions // max(count, CHECKED_MOTIONS)))), settings
    )
    model = replace(first.model, measured=pack(flat, settings.noise), weight=None)
    whole = slice(None)
    parts = [
        motion_information(model.narrow(whole, part), first.state)[0] for _, along in model.parts() for part in along
    ]
    information = torch.cat(parts)
    return select_d_optimal(information, torch.diag(first.model.layout.sigma[0].square().reciprocal()), count)


def _spread(solution: Solution, index: Int[Tensor, " k"], n: int) -> Solution:
    """The solution of some motions with its per-motion values at their places among all `n`; the others are marked as
    thinned."""

    def spread(value: Tensor, empty: float | int) -> Tensor:
        out = torch.full((*value.shape[:-1], n), empty, dtype=value.dtype, device=value.device)
        out[..., index] = value
        return out

    names = ("residual_lines", "residual_ends", "residual_heads", "distance")
    values: dict[str, Any] = {name: spread(getattr(solution, name), torch.nan) for name in names}
    values["residual_own"] = {name: spread(value, torch.nan) for name, value in solution.residual_own.items()}
    if solution.groups is not None:
        values["groups"] = replace(solution.groups, group=spread(solution.groups.group, -1))
    return replace(solution, reason=spread(solution.reason, int(MotionReason.THINNED)), **values)


def _check(problem: Problem) -> None:
    poses = problem.arm_T_rcm
    if not bool(torch.isfinite(poses).all()):
        raise ObservationsError(where="arm_T_rcm", expected="finite poses", found="NaN or infinity")
    for name, R in (
        ("arm_T_rcm", poses[..., :3, :3]),
        ("camera_left_T_camera_right", problem.camera_T_camera_right[..., :3, :3]),
    ):
        gap = float((R.detach() @ R.detach().mT - torch.eye(3, dtype=R.dtype, device=R.device)).abs().max())
        handed = (torch.linalg.cross(R[..., 0], R[..., 1]) * R[..., 2]).sum(-1)  # LU of a million 3x3 takes a second
        if not gap < 1e-5 or not bool((handed > 0).all()):
            raise ObservationsError(
                where=name, expected="rotations (orthonormal, determinant +1)", found=f"a deviation of {gap:.2g}"
            )


def _shaped(solution: Solution, batch: torch.Size) -> Solution:
    """The solution with the problem's own batch shape, in tensors that autograd may use (copies: those made in
    inference mode it may not)."""

    def shaped(value: Tensor) -> Tensor:
        return value.clone().reshape((*batch, *value.shape[1:]))

    flat = ("observability", "posterior", "groups", "clock_jump", "tests", "causes", "history")
    return replace(
        solution,
        **{name: map_tensors(item, torch.clone if name in flat else shaped) for name, item in vars(solution).items()},
    )
