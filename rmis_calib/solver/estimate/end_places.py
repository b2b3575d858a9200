"""At which places of the instrument its shaft ends are measured.

A detector calls the ring of the tube the end in one picture and the tip of the metal in the next, or an end where
something lies over the shaft. Such ends do not scatter about one place: a level of noise that explains them all takes
the exact ones along, or rejects the contours of their pictures too. So their places along the shaft are a mixture of
one or two places and of nothing in particular (expectation maximisation: Dempster, Laird & Rubin 1977), set out from
the kinds that the detector tells and how sure it is of them. The detector's kinds need not be right: what share of each
kind lies where is estimated. Two places are found where the likelihood is clearly higher than that of one (Bayesian
information criterion) and they are apart; ends between them, and those that are nowhere in particular, are left out.
Ends without any common place are left out altogether.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.solver.model.measurement_rows import END, MeasurementRows
from rmis_calib.solver.model.motion_covariance import NoiseModel
from rmis_calib.solver.model.residuals import linearise
from rmis_calib.solver.model.state import State

RANGE_MM = 40.0
"""Length over which ends that are nowhere in particular are spread: a wrist with its jaws."""
ELSEWHERE = 5.0
"""Distance from the common place, in robust sigmas, from which an end is certainly not there."""
SCATTERED_MM = 5.0
"""Sigma along the shaft beyond which ends have no common place: a wrist's ring and its jaws are 10 mm apart."""
WIDE = 2.0
"""Scatter, times the expected one, up to which ends that are all near each other need no second look."""
APART = 4.0
"""Distance of two places in their sigmas from which hardly an end lies between them..."""
APART_MM = 2.0
"""...and what parts of one instrument are apart at least."""
CLEARLY = 5.0
"""Gain in the logarithm of the likelihood, beyond what more numbers bring by themselves."""
FEWEST, LEAST_SHARE = 4, 0.05
"""Ends that make a place."""
UNAMBIGUOUS = 0.9
"""Probability of the more probable of two places from which an end is taken for one of it."""
EM_STEPS = 40
CANDIDATES = 64
NORMAL_HALF = 1.349
"""Width of the shortest half of a normal distribution, in sigmas."""
NORMAL_MEDIAN = 0.6745
"""Median distance of a normal distribution from its middle, in sigmas."""
_UNKNOWN, _KINDS = 0, 3
"""Kinds by number: not told, tube, ring."""


def with_places(measured: MeasurementRows, state: State, noise: NoiseModel) -> MeasurementRows:
    """The rows with each end at its place; those of none are marked as not measured, per trial.

    Args:
        measured: of all cameras together: they see the same ends.
        state: an estimate that need not be exact.
        noise: assumed levels; only scatter that goes beyond them counts.
    """
    if not measured.has_ends:
        return measured
    ends = _Ends.of(measured, state, noise)
    centre, spread = shortest_half(ends.at, ends.known)
    expected = torch.where(ends.known, ends.sigma, torch.nan).nanmedian(1).values
    far = (ends.at - centre[:, None]).abs() > ELSEWHERE * torch.maximum(ends.sigma, spread[:, None])
    mixed = (ends.known & far).any(1) | (spread > WIDE * expected)  # NaN: too few to tell
    index = torch.nonzero(mixed)[:, 0]
    if not len(index):
        return replace(measured, end_second=torch.zeros_like(measured.end_var))
    kept, second = ends.known.clone(), torch.zeros_like(ends.known)
    kept[index], second[index] = ends.take(index).places(centre[index], len(measured.end_ok))

    def by_camera(value: Tensor) -> Tensor:
        return value.unflatten(1, (len(measured.end_ok), -1)).transpose(0, 1)

    return replace(measured, end_ok=by_camera(kept), end_second=by_camera(second & kept).to(measured.p.dtype))


