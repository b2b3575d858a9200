"""Arrays in the keys of an observations file (docs/observations.md), read as tensors of known shapes for `Problem`."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import InsufficientDataError, ObservationsError

MIN_MOTIONS = 3
CAMERAS = ("right", "left")


class ObservationArrays:
    """Arrays by key, any leading batch of trials; what is absent reads as NaN.

    Motions whose kinematics are NaN take the place of the first known one, where they change nothing that is told from
    the poses, and are not valid.
    """

    def __init__(self, arrays: Mapping[str, Any], dtype: torch.dtype, device: str) -> None:
        """Look at the poses, which say how many trials and motions there are.

        Raises:
            ObservationsError: no `arm_T_rcm` or `rcm_v_axis`, one of another shape, or no motion with finite poses.
            InsufficientDataError: fewer than 3 motions.
        """
        self.arrays, self.dtype, self.device = arrays, dtype, device
        self._poses = self._tensor("arm_T_rcm")
        if self._poses.ndim < 3 or self._poses.shape[-2:] != (4, 4):
            raise ObservationsError(where="arm_T_rcm", expected="shape (..., N, 4, 4)", found=tuple(self._poses.shape))
        self.batch, self.n = self._poses.shape[:-3], self._poses.shape[-3]
        if self.n < MIN_MOTIONS:
            raise InsufficientDataError(where="arm_T_rcm", expected=f"at least {MIN_MOTIONS} motions", found=self.n)
        two = arrays.get("camera_left_T_camera_right") is not None and self._seen("left")
        self.sides = CAMERAS if two else CAMERAS[:1]
        self._tensor("rcm_v_axis")  # required
        self._axis = self.filled("rcm_v_axis", self.n, 3)
        self._unknown = torch.isnan(self._poses).flatten(-2).any(-1) | torch.isnan(self._axis).any(-1)
        if bool(self._unknown.all(-1).any()):
            raise ObservationsError(where="arm_T_rcm", expected="finite poses", found="NaN in every motion")
        self._first_known = (~self._unknown).int().argmax(-1, keepdim=True)

    def motions(self) -> dict[str, Any]:
        """Kinematics and measurements, by the names of `Problem`, but not its noise levels.

        Raises:
            ObservationsError: an array has the wrong shape, or a direction is zero or infinite.
        """
        axis = self._both("axis_{}", 2, 2)
        valid = torch.stack([self._valid(side) for side in self.sides], dim=len(self.batch))
        cameras = [self._eye()] + [self.filled("camera_left_T_camera_right", 4, 4) for _ in self.sides[1:]]
        v = self._known(self._axis)
        length = torch.linalg.vector_norm(v, dim=-1)
        if not bool((torch.isfinite(length) & (length > 1e-9)).all()):
            found = "a zero or infinite one"
            raise ObservationsError(where="rcm_v_axis", expected="finite unit directions", found=found)
        return {
            "arm_T_rcm": self._known(self._poses),
            "rcm_v_axis": v / length[..., None],
            "camera_T_camera_right": torch.stack(cameras, dim=-3),
            "axis_xy": axis,
            "axis_sigma": self._both("sigma_axis_{}"),
            "contour_xy": _canonical_edges(self._both("contour_{}", 2, 2, 2), axis),
            "contour_sigma": self._both("sigma_contour_{}", 2),
            "end_xy": self._both("end_{}", 2),
            "end_sigma": self._both("sigma_end_{}"),
            "end_kind": self._both("end_kind_{}"),
            "end_sureness": self._both("end_sureness_{}"),
            "head_xy": self._both("head_{}", 2),
            "head_sigma": self._both("sigma_head_{}"),
            "valid": valid & ~self._unknown[..., None, :],
            "rcm_s_end_mm": self.filled("rcm_s_end_mm", self.n),
            "rcm_p_head": self.filled("rcm_p_head", self.n, 3),
            "radius_mm": self.filled("shaft_radius_mm"),
        }

    def chains(self) -> dict[str, Any]:
        """The laparoscope's own kinematics and the set-up, by the names of `Problem`; empty where they are not told.

        Raises:
            ObservationsError: an array has the wrong shape.
        """
        if self.arrays.get("laparoscope_base_T_arm") is None:
            return {}
        stated = self.filled("laparoscope_base_T_instrument_base", 4, 4)
        return {
            "laparoscope_base_T_arm": self._known(self.filled("laparoscope_base_T_arm", self.n, 4, 4)),
            "laparoscope_base_T_instrument_base": torch.where(torch.isnan(stated), self._eye(), stated),
            "setup_stated": stated,
        }

    def filled(self, key: str, *tail: int) -> Tensor:
        """The array broadcast to (*batch, *tail), or NaN.

        Raises:
            ObservationsError: it has another shape.
        """
        shape = (*self.batch, *tail)
        if self.arrays.get(key) is None:
            return torch.full(shape, torch.nan, dtype=self.dtype, device=self.device)
        value = self._tensor(key)
        if value.ndim == 0:
            return value.expand(shape).clone()
        if value.shape != shape:
            raise ObservationsError(where=key, expected=f"shape {shape}", found=tuple(value.shape))
        return value

    def _seen(self, side: str) -> bool:
        return any(self.arrays.get(f"{kind}_{side}") is not None for kind in ("axis", "contour", "end", "head"))

    def _tensor(self, key: str) -> Tensor:
        value = self.arrays.get(key)
        if value is None:
            raise ObservationsError(where=key, expected="an array", found="nothing")
        if isinstance(value, np.ndarray) and not value.flags.writeable:
            value = value.copy()  # torch cannot share read-only memory
        return torch.as_tensor(value, dtype=self.dtype, device=self.device)

    def _both(self, name: str, *tail: int) -> Tensor:
        return torch.stack([self.filled(name.format(side), self.n, *tail) for side in self.sides], dim=len(self.batch))

    def _known(self, value: Tensor) -> Tensor:
        """A value of every motion (*batch, n, ...), that of the first known motion where the motion is unknown."""
        tail = (1,) * (value.ndim - len(self.batch) - 1)
        unknown, first = (x.reshape(*x.shape, *tail) for x in (self._unknown, self._first_known))
        return torch.where(unknown, torch.take_along_dim(value, first, len(self.batch)), value)

    def _eye(self) -> Tensor:
        return torch.eye(4, dtype=self.dtype, device=self.device).expand(*self.batch, 4, 4)

    def _valid(self, side: str) -> Tensor:
        value = self.arrays.get(f"valid_{side}")
        if value is None:
            return torch.ones((*self.batch, self.n), dtype=torch.bool, device=self.device)
        if isinstance(value, np.ndarray):
            value = value.astype(bool)  # a copy: torch cannot share read-only memory
        return torch.as_tensor(value, dtype=torch.bool, device=self.device).expand(*self.batch, self.n)


def _canonical_edges(
    contour_xy: Float[Tensor, "*batch 2 2 2"], axis_xy: Float[Tensor, "*batch 2 2"]
) -> Float[Tensor, "*batch 2 2 2"]:
    """Edges swapped where edge 0 does not lie on the left-hand side (x right, y down) of the direction from the RCM
    side to the tip."""
    along = torch.where(
        torch.isfinite(axis_xy).all(-1).all(-1)[..., None], axis_xy[..., 1, :] - axis_xy[..., 0, :], torch.nan
    )
    own = (contour_xy[..., 1, :] - contour_xy[..., 0, :]).sum(-2)
    along = torch.where(torch.isfinite(along), along, own)
    across = contour_xy[..., 0, :, :].mean(-2) - contour_xy[..., 1, :, :].mean(-2)
    turn = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
    return torch.where((turn > 0)[..., None, None, None], contour_xy.flip(-3), contour_xy)
