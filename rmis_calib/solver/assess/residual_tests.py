"""The one list of tests of the residuals: is anything left in them that the model should have told?

Each kind of residual (tested_residuals.py) is tested for its mean, and over time, the picture, each joint, and between
neighbours. A test is a pattern f over the motions: 1, the time, a step in time, a coordinate of the picture, its square
about the centre, a joint. With u the score of f times the kind, and A its information, both with all parameters of the
fit eliminated (so that what the fit took of the residuals is not missed: Rao 1948), u / sqrt(A) is standard normal
where the model is right. The variance is not below what the scatter over places says (cluster-robust, Cameron & Miller
2015): motions at one place share their error of the kinematics and count as one, and the reference is Student's t with
as many degrees of freedom as there are places, less one.

Neighbours: e_i is the residual of place i in its own sigma; sum e_i e_j over pairs has the variance sum e_i^2 e_j^2,
and not below the number of pairs.

Beside these stand the tests that compare answers: of two halves of the motions, of what comes before and after
(groups.py), and the clock before and after (clock_jump.py).

A further kind of residual needs its values alone: `solution.tests.joined(residual_tests(TestedResiduals.of_values(...),
over_of_solution(...)))`; words for it stand in `pipeline.answer.records.tests_in_words`.

All are corrected together for their number (Holm 1979, with weights: Genovese, Roeder & Wasserman 2006): the few
comparisons of answers are worth more than each of a hundred tests of residuals.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.special import stdtr
from torch import Tensor

from rmis_calib.solver.assess.clock_jump import BLOCKS, MOTIONS_A_BLOCK
from rmis_calib.solver.assess.information import inverse
from rmis_calib.solver.assess.tested_over import Over, over_of
from rmis_calib.solver.assess.tested_residuals import TestedResiduals, residuals_of
from rmis_calib.solver.estimate.bias import simulated_pairs
from rmis_calib.solver.estimate.map_estimate import MapEstimate
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.settings import SolverSettings
from rmis_calib.solver.solution import ClockJump, GroupCheck
from rmis_calib.solver.test_list import (
    ANSWER,
    CLOCK,
    HALVES,
    NEAR_IN_JOINTS,
    NEAR_IN_TIME,
    TIME_STEP,
    TestList,
    TestName,
)

TESTED_MOTIONS = 640
"""Long recordings are tested on a sample, evenly in time: it shows a fifth of the noise of one motion, and takes a
small part of the time of the solve."""
SIMULATIONS = 4
"""Antithetic pairs of every motion, of trials where some test fails."""
PAIRED_PLACES = 384
"""Places among which each one's nearest is looked for."""
LEAST_PLACES = 12
"""Fewest places that a test says anything from."""
APART_IN_TIME = 3
"""Places between two that are compared as neighbours in joint space: others are neighbours in time."""
LEAST_LEFT = 0.03
"""Part of a pattern that the fit must leave: nearly all of a mean shift becomes a shift of the transform or of the
stereo extrinsics, and what little is left is of second order."""
LEAST_SPREAD = 1e-9
"""Information on a pattern, in that of its kind's mean, below which it is none: a joint that stands still."""


