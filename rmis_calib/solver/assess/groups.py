"""Do parts of the data agree? Groups of neighbouring motions are left out in turn; where the answer moves by more than
noise allows, the covariance grows.

What a model leaves out (lens, compliance, an arm that rests, a tool that is another one) is shared by motions that lie
near to each other and does not average out, so that sigma falls with 1/sqrt(N) and truth does not. Leaving out random
motions does not show it; leaving out neighbours does (a delete-group jackknife: Shao & Tu 1995; cluster-robust
covariance: Cameron & Miller 2015).

With H the information, H_k and s_k the information and the score of group k, the estimate without it is off by
d_k = (H - H_k)^-1 s_k, one Gauss-Newton step; noise alone would make its covariance V_k = (H - H_k)^-1 - H^-1. In the
units of the answer's own covariance, W = (sum V_k)^-1/2 (sum d_k d_k^T) (sum V_k)^-1/2 is the identity on average.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.solver.assess.information import inverse
from rmis_calib.solver.estimate.map_estimate import MapEstimate
from rmis_calib.solver.estimate.outliers import REJECTED
from rmis_calib.solver.model.batched_linalg import unit_diagonal
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.normal_equations import member_sums, membership
from rmis_calib.solver.model.parameters import ParameterLayout
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.solution import GroupCheck

LEAST_GROUPS = 5
"""Fewer say too little: below this many, covariances stay as they are."""
MOTIONS_A_GROUP = 4
"""Motions for each group that is made, on average."""
LEAST_USED = 3
"""Used motions a group, on average, below which a trial is left as it is."""
LEVER_MM = 100.0
"""Length that turns a change of the shaft's direction into a displacement: from the trocar to the working point."""
LLOYD_ROUNDS = 12
TINY = 1e-20
"""Variance, rad^2 or mm^2, below which a direction is none: the inverse has left it out."""
HARDLY_SEEN = 40.0
"""Variance of a difference of two parts, in that of the answer of all, from which a direction does not count."""
LARGEST = 1e9
"""Squared sigmas beyond which nothing differs any more."""
RIDGE = 0.02
"""In units of the covariance: a direction that no group moves (it is the prior's) counts as agreeing."""


def check_groups(fit: MapEstimate, asked: int) -> GroupCheck:
    """Leave out groups of neighbours of every trial at once.

    Args:
        fit: the estimate.
        asked: groups wanted; fewer where motions are few.
    """
    measured, state = fit.model.measured, fit.state
    group, count, enough = groups_of(fit.model, asked)
    if count == 0:
        return GroupCheck.none(measured.motions, state.t)
    block = torch.arange(measured.motions, device=group.device) * count // measured.motions
    in_time = membership(block.expand_as(group), count, state.t.dtype)
    model, in_full = fit.model, recounted(fit, in_time[0])
    H_all, s_all = sums_of(model, state, torch.cat((membership(group, count, state.t.dtype), in_time), dim=-1))
    H_k, s_k = H_all[:, :count], s_all[:, :count]
    H_t, s_t = (H_all[:, count:], s_all[:, count:]) if in_full is model else sums_of(in_full, state, in_time)
    left = leave_groups_out(model.layout, state, H_k, s_k)
    shift, s_k = left.shift[..., :6], left.score_k
    covariance, covariance_k = left.covariance[..., :6, :6], left.covariance_k[..., :6, :6]
    told = torch.isfinite(shift).flatten(1).all(-1) & (covariance.diagonal(dim1=-2, dim2=-1) > TINY).all(-1)
    enough = told & enough
    eye = torch.eye(6, dtype=shift.dtype, device=shift.device)
    covariance = torch.where(told[:, None, None], covariance, eye)
    covariance_k = torch.where(told[:, None, None, None], covariance_k, eye)
    shift = torch.where(told[:, None, None], shift, 0.0)
    root, inverse_root = _roots(covariance)
    own = shift @ inverse_root.mT  # (b, k, 6)
    extra = inverse_root[:, None] @ (covariance_k - covariance[:, None]) @ inverse_root[:, None].mT
    factor, turn = _growth(own, extra)
    factor = torch.where(enough[:, None], factor, 1.0)
    growth = root @ (turn * factor.sqrt()[:, None] @ turn.mT) @ inverse_root
    deviation, prior = model.layout.prior(state)
    first_half = _first_half(where_motions_are(measured), group, count)
    halves, apart = _difference(H_k, s_k, prior, deviation, first_half[:, None], growth, inverse_root)
    before = torch.tril(torch.ones(count - 1, count, dtype=prior.dtype, device=prior.device)).expand(len(prior), -1, -1)
    changes, change_apart = _difference(H_t, s_t, prior, deviation, before, growth, inverse_root)
    clearest = change_apart.argmax(-1)
    sigmas = torch.linalg.solve(extra + RIDGE * eye, own[..., None])[..., 0]
    return GroupCheck(
        group=torch.where(enough[:, None], group, -1),
        count=count,
        shift=shift,
        sigmas=(sigmas * own).sum(-1).clamp_min(0.0).sqrt(),
        growth=growth,
        first_half=first_half > 0.5,
        halves=halves[:, 0],
        halves_sigmas=torch.where(enough, apart[:, 0], 0.0),
        change=torch.take_along_dim(changes, clearest[:, None, None], dim=1)[:, 0],
        change_sigmas=torch.where(enough, change_apart.amax(-1), 0.0),
        change_at=first_of_block(measured.motions, count, clearest + 1),
        inflation=factor.mean(-1).sqrt(),
    )


