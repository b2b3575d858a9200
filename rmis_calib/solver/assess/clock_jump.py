"""Does the clock jump? A score test of a step in the clock's offset, at every border of blocks in time.

A grabber that loses frames without a word, or a log that pauses, shifts all that comes after against all before. With
s_k and H_k the score and the information of block k, a step of the offset from block K on has the score u = sum s_k and
the information a = sum H_k of the clock over k >= K, both with all other unknowns eliminated; the step is -u / a (a
change-point test: Andrews 1993). No problem is solved again.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.assess.groups import GroupCheck, first_of_block, recounted
from rmis_calib.solver.assess.information import inverse
from rmis_calib.solver.estimate.map_estimate import MapEstimate
from rmis_calib.solver.model.normal_equations import member_sums, membership
from rmis_calib.solver.solution import ClockJump

BLOCKS, MOTIONS_A_BLOCK, LEAST_BLOCKS = 32, 3, 6
"""Blocks at most, motions of each at least, and fewest blocks that a jump is told from."""
ALLOWED_S = 0.003
"""Jumps of this size, 1 sigma, are no reason for doubt: a tenth of the time between two frames."""


def find_clock_jump(fit: MapEstimate, excess: Float[Tensor, " b"], groups: GroupCheck) -> ClockJump | None:
    """The clearest jump of the clock in every trial; None where the clock is no unknown, or motions are few.

    Args:
        fit: the estimate, motions in the order of time.
        excess: what the residuals exceed the noise by, as a factor on the variance.
        groups: what neighbouring motions exceed it by.
    """
    model, state = fit.model, fit.state
    motions, layout = model.measured.motions, fit.model.layout
    count = min(BLOCKS, motions // MOTIONS_A_BLOCK)
    if "clock" not in layout.blocks or count < LEAST_BLOCKS:
        return None
    block = torch.arange(motions, device=state.t.device) * count // motions
    member = membership(block.expand(len(state.t), -1), count, state.t.dtype)
    H_k, s_k = (torch.nan_to_num(x) for x in member_sums(recounted(fit, member[0]), state, member))
    prior = layout.sigma.square().reciprocal()
    deviation, _ = layout.prior(state)
    s_k = s_k - (s_k.sum(1) + prior * deviation)[:, None] / count  # what the bias correction left of the score
    C = inverse(H_k.sum(1) + torch.diag_embed(prior))
    clock = layout.blocks["clock"].start
    after = H_k[..., clock].flip(1).cumsum(1).flip(1)[:, 1:]  # (b, border, p): effect of a step on every score
    score = s_k[..., clock].flip(1).cumsum(1).flip(1)[:, 1:]
    information = after[..., clock] - ((after @ C) * after).sum(-1)
    seen = information > 1e-6 * after[..., clock].clamp_min(1e-300)  # of a clock that nothing tells nothing is said
    information = information.clamp_min(1e-300)
    jump = torch.where(seen, -score / information, 0.0)
    variance = (excess.clamp_min(1.0) * groups.inflation.square())[:, None] / information + ALLOWED_S**2
    sigmas = jump.abs() / variance.sqrt()
    clearest = sigmas.argmax(-1, keepdim=True)
    return ClockJump(
        jump_s=jump.gather(1, clearest)[:, 0],
        sigmas=sigmas.amax(-1),
        at=first_of_block(motions, count, clearest[:, 0] + 1),
    )
