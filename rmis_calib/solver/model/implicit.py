"""Implicit differentiation: the derivative of the root of an equation, whatever found the root.

Where F(x, data) = 0, dx = -(dF/dx)^-1 (dF/d data) (implicit function theorem). A Newton step from the root, with dF/dx
held, is a function of the data with that derivative, and with the root as its value: one linear solve, and no memory
of the steps that led there.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.model.batched_linalg import rescaled


def newton_on_graph(
    equation: Callable[[Float[Tensor, "*batch k"]], Float[Tensor, "*batch k"]], like: Float[Tensor, "*batch k"]
) -> Float[Tensor, "*batch k"]:
    """The Newton step from zero, with derivatives to all tensors that the equation closes over.

    Args:
        equation: F of a step from the root; each entry of the batch on its own. Its derivative comes from autograd.
        like: gives shape, dtype and device of the step.
    """
    with torch.inference_mode(False), torch.enable_grad():
        step = torch.zeros(like.shape, dtype=like.dtype, device=like.device, requires_grad=True)
        value = equation(step)
        rows = [torch.autograd.grad(value[..., i].sum(), step, retain_graph=True)[0] for i in range(step.shape[-1])]
        slope = torch.stack(rows, dim=-2)
        # Radians and millimetres mix once every row and column is of one size.
        size = slope.diagonal(dim1=-2, dim2=-1).abs().clamp_min(1e-300).rsqrt()
        scaled = rescaled(slope, size)
        solved = torch.linalg.solve_ex(scaled, (size * value)[..., None]).result[..., 0]
        return -size * solved
