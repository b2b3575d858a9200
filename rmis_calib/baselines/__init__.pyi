from .api import METHODS as METHODS
from .api import hand_eye as hand_eye
from .result import HandEye as HandEye
from .status import HandEyeStatus as HandEyeStatus
