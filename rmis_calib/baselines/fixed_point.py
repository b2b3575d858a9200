"""Iterations over batches of trials: each stops on its own, and the answer carries derivatives of what it solves."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.solver.model.implicit import newton_on_graph

Update = Callable[..., Float[Tensor, "*batch k"]]
"""update(x, *data) -> the next x; each trial on its own."""
_STEPS_BETWEEN_SORTING = 10


def fixed_point(
    update: Update, start: Float[Tensor, "b k"], data: Sequence[Float[Tensor, "b ..."]], *, steps: int, tolerance: float
) -> tuple[Float[Tensor, "b k"], Bool[Tensor, " b"]]:
    """x with x = update(x, *data), and whether each trial settled.

    Args:
        update: one step.
        start: first x, of size about one.
        data: what the steps use of every trial.
        steps: most steps.
        tolerance: settled where a step is shorter than this.
    """
    x = start.detach().clone()
    settled = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    rows, active, held = torch.arange(len(x), device=x.device), x, tuple(data)
    with torch.no_grad():
        for k in range(steps):
            step = update(active, *held) - active
            active = active + step
            done = step.norm(dim=-1) <= tolerance
            if (k + 1) % _STEPS_BETWEEN_SORTING == 0 or k + 1 == steps:
                x[rows], settled[rows] = active, done
                if bool(done.all()):
                    break
                rows = rows[~done]
                active, held = x[rows], tuple(values[rows] for values in data)
    if not any(values.requires_grad for values in data):
        return x, settled
    # The derivative is that of the fixed point; the value of the Newton step is zero up to the tolerance.
    return x + newton_on_graph(lambda shift: update(x + shift, *data) - (x + shift), x), settled
