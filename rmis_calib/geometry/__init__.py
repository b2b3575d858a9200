"""Rotations, rigid transforms, cameras, lines and planes on plain tensors, with any leading batch and autograd.

`conventions` is the page that states every sign and order once.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
