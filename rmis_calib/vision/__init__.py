"""Finding instrument shafts in pictures: contour lines, axis and end, with uncertainty."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
