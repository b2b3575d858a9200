"""The answer of a hand-eye calibration with a board: both transforms in both directions, and how far to trust them."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.baselines.status import HandEyeStatus
from rmis_calib.errors import FrameMismatchError
from rmis_calib.geometry import rigid_inverse

Setup = Literal["eye_in_hand", "eye_to_hand"]
CARRIERS: dict[Setup, tuple[str, str]] = {"eye_in_hand": ("flange", "base"), "eye_to_hand": ("base", "flange")}
"""The frame that carries the camera (`mount`) and the frame that carries the board (`anchor`)."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """Solutions of one or many trials. Lengths in mm, angles in rad unless the name says deg.

    A trial whose status is not OK or NOT_CONVERGED has NaN for its transforms: it is named, not answered.

    Attributes:
        method: that solved it.
        setup: eye_in_hand (the camera is on the flange, the board stands still) or eye_to_hand (the reverse).
        mount_T_camera: camera in the frame that carries it: flange_T_camera, or base_T_camera.
        anchor_T_board: board in the frame that carries it: base_T_board, or flange_T_board.
        status: a `HandEyeStatus` for every trial.
        residual_deg: angle between measured and predicted camera_T_board of every sample.
        residual_mm: distance between the board's origin measured and predicted, in the camera.
        covariance: of mount_T_camera, (rotation, translation): R = exp(dphi) R^, t = t^ + dt, as everywhere here; from
            the noise levels below and the method's own derivatives, to first order. None where it was not asked for.
        rotation_noise_deg: 1 sigma an axis of the poses' orientations, robot and board together.
        translation_noise_mm: the same of their positions.
        robot_rotation_share: fraction of the rotation's variance that is the robot's.
    """

    method: str
    setup: Setup
    mount_T_camera: Float[Tensor, "*batch 4 4"]
    anchor_T_board: Float[Tensor, "*batch 4 4"]
    status: Int[Tensor, "*batch"]
    residual_deg: Float[Tensor, "*batch n"]
    residual_mm: Float[Tensor, "*batch n"]
    covariance: Float[Tensor, "*batch 6 6"] | None
    rotation_noise_deg: Float[Tensor, "*batch"]
    translation_noise_mm: Float[Tensor, "*batch"]
    robot_rotation_share: Float[Tensor, "*batch"]

    @property
    def flange_T_camera(self) -> Float[Tensor, "*batch 4 4"]:
        """Camera on the flange, of an eye-in-hand set-up."""
        return self._named("flange", "camera")

    @property
    def base_T_board(self) -> Float[Tensor, "*batch 4 4"]:
        """Board in the base, of an eye-in-hand set-up."""
        return self._named("base", "board")

    @property
    def base_T_camera(self) -> Float[Tensor, "*batch 4 4"]:
        """Camera in the base, of an eye-to-hand set-up."""
        return self._named("base", "camera")

    @property
    def flange_T_board(self) -> Float[Tensor, "*batch 4 4"]:
        """Board on the flange, of an eye-to-hand set-up."""
        return self._named("flange", "board")

    def transforms(self) -> dict[str, Float[Tensor, "*batch 4 4"]]:
        """Both transforms in both directions, by name: `a_T_b` maps coordinates in b to coordinates in a."""
        mount, anchor = CARRIERS[self.setup]
        return {
            f"{mount}_T_camera": self.mount_T_camera,
            f"camera_T_{mount}": rigid_inverse(self.mount_T_camera),
            f"{anchor}_T_board": self.anchor_T_board,
            f"board_T_{anchor}": rigid_inverse(self.anchor_T_board),
        }

    @property
    def ok(self) -> Tensor:
        """Which trials are solved."""
        return self.status == HandEyeStatus.OK

    @property
    def rotation_sigma_deg(self) -> Float[Tensor, "*batch"] | None:
        """1 sigma of the camera's rotation: root of the trace of its block."""
        return None if self.covariance is None else torch.rad2deg(_root_trace(self.covariance[..., :3, :3]))

    @property
    def translation_sigma_mm(self) -> Float[Tensor, "*batch"] | None:
        """1 sigma of the camera's position: root of the trace of its block."""
        return None if self.covariance is None else _root_trace(self.covariance[..., 3:, 3:])

    def sentences(self) -> list[str]:
        """What became of every trial, in words, in the order of the flattened batch."""
        return [HandEyeStatus(code).sentence for code in self.status.flatten().tolist()]

    def degeneracy(self) -> list[str]:
        """For every trial, what its motion cannot show, in words; empty where it can show everything."""
        codes = [HandEyeStatus(code) for code in self.status.flatten().tolist()]
        return [code.sentence if code.is_degenerate else "" for code in codes]

    def _named(self, dst: str, src: str) -> Tensor:
        transforms = self.transforms()
        if f"{dst}_T_{src}" not in transforms:
            expected = f"one of {', '.join(transforms)}"
            raise FrameMismatchError(where=f"result of {self.setup}", expected=expected, found=f"{dst}_T_{src}")
        return transforms[f"{dst}_T_{src}"]


def _root_trace(block: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    return block.diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(0).sqrt()
