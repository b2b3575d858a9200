"""Every unknown of a joint estimate, and how a step moves it."""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rotations import rotvec_to_matrix


@dataclass(frozen=True)
class State:
    """Estimates of `b` trials. The offsets are zero where they are not estimated.

    Attributes:
        R: `camera_right_R_arm`.
        t: `camera_right_t_arm`, mm.
        stereo_R: `camera_left_R_camera_right`.
        stereo_t: its translation, mm.
        radius: of the shaft, mm.
        end_offset: of the shaft's end along the axis, mm.
        end_gap: how far beyond that the second place lies at which ends are measured, mm.
        rcm_offset: of the shaft's axis from the nominal RCM, along two directions across the axis, mm.
        joint_offset: in each joint's unit.
        clock: seconds added to the time at which the joints were read in the middle of the recording, and what is added
            a second before and after it.
        readout: seconds from reading a row to reading the one that is a focal length farther down.
        edge_bias: shift across its line that a line row of each camera has in every motion alike, normalised units.
        intrinsics: corrections of each camera, in the order of `cameras.corrected_point`.
        setup: `laparoscope_base_T_instrument_base` from where the kinematics were evaluated: right perturbation,
            rotation vector and translation, rad and mm.
        compliance: coefficients of the shaft's bend and shift with its pose (model/compliance.py), rad and mm: two
            rotations, then three translations, each with all functions.
    """

    R: Float[Tensor, "b 3 3"]
    t: Float[Tensor, "b 3"]
    stereo_R: Float[Tensor, "b 3 3"]
    stereo_t: Float[Tensor, "b 3"]
    radius: Float[Tensor, " b"]
    end_offset: Float[Tensor, " b"]
    end_gap: Float[Tensor, " b"]
    rcm_offset: Float[Tensor, "b 2"]
    joint_offset: Float[Tensor, "b j"]
    clock: Float[Tensor, "b 2"]
    readout: Float[Tensor, " b"]
    edge_bias: Float[Tensor, "b l c"]
    intrinsics: Float[Tensor, "b c 4"]
    setup: Float[Tensor, "b 6"]
    compliance: Float[Tensor, "b q"]

    def where(self, chosen: Tensor, other: "State") -> "State":
        """This state in the chosen trials, `other` elsewhere."""

        def pick(a: Tensor, b: Tensor) -> Tensor:
            return torch.where(chosen.reshape(-1, *(1,) * (a.ndim - 1)), a, b)

        return State(**{f.name: pick(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)})

    def put(self, index: Tensor, part: "State") -> "State":
        """This state with that of the trials `index` replaced."""
        return State(
            **{f.name: getattr(self, f.name).index_copy(0, index, getattr(part, f.name)) for f in fields(self)}
        )

    def take(self, index: Tensor | slice) -> "State":
        """The state of the trials `index`."""
        return State(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def moved(self, step: dict[str, Tensor]) -> "State":
        """The state after a step, given by parameter block (`parameters.ParameterLayout.blocks`)."""
        changed = {}
        turns = [name for name in ("rotation", "stereo_rotation") if name in step]
        angles = [step[name] for name in turns]
        turned = dict(zip(turns, rotvec_to_matrix(torch.stack(angles)), strict=True)) if turns else {}
        if "rotation" in step:
            changed["R"] = turned["rotation"] @ self.R
        if "stereo_rotation" in step:
            changed["stereo_R"] = self.stereo_R @ turned["stereo_rotation"]
        if "stereo_translation" in step:
            changed["stereo_t"] = self.stereo_t + (self.stereo_R @ step["stereo_translation"][..., None])[..., 0]
        for name in ("rcm_offset", "joint_offset", "setup", "compliance"):
            if name in step:
                changed[name] = getattr(self, name) + step[name]
        if "translation" in step:
            changed["t"] = self.t + step["translation"]
        for name in ("radius", "end_offset", "end_gap", "readout"):
            if name in step:
                changed[name] = getattr(self, name) + step[name][:, 0]
        parts = [step[name][:, 0] if name in step else self.clock[:, 0] * 0.0 for name in ("clock", "clock_rate")]
        if "clock" in step or "clock_rate" in step:
            changed["clock"] = self.clock + torch.stack(parts, dim=-1)
        if "edge_bias" in step:
            changed["edge_bias"] = self.edge_bias + step["edge_bias"].reshape(self.edge_bias.shape)
        if "intrinsics" in step:
            changed["intrinsics"] = self.intrinsics + step["intrinsics"].reshape(self.intrinsics.shape)
        return replace(self, **changed)
