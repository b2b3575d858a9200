"""Hand-eye calibration with a board by published methods: one interface, batched over trials, differentiable.

`hand_eye` runs them all. Every method is implemented from its paper's equations; none calls OpenCV.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
