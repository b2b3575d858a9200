"""Which motion to add next: candidates ranked by the uncertainty that would be left with them.

The measurements of a candidate are not known, but what they would tell is: the information J^T S^-1 J of noise-free
measurements at the present estimate, of every kind that each camera has measured so far, where the field of view shows
it. It adds to the information of the data. The criterion is A-optimality of the covariance that `observability.py`
takes its directions from, (lever * dphi, displacement of the working point): its trace is nearly the variance of the
weakest direction as long as there is one, and does not stall where two are equally weak. Several motions are chosen one
after the other, each with those before it counted in.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.solver.assess.information import inverse, motion_information
from rmis_calib.solver.assess.observability import working_point_jacobian
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.predicted_shaft import Shaft, predict_shaft
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import SolverSettings
from rmis_calib.solver.solution import Posterior
from rmis_calib.solver.tensors import spans

SHORTEST_VISIBLE_MM = 10.0
"""Of a shaft in view."""
ALONG_SAMPLES = 48
OFF_SIGMAS, MOST_OFF = 2.0, 0.2
"""What is predicted within this many sigma of the picture's border, but at most within this part of its size, may lie
outside: it does not count as seen."""
NEARLY_BEST, NOT_WORSE = 0.1, 1.5
"""Among candidates that miss at most this part of the best gain (in log sigma), and leave at most this many times the
least sigma, the one of least effort is advised: few joints are easier to move than many."""
ALIKE_RAD, ALIKE_MM = 0.035, 3.0
"""Motions that differ by less (2 degrees in the shaft's direction; place of the RCM, and along the shaft) are one: only
one of them is advised."""


@dataclass(frozen=True)
class Advice:
    """Candidate motions and what they would leave of the uncertainty.

    Attributes:
        chosen: the motions to add, in this order, no two alike; empty when none keeps the shaft in view.
        weakest_mm: 1 sigma of the weakest direction, mm at the working point: now, then after each chosen motion. What
            the reported covariance allows for beside the model (joint offsets) stays in it.
        point_mm: predicted error at the working point, likewise.
        alone_mm: 1 sigma of the weakest direction after adding one candidate alone; infinite where it is out of view.
        visible: whether each candidate would be in view.
    """

    chosen: Int[Tensor, " k"]
    weakest_mm: Float[Tensor, " k1"]
    point_mm: Float[Tensor, " k1"]
    alone_mm: Float[Tensor, " m"]
    visible: Bool[Tensor, " m"]


def measured_alike(problem: Problem, count: int, motion: int = 0) -> Problem:
    """`count` motions in which every camera measures what it measured in `problem`, with the median sigma.

    Poses are those of one motion, measurements zero: both are for the caller and for `advise` to fill in.

    Args:
        problem: with one trial axis of length 1.
        count: how many.
        motion: index of the one.
    """
    like = problem.select_motions(torch.full((count,), motion, dtype=torch.int64, device=problem.arm_T_rcm.device))
    changed: dict[str, Tensor] = {"valid": problem.valid.any(-1, keepdim=True).expand_as(like.valid)}
    for kind in ("axis", "contour", "end", "head"):
        xy, sigma = getattr(problem, f"{kind}_xy"), getattr(problem, f"{kind}_sigma")
        measured = torch.isfinite(xy).flatten(3).all(-1).any(-1)  # (1, c)
        shape = (*measured.shape, *(1,) * (xy.ndim - 2))
        new = torch.where(measured.view(shape), 0.0, torch.nan).to(xy)
        changed[f"{kind}_xy"] = new.expand_as(getattr(like, f"{kind}_xy"))
        changed[f"{kind}_sigma"] = sigma.nanmedian(2, keepdim=True).values.expand_as(getattr(like, f"{kind}_sigma"))
    return replace(like, **changed)


def advise(
    candidates: Problem,
    posterior: Posterior,
    working_point_mm: Float[Tensor, "3"],
    view: Float[Tensor, "c 4"],
    settings: SolverSettings,
    effort: Int[Tensor, " m"] | None = None,
    reported: Float[Tensor, "6 6"] | None = None,
) -> Advice:
    """The motions that would shrink the uncertainty most.

    Args:
        candidates: one trial of poses within reach; finite measurements in it say which kinds would be measured
            (`measured_alike`), their values are predicted here.
        posterior: of the present estimate, one trial.
        working_point_mm: where errors count, in `camera_right`.
        view: least x, least y, greatest x, greatest y in each camera's picture, normalised units.
        settings: as in the estimate.
        effort: of each candidate; less is advised where it is nearly as good.
        reported: covariance of the transform as the result states it; default: that of the posterior alone.
    """
    state = posterior.state
    A = working_point_jacobian(state.t[0], working_point_mm, settings.verdict.lever_mm)
    information = posterior.information[0]
    allowance = torch.zeros_like(A) if reported is None else A @ (reported - inverse(information)[:6, :6]) @ A.mT

    before, *now = _remaining(information, A, allowance)
    view = _narrowed(view, now[1] / torch.linalg.vector_norm(working_point_mm))
    gain, visible = predicted_information(candidates, posterior, view, settings)
    chosen, path = [], [now]
    alone = torch.full_like(gain[:, 0, 0], torch.inf)
    open_ = visible
    for step in range(settings.advice.motions):
        if not bool(open_.any()):
            break
        trace, weakest, at_point = _remaining(information + gain, A, allowance)
        trace = torch.where(open_, trace, torch.inf)
        if step == 0:
            alone = torch.where(visible, weakest, torch.inf)
        best = _least_effort(before, trace, effort)
        before = trace[best]
        chosen.append(best)
        path.append([weakest[best], at_point[best]])
        information = information + gain[best]
        open_ = open_ & ~_alike(candidates, best)
    path = torch.stack([torch.stack(pair) for pair in path])
    return Advice(
        chosen=torch.tensor(chosen, dtype=torch.int64),
        weakest_mm=path[:, 0],
        point_mm=path[:, 1],
        alone_mm=alone,
        visible=visible,
    )


def _remaining(
    information: Float[Tensor, "*m p p"], A: Float[Tensor, "6 6"], allowance: Float[Tensor, "6 6"]
) -> tuple[Tensor, Tensor, Tensor]:
    """What is left of the uncertainty at the working point: its trace by the model alone; with the allowance, the
    weakest direction's sigma and that of the point."""
    C = A @ inverse(information)[..., :6, :6] @ A.mT
    trace, C = C.diagonal(dim1=-2, dim2=-1).sum(-1), C + allowance
    weakest = torch.linalg.eigvalsh(C)[..., -1].clamp_min(0.0).sqrt()
    at_point = C[..., 3:, 3:].diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(0.0).sqrt()
    return trace, weakest, at_point


def _alike(candidates: Problem, index: int) -> Bool[Tensor, " m"]:
    """Which candidates are the same motion as one of them, to anybody who moves the arms."""
    T, v, s = candidates.arm_T_rcm[0], candidates.rcm_v_axis[0], candidates.rcm_s_end_mm[0]
    d = (T[:, :3, :3] @ v[..., None])[..., 0]
    cosine = (d @ d[index]).clamp(-1.0, 1.0)
    near = (T[:, :3, 3] - T[index, :3, 3]).norm(dim=-1) < ALIKE_MM
    along = torch.nan_to_num(s - s[index]).abs() < ALIKE_MM
    return (cosine.acos() < ALIKE_RAD) & near & along


def predicted_information(
    candidates: Problem, posterior: Posterior, view: Float[Tensor, "c 4"], settings: SolverSettings
) -> tuple[Float[Tensor, "m p p"], Bool[Tensor, " m"]]:
    """What each candidate would add to the information of all unknowns, and whether some camera sees it.

    Args:
        candidates: one trial of poses; finite measurements in it say which kinds would be measured.
        posterior: of the estimate that predicts what would be seen, one trial.
        view: least x, least y, greatest x, greatest y in each camera's picture, normalised units.
        settings: as in the estimate.
    """
    each, seen = [], []
    for span in spans(candidates.n_motions, settings.chunk):
        part = candidates.select_motions(span)
        measured, visible = _predicted(pack(part, settings.noise), posterior.state, view, settings.advice.nearest_mm)
        each.append(motion_information(WeightedModel(measured, posterior.layout, posterior.noise), posterior.state)[0])
        seen.append(visible)
    return torch.cat(each), torch.cat(seen)


def _narrowed(view: Float[Tensor, "c 4"], sigma: Float[Tensor, ""]) -> Float[Tensor, "c 4"]:
    """The view less what the estimate may be off, on every side."""
    size = (view[:, 2:] - view[:, :2]).repeat(1, 2)
    off = torch.minimum(OFF_SIGMAS * sigma, MOST_OFF * size)
    return view + off * view.new_tensor((1.0, 1.0, -1.0, -1.0))


def _least_effort(before: Tensor, trace: Float[Tensor, " m"], effort: Int[Tensor, " m"] | None) -> int:
    if effort is None:
        return int(trace.argmin())
    least = trace.amin()
    nearly = (trace <= NOT_WORSE**2 * least) & (trace <= least * (before / least) ** NEARLY_BEST)
    easiest = torch.where(nearly, effort, effort.max() + 1)
    return int(torch.where(easiest == easiest.amin(), trace, torch.inf).argmin())


def _predicted(
    measured: MeasurementRows, state: State, view: Float[Tensor, "c 4"], nearest_mm: float
) -> tuple[MeasurementRows, Bool[Tensor, " m"]]:
    """The candidates with noise-free measurements of what each camera would see, and which ones some camera sees."""
    shaft = predict_shaft(measured, state)
    part = torch.linspace(0.0, 1.0, ALONG_SAMPLES, dtype=shaft.D.dtype, device=shaft.D.device)
    s_end = (measured.s_end + state.end_offset[:, None]).clamp_min(SHORTEST_VISIBLE_MM)
    s = part[:, None, None, None] * s_end
    xy, inside, depth = _in_view(shaft.p[:, None] + s * shaft.d[:, None], view)  # samples, c, b, n
    near = (inside & (depth < nearest_mm)).any(0)
    first = torch.where(inside, s, torch.inf).amin(0)
    last = torch.where(inside, s, -torch.inf).amax(0)
    seen = (last - first > SHORTEST_VISIBLE_MM) & ~near
    points = _contact_points(measured, state, shaft, torch.where(seen, first, 0.0), torch.where(seen, last, 0.0))
    changed: dict[str, Tensor] = {"line_xy": points, "line_ok": seen & measured.line_ok}
    if measured.has_ends:
        changed |= {"end_xy": xy[:, -1], "end_ok": inside[-1] & seen & measured.end_ok}
    if measured.has_heads:
        head_xy, head_inside, _ = _in_view(shaft.p + shaft.head, view)
        changed |= {"head_xy": head_xy, "head_ok": head_inside & ~near & measured.head_ok}
    measured = replace(measured, **changed)
    return measured, measured.rows_ok.any(0)[0] & ~near.any(0)[0]


def _in_view(q: Float[Tensor, "3 *s c b n"], view: Float[Tensor, "c 4"]) -> tuple[Tensor, Tensor, Tensor]:
    """Image points (2, *s, c, b, n), whether they lie in the picture, and their depth, mm."""
    xy = q[:2] / q[2].clamp_min(1e-6)
    x0, y0, x1, y1 = view.T[..., None, None]
    inside = (q[2] > 1.0) & (xy[0] > x0) & (xy[0] < x1) & (xy[1] > y0) & (xy[1] < y1)
    return xy, inside, q[2]


def _contact_points(
    measured: MeasurementRows, state: State, shaft: Shaft, first: Tensor, last: Tensor
) -> Float[Tensor, "..."]:
    """Two points of each line row pair: where the contours, or the axis, are seen at these places along the axis."""
    lines = []
    for point, along in enumerate((first, last)):
        axis = shaft.p + along * shaft.d
        rho = measured.line_rho[point::2]
        sine = (rho * state.radius[:, None] / shaft.D).clamp(-0.99, 0.99)
        n = (1.0 - sine.square()).sqrt() * shaft.m[:, None] + sine * shaft.u[:, None]
        contact = axis[:, None] - (n * axis[:, None]).sum(0) * n
        lines.append(contact[:2] / torch.where(contact[2].abs() < 1e-6, 1e-6, contact[2]))
    return torch.stack(lines, dim=2).flatten(1, 2)