@dataclass(frozen=True)
class LeftOut:
    """Estimates without one group of motions each.

    Attributes:
        score_k: of each group, without its share of what is not zero at the estimate.
        shift: of all parameters when a group is left out.
        covariance, covariance_k: of all parameters, with all groups and without each.
    """

    score_k: Float[Tensor, "b k p"]
    shift: Float[Tensor, "b k p"]
    covariance: Float[Tensor, "b p p"]
    covariance_k: Float[Tensor, "b k p p"]


def leave_groups_out(
    layout: ParameterLayout,
    state: State,
    H_k: Float[Tensor, "b k p p"],
    s_k: Float[Tensor, "b k p"],
    g: Float[Tensor, "b p"] | None = None,
) -> LeftOut:
    """One Gauss-Newton step for each group that is left out.

    Args:
        layout: the unknowns.
        state: where the sums were taken.
        H_k, s_k: information and score of each group, without priors.
        g: score of all, with priors, where the state is not the estimate: one step away from it.
    """
    deviation, prior = layout.prior(state)
    H = H_k.sum(1) + torch.diag_embed(prior)
    covariance, rest = inverse(H), inverse(H[:, None] - H_k)
    if g is not None:
        step = (covariance @ g[..., None])[..., 0]
        s_k, deviation = s_k - (H_k @ step[:, None, :, None])[..., 0], deviation - step
    s_k = s_k - (s_k.sum(1) + prior * deviation)[:, None] / s_k.shape[1]  # what the bias correction left of the score
    return LeftOut(s_k, (rest @ s_k[..., None])[..., 0], covariance, rest)


