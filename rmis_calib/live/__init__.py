"""Calibration while frames come in: `rc.Session`, and a thin ROS 2 node around it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
