"""Files in and out: recordings, robots, cameras, joint logs, video, observations. Units are converted here only."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