def groups_of(model: WeightedModel, asked: int) -> tuple[Int[Tensor, "b n"], int, Bool[Tensor, " b"]]:
    """Number of each used motion's group (-1: not used), how many groups (0: motions are too few), and the trials that
    have enough used motions for them."""
    measured = model.measured
    seen = measured.rows_seen > 0
    used = (seen if model.weight is None else seen & (model.weight > REJECTED)).any(0)  # (b, n)
    count = min(asked, measured.motions // MOTIONS_A_GROUP)
    if count < LEAST_GROUPS:
        return torch.full_like(used, -1, dtype=torch.int64), 0, torch.zeros_like(used[:, 0])
    return neighbours(where_motions_are(measured), used, count), count, used.sum(-1) >= LEAST_USED * count


def _growth(
    own: Float[Tensor, "b k 6"], extra: Float[Tensor, "b k 6 6"]
) -> tuple[Float[Tensor, "b 6"], Float[Tensor, "b 6 6"]]:
    """Factors on the variance, 1 or more, along orthogonal directions (columns).

    The mean of all directions is known to a fifth with eight groups; a single direction counts only where it is beyond
    what the largest of six directions reaches by chance.

    Args:
        own: shifts when a group is left out, in units of the covariance.
        extra: covariance of each that noise alone would make, in the same units.
    """
    ridge = RIDGE * torch.eye(6, dtype=own.dtype, device=own.device)
    expected, axes = torch.linalg.eigh(_bounded(extra.sum(1)) + ridge)
    narrow = axes * expected.clamp_min(RIDGE).rsqrt()[:, None] @ axes.mT
    W = narrow @ (_bounded(own.mT @ own) + ridge) @ narrow
    values, vectors = torch.linalg.eigh(_bounded(0.5 * (W + W.mT)))
    mean = values.mean(-1, keepdim=True).clamp_min(1.0)
    return torch.where(values > _largest_by_chance(own.shape[1]), values, 0.0).maximum(mean), vectors


def sums_of(
    model: WeightedModel, state: State, member: Float[Tensor, "b n k"]
) -> tuple[Float[Tensor, "b k p p"], Float[Tensor, "b k p"]]:
    """Information and score of each group, without what is not finite."""
    H_k, s_k = member_sums(model, state, member)
    return torch.nan_to_num(H_k), torch.nan_to_num(s_k)


def where_motions_are(measured: MeasurementRows) -> Float[Tensor, "b n 9"]:
    """Where the shaft is in `arm`: RCM and working point, mm, and its direction times a lever: alike for neighbours in
    joint space."""
    p, v = measured.p.permute(1, 2, 0), measured.v.permute(1, 2, 0)
    return torch.cat((p, p + LEVER_MM * v, LEVER_MM * v), dim=-1)


def neighbours(place: Float[Tensor, "b n d"], used: Tensor, count: int) -> Int[Tensor, "b n"]:
    """k-means groups of the used motions, -1 for the others; starts are the farthest from each other, so that nothing
    is random."""
    masked = torch.where(used[..., None], place, 0.0)
    mean = masked.sum(1, keepdim=True) / used.sum(1).clamp_min(1)[:, None, None]
    distance = (place - mean).square().sum(-1)
    centres = []
    for _ in range(count):
        index = torch.where(used, distance, -1.0).argmax(-1)
        centre = torch.take_along_dim(place, index[:, None, None], dim=1)
        nearer = (place - centre).square().sum(-1)
        distance = nearer if not centres else torch.minimum(distance, nearer)
        centres.append(centre)
    centre = torch.cat(centres, dim=1)
    number, group = torch.arange(count, device=place.device), torch.full_like(used, -1, dtype=torch.int64)
    for _ in range(LLOYD_ROUNDS):
        half_squares = 0.5 * centre.square().sum(-1)[:, None]
        nearest = torch.baddbmm(half_squares, place, centre.mT, alpha=-1.0).argmin(-1)
        if torch.equal(nearest, group):
            break
        group = nearest
        member = (group[..., None] == number).to(place.dtype) * used[..., None]
        sizes = member.sum(1)
        moved = member.mT @ masked / sizes.clamp_min(1.0)[..., None]
        centre = torch.where(sizes[..., None] > 0, moved, centre)
    return torch.where(used, group, -1)


def _first_half(place: Float[Tensor, "b n d"], group: Int[Tensor, "b n"], count: int) -> Float[Tensor, "b k"]:
    """1 for the groups that make up one half of the used motions, on one side along where they spread most."""
    member = membership(group, count, place.dtype)
    sizes = member.sum(1)
    centre = member.mT @ place / sizes.clamp_min(1.0)[..., None]
    total = sizes.sum(-1).clamp_min(1.0)
    mean = (sizes[..., None] * centre).sum(1, keepdim=True) / total[:, None, None]
    centred = torch.where(sizes[..., None] > 0, centre - mean, 0.0)
    _, vectors = torch.linalg.eigh(centred.mT @ (sizes[..., None] * centred))
    order = (centred @ vectors[..., -1:])[..., 0].argsort(-1)
    ordered = torch.take_along_dim(sizes, order, dim=-1)
    is_first = ordered.cumsum(-1) - 0.5 * ordered < 0.5 * total[:, None]
    return torch.zeros_like(is_first).scatter(-1, order, is_first).to(place.dtype)


def recounted(fit: MapEstimate, block: Float[Tensor, "n k"]) -> WeightedModel:
    """The model for the comparison of blocks in time. Where most motions of a block were rejected they count in full: a
    camera that was knocked looks like a block of outliers."""
    if fit.model.weight is None:
        return fit.model
    weight, counted = fit.weight, fit.model.measured.rows_seen > 0
    share = ((weight < REJECTED) & counted).to(weight.dtype) @ block / (counted.to(weight.dtype) @ block).clamp_min(1.0)
    mostly = (share > 0.5).any(0).to(weight.dtype) @ block.T > 0.5  # (b, n)
    return replace(fit.model, weight=torch.where(mostly, 1.0, weight))


def first_of_block(motions: int, count: int, block: Int[Tensor, " b"]) -> Int[Tensor, " b"]:
    """Number of the first motion of one of `count` consecutive blocks."""
    return (block * motions + count - 1) // count


def _difference(
    H_k: Float[Tensor, "b k p p"],
    s_k: Float[Tensor, "b k p"],
    prior: Float[Tensor, "b p"],
    deviation: Float[Tensor, "b p"],
    first: Float[Tensor, "b s k"],
    growth: Float[Tensor, "b 6 6"],
    inverse_root: Float[Tensor, "b 6 6"],
) -> tuple[Float[Tensor, "b s 6"], Float[Tensor, "b s"]]:
    """How far the answers of two parts of the data are apart, one Gauss-Newton step each from that of all, and in their
    grown sigmas.

    Args:
        first: 1 for the groups of the first part, 0 for those of the other; `s` ways to part them.
        growth: of covariances.
        inverse_root: what makes the covariance of all the identity.
    """
    steps, variances = [], []
    for part in (first, 1.0 - first):
        H = torch.einsum("bsk,bkpq->bspq", part, H_k) + torch.diag_embed(prior)[:, None]
        C = inverse(H)
        steps.append(-(C @ (part @ s_k + (prior * deviation)[:, None])[..., None])[..., :6, 0])
        variances.append(inverse_root[:, None] @ C[..., :6, :6] @ inverse_root[:, None].mT)
    gap = steps[0] - steps[1]
    # The growth takes both covariances and the unit that they are measured in along, so that it acts on the gap alone.
    own = gap @ (inverse_root @ torch.linalg.inv(growth)).mT
    values, vectors = torch.linalg.eigh(_bounded(variances[0] + variances[1]))
    along = (vectors.mT @ _bounded(own)[..., None])[..., 0].square() / values.clamp_min(RIDGE)
    # A part that hardly sees a direction has little to say of it, and noise in its Jacobian looks like sight.
    return gap, torch.where(values < HARDLY_SEEN, along, 0.0).sum(-1).sqrt()


def _bounded(matrix: Tensor) -> Tensor:
    """The matrix without what eigenvalue routines choke on; where it matters the answer is none anyway."""
    return torch.nan_to_num(matrix, nan=0.0, posinf=LARGEST, neginf=-LARGEST).clamp(-LARGEST, LARGEST)


def _roots(matrix: Float[Tensor, "*b 6 6"]) -> tuple[Float[Tensor, "*b 6 6"], Float[Tensor, "*b 6 6"]]:
    """Square root and its inverse of a covariance: root root^T = matrix."""
    scaled, scale = unit_diagonal(matrix)
    values, vectors = torch.linalg.eigh(scaled)
    values = values.clamp_min(1e-12).sqrt()
    root = vectors * values[..., None, :] / scale[..., :, None]
    return root, (vectors / values[..., None, :]).mT * scale[..., None, :]


def _largest_by_chance(count: int) -> float:
    """What the largest eigenvalue of W exceeds in one of a hundred right models: of a 6 x 6 Wishart matrix with
    count - 1 degrees of freedom over these (Johnstone 2001)."""
    n, p = max(count - 1, 1), 6
    centre = (max(n - 1, 0) ** 0.5 + p**0.5) ** 2
    spread = (max(n - 1, 0) ** 0.5 + p**0.5) * (1.0 / max(n - 1, 1) ** 0.5 + p**-0.5) ** (1.0 / 3.0)
    return (centre + 2.02 * spread) / n
