"""Vectors and small systems with the batch last: component-first tensors, so that every operation runs along memory.

Torch's LAPACK route for batches of 10x10 systems costs 3 to 6 us a system on one core and does not use the second; the
elimination here is K fused operations over contiguous batches (`tests/benchmarks/bench_solver_speed.py`).
"""

import torch
from jaxtyping import Float
from torch import Tensor


def dot(a: Float[Tensor, "3 ..."], b: Float[Tensor, "3 ..."]) -> Tensor:
    """Scalar product over the first axis; the rest broadcasts."""
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def cross(a: Float[Tensor, "3 ..."], b: Float[Tensor, "3 ..."]) -> Float[Tensor, "3 ..."]:
    """Vector product over the first axis; the rest broadcasts."""
    return torch.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


def rotate(R: Float[Tensor, "3 3 ..."], v: Float[Tensor, "3 ..."]) -> Float[Tensor, "3 ..."]:
    """R v for matrices with the batch last."""
    return torch.stack([torch.addcmul(torch.addcmul(R[i, 0] * v[0], R[i, 1], v[1]), R[i, 2], v[2]) for i in range(3)])


def rotate_back(R: Float[Tensor, "3 3 ..."], v: Float[Tensor, "3 ..."]) -> Float[Tensor, "3 ..."]:
    """R^T v for matrices with the batch last."""
    return rotate(R.transpose(0, 1), v)


def unit(v: Float[Tensor, "3 ..."]) -> Float[Tensor, "3 ..."]:
    """v / |v|."""
    return v / dot(v, v).sqrt()


def batch_last(x: Tensor, kept: int) -> Tensor:
    """Moves the last `kept` axes to the front."""
    return x.permute(*range(x.ndim - kept, x.ndim), *range(x.ndim - kept)).contiguous()


def eliminate(augmented: Float[Tensor, "k cols b n"]) -> Float[Tensor, "k cols b n"]:
    """LDL^T elimination, in place, of the symmetric positive definite systems in the first k columns.

    Afterwards row i, column j < i holds the multiplier l_ij, the diagonal holds the pivots d_j, and the columns past k
    hold L^-1 B of the right-hand sides B. So B^T S^-1 B = sum_j (L^-1 B)_j (L^-1 B)_j^T / d_j.
    """
    size = augmented.shape[0]
    for j in range(size - 1):
        augmented[j + 1 :, j].div_(augmented[j, j])
        augmented[j + 1 :, j + 1 :].addcmul_(augmented[j + 1 :, j, None], augmented[j, None, j + 1 :], value=-1.0)
    return augmented


def forward_substitute(factor: Float[Tensor, "k cols b n"], r: Float[Tensor, "k b n"]) -> Float[Tensor, "k b n"]:
    """L^-1 r for the multipliers that `eliminate` left behind."""
    out = r.clone()
    for j in range(r.shape[0] - 1):
        out[j + 1 :].addcmul_(factor[j + 1 : r.shape[0], j], out[j].unsqueeze(0), value=-1.0)
    return out
