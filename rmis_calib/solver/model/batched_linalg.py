"""Vectors and small systems with the batch last: component-first tensors, so that every operation runs along memory.

Torch's LAPACK route for batches of 10x10 systems costs 3 to 6 us a system on one core and does not use the second; the
elimination here is K fused operations over contiguous batches (`tests/benchmarks/bench_solver_speed.py`).
"""

import torch
from jaxtyping import Float
from torch import Tensor


def dot(a: Float[Tensor, "3 ..."], b: Float[Tensor, "3 ..."]) -> Tensor:
    """Scalar product over the first axis; the rest broadcasts."""
    (a0, a1, a2), (b0, b1, b2) = a.unbind(), b.unbind()
    return torch.addcmul(torch.addcmul(a0 * b0, a1, b1), a2, b2)


def cross(a: Float[Tensor, "3 ..."], b: Float[Tensor, "3 ..."]) -> Float[Tensor, "3 ..."]:
    """Vector product over the first axis; the rest broadcasts."""
    (a0, a1, a2), (b0, b1, b2) = a.unbind(), b.unbind()
    return torch.stack(
        (
            torch.addcmul(a1 * b2, a2, b1, value=-1.0),
            torch.addcmul(a2 * b0, a0, b2, value=-1.0),
            torch.addcmul(a0 * b1, a1, b0, value=-1.0),
        )
    )


def add_cross_(out: Float[Tensor, "3 ..."], a: Float[Tensor, "3 ..."], b: Float[Tensor, "3 ..."]) -> None:
    """Adds a x b to `out`, in place; a and b broadcast."""
    x, y, z = out[0], out[1], out[2]  # not unbind: autograd refuses to change its outputs in place
    (a0, a1, a2), (b0, b1, b2) = a.unbind(), b.unbind()
    x.addcmul_(a1, b2).addcmul_(a2, b1, value=-1.0)
    y.addcmul_(a2, b0).addcmul_(a0, b2, value=-1.0)
    z.addcmul_(a0, b1).addcmul_(a1, b0, value=-1.0)


def rotate(R: Float[Tensor, "3 3 ..."], v: Float[Tensor, "3 ..."]) -> Float[Tensor, "3 ..."]:
    """R v for matrices with the batch last."""
    v0, v1, v2 = v.unbind()
    turned = []
    for row in R.unbind():
        r0, r1, r2 = row.unbind()
        turned.append(torch.addcmul(torch.addcmul(r0 * v0, r1, v1), r2, v2))
    return torch.stack(turned)


def rotate_back(R: Float[Tensor, "3 3 ..."], v: Float[Tensor, "3 ..."]) -> Float[Tensor, "3 ..."]:
    """R^T v for matrices with the batch last."""
    return rotate(R.transpose(0, 1), v)


def rotate_trials(R: Float[Tensor, "b m 3 3"], v: Float[Tensor, "3 b n"]) -> Float[Tensor, "3 m b n"]:
    """R v for m matrices a trial, the same for all its motions: one matrix product."""
    m = R.shape[1]
    return torch.matmul(R.transpose(1, 2).flatten(1, 2), v.transpose(0, 1)).transpose(0, 1).unflatten(0, (3, m))


def unit(v: Float[Tensor, "3 ..."]) -> Float[Tensor, "3 ..."]:
    """v / |v|."""
    return v / dot(v, v).sqrt()


def batch_last(x: Tensor, kept: int) -> Tensor:
    """Moves the last `kept` axes to the front."""
    return x.permute(*range(x.ndim - kept, x.ndim), *range(x.ndim - kept)).contiguous()


def unit_diagonal(matrix: Float[Tensor, "*b p p"]) -> tuple[Float[Tensor, "*b p p"], Float[Tensor, "*b p"]]:
    """(S M S, the diagonal of S) with S = diag(M)^-1/2: radians and millimetres mix once the diagonal is one.

    So M^-1 = S (S M S)^-1 S. A diagonal entry of zero, or below, is scaled as if it were 1e-300.
    """
    scale = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    return rescaled(matrix, scale), scale


def rescaled(matrix: Float[Tensor, "*#b p p"], scale: Float[Tensor, "*#b p"]) -> Float[Tensor, "*b p p"]:
    """S M S with S = diag(scale)."""
    return matrix * scale[..., :, None] * scale[..., None, :]


def eliminate(augmented: Float[Tensor, "k cols b n"]) -> Float[Tensor, "k cols b n"]:
    """LDL^T elimination, in place, of the symmetric positive definite systems in the first k columns.

    Afterwards row i, column j < i holds the multiplier l_ij, the diagonal holds the pivots d_j, and the columns past k
    hold L^-1 B of the right-hand sides B. So B^T S^-1 B = sum_j (L^-1 B)_j (L^-1 B)_j^T / d_j.
    """
    size = augmented.shape[0]
    for j, pivot_row in enumerate(augmented.unbind()[: size - 1]):
        below = augmented[j + 1 :]
        factor = below[:, j].div_(pivot_row[j])
        below[:, j + 1 :].addcmul_(factor.unsqueeze(1), pivot_row[j + 1 :], value=-1.0)
    return augmented


def forward_substitute(factor: Float[Tensor, "k cols b n"], r: Float[Tensor, "k b n"]) -> Float[Tensor, "k b n"]:
    """L^-1 r for the multipliers that `eliminate` left behind."""
    out = r.clone()
    for j in range(r.shape[0] - 1):
        out[j + 1 :].addcmul_(factor[j + 1 : r.shape[0], j], out[j].unsqueeze(0), value=-1.0)
    return out
