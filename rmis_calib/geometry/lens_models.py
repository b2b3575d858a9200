"""Names of the lens models, and how many numbers each has. Needs no torch, so that files can be checked without it."""

from typing import Literal

LensModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
"""As ROS calls them: Brown-Conrady [k1, k2, p1, p2, k3]; the same with a denominator [.., k4, k5, k6]; fisheye
[k1, k2, k3, k4] after Kannala and Brandt (OpenCV's `cv2.fisheye`)."""

COEFFICIENTS: dict[LensModel, int] = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
"""How many numbers a model's distortion has."""
