"""Denavit-Hartenberg tables as pytorch-kinematics chains."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from pytorch_kinematics.chain import Chain
from pytorch_kinematics.frame import Frame, Link
from pytorch_kinematics.frame import Joint as ChainJoint
from pytorch_kinematics.transforms import Transform3d
from torch import Tensor

from rmis_calib.errors import RobotError, ShapeError
from rmis_calib.robot import Joint


def dh_matrix(
    alpha: Float[Tensor, "*#batch"],
    a: Float[Tensor, "*#batch"],
    theta: Float[Tensor, "*#batch"],
    d: Float[Tensor, "*#batch"],
    convention: str,
) -> Float[Tensor, "*#batch 4 4"]:
    """Pose of a frame in the frame before it.

    Args:
        alpha: twist, rad.
        a: length along x, mm.
        theta: angle about z, rad.
        d: length along z, mm.
        convention: "modified" (Craig): Rx(alpha) Tx(a) Rz(theta) Tz(d); "standard": Rz(theta) Tz(d) Tx(a) Rx(alpha).

    Raises:
        RobotError: another convention.
    Source: Craig, Introduction to Robotics, Eq. 3.6 (modified); Spong, Robot Modeling and Control, Eq. 3.10 (standard).
    """
    alpha, a, theta, d = torch.broadcast_tensors(alpha, a, theta, d)
    ca, sa, ct, st = alpha.cos(), alpha.sin(), theta.cos(), theta.sin()
    zero, one = torch.zeros_like(ct), torch.ones_like(ct)
    last = [zero, zero, zero, one]
    if convention == "modified":
        rows = [ct, -st, zero, a, st * ca, ct * ca, -sa, -d * sa, st * sa, ct * sa, ca, d * ca, *last]
    elif convention == "standard":
        rows = [ct, -st * ca, st * sa, a * ct, st, ct * ca, -ct * sa, a * st, zero, sa, ca, d, *last]
    else:
        raise RobotError(where="dh_convention", expected="modified or standard", found=repr(convention))
    return torch.stack(rows, dim=-1).unflatten(-1, (4, 4))


def build_chain(
    joints: Sequence[Joint], convention: str, dtype: torch.dtype, device: torch.device | str = "cpu"
) -> Chain:
    """Serial chain whose frames `frame_0` (the arm's base) to `frame_J` are those of the table.

    A chain's joint turns about, or slides along, the z axis of its fixed offset. A row of a modified table is that
    offset itself, since Rz(q) and Tz(q) commute with its last two factors. In a standard table Tx(a) Rx(alpha) comes
    after the joint: it is a fixed frame of its own there.

    Args:
        joints: rows from the base to the end.
        convention: "modified" or "standard".
        dtype: of the chain; readings must have it too.
        device: of the chain.

    Raises:
        RobotError: no joints, an unknown joint type or an unknown convention.
    """
    if not joints:
        raise RobotError(where="joints", expected="at least one joint", found="none")

    def fixed(alpha: float, a: float, theta: float, d: float) -> Transform3d:
        # In float64 until the end, so that a chain in single precision is the rounded one.
        row = torch.tensor([alpha, a, theta, d], dtype=torch.float64)
        return Transform3d(matrix=dh_matrix(row[0], row[1], row[2], row[3], convention).to(dtype))

    root = end = Frame("frame_0", link=Link("frame_0"), joint=ChainJoint(dtype=dtype))
    for number, row in enumerate(joints, start=1):
        if row.type not in ("revolute", "prismatic"):
            expected = "type revolute or prismatic"
            raise RobotError(where=f"joint {row.name}", expected=expected, found=repr(row.type))
        modified = convention == "modified"
        before = (row.alpha_rad, row.a_mm) if modified else (0.0, 0.0)
        offset = fixed(*before, row.theta_rad, row.d_mm)
        joint = ChainJoint(f"{number}.{row.name}", offset, row.type, dtype=dtype)
        end = _append(end, f"frame_{number}" if modified else f"joint_{number}", joint)
        if not modified:
            after = fixed(row.alpha_rad, row.a_mm, 0.0, 0.0)
            end = _append(end, f"frame_{number}", ChainJoint(f"{number}.link", after, "fixed", dtype=dtype))
    # Moved at the end: a chain that is made on another device keeps some of its index tensors on the CPU.
    return Chain(root, dtype=dtype).to(device=device)


def frame_poses(chain: Chain, joints: Float[Tensor, "*batch j"]) -> Float[Tensor, "*batch frames 4 4"]:
    """Poses of frame 0 to frame J of a chain from `build_chain`, in frame 0, in one batched call.

    Args:
        chain: of J joints.
        joints: readings plus offsets, rad or mm, in the order of the table.

    Raises:
        ShapeError: not J values, or not the dtype of the chain.
    """
    if joints.shape[-1] != chain.n_joints or joints.dtype != chain.dtype:
        expected = f"(..., {chain.n_joints}) of {chain.dtype}"
        raise ShapeError(where="joint readings", expected=expected, found=f"{tuple(joints.shape)} of {joints.dtype}")
    # Not the library's analytic backward pass: it is a first derivative only, and a second one would be silently wrong.
    poses = chain.forward_kinematics_tensor(joints.reshape(-1, chain.n_joints), analytical_grad=False)
    frames = chain.get_frame_indices(*(f"frame_{number}" for number in range(chain.n_joints + 1)))
    return poses[frames].movedim(0, 1).reshape(*joints.shape[:-1], len(frames), 4, 4)


def _append(parent: Frame, name: str, joint: ChainJoint) -> Frame:
    child = Frame(name, link=Link(name), joint=joint)
    parent.add_child(child)
    return child
