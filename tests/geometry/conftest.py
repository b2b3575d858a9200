"""Rotations to test with: three samplers times three batch shapes."""

import math

import pytest
import torch
from torch import Tensor

from rmis_calib.geometry import random_quat, rotvec_to_quat

SAMPLERS = ("uniform", "tangent", "tiny")
BATCHES = ((), (1,), (3, 1, 2))


def sample_quats(sampler: str, batch: tuple[int, ...], seed: int) -> Tensor:
    """Unit quaternions: uniform, exp of a normal rotation vector, or within 1e-7 rad of the identity."""
    generator = torch.Generator().manual_seed(seed)
    if sampler == "uniform":
        return random_quat(batch, generator)
    scale = {"tangent": 1.0, "tiny": 1e-7 / math.sqrt(3)}[sampler]
    return rotvec_to_quat(scale * torch.randn(*batch, 3, generator=generator, dtype=torch.float64).clamp(-1, 1))


@pytest.fixture(params=[(sampler, batch) for sampler in SAMPLERS for batch in BATCHES], ids=str)
def three_quats(request: pytest.FixtureRequest) -> tuple[Tensor, Tensor, Tensor]:
    """Three independent samples of one sampler and one batch shape."""
    sampler, batch = request.param
    return tuple(sample_quats(sampler, batch, seed) for seed in (1, 2, 3))


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)
