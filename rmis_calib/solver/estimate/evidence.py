"""Do the data ask for an unknown that was left out? A score test of each candidate, from one linearised step.

With u the score of the unknowns that were left out and A their information, both with the other unknowns eliminated,
u^T A^-1 u is chi^2 where all of them are nominal (Rao 1948): no problem is solved again to know. Only directions that
the data see better than the prior count. Freeing an unknown that is nominal costs sigma, and believing in one that is
not costs the truth, so the tests are loose ones, and the candidate of least chance is freed first.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.estimate.bias import expected_score
from rmis_calib.solver.estimate.map_estimate import MapEstimate
from rmis_calib.solver.model.normal_equations import accumulate
from rmis_calib.solver.model.parameters import NuisancePriors, make_layout
from rmis_calib.solver.problem import stands_still
from rmis_calib.solver.settings import SolverSettings, UnknownSettings

CHANCE = {"clock_rate": 0.005, "setup": 0.02, "compliance": 1e-4}
"""Probability, with everything nominal, from which an unknown is freed: less for what costs more."""
TESTED_MOTIONS = 2048
"""Long recordings are tested on a sample: what needs more motions to show is below the sigmas that matter."""
SEEN = 2.0
"""Information on a direction, in that of the prior, from which it counts."""


def freed(unknowns: UnknownSettings, name: str) -> UnknownSettings:
    """The settings with a candidate estimated."""
    return replace(unknowns, **{name: "prior" if name == "setup" else "always"})


def chances(fit: MapEstimate, settings: SolverSettings) -> dict[str, Float[Tensor, " b"]]:
    """Probability of what the data say if each candidate (`clock_rate`, `setup`, `compliance`) were nominal, for every
    trial; only of those that are left out, and may be estimated."""
    asked, found, laparoscope = settings.unknowns, {}, fit.problem.laparoscope_base_T_arm
    left_out = {"clock_rate": asked.clock_rate == "auto" and "clock" in fit.model.layout.blocks}
    if laparoscope is not None:
        left_out |= {"setup": asked.setup == "known", "compliance": asked.compliance == "auto"}
    for name in (name for name, is_left_out in left_out.items() if is_left_out):
        nominal, model = NuisancePriors.of(fit.problem), fit.model
        layout = make_layout(nominal, model.measured, model.layout.origin, freed(asked, name), settings.noise)
        model = replace(model, layout=layout)
        step = -(-model.measured.motions // TESTED_MOTIONS)
        if step > 1:
            model = model.take_motions(torch.arange(0, model.measured.motions, step, device=fit.state.t.device))
        normal = accumulate(model, fit.state)
        found[name] = _chance(normal.H, normal.g, layout.sigma, layout.blocks[name])
        if bool((found[name] < CHANCE[name]).any()):
            # Noise in the Jacobian alone makes a score.
            expected = expected_score(model, fit.state, settings.bias_motions, settings.seed)
            found[name] = _chance(normal.H, normal.g - expected.g, layout.sigma, layout.blocks[name])
        # A camera that stands still cannot tell a bend of the shaft from an error of the picture.
        if laparoscope is not None and name != "clock_rate":
            found[name] = torch.where(stands_still(laparoscope), 1.0, found[name])
    return found


def _chance(
    H: Float[Tensor, "b p p"], g: Float[Tensor, "b p"], sigma: Float[Tensor, "b p"], part: slice
) -> Float[Tensor, " b"]:
    """Probability of a larger score of the block `part`; H and g with priors, at zero of that block."""
    H, g = torch.nan_to_num(H), torch.nan_to_num(g)
    inside = torch.zeros(H.shape[-1], dtype=torch.bool, device=H.device)
    inside[part] = True
    scale = sigma[:, inside]  # in units of the priors
    others = H[:, ~inside][:, :, ~inside]
    size = others.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
    cross = H[:, ~inside][:, :, inside] * scale[:, None] * size[..., None]
    right = torch.cat((cross, (g[:, ~inside] * size)[..., None]), dim=-1)
    unit = others * size[:, :, None] * size[:, None] + 1e-12 * eye[~inside][:, ~inside]
    solved = torch.linalg.solve_ex(unit, right).result
    A = H[:, inside][:, :, inside] * scale[:, :, None] * scale[:, None] - cross.mT @ solved[..., :-1]
    u = g[:, inside] * scale - (cross.mT @ solved[..., -1:])[..., 0]
    values, vectors = torch.linalg.eigh(torch.nan_to_num(0.5 * (A + A.mT)) - eye[inside][:, inside])
    along, seen = (vectors.mT @ u[..., None])[..., 0], values > SEEN
    chi2 = torch.where(seen, along.square() / values.clamp_min(SEEN), 0.0).sum(-1)
    freedom = seen.sum(-1)
    tail = torch.special.gammaincc(0.5 * freedom.clamp_min(1), 0.5 * chi2)
    return torch.where(freedom > 0, tail, 1.0)
