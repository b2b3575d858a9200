"""Long recordings: one step over all motions from the estimate of a large sample."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.estimate.gauss_newton import Refined, solve_system
from rmis_calib.solver.estimate.outliers import REJECTED, classify
from rmis_calib.solver.model.normal_equations import accumulate
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.settings import SolverSettings
from rmis_calib.solver.status import SolveStatus

MAX_SAMPLE_SIGMA = 6.0
"""Largest single step, in standard errors of the sample that it starts from; a larger one says that the sample does
not speak for all motions."""


def one_step_update(
    model: WeightedModel, state: State, settings: SolverSettings, sample_covariance: Float[Tensor, "b p p"]
) -> tuple[Refined | None, Float[Tensor, "c b n"] | None]:
    """One Gauss-Newton step of a long recording from the estimate of a large sample, outliers taken out of the same
    pass.

    The step is of the order of the sample's standard error e; what it leaves is of order e^2 over the scene's size
    (1e-3 e or less). Returns None where the step is larger than the sample allows.
    """
    normal = accumulate(model, state)
    weight = None
    if settings.robust != "off":
        weight = classify(model, state, settings.outlier_probability, normal.distance2)
        index = torch.nonzero((weight < REJECTED).any(0)[0])[:, 0]
        if len(index) > 0:
            out = model.take_motions(index)
            with_all = accumulate(out, state)
            with_rest = accumulate(replace(out, weight=weight[..., index]), state)
            changed = {
                name: getattr(normal, name) - getattr(with_all, name) + getattr(with_rest, name)
                for name in ("H", "g", "chi2")
            }
            normal = replace(normal, **changed)
    delta, solvable = solve_system(normal.H, normal.g)
    whitened = torch.linalg.solve(sample_covariance, delta[..., None])[..., 0]
    sigma = (delta * whitened).sum(-1).clamp_min(0.0).sqrt()
    if not bool((solvable & (sigma < MAX_SAMPLE_SIGMA)).all()):
        return None, None
    settled = replace(normal, g=torch.zeros_like(normal.g), chi2=normal.chi2 + (normal.g * delta).sum(-1))
    status = torch.full_like(sigma, SolveStatus.CONVERGED, dtype=torch.int64)
    return Refined(state.moved(model.layout.step(delta)), settled, status, torch.ones_like(status)), weight
