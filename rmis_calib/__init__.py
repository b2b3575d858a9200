"""Markerless hand-eye calibration of a stereo laparoscope from video and joint logs.

    import rmis_calib as rc

    result = rc.calibrate(rc.load_recording("my_recording"))

Everything public loads on first use, so that importing the package costs nothing.
"""

import lazy_loader

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
