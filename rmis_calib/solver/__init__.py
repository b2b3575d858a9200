"""Estimation of `camera_right_T_arm` from lines, contours, ends and head points of the instrument's shaft."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
