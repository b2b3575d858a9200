"""A posterior with one more motion: one step of an extended information filter, for answers while motions come in."""

from dataclasses import replace

from jaxtyping import Bool
from torch import Tensor

from rmis_calib.solver.estimate.gauss_newton import solve_system
from rmis_calib.solver.estimate.outliers import chi2_quantile
from rmis_calib.solver.model.normal_equations import normal_equations
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import SolverSettings
from rmis_calib.solver.solution import Posterior


def add_motion(
    posterior: Posterior, problem: Problem, settings: SolverSettings
) -> tuple[Posterior, Bool[Tensor, " b"]]:
    """The posterior after one more motion, and whether the motion was taken.

    The motions before count by their information at the state at which each was added: exact for small steps, so the
    caller solves all of them again from time to time. A motion that contradicts the posterior is not taken.
    Source: with H the information and g the gradient of the motion, step = -(H0 + H)^-1 g; the squared innovation over
    its covariance, which counts the posterior's, is r^T S^-1 r + g^T step.

    Args:
        posterior: of the motions before, one trial.
        problem: one trial of one motion, with the kinds of measurement of the estimate.
        settings: as in the estimate.
    """
    state, layout = posterior.state, posterior.layout
    measured = pack(problem.flatten_batch(), settings.noise)
    normal = normal_equations(WeightedModel(measured, layout, posterior.noise), state)
    information = posterior.information + normal.H
    step, solvable = solve_system(information, normal.g)
    innovation = normal.distance2.sum(-1) + (normal.g * step).sum(-1)
    taken = solvable & (normal.rows > 0) & (innovation <= chi2_quantile(normal.rows, settings.outlier_probability))
    moved = replace(posterior, state=state.moved(layout.step(step)), information=information)
    return (moved if bool(taken.all()) else posterior), taken
