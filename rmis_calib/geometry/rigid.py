"""Rigid transforms: plain (..., 4, 4) tensors inside, `RigidTransform` with named frames at boundaries and in files."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import FrameMismatchError, InputError, ShapeError
from rmis_calib.geometry.rotations import matrix_to_quat, matrix_to_rotvec, quat_to_matrix, rotvec_to_matrix

# An entry of R^T R may differ from the identity by this much: far above the rounding of printed matrices with seven
# digits, far below any error that a wrong matrix has. Single precision cannot hold it, so there it is a few tens of
# roundings.
_ORTHONORMAL_TOLERANCE = 1e-6


def rigid_from_rotation_translation(
    R: Float[Tensor, "*#batch 3 3"], t: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*#batch 4 4"]:
    """Homogeneous matrix [[R, t], [0, 1]]; translation in mm."""
    # Not torch.broadcast_shapes: its first call imports SymPy, 0.3 s and 40 MB.
    batch = torch.broadcast_tensors(R[..., 0, 0], t[..., 0])[0].shape
    top = torch.cat([R.expand(*batch, 3, 3), t.expand(*batch, 3)[..., None]], dim=-1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*batch, 1, 4)
    return torch.cat([top, bottom], dim=-2)


def rigid_inverse(a_T_b: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """`b_T_a`, by transposing the rotation."""
    b_R_a = a_T_b[..., :3, :3].mT
    b_t_a = -(b_R_a @ a_T_b[..., :3, 3:])[..., 0]
    return rigid_from_rotation_translation(b_R_a, b_t_a)


def transform_points(
    a_T_b: Float[Tensor, "*#batch 4 4"], b_p_x: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*#batch 3"]:
    """Points of frame b in frame a, mm. Batches broadcast: for n points a transform, pass `a_T_b[..., None, :, :]`."""
    return rotate_vectors(a_T_b, b_p_x) + a_T_b[..., :3, 3]


def rotate_vectors(
    a_T_b: Float[Tensor, "*#batch 4 4"], b_v_x: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*#batch 3"]:
    """Directions of frame b in frame a: the translation does not act on them."""
    return (a_T_b[..., :3, :3] @ b_v_x[..., None])[..., 0]


def rigid_exp(xi: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """The transform [[exp(rotvec), translation], [0, 1]] of the noise model.

    Convention: the translation enters directly. This is not the exponential of SE(3), which would rotate it as it goes.

    Args:
        xi: rotation vector in rad, then translation in mm.
    """
    return rigid_from_rotation_translation(rotvec_to_matrix(xi[..., :3]), xi[..., 3:])


def rigid_log(a_T_b: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6"]:
    """Rotation vector in rad, then translation in mm: the inverse of `rigid_exp`."""
    return torch.cat((matrix_to_rotvec(a_T_b[..., :3, :3]), a_T_b[..., :3, 3]), dim=-1)


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """A rigid transform that knows its frames: maps coordinates in `src` to coordinates in `dst`, mm.

    `RigidTransform("a", "b", m)` is what the code calls `a_T_b`. Joining two that do not meet is an error.

    Raises:
        ShapeError: `matrix` is not a floating-point tensor of shape (..., 4, 4).
        InputError: it is not finite, its rotation is not one, or its last row is not (0, 0, 0, 1).
    """

    dst: str
    """Frame that the result of `apply` is expressed in."""
    src: str
    """Frame that the argument of `apply` is expressed in."""
    matrix: Tensor
    """Homogeneous matrix, (..., 4, 4)."""

    def __post_init__(self) -> None:
        name = self.name
        if self.matrix.shape[-2:] != (4, 4) or not self.matrix.is_floating_point():
            found = f"{tuple(self.matrix.shape)} of {self.matrix.dtype}"
            raise ShapeError(where=name, expected="a floating-point tensor of shape (..., 4, 4)", found=found)
        matrix = self.matrix.detach()
        if not bool(torch.isfinite(matrix).all()):
            raise InputError(where=name, expected="finite entries", found="NaN or infinity")
        tolerance = max(_ORTHONORMAL_TOLERANCE, 50 * torch.finfo(matrix.dtype).eps)
        R = matrix[..., :3, :3]
        eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
        error = float((R.mT @ R - eye).abs().amax()) if matrix.numel() else 0.0
        if error > tolerance:
            expected = f"an orthonormal rotation (R^T R = I within {tolerance:.1g})"
            raise InputError(where=name, expected=expected, found=f"a deviation of {error:.3g}")
        if not bool((torch.linalg.det(R) > 0).all()):
            raise InputError(where=name, expected="a rotation (determinant +1)", found="a reflection (determinant -1)")
        if not bool((matrix[..., 3, :] == matrix.new_tensor([0.0, 0.0, 0.0, 1.0])).all()):
            row = matrix[..., 3, :].reshape(-1, 4)[0].tolist()
            raise InputError(where=name, expected="a last row of 0, 0, 0, 1", found=row)

    @property
    def name(self) -> str:
        """`dst_T_src`."""
        return f"{self.dst}_T_{self.src}"

    @property
    def R(self) -> Float[Tensor, "*batch 3 3"]:
        """Rotation matrix `dst_R_src`."""
        return self.matrix[..., :3, :3]

    @property
    def t(self) -> Float[Tensor, "*batch 3"]:
        """Where the origin of `src` is, in `dst`, mm."""
        return self.matrix[..., :3, 3]

    @property
    def quat_wxyz(self) -> Float[Tensor, "*batch 4"]:
        """Rotation as a unit quaternion (w, x, y, z), w >= 0."""
        return matrix_to_quat(self.R)

    def inverse(self) -> "RigidTransform":
        """`src_T_dst`."""
        return RigidTransform(self.src, self.dst, rigid_inverse(self.matrix))

    def __matmul__(self, other: "RigidTransform") -> "RigidTransform":
        """`a_T_b @ b_T_c = a_T_c`.

        Raises:
            FrameMismatchError: the inner frames differ.
        """
        if self.src != other.dst:
            expected = f"a transform into {self.src!r}"
            raise FrameMismatchError(where=f"{self.name} @ {other.name}", expected=expected, found=repr(other.dst))
        return RigidTransform(self.dst, other.src, self.matrix @ other.matrix)

    def apply(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*result 3"]:
        """Points of `src` in `dst`, mm; batches broadcast as in `transform_points`."""
        return transform_points(self.matrix, points)

    def rotate(self, vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*result 3"]:
        """Directions of `src` in `dst`."""
        return rotate_vectors(self.matrix, vectors)

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "RigidTransform":
        """The same transform in another precision or on another device."""
        return RigidTransform(self.dst, self.src, self.matrix.to(dtype=dtype, device=device))

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and strings for files: dst, src, matrix (rows, mm), quat_wxyz, translation_mm."""
        return {
            "dst": self.dst,
            "src": self.src,
            "matrix": self.matrix.tolist(),
            "quat_wxyz": self.quat_wxyz.tolist(),
            "translation_mm": self.t.tolist(),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "RigidTransform":
        """Inverse of `to_dict`, in float64. `quat_wxyz` and `translation_mm` may be absent; present, they must agree.

        Raises:
            InputError: a key is missing or unknown, or the entries contradict each other.
        """
        required, optional = {"dst", "src", "matrix"}, {"quat_wxyz", "translation_mm"}
        if not required <= set(values) <= required | optional:
            expected = "keys dst, src, matrix and optionally quat_wxyz, translation_mm"
            raise InputError(where="rigid transform", expected=expected, found=", ".join(sorted(map(str, values))))
        try:
            given = {
                key: torch.tensor(values[key], dtype=torch.float64) for key in {"matrix", *(optional & set(values))}
            }
        except (TypeError, ValueError) as error:
            raise InputError(where="rigid transform", expected="numbers in nested lists", found=str(error)) from error
        transform = cls(str(values["dst"]), str(values["src"]), given["matrix"])
        for key, other in (("translation_mm", transform.t), ("quat_wxyz", transform.quat_wxyz)):
            if key in given and given[key].shape != other.shape:
                raise InputError(
                    where=f"{transform.name} {key}",
                    expected=f"shape {tuple(other.shape)}",
                    found=tuple(given[key].shape),
                )
        agree = _close(given.get("translation_mm", transform.t), transform.t)
        agree = agree and _close(quat_to_matrix(given.get("quat_wxyz", transform.quat_wxyz)), transform.R)
        if not agree:
            expected = "quat_wxyz and translation_mm equal to what the matrix says"
            raise InputError(where=transform.name, expected=expected, found="another rotation or translation")
        return transform


def _close(a: Tensor, b: Tensor) -> bool:
    return bool(torch.allclose(a, b, rtol=1e-6, atol=1e-6))
