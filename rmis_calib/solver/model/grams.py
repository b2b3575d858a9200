"""Sums over motions of the products of whitened columns: information and score of all motions, or of groups of them.

The unknowns of what gives way are products: the effect of each component on the rows, times functions of the motion's
pose (compliance.py). A function is one number a motion, so that whitening commutes with it: only the components are
whitened, and the functions enter with the sums.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def gram(white: Float[Tensor, "k q b n"], member: Float[Tensor, "b n g"] | None) -> Float[Tensor, "b g q q"]:
    """Products of all columns with each other, summed over rows and the motions of each group.

    Args:
        white: columns of each motion, in units of their noise.
        member: weight of each motion in each group; None: one group of all.
    """
    if member is None:
        return torch.matmul(white.permute(0, 2, 1, 3), white.permute(0, 2, 3, 1)).sum(0)[:, None]
    rows = _by_motion(white)
    return _summed(rows @ rows.mT, member)


def gram_of_products(
    white: Float[Tensor, "k q b n"],
    member: Float[Tensor, "b n g"] | None,
    part: slice,
    functions: Float[Tensor, "f b n"],
) -> Float[Tensor, "b g p p"]:
    """`gram` where some columns are components, each of which stands for its products with all functions, neighbours
    together.

    Args:
        white: as in `gram`.
        member: as in `gram`.
        part: the components among the columns.
        functions: of the pose of each motion.
    """
    f, rows = functions.permute(1, 2, 0), _by_motion(white)
    each, groups = (f, 1) if member is None else (_times(member, f), member.shape[-1])
    products = rows[:, :, part].contiguous() @ rows.mT  # (b, n, c, q)
    once = _summed(products, each).unflatten(1, (groups, -1))
    twice = _summed(products[..., part], _times(each, f)).unflatten(1, (groups, f.shape[-1], f.shape[-1]))
    once, twice = once.transpose(2, 3).flatten(2, 3), twice.permute(0, 1, 4, 2, 5, 3)
    return _joined(gram(white, member), once, twice, part)


def _by_motion(white: Float[Tensor, "k q b n"]) -> Float[Tensor, "b n q k"]:
    """Contiguous: many small products take six times as long on strides."""
    return white.permute(2, 3, 1, 0).contiguous()


def _summed(each: Float[Tensor, "b n i j"], weight: Float[Tensor, "b n w"]) -> Float[Tensor, "b w i j"]:
    return (weight.mT @ each.flatten(2)).unflatten(-1, each.shape[2:])


def _times(x: Float[Tensor, "b n i"], y: Float[Tensor, "b n j"]) -> Float[Tensor, "b n ij"]:
    return (x[..., :, None] * y[..., None, :]).flatten(2)


def _joined(
    base: Float[Tensor, "b g q q"],
    once: Float[Tensor, "b g cf q"],
    twice: Float[Tensor, "b g c f c f"],
    part: slice,
) -> Float[Tensor, "b g p p"]:
    """The sums with every component in the place of its products."""
    count, q = once.shape[2], base.shape[-1]
    other = torch.cat((torch.arange(part.start), torch.arange(part.stop, q))).to(base.device)
    place = torch.where(other < part.start, other, other + count - (part.stop - part.start))
    p = len(other) + count
    out = base.new_empty((*base.shape[:2], p, p))
    products = slice(part.start, part.start + count)
    out[..., place[:, None], place] = base[..., other[:, None], other]
    out[..., products, place] = once[..., other]
    out[..., place, products] = once[..., other].mT
    out[..., products, products] = twice.flatten(4, 5).flatten(2, 3)
    return out
