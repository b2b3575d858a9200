"""Results in the files that other programs read: dVRK, ROS, MoveIt, OpenCV, URDF and more."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
