"""Which motions matter: thinning long recordings, and advice on the next motion. Both rank motions by their
information on the transform."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.solver.measurements import Packed, pack
from rmis_calib.solver.normal import NoiseModel, covariance, image_variance
from rmis_calib.solver.observability import carried
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.residuals import State, linearise, predict_shaft
from rmis_calib.solver.settings import SolverSettings
from rmis_calib.solver.soa import eliminate
from rmis_calib.solver.unknowns import Layout, columns

THINNING_ROUNDS = 16
"""Motions are picked in this many rounds, the information updated between; one by one keeps under 1 per cent more."""
SHORTEST_VISIBLE_MM = 10.0
ALONG_SAMPLES = 48


def motion_information(packed: Packed, state: State, layout: Layout, noise: NoiseModel) -> Float[Tensor, "b n p p"]:
    """Information J^T S^-1 J of each motion on its own."""
    rows, shaft = linearise(packed, state)
    k, b, n = rows.r.shape
    system = torch.empty((k, k + layout.size, b, n), dtype=rows.r.dtype, device=rows.r.device)
    covariance(rows.w, rows.a, image_variance(packed, noise), packed.cameras, noise, system[:, :k])
    system[:, k:] = columns(layout, rows, shaft, packed, state)
    eliminate(system)
    white = system[:, k:] * system.diagonal(dim1=0, dim2=1).permute(2, 0, 1).rsqrt()[:, None]
    return torch.einsum("kpbn,kqbn->bnpq", white, white)


def _marginal(information: Float[Tensor, "*b p p"]) -> Float[Tensor, "*b 6 6"]:
    """Covariance of the transform with everything else eliminated."""
    scale = information.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    inverse = torch.linalg.pinv(information * scale[..., :, None] * scale[..., None, :], hermitian=True)
    return (inverse * scale[..., :, None] * scale[..., None, :])[..., :6, :6]


def thin(
    information: Float[Tensor, "n p p"], prior: Float[Tensor, "p p"], count: int
) -> tuple[Int[Tensor, " k"], float]:
    """Indices of `count` motions that keep most of det(information) (D-optimal, greedy in rounds), and the part kept:
    the geometric mean over the six parameters of the transform of how much of the information is left."""
    n, p = information.shape[:2]
    scale = (information.sum(0) + prior).diagonal().clamp_min(1e-300).rsqrt()
    flat = (information * scale[:, None] * scale).flatten(1)
    base = prior * scale[:, None] * scale
    ridge = 1e-6 * torch.eye(p, dtype=flat.dtype, device=flat.device)
    chosen = torch.zeros(n, dtype=torch.bool, device=flat.device)
    for round_ in range(THINNING_ROUNDS):
        target = count * (round_ + 1) // THINNING_ROUNDS
        wanted = target - int(chosen.sum())
        if wanted <= 0:
            continue
        now = base + flat[chosen].sum(0).view(p, p) + ridge * max(1.0, float(chosen.sum()) / n)
        gain = flat @ torch.linalg.inv(now).flatten()
        chosen[torch.where(chosen, -torch.inf, gain).topk(wanted).indices] = True
    index = torch.nonzero(chosen)[:, 0]
    full, part = _marginal(information.sum(0) + prior), _marginal(information[index].sum(0) + prior)
    kept = torch.exp((torch.logdet(full) - torch.logdet(part)) / 6.0)
    return index, float(kept)


@dataclass(frozen=True)
class Advice:
    """Candidate motions ranked by the error that is left after adding one of them.

    Attributes:
        order: candidates from best to worst; those out of view last.
        sigma_mm: predicted error at the working point after adding each candidate; infinite where it is out of view.
        sigma_before_mm: the same without.
        visible: whether enough of the shaft would be in view of the right camera.
    """

    order: Int[Tensor, " m"]
    sigma_mm: Float[Tensor, " m"]
    sigma_before_mm: float
    visible: Bool[Tensor, " m"]


def advise(
    candidates: Problem,
    state: State,
    layout: Layout,
    noise: NoiseModel,
    information: Float[Tensor, "p p"],
    working_point_mm: Float[Tensor, "3"],
    half_view: tuple[float, float],
    settings: SolverSettings,
) -> Advice:
    """Which of these motions would shrink the predicted error at the working point most (A-optimal for that point).

    Args:
        candidates: one trial of poses within the joint limits; measurements in it say only which kinds will be
            measured (any finite value), their values are predicted here.
        state, layout, noise: of the present estimate, one trial.
        information: of the present estimate, priors included.
        working_point_mm: in `camera_right`.
        half_view: half width and half height of the picture, normalised units.
        settings: as in the estimate.
    """
    packed, visible = _predicted(pack(candidates, settings.noise), state, half_view)
    each = motion_information(packed, state, layout, noise)[0]
    A = carried(state.t[0], working_point_mm, 0.0)[3:]

    def sigma(covariance_: Tensor) -> Tensor:
        return (A @ covariance_ @ A.mT).diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(0.0).sqrt()

    after = torch.where(visible, sigma(_marginal(information + each)), torch.inf)
    return Advice(
        order=after.argsort(), sigma_mm=after, sigma_before_mm=float(sigma(_marginal(information))), visible=visible
    )


def _predicted(packed: Packed, state: State, half_view: tuple[float, float]) -> tuple[Packed, Tensor]:
    """The candidates with noise-free measurements of what each camera would see, and which are in the right camera's
    view."""
    shaft = predict_shaft(packed, state)
    part = torch.linspace(0.0, 1.0, ALONG_SAMPLES, dtype=shaft.D.dtype, device=shaft.D.device)
    s = part[:, None, None, None] * (packed.s_end + state.end_offset[:, None]).clamp_min(SHORTEST_VISIBLE_MM)
    q = shaft.p[:, None] + s * shaft.d[:, None]  # (3, samples, c, b, n)
    xy = q[:2] / q[2].clamp_min(1e-6)
    inside = (q[2] > 1.0) & (xy[0].abs() < half_view[0]) & (xy[1].abs() < half_view[1])
    first = torch.where(inside, s, torch.inf).amin(0)
    last = torch.where(inside, s, -torch.inf).amax(0)
    seen = last - first > SHORTEST_VISIBLE_MM
    line_xy = []
    for point, along in enumerate((first, last)):
        axis = shaft.p + torch.where(seen, along, 0.0) * shaft.d
        rho = packed.line_rho[point::2]
        sine = (rho * state.radius[:, None] / shaft.D).clamp(-0.99, 0.99)
        n = (1.0 - sine.square()).sqrt() * shaft.m[:, None] + sine * shaft.u[:, None]
        contact = axis[:, None] - (n * axis[:, None]).sum(0) * n
        line_xy.append(contact[:2] / torch.where(contact[2].abs() < 1e-6, 1e-6, contact[2]))
    points = torch.stack(line_xy, dim=2).flatten(1, 2)
    end_ok = packed.end_ok
    end_xy = packed.end_xy
    if packed.has_ends:
        end_xy, end_ok = xy[:, -1], inside[-1] & seen
    head_ok = torch.zeros_like(packed.head_ok)
    packed = replace(
        packed, line_xy=points, line_ok=seen.expand_as(packed.line_ok), end_xy=end_xy, end_ok=end_ok, head_ok=head_ok
    )
    return packed, seen[0, 0]