def answer_tests(groups: GroupCheck, jump: ClockJump | None, motions: int) -> TestList:
    """The tests that compare answers of parts of the data."""
    names, columns = [], []
    b, none = len(groups.inflation), torch.full_like(groups.change_at, -1)
    if groups.count:
        halves, change = groups.halves_sigmas, groups.change_sigmas
        names += [TestName(ANSWER, HALVES), TestName(ANSWER, TIME_STEP)]
        columns.append((halves, _chi2_tail(halves), none))
        columns.append((change, (groups.count - 1) * _chi2_tail(change), groups.change_at))
    if jump is not None:
        borders = min(BLOCKS, motions // MOTIONS_A_BLOCK) - 1
        names.append(TestName(CLOCK, TIME_STEP))
        columns.append((jump.sigmas, borders * 2.0 * torch.special.ndtr(-jump.sigmas), jump.at))
    if not columns:
        empty = groups.inflation.new_zeros(b, 0)
        return TestList((), empty, empty, none[:, None][:, :0])
    statistic, chance, at = (torch.stack(parts, dim=-1) for parts in zip(*columns, strict=True))
    return TestList(tuple(names), statistic, chance.clamp_max(1.0), at)


def _chi2_tail(sigmas: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
    """Probability of a larger distance of 6 unknowns."""
    return torch.special.gammaincc(torch.full_like(sigmas, 3.0), 0.5 * sigmas.square())


def fit_tests(fit: MapEstimate, settings: SolverSettings) -> TestList:
    """All tests of the residuals of an estimate."""
    model, joints = fit.model, fit.problem.joints
    # Where they fit best, residuals are what the model says; without its bias the estimate fits a little worse.
    state = fit.state.moved(model.layout.step(fit.bias))
    motions = model.measured.motions
    model, step = model.sample(TESTED_MOTIONS)
    number = torch.arange(0, motions, step, device=state.t.device)
    joints = None if joints is None else joints[:, ::step]
    levels = model.noise.kinematics_mm.sqrt(), model.noise.kinematics_rad.sqrt()
    residuals, over = residuals_of(model, state), over_of(model.measured, levels, joints, number, motions)
    prior = torch.diag_embed(model.layout.sigma.square().reciprocal())
    C = inverse(torch.nan_to_num(residuals.own_information) * (motions / len(number)) + prior)
    tests = residual_tests(residuals, over, C)
    doubtful = torch.nonzero(tests.failed.any(-1))[:, 0]
    if not settings.bias_correction or not len(doubtful):
        return tests
    few, there, C = model.take_trials(doubtful), state.take(doubtful), C[doubtful]
    expected = _expected(few, there, C, None if joints is None else joints[doubtful], over, settings)
    return tests.put(doubtful, residual_tests(residuals.take(doubtful), over.take(doubtful), C, expected))


def _expected(
    model: WeightedModel,
    state: State,
    covariance: Float[Tensor, "b p p"],
    joints: Float[Tensor, "b n j"] | None,
    over: Over,
    settings: SolverSettings,
) -> Float[Tensor, "m f b"]:
    """Scores that noise of the kinematics alone makes, which is in the residuals, in their Jacobian, and in what they
    are tested over, from antithetic simulations (bias.py). They grow with the number of motions as sums do."""
    n = model.measured.motions
    repeats = max(SIMULATIONS, -(-settings.bias_motions // n))
    readings = None if joints is None else joints.repeat(2, 1, 1)
    twice, total = covariance.repeat(2, 1, 1) * (over.motions / n), torch.zeros(())
    for pairs, at in simulated_pairs(model, state, repeats, settings.seed):
        levels = pairs.noise.kinematics_mm.sqrt(), pairs.noise.kinematics_rad.sqrt()
        simulated = over_of(pairs.measured, levels, readings, over.number, over.motions)
        scores = Scores.of(residuals_of(pairs, at), simulated, twice)
        total = total + scores.fitted.unflatten(-1, (2, -1)).sum(-2)
    return total / (2.0 * repeats)


def residual_tests(
    residuals: TestedResiduals,
    over: Over,
    covariance: Float[Tensor, "b p p"] | None = None,
    expected: Float[Tensor, "m f b"] | None = None,
) -> TestList:
    """All tests of some kinds of residuals.

    Args:
        residuals: of motions in the order of time.
        over: what they are tested over.
        covariance: of the parameters that took of them; None: none did (`TestedResiduals.of_values`).
        expected: scores of all patterns with the right model; None: zero.
    """
    if covariance is None:
        covariance = residuals.score.new_zeros(len(over.cluster), 0, 0)
    found = Scores.of(residuals, over, covariance)
    score = found.score if expected is None else found.score - expected
    statistic = torch.where(found.seen, score / found.variance.clamp_min(1e-300).sqrt(), torch.nan)
    places = Places.of(residuals, over, covariance)
    near = torch.stack([places.against_next(), places.against_nearest()], dim=1)
    statistic = torch.where(places.count[:, None] < LEAST_PLACES, torch.nan, torch.cat((statistic, near), dim=1))
    chance = _t_tail(statistic, (places.count - 1).clamp_min(1)[:, None].expand_as(statistic))
    return _listed(residuals.names, over, statistic, chance)


@dataclass(frozen=True)
class Scores:
    """Scores of all patterns of all kinds, the parameters eliminated.

    Attributes:
        score: of each, where the parameters fit best.
        fitted: the same less what parameters that fit these motions alone would take of it.
        variance: with the right model, and not below its scatter over places.
        seen: whether the motions differ in what the pattern is of, and the fit leaves some of it.
    """

    score: Float[Tensor, "m f b"]
    fitted: Float[Tensor, "m f b"]
    variance: Float[Tensor, "m f b"]
    seen: Bool[Tensor, "m f b"]

    @classmethod
    def of(cls, residuals: TestedResiduals, over: Over, covariance: Float[Tensor, "b p p"]) -> "Scores":
        """Arguments as for `residual_tests`."""
        patterns = _patterns(over, residuals)
        taken = torch.einsum("mfbn,mbnp->bmfp", patterns, residuals.shared)
        back = (taken.flatten(1, 2) @ covariance).unflatten(1, taken.shape[1:3])
        # What each motion adds to every score, with what the parameters took of it.
        each = patterns * residuals.score[:, None]
        score = each.sum(-1)
        each = each - torch.einsum("bmfp,bnp->mfbn", back, residuals.own_score)
        plain = (patterns.square() * residuals.information[:, None]).sum(-1)
        information = plain - (back * taken).sum(-1).permute(1, 2, 0)
        scatter = _by_place(each, over.cluster).square().sum(-1)
        seen = (plain > LEAST_SPREAD * plain[:, :1]) & (information > LEAST_LEFT * plain)
        is_scaled = covariance.shape[-1] > 0  # else the noise is known to a factor only
        variance = torch.maximum(information, scatter) if is_scaled else scatter
        return cls(score, each.sum(-1), variance, seen)


def _patterns(over: Over, residuals: TestedResiduals) -> Float[Tensor, "m f b n"]:
    """Patterns over the motions for every kind, all but the first without their mean, in the order of `Over.names`."""
    b, n = over.cluster.shape
    u, v = over.picture
    picture = torch.stack((u, v, u.square() + v.square()))[:, list(residuals.cameras)].transpose(0, 1)  # (m, 3, b, n)
    size = over.joints.abs().amax((1, 2)).clamp_min(1.0)  # so that what hardly changes is told from rounding
    time = over.number.to(u) / over.motions - 0.5
    steps = over.number >= over.number.new_tensor(over.borders)[:, None]
    alike = torch.cat((time[None], steps.to(time)))[:, None].expand(-1, b, n)
    shared = torch.cat((over.joints / size[:, None, None], alike))
    f = torch.cat((picture, shared.expand(len(picture), *shared.shape)), dim=1)
    weight = residuals.information[:, None]
    mean = (f * weight).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True).clamp_min(1e-300)
    return torch.cat((torch.ones_like(f[:, :1]), f - mean), dim=1)


def _by_place(each: Float[Tensor, "*a b n"], cluster: Int[Tensor, "b n"]) -> Float[Tensor, "*a b g"]:
    """Sums over the motions of each place."""
    places = int(cluster.max()) + 1
    if places == cluster.shape[-1]:
        return each
    return each.new_zeros(*each.shape[:-1], places).scatter_add(-1, cluster.expand_as(each), each)


@dataclass(frozen=True)
class Places:
    """Residuals of each of `g` places, in time.

    Attributes:
        e: in their own sigma, as if nothing had been fitted; zero where nothing was measured.
        effect: of the parameters, in the same unit.
        known: where something was measured.
        covariance: of the parameters.
        where: the place, mm.
    """

    e: Float[Tensor, "m b g"]
    effect: Float[Tensor, "m b g p"]
    known: Float[Tensor, "m b g"]
    covariance: Float[Tensor, "b p p"]
    where: Float[Tensor, "b g d"]

    @classmethod
    def of(cls, residuals: TestedResiduals, over: Over, covariance: Float[Tensor, "b p p"]) -> "Places":
        """Of the residuals of motions."""
        information = _by_place(residuals.information, over.cluster)
        known = (information > 0).to(information.dtype)
        sigma = torch.where(information > 0, information, 1.0).rsqrt()
        shared = _by_place(residuals.shared.permute(0, 3, 1, 2), over.cluster).permute(0, 2, 3, 1)
        size = _by_place(torch.ones_like(over.place[..., 0]), over.cluster)
        where = _by_place(over.place.permute(2, 0, 1), over.cluster).permute(1, 2, 0) / size.clamp_min(1.0)[..., None]
        score = _by_place(residuals.score, over.cluster)
        return cls(score * sigma, shared * sigma[..., None], known, covariance, where)

    @property
    def count(self) -> Float[Tensor, "m b"]:
        """Places where each kind was measured."""
        return self.known.sum(-1)

    def against_next(self) -> Float[Tensor, "m b"]:
        """Autocorrelation between places that follow each other, in its sigma."""
        one, other = (
            (self.e[..., part], self.effect[..., part, :], self.known[..., part])
            for part in (slice(1, None), slice(None, -1))
        )
        return self._alike(one, other, torch.ones_like(self.e[0, :, 1:]))

    def against_nearest(self) -> Float[Tensor, "m b"]:
        """The same between each place and the nearest one that does not come just before or after it."""
        step = -(-self.where.shape[1] // PAIRED_PLACES)
        where, one = self.where[:, ::step], (self.e[..., ::step], self.effect[..., ::step, :], self.known[..., ::step])
        number = torch.arange(where.shape[1], device=where.device)
        close = (number[:, None] - number).abs() * step < APART_IN_TIME
        nearest = torch.where(close, torch.inf, torch.cdist(where, where)).argmin(-1)  # (b, g)
        e, effect, known = one
        partner = nearest.expand(e.shape)
        other = (e.gather(-1, partner), effect.take_along_dim(partner[..., None], dim=-2), known.gather(-1, partner))
        mutual = nearest.gather(-1, nearest) == number  # a pair of two that are nearest to each other is one
        return self._alike(one, other, torch.where(mutual, 0.5, 1.0).to(e))

    def _alike(
        self, one: tuple[Tensor, Tensor, Tensor], other: tuple[Tensor, Tensor, Tensor], weight: Float[Tensor, "b g"]
    ) -> Float[Tensor, "m b"]:
        """Sum of the products of pairs of places less what is expected of it, in its sigma.

        That is not below the sigma of the noise as fitted, with which the expected goes, and which may lie far above
        most residuals.

        Args:
            one, other: `e`, `effect` and `known` of the places of each pair.
            weight: of each pair.
        """
        (e, effect, known), (e_other, effect_other, known_other) = one, other
        products = e * e_other
        taken = ((effect @ self.covariance) * effect_other).sum(-1)
        excess, squares, pairs = (
            (weight * each).sum(-1) for each in (products + taken, products.square(), known * known_other)
        )
        is_scaled = self.covariance.shape[-1] > 0  # else the noise is known to a factor only
        return excess / (torch.maximum(squares, pairs) if is_scaled else squares).clamp_min(1e-12).sqrt()


def _t_tail(statistic: Float[Tensor, "*a"], freedom: Float[Tensor, "*a"]) -> Float[Tensor, "*a"]:
    """Probability of a larger absolute value of Student's t; NaN of NaN."""
    tail = 2.0 * stdtr(freedom.cpu().numpy(), -statistic.abs().cpu().numpy())
    return torch.as_tensor(tail).to(statistic)


def _listed(
    kinds: tuple[str, ...], over: Over, statistic: Float[Tensor, "m t b"], chance: Float[Tensor, "m t b"]
) -> TestList:
    """The list, in which the steps in time at all borders are one test, the clearest."""
    first, count = len(over.names), len(over.borders)
    keep = [*range(first), *range(first + count, statistic.shape[1])]
    names, columns = [*over.names, NEAR_IN_TIME, NEAR_IN_JOINTS], [statistic[:, keep], chance[:, keep]]
    at = torch.full_like(columns[1], -1, dtype=torch.int64)
    if count:
        z, tail = statistic[:, first : first + count], chance[:, first : first + count]
        best = torch.nan_to_num(tail, nan=torch.inf).argmin(1, keepdim=True)
        tried = torch.isfinite(tail).sum(1, keepdim=True)
        names.append(TIME_STEP)
        columns[0] = torch.cat((columns[0], z.gather(1, best)), dim=1)
        columns[1] = torch.cat((columns[1], (tail.gather(1, best) * tried).clamp_max(1.0)), dim=1)
        at = torch.cat((at, over.number.new_tensor(over.borders)[best]), dim=1)
    listed = tuple(TestName(kind, name) for kind in kinds for name in names)
    return TestList(listed, *(x.flatten(0, 1).T.contiguous() for x in (*columns, at)))
