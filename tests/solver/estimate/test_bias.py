"""The simulations from which the bias is known are those of the state: without noise they leave no residual."""

from dataclasses import fields, replace

import torch

from rmis_calib.solver.estimate.bias import simulated_pairs
from rmis_calib.solver.model.motion_covariance import NoiseModel
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.parameters import NuisancePriors, initial_state, make_layout
from rmis_calib.solver.model.residuals import residual_rows
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.settings import NoiseSettings, UnknownSettings

READOUT_S = 0.03
NONE = 1e-24
"""Variance of no noise."""


def moving_shaft(simulate, noise_settings):
    """A problem whose shaft moves by degrees and tens of mm a second, and a state that is off in every unknown."""
    problem, truth, _ = simulate(trials=1)
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([0.3, 0.3, 0.3, 20.0, 20.0, 20.0], dtype=torch.float64)[:, None]
    velocity = size * torch.randn(1, problem.n_motions, 6, 2, generator=generator, dtype=torch.float64)
    levels = replace(problem.noise, readout=torch.full_like(problem.noise.image, 0.01))
    problem = replace(problem, clock_derivative=velocity, noise=levels)
    measured, nominal = pack(problem, noise_settings), NuisancePriors.of(problem)
    X = torch.as_tensor(truth["camera_right_T_arm"]).reshape(1, 4, 4)
    state = initial_state(nominal, X[:, :3, :3], X[:, :3, 3])
    state = replace(
        state,
        radius=state.radius + 0.1,
        end_offset=state.end_offset - 9.0,
        rcm_offset=torch.tensor([[0.5, -0.3]], dtype=torch.float64),
        clock=torch.tensor([[0.02, 0.0]], dtype=torch.float64),
        edge_bias=state.edge_bias + 1e-4,
        intrinsics=state.intrinsics + 1e-4,
        readout=torch.full_like(state.readout, READOUT_S),
    )
    return measured, nominal, state


def test_what_is_simulated_without_noise_leaves_no_residual(simulate):
    settings = NoiseSettings()
    measured, nominal, state = moving_shaft(simulate, settings)
    layout = make_layout(nominal, measured, state, UnknownSettings(readout="always"), settings)
    assert "readout" in layout.blocks
    none = torch.full_like(state.radius, NONE)
    noise = NoiseModel(**{field.name: none for field in fields(NoiseModel)})
    model = WeightedModel(measured, layout, noise)
    pairs, at = next(simulated_pairs(model, state, 1, 0))
    assert float(residual_rows(measured, state).abs().max()) > 1e-3  # the state is not that of the measurements
    # Corrections of cameras are undone to first order; rows read at other instants than they are predicted at: 1e-2.
    assert float(residual_rows(pairs.measured, at).abs().max()) < 2e-5