@dataclass(frozen=True)
class _Ends:
    """Ends of both cameras in a row: m = c n.

    Attributes:
        at: distance of each end from the predicted one along the shaft, mm.
        sigma: of it; own: the part of it that is not shared with the other camera.
        known: where one was measured.
        kind: as the detector says, by number; sureness: how sure it is; NaN where it says nothing.
    """

    at: Float[Tensor, "b m"]
    sigma: Float[Tensor, "b m"]
    own: Float[Tensor, "b m"]
    known: Bool[Tensor, "b m"]
    kind: Int[Tensor, "b m"]
    sureness: Float[Tensor, "b m"]

    @classmethod
    def of(cls, measured: MeasurementRows, state: State, noise: NoiseModel) -> "_Ends":
        """From where a state predicts the first place."""
        first = replace(measured, end_second=torch.zeros_like(measured.end_var))
        at, sigma, own = _offsets(first, state, noise)
        told = torch.isfinite(measured.end_kind)
        kind = torch.where(told, measured.end_kind + 1.0, _UNKNOWN).long().clamp(0, _KINDS - 1)
        values = (at, sigma, own, measured.end_ok, kind, torch.where(told, measured.end_sureness, torch.nan))
        return cls(*(value.transpose(0, 1).flatten(1) for value in values))

    def take(self, index: Tensor) -> "_Ends":
        return _Ends(**{name: value[index] for name, value in vars(self).items()})

    def places(self, centre: Float[Tensor, " b"], cameras: int) -> tuple[Bool[Tensor, "b m"], Bool[Tensor, "b m"]]:
        """Which ends are kept, and which of these are at the second place."""
        count = self.known.sum(1)
        one = self.mixture(centre[None, :, None].nan_to_num())
        two = self.mixture(self.starts())
        more = 0.5 * (1 + _KINDS) * count.clamp_min(2).log()
        members = two.share[..., :2].sum(1).amin(-1)
        apart = (two.place[:, 1] - two.place[:, 0]).abs()
        typical = torch.where(self.known, self.sigma, torch.nan).nanmedian(1).values.hypot(two.scatter)
        is_two = (two.likelihood - one.likelihood > more + CLEARLY) & (apart > (APART * typical).clamp_min(APART_MM))
        is_two &= (members >= FEWEST) & (members >= LEAST_SHARE * count)
        nothing = -count * math.log(RANGE_MM)
        best, scatter = (
            torch.where(is_two, two.likelihood, one.likelihood),
            torch.where(is_two, two.scatter, one.scatter),
        )
        common = (best - nothing > more + CLEARLY) & (scatter < SCATTERED_MM)
        at_one = one.share[..., 0] > one.share[..., 1]
        larger, smaller = two.share[..., :2].amax(-1), two.share[..., :2].amin(-1)
        at_two = (larger > two.share[..., 2]) & (larger > UNAMBIGUOUS * (larger + smaller))
        kept = self.known & torch.where(is_two[:, None], at_two, at_one) & common[:, None]
        by_size = (two.share * kept[..., None]).sum(1)
        second = (two.share[..., 1] > two.share[..., 0]) ^ (by_size[:, 1] > by_size[:, 0])[:, None]
        second = second & is_two[:, None]
        place = torch.where(is_two[:, None], two.place, one.place)
        nearest = place.gather(1, (two.share[..., 1] > two.share[..., 0]).long() * is_two[:, None])
        return kept & ~self.contradicted(self.at - nearest, kept, cameras), second & kept

    def contradicted(self, away: Float[Tensor, "b m"], kept: Bool[Tensor, "b m"], cameras: int) -> Bool[Tensor, "b m"]:
        """Ends that one camera sees elsewhere than the other, of the two the one farther from its place. Noise of the
        kinematics, which both cameras share, hides them from everything else.

        Args:
            away: distance of each end from its place.
        """
        if cameras < 2:
            return torch.zeros_like(kept)
        right, left = away.unflatten(1, (2, -1)).unbind(1)
        both = kept.unflatten(1, (2, -1)).all(1)
        gap = torch.where(both, right - left, torch.nan)
        gap = gap - gap.nanmedian(1, keepdim=True).values
        scatter = gap.abs().nanmedian(1, keepdim=True).values / NORMAL_MEDIAN
        sigma = torch.maximum(self.own.square().unflatten(1, (2, -1)).sum(1).sqrt(), scatter)
        apart = both & (gap.abs() > ELSEWHERE * sigma)
        return torch.cat((apart & (right.abs() >= left.abs()), apart & (right.abs() < left.abs())), 1)

    def starts(self) -> Float[Tensor, "s b 2"]:
        """Two pairs of places to set out from: where ends are densest, there and elsewhere; and the middle of each
        kind."""
        ordered = torch.where(self.known, self.at, torch.inf).sort(1).values
        count = self.known.sum(1, keepdim=True)
        part = torch.linspace(0.0, 1.0, CANDIDATES, device=count.device, dtype=self.at.dtype)
        candidate = ordered.gather(1, ((count - 1).clamp_min(0) * part).long())
        candidate = torch.where(torch.isfinite(candidate), candidate, 0.0)
        away = (self.at[:, None] - candidate[..., None]) / self.sigma[:, None]
        density = torch.where(self.known[:, None], torch.exp(-0.5 * away.square()), 0.0).sum(-1)
        first = candidate.gather(1, density.argmax(1, keepdim=True))
        typical = torch.where(self.known, self.sigma, torch.nan).nanmedian(1, keepdim=True).values.nan_to_num()
        elsewhere = (candidate - first).abs() > (APART * typical).clamp_min(APART_MM)
        second = candidate.gather(1, torch.where(elsewhere, density, -1.0).argmax(1, keepdim=True))
        middle = [torch.where(self.known & (self.kind == k), self.at, torch.nan).nanmedian(1).values for k in (1, 2)]
        densest, by_kind = torch.cat((first, second), 1), torch.stack(middle, 1)
        return torch.stack((densest, torch.where(torch.isfinite(by_kind).all(1, keepdim=True), by_kind, densest)))

    def mixture(self, place: Float[Tensor, "s b k"]) -> "_Mixture":
        """The mixture of k places and of nothing in particular that is most likely, from several starts."""
        like, k = self.at, place.shape[-1]
        share = like.new_full((*place.shape[:2], _KINDS, k + 1), 0.9 / k)  # of each kind at each place
        share[..., k] = 0.1
        scatter = like.new_zeros(place.shape[:2])
        sure = self._relative_sureness()
        member = torch.nn.functional.one_hot(self.kind, _KINDS).to(like.dtype) * self.known[..., None]
        total = like.new_zeros(place.shape[:2])
        probability = like.new_zeros((*place.shape[:2], like.shape[1], k + 1))
        for _ in range(EM_STEPS):
            variance = self.sigma.square() + scatter.square()[..., None]  # (s, b, m)
            away = self.at[..., None] - place[:, :, None]
            log_density = -0.5 * (away.square() / variance[..., None] + (2.0 * math.pi * variance).log()[..., None])
            nowhere = torch.full_like(log_density[..., :1], -math.log(RANGE_MM))
            prior = torch.einsum("bmg,sbgk->sbmk", member, share) * sure(k)
            prior = prior / prior.sum(-1, keepdim=True).clamp_min(1e-30)
            log_joint = torch.cat((log_density, nowhere), -1) + prior.clamp_min(1e-30).log()
            each = log_joint.logsumexp(-1)
            total = torch.where(self.known, each, 0.0).sum(-1)
            probability = (log_joint - each[..., None]).exp() * self.known[..., None]
            share = torch.einsum("bmg,sbmk->sbgk", member, probability) + 1.0
            share = share / share.sum(-1, keepdim=True)
            weight = probability[..., :k] / variance[..., None]
            place = (weight * self.at[..., None]).sum(-2) / weight.sum(-2).clamp_min(1e-30)
            away = self.at[..., None] - place[:, :, None]
            excess = probability[..., :k] * (away.square() - self.sigma.square()[..., None])
            count = probability[..., :k].sum((-2, -1)).clamp_min(1e-30)
            scatter = (excess.sum((-2, -1)) / count).clamp_min(0.0).sqrt()
        best = total.argmax(0)
        rows = torch.arange(len(best), device=best.device)
        return _Mixture(place[best, rows], scatter[best, rows], probability[best, rows], total[best, rows])

    def _relative_sureness(self):
        """How much more than its kind's share each end is somewhere, or nowhere: its sureness over that of its kind."""
        told = torch.isfinite(self.sureness) & self.known
        sure = torch.where(told, self.sureness, torch.nan).clamp(0.05, 0.95)
        relative = torch.ones((*sure.shape, 2), dtype=sure.dtype, device=sure.device)
        for kind in range(_KINDS):
            of_kind = told & (self.kind == kind)
            mean = torch.where(of_kind, sure, torch.nan).nanmean(1, keepdim=True)
            both = torch.stack((sure / mean, (1.0 - sure) / (1.0 - mean)), -1)
            relative = torch.where(of_kind[..., None], both, relative)

        def by_place(k: int) -> Float[Tensor, "b m k"]:
            return torch.cat((relative[..., :1].expand(*relative.shape[:-1], k), relative[..., 1:]), -1)

        return by_place


