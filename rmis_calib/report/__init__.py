"""The one-page report of a calibration: the answer, how sure it is, and what it rests on."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
