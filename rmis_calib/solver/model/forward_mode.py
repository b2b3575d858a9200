"""Forward-mode autograd, without the warning that comes with it."""

import warnings
from functools import cache

import torch
import torch.autograd.forward_ad as forward_ad


@cache
def load_forward_mode() -> None:
    """Have torch load its forward-mode rules (about a second, once), which warns of what torch itself uses."""
    with warnings.catch_warnings(), torch.inference_mode(False), forward_ad.dual_level():
        warnings.simplefilter("ignore", DeprecationWarning)
        forward_ad.make_dual(torch.zeros(1), torch.zeros(1))
