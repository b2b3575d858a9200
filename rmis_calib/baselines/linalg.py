"""Eigenvectors whose derivative divides only by the gaps that separate them from the rest."""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry import project_to_so3


def extreme_eigenvectors(
    matrix: Float[Tensor, "*batch n n"], count: int, *, largest: bool = False
) -> Float[Tensor, "*batch n count"]:
    """Orthonormal eigenvectors of the `count` smallest (or largest) eigenvalues of symmetric matrices.

    They span the invariant subspace; what is computed from them must not depend on the basis within it. The derivative
    is then that of the subspace, and stays finite where eigenvalues inside it, or outside it, coincide.
    """
    with torch.no_grad():
        values, vectors = torch.linalg.eigh(matrix)
        order = values.shape[-1] - count
        chosen, rest = (order, None), (None, order)
        if not largest:
            chosen, rest = (None, count), (count, None)
        inside, outside = vectors[..., slice(*chosen)], vectors[..., slice(*rest)]
        gaps = values[..., None, slice(*chosen)] - values[..., slice(*rest), None]
    if not matrix.requires_grad:
        return inside
    change = outside @ ((outside.mT @ matrix @ inside) / gaps)
    return inside + (change - change.detach())


def solve_symmetric(matrix: Float[Tensor, "*batch n n"], rhs: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """Solution of well-scaled systems; a singular one gives what is not finite, not an exception."""
    return torch.linalg.solve_ex(matrix, rhs[..., None]).result[..., 0]


def nearest_rotation(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation nearest to a matrix; one that is not finite stays so, where the decomposition would raise."""
    finite = torch.isfinite(matrix).all(-1).all(-1)[..., None, None]
    eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    return torch.where(finite, project_to_so3(torch.where(finite, matrix, eye)), torch.nan)
