"""Monte-Carlo studies: the paper's experiments beside other methods and the Cramer-Rao bound, on anybody's robot."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
