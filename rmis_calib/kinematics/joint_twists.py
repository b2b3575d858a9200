"""What a unit of each joint does to everything beyond it: the columns of the geometric Jacobian."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.robot import Joint


def joint_twists(
    base_T_frame: Float[Tensor, "*batch frames 4 4"], joints: Sequence[Joint], convention: str
) -> Float[Tensor, "*batch j 6"]:
    """Rotation vector (rad) and velocity of the base's origin (mm) per unit of each joint, rad or mm, in `base`.

    A joint turns about, or slides along, the z axis of its own frame in a modified table, and that of the frame before
    in a standard one.

    Args:
        base_T_frame: poses of frame 0 to frame J.
        joints: rows of the table.
        convention: of the table, "modified" or "standard".
    Source: Siciliano et al., Robotics: Modelling, Planning and Control, Eq. 3.30.
    """
    own = base_T_frame[..., 1:, :, :] if convention == "modified" else base_T_frame[..., :-1, :, :]
    z, o = own[..., :3, 2], own[..., :3, 3]
    turns = torch.tensor([joint.type == "revolute" for joint in joints], device=z.device)[:, None]
    omega = torch.where(turns, z, 0.0)
    return torch.cat((omega, torch.where(turns, torch.linalg.cross(o, z), z)), dim=-1)


def velocity_of(p: Float[Tensor, "*batch 3"], twist: Float[Tensor, "*batch j 6"]) -> Float[Tensor, "*batch j 3"]:
    """Velocity of a point p, mm, under each twist."""
    omega, shift = twist.tensor_split(2, dim=-1)
    return shift + torch.linalg.cross(omega, p[..., None, :].expand_as(omega))
