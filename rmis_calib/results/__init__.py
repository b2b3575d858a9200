"""What a calibration answers: the transform with its uncertainty, what was used, and whether to trust it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