@dataclass(frozen=True)
class _Mixture:
    """Places of k groups of ends, their scatter beyond the expected one, the probability that each end is at each place
    or (last) nowhere in particular, and the log of the likelihood."""

    place: Float[Tensor, "b k"]
    scatter: Float[Tensor, " b"]
    share: Float[Tensor, "b m q"]
    likelihood: Float[Tensor, " b"]


def _offsets(
    measured: MeasurementRows, state: State, noise: NoiseModel
) -> tuple[Float[Tensor, "c b n"], Float[Tensor, "c b n"], Float[Tensor, "c b n"]]:
    """Distance of each measured end from the predicted one along the shaft, its sigma, and the part of that which is
    its camera's own; mm."""
    linear, _ = linearise(measured, state)
    rows = [index for index, kind in enumerate(measured.row_kind) if kind == END]
    gain = linear.end[rows].abs().clamp_min(1e-12)
    shift, turn = (vectors[:, rows].square().sum(0) for vectors in (linear.w, linear.a))
    own = measured.end_var * noise.end[:, None] + shift * noise.camera_mm[:, None] + turn * noise.camera_rad[:, None]
    shared = shift * noise.kinematics_mm[:, None] + turn * noise.kinematics_rad[:, None]
    return linear.r[rows] / gain, (own + shared).sqrt() / gain, own.sqrt() / gain


def shortest_half(
    value: Float[Tensor, "b m"], known: Bool[Tensor, "b m"]
) -> tuple[Float[Tensor, " b"], Float[Tensor, " b"]]:
    """Middle of the shortest interval that holds more than half of a trial's known values (Rousseeuw & Leroy 1987), and
    the sigma that a normal distribution of this half has; NaN where fewer than 4 are known."""
    ordered = torch.where(known, value, torch.inf).sort(1).values
    count = known.sum(1, keepdim=True)
    first = torch.arange(ordered.shape[1], device=value.device).expand_as(ordered)
    last = first + torch.div(count, 2, rounding_mode="floor")
    width = ordered.gather(1, last.clamp_max(ordered.shape[1] - 1)) - ordered
    width = torch.where(last < count, width, torch.inf)
    at = width.argmin(1, keepdim=True)
    low, shortest = ordered.gather(1, at), width.gather(1, at)
    enough = count >= 4
    centre = torch.where(enough, low + 0.5 * shortest, torch.nan)
    return centre[:, 0], torch.where(enough, shortest / NORMAL_HALF, torch.nan)[:, 0]
