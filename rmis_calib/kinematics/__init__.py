"""Forward kinematics of both arms from their Denavit-Hartenberg tables, batched and differentiable."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
