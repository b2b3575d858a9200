"""The set-up in a browser: arms, cameras, shaft and uncertainty, motion by motion."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
