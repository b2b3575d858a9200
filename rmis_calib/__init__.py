"""Markerless hand-eye calibration of a stereo laparoscope from video and joint logs."""

__version__ = "0.1.0"
