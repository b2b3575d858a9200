"""Levenberg-Marquardt over a unit quaternion and a translation, with derivatives from autograd.

Steps live in the tangent space: R <- exp(dphi) R and t <- t + dt. The Jacobian is one forward-mode pass over as
many copies of the pose as there are free directions, so a residual needs no derivative of its own.
Source: Levenberg (1944), Marquardt (1963); Nocedal & Wright, Numerical Optimization, ch. 10.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
import torch.autograd.forward_ad as forward_ad
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.errors import InputError, ShapeError
from rmis_calib.geometry.rotations import quat_multiply, rotvec_to_quat
from rmis_calib.solver.model.batched_linalg import unit_diagonal
from rmis_calib.solver.model.forward_mode import load_forward_mode
from rmis_calib.solver.model.implicit import newton_on_graph
from rmis_calib.solver.status import SolveStatus

Residual = Callable[[Float[Tensor, "*batch 4"], Float[Tensor, "*batch 3"]], Float[Tensor, "*batch m"]]
"""(unit quaternion, translation) -> residuals in units of their sigma. Leading axes are prepended to those of the
start, so whatever the function closes over must broadcast against them."""
Free = Literal["rotation", "translation", "both"]

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e-12, 1e8
SINGULAR = 1e-13
"""Least eigenvalue of the information, scaled to a unit diagonal, of directions that the residuals see."""


@dataclass(frozen=True)
class Refinement:
    """Where a refinement ended.

    Attributes:
        quaternion: unit, (w, x, y, z).
        translation: in the unit of the start.
        cost: sum of the squared residuals.
        information: J^T J of the free directions: rotation (left perturbation, rad), then translation.
        status: a `SolveStatus` for every pose.
        iterations: steps tried.
    """

    quaternion: Float[Tensor, "*batch 4"]
    translation: Float[Tensor, "*batch 3"]
    cost: Float[Tensor, "*batch"]
    information: Float[Tensor, "*batch k k"]
    status: Int[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]

    @property
    def converged(self) -> Tensor:
        return self.status == SolveStatus.CONVERGED


def refine(
    residual_fn: Residual,
    quaternion: Float[Tensor, "*batch 4"],
    translation: Float[Tensor, "*batch 3"],
    *,
    free: Free = "both",
    max_iterations: int = 50,
    tolerance: float = 1e-9,
    max_turn_rad: float = torch.inf,
    differentiable: bool = False,
) -> Refinement:
    """Minimise the sum of squared residuals over poses; every pose of the batch on its own.

    Args:
        residual_fn: see `Residual`; `rmis_calib.residuals` has one for each equation.
        quaternion: start, (w, x, y, z), any length but 0.
        translation: start.
        free: what is refined; the other is held.
        max_iterations: steps of a pose at most.
        tolerance: settled where a step turns by less (rad) and shifts by less (times 1 + |t|).
        max_turn_rad: longest turn of one step.
        differentiable: whether `quaternion` and `translation` pass gradients to the tensors that `residual_fn` closes
            over, by implicit differentiation at the minimum: whatever the number of steps, one linear solve of the full
            Hessian. `residual_fn` must then be twice differentiable. Gradients of poses that are not CONVERGED mean
            nothing.

    Returns:
        The poses with a status each. A pose that is not finite, or whose residuals do not see some direction, is data
        with a status, never an exception.

    Raises:
        InputError: `free` is none of the three. ShapeError: the starts or the residuals do not have these shapes.
    """
    if free not in ("rotation", "translation", "both"):
        raise InputError(where="free", expected="rotation, translation or both", found=repr(free))
    if quaternion.shape[-1:] != (4,) or translation.shape != (*quaternion.shape[:-1], 3):
        raise ShapeError(
            where="refine",
            expected="a quaternion (*batch, 4) and a translation (*batch, 3)",
            found=f"{tuple(quaternion.shape)} and {tuple(translation.shape)}",
        )
    load_forward_mode()
    with torch.inference_mode(False), torch.no_grad():
        q, t = torch.nn.functional.normalize(quaternion, dim=-1).clone(), translation.clone()
        found = _minimise(residual_fn, q, t, free, max_iterations, tolerance, max_turn_rad)
    return _attached(residual_fn, found, free) if differentiable else found


def _attached(residual_fn: Residual, found: Refinement, free: Free) -> Refinement:
    """The same poses as functions of the data.

    At the minimum the gradient of half the cost vanishes: that is the equation (implicit.py).
    """
    q, t = found.quaternion, found.translation

    def gradient(step: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch k"]:
        half_cost = 0.5 * residual_fn(*_moved(q, t, step, free)).square().sum()
        return torch.autograd.grad(half_cost, step, create_graph=True)[0]

    step = newton_on_graph(gradient, found.information[..., 0])
    with torch.inference_mode(False), torch.enable_grad():
        q, t = _moved(q, t, step, free)
    return replace(found, quaternion=q, translation=t)


def _minimise(
    residual_fn: Residual, q: Tensor, t: Tensor, free: Free, max_iterations: int, tolerance: float, max_turn: float
) -> Refinement:
    cost, gradient, information = _derivatives(residual_fn, q, t, free)
    damping = torch.full_like(cost, FIRST_DAMPING)
    iterations = torch.zeros_like(cost, dtype=torch.int64)
    finite = torch.isfinite(cost)
    status = torch.where(finite, SolveStatus.MAX_ITERATIONS, SolveStatus.NON_FINITE)
    active = finite
    for _ in range(max_iterations):
        step = _limited(_step(information, gradient, damping), free, max_turn)
        new_q, new_t = _moved(q, t, step, free)
        new_cost, new_gradient, new_information = _derivatives(residual_fn, new_q, new_t, free)
        iterations = iterations + active
        better = active & (new_cost <= cost)
        settled = active & _is_small(step, t, free, tolerance)
        stuck = active & ~settled & ~better & (damping >= MOST_DAMPING)
        q, t = torch.where(better[..., None], new_q, q), torch.where(better[..., None], new_t, t)
        cost = torch.where(better, new_cost, cost)
        gradient = torch.where(better[..., None], new_gradient, gradient)
        information = torch.where(better[..., None, None], new_information, information)
        status = torch.where(settled, SolveStatus.CONVERGED, torch.where(stuck, SolveStatus.STALLED, status))
        damping = torch.where(better, damping * 0.1, damping.clamp_min(1e-4) * 10.0).clamp(LEAST_DAMPING, MOST_DAMPING)
        active = active & ~settled & ~stuck
        if not bool(active.any()):
            break
    blind = finite & (torch.linalg.eigvalsh(unit_diagonal(torch.nan_to_num(information))[0])[..., 0] < SINGULAR)
    status = torch.where(blind, SolveStatus.SINGULAR, status)
    return Refinement(q, t, cost, information, status, iterations)


def _derivatives(residual_fn: Residual, q: Tensor, t: Tensor, free: Free) -> tuple[Tensor, Tensor, Tensor]:
    """Cost, J^T r and J^T J."""
    turns, shifts = 3 * (free != "translation"), 3 * (free != "rotation")
    eye = torch.eye(4, dtype=q.dtype, device=q.device).reshape(4, *(1,) * (q.ndim - 1), 4)
    dq = torch.cat((0.5 * quat_multiply(eye[1:].expand(3, *q.shape), q)[:turns], q.new_zeros((shifts, *q.shape))))
    dt = torch.cat((t.new_zeros((turns, *t.shape)), eye[:shifts, ..., :3].expand(shifts, *t.shape)))
    k = turns + shifts
    with forward_ad.dual_level():  # `torch.func.jvp` does the same at four times the cost of a call
        dual_q = forward_ad.make_dual(q.expand(k, *q.shape).clone(), dq)
        dual_t = forward_ad.make_dual(t.expand(k, *t.shape).clone(), dt)
        residuals = residual_fn(dual_q, dual_t)
        if residuals.shape[:-1] != (k, *q.shape[:-1]):
            shape = f"residuals ({', '.join(map(str, (k, *q.shape[:-1])))}, m)"
            raise ShapeError(where="residual_fn", expected=shape, found=tuple(residuals.shape))
        r, J = forward_ad.unpack_dual(residuals)
    if J is None:
        raise InputError(where="residual_fn", expected="residuals that depend on the pose", found="constants")
    r, J = r[0], J.movedim(0, -2)  # (*batch, m), (*batch, k, m)
    return r.square().sum(-1), (J @ r[..., None])[..., 0], J @ J.mT


def _step(information: Tensor, gradient: Tensor, damping: Tensor) -> Tensor:
    diagonal = information.diagonal(dim1=-2, dim2=-1)
    least = 1e-12 * diagonal.amax(-1, keepdim=True).clamp_min(1e-300)  # a direction without any effect stays put
    system = information + torch.diag_embed(damping[..., None] * diagonal + least)
    return -torch.linalg.solve_ex(system, gradient[..., None]).result[..., 0].nan_to_num()


def _limited(step: Tensor, free: Free, max_turn: float) -> Tensor:
    if free == "translation" or max_turn == torch.inf:
        return step
    return step * (max_turn / torch.linalg.vector_norm(step[..., :3], dim=-1, keepdim=True).clamp_min(max_turn))


def _moved(q: Tensor, t: Tensor, step: Tensor, free: Free) -> tuple[Tensor, Tensor]:
    if free != "translation":
        q = torch.nn.functional.normalize(quat_multiply(rotvec_to_quat(step[..., :3]), q), dim=-1)
    return q, t if free == "rotation" else t + step[..., -3:]


def _is_small(step: Tensor, t: Tensor, free: Free, tolerance: float) -> Tensor:
    size = torch.ones_like(step)
    if free != "rotation":
        size[..., -3:] += torch.linalg.vector_norm(t, dim=-1, keepdim=True)
    return (step.abs() < tolerance * size).all(-1)
