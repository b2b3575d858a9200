from .api import METHODS as METHODS
from .api import hand_eye as hand_eye
from .directions import fits_inverted as fits_inverted
from .result import HandEye as HandEye
from .status import HandEyeStatus as HandEyeStatus
