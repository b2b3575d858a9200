"""Whether the other reading of the same poses would fit: the usual mistake is a transform read the wrong way round."""

from torch import Tensor

from rmis_calib.baselines.api import hand_eye
from rmis_calib.geometry import rigid_inverse


def fits_inverted(base_T_flange: Tensor, camera_T_board: Tensor, setup: str = "eye_in_hand") -> bool:
    """Whether poses of one trial that do not fit a rigid mounting do so with one of the two read as its inverse.

    Which of the two cannot be told: inverting both exchanges the roles of X and Z in A X C = Z, and fits again.

    Args:
        base_T_flange: (N, 4, 4) mm.
        camera_T_board: (N, 4, 4) mm.
        setup: under which they did not fit.
    """
    return bool(hand_eye(base_T_flange, rigid_inverse(camera_T_board), "park", setup=setup, covariance=False).ok)
