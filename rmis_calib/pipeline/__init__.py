"""From a recording to the answer: detect, kinematics, assemble, solve, check; and the measures of an answer."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
