"""Second-order bias of errors in variables, from antithetic simulations at the estimate.

Noise of the kinematics enters the Jacobian, the weights and the residuals of the score g = J^T S^-1 r together, and
noise of the pose that a camera sees enters through the curvature of the projection. So E[g] at the true parameters is
not zero but of second order in the noise, the same in every motion, while the standard error falls with N: for many
motions the estimate is biased by more than its sigma. The estimate that solves g = E[g] is free of it to that order.

E[g] comes from simulating the measurement at the estimate, with the measured kinematics taken as true, and evaluating
the score there: no simulated problem is solved. Each draw is used with both signs. Terms of first (and any odd) order
in the noise cancel exactly in the mean of the pair, so what remains to average is the second-order term itself: one
pair knows the bias to a few per cent of the standard error, where a plain bootstrap with B replicas adds 1/B of the
variance and needs B solves. `tests/benchmarks/bench_solver_efficiency.py` compares.

The same pairs correct the information: noise in J inflates J^T S^-1 J by its own variance, and 2 H - E[H] removes
that to second order.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.solver.model.batched_linalg import cross, dot, unit
from rmis_calib.solver.model.measurement_rows import LINE, MeasurementRows
from rmis_calib.solver.model.motion_covariance import NoiseModel, image_variance
from rmis_calib.solver.model.normal_equations import normal_equations
from rmis_calib.solver.model.own_rows import own_rows, shaft_poses
from rmis_calib.solver.model.predicted_shaft import Shaft, predict_shaft
from rmis_calib.solver.model.residuals import _line_geometry, corrected_points, predicted_s_end
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel

SIMULATED_PART = 16
"""One motion in so many is simulated in long recordings: the expected score is then known to about a fifth of its
standard error at c = 1, much better below."""


@dataclass(frozen=True)
class ScoreBias:
    """Expected score and information of simulated data, summed over the motions of the problem (priors not
    included)."""

    g: Float[Tensor, "b p"]
    H: Float[Tensor, "b p p"]


def _turned(v: Tensor, phi: Tensor) -> Tensor:
    """exp([phi]x) v to second order."""
    first = cross(phi, v)
    return v + first + 0.5 * cross(phi, first)


class _Draws:
    """Standard normal draws of one simulation, and the same with the other sign: trials of twice as many.

    All trials have the same draws, and each kind of measurement has draws of its own, so that the answer of a trial
    does not depend on the others or on what they measured.
    """

    def __init__(self, measured: MeasurementRows, generator: torch.Generator) -> None:
        c, b, n = measured.cameras, measured.trials, measured.motions
        seeds = iter(
            torch.randint(2**62, (7 + len(measured.own),), generator=generator, device=generator.device).tolist()
        )

        def draw(*shape: int) -> Tensor:
            own = torch.Generator(device=generator.device).manual_seed(next(seeds))
            one = torch.randn(*shape, 1, n, generator=own, dtype=measured.p.dtype, device=measured.p.device)
            return torch.cat((one, -one), dim=-2).repeat_interleave(b, dim=-2)

        self.turn, self.shift = draw(3), draw(3)
        self.camera_turn, self.camera_shift = draw(3, c), draw(3, c)
        self.line = draw(*measured.line_rho.shape[:2])
        self.end = draw(2, measured.end_xy.shape[1])
        self.head = draw(2, measured.head_xy.shape[1])
        self.own = [draw(len(rows.ok)) for rows in measured.own]


def simulate(measured: MeasurementRows, state: State, noise: NoiseModel, draws: "_Draws") -> MeasurementRows:
    """The measurements that the state and the measured kinematics predict, with noise of the model and these draws
    added."""

    def scaled(variance: Tensor, draw: Tensor) -> Tensor:
        return variance.sqrt()[:, None] * draw

    shaft = predict_shaft(measured, state)
    phi = scaled(noise.camera_rad, draws.camera_turn)
    p = shaft.p + scaled(noise.camera_mm, draws.camera_shift)
    d = unit(_turned(shaft.d, phi))
    M = cross(p, d)
    D = dot(M, M).sqrt()
    seen = Shaft(p=p, d=d, m=M / D, u=cross(d, M / D), D=D, s0=dot(p, d), head=_turned(shaft.head, phi))
    predicted = _line_geometry(measured, state, seen)
    sigma = image_variance(measured, noise).sqrt()
    lines = measured.row_kind.count(LINE)
    off = sigma[:lines].view_as(predicted.f) * draws.line - predicted.f
    line_xy = torch.addcmul(measured.line_xy, predicted.n_image, off)
    turn = scaled(noise.kinematics_rad, draws.turn)
    simulated = replace(
        measured,
        p=measured.p + scaled(noise.kinematics_mm, draws.shift),
        v=unit(_turned(measured.v, turn)),
        head=_turned(measured.head, turn),
        line_xy=line_xy,
    )
    ends = measured.end_xy.shape[1]
    if measured.has_ends:
        q = seen.p + predicted_s_end(measured, state) * seen.d
        end_xy = q[:2] / q[2] + sigma[lines : lines + ends] * draws.end
        simulated = replace(simulated, end_xy=_uncorrected(end_xy, state))
    if measured.has_heads:
        q = seen.p + seen.head
        heads = sigma[lines + ends : lines + ends + draws.head[:, :, 0, 0].numel()].view_as(draws.head)
        simulated = replace(simulated, head_xy=_uncorrected(q[:2] / q[2] + heads * draws.head, state))
    own = []
    for rows, draw in zip(measured.own, draws.own, strict=True):
        c = rows.camera
        R, t = shaft_poses(rows, measured, state)
        seen_R, p_before, p_after = (x[:, c].permute(1, 2, 0) for x in (phi, shaft.p, p))
        seen_R = rotvec_to_matrix(seen_R)
        seen_t = p_after + (seen_R @ (t - p_before)[..., None])[..., 0]
        shift = rows.var.sqrt() * draw - own_rows(rows, seen_R @ R, seen_t)
        moved = scaled(noise.kinematics_mm, draws.shift)
        own.append(replace(rows, shift=rows.shift + shift, turn=turn, moved=moved))
    return replace(simulated, own=tuple(own))


def _uncorrected(xy: Float[Tensor, "2 c b n"], state: State) -> Float[Tensor, "2 c b n"]:
    """The points whose correction these are, to first order."""
    return 2.0 * xy - corrected_points(xy, state)


def simulated_pairs(
    model: WeightedModel, state: State, repeats: int, seed: int
) -> Iterator[tuple[WeightedModel, State]]:
    """The model with simulated measurements at the state: twice its trials, first with one sign of the noise, then with
    the other."""
    generator = torch.Generator(device=model.measured.p.device).manual_seed(seed)
    twice = torch.arange(model.measured.trials, device=model.measured.p.device).repeat(2)
    both, at = model.take_trials(twice), state.take(twice)
    for _ in range(repeats):
        draws = _Draws(model.measured, generator)
        yield replace(both, measured=simulate(both.measured, at, both.noise, draws)), at


def expected_score(model: WeightedModel, state: State, simulated_motions: int, seed: int) -> ScoreBias:
    """E[g] and E[H] at the state, from at least `simulated_motions` antithetic pairs (or one motion in SIMULATED_PART
    where that is more). Motions of weight near 0 (outliers) do not take part.
    """
    like = model.measured.p
    generator = torch.Generator(device=like.device).manual_seed(seed)
    n, b, p = model.measured.motions, model.measured.trials, model.layout.size
    wanted = max(simulated_motions, n // SIMULATED_PART)
    repeats = max(1, -(-wanted // n))
    picked = model
    if wanted < n:
        picked = model.take_motions(torch.randperm(n, generator=generator, device=like.device)[:wanted])
    g, H = torch.zeros_like(model.layout.sigma), torch.zeros(b, p, p, dtype=like.dtype, device=like.device)
    drawn = generator.get_state()
    for trials, along in picked.parts():
        generator.set_state(drawn)
        twice = torch.arange(trials.stop - trials.start, device=like.device).repeat(2)
        at = state.take(trials).take(twice)
        for motions in along:
            part = picked.narrow(trials, motions)
            both = part.take_trials(twice)
            for _ in range(repeats):
                simulated = simulate(both.measured, at, both.noise, _Draws(part.measured, generator))
                normal = normal_equations(replace(both, measured=simulated), at)
                g[trials] += normal.g.unflatten(0, (2, -1)).sum(0)
                H[trials] += normal.H.unflatten(0, (2, -1)).sum(0)
    scale = n / (picked.measured.motions * repeats * 2.0)
    return ScoreBias(g * scale, H * scale)
