"""Measurements of the user's own, which `joint` uses beside those that it knows."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import InputError

OwnResidual = Callable[..., Float[Tensor, "..."]]
"""(camera_R_arm (*batch, 3, 3), camera_t_arm (*batch, 3) in mm, **values) -> (*batch, m). Plain torch, and batched: a
transform has more leading axes than a value, and they broadcast from the right."""

_TAKEN = {f"{kind}{side}" for kind in ("axis", "contour", "end", "head") for side in ("", "_right", "_left")}


@dataclass(frozen=True)
class Measurement:
    """A kind of measurement that is not built in: a tracked point, a depth, a distance.

    What is measured must move rigidly with the instrument's shaft, as a marker on it does: then joint offsets, the
    clock and the noise of the kinematics act on it as on the shaft, and need not be told.

        def depth(R, t, arm_p, z_mm):
            return ((R @ arm_p[..., None])[..., 0] + t)[..., 2:] - z_mm[..., None]

        rc.Measurement("depth", depth, {"arm_p": arm_p, "z_mm": z_mm}, sigma=0.5)

    Attributes:
        name: as reports call it.
        residual: measured and predicted, subtracted, from the transform of the camera and the values of each motion;
            `rmis_calib.residuals` has some. Its derivatives come from autograd.
        values: by argument name, whatever the residual needs of each motion, (*batch, N, ...). Where any of them is
            NaN, that motion was not measured.
        sigma: noise of each component of the residual, 1 sigma, in its unit: a number, or (*batch, N).
        camera: whose transform the residual is given.
        unit: of the residual, as reports show it.

    Raises:
        InputError: no values, an unknown camera, a sigma that is not positive, or a name that is taken.
    """

    name: str
    residual: OwnResidual
    values: Mapping[str, Any]
    sigma: Any
    camera: Literal["right", "left"] = "right"
    unit: str = "mm"

    def __post_init__(self) -> None:
        if not self.values:
            raise InputError(where=f"measurement {self.name!r}", expected="values of every motion", found="none")
        if self.camera not in ("right", "left"):
            raise InputError(where=f"measurement {self.name!r}", expected="camera right or left", found=self.camera)
        if not self.name or self.name in _TAKEN:
            raise InputError(where="measurement", expected="a name that is not built in", found=repr(self.name))

    def as_tensors(self, batch: torch.Size, motions: int, dtype: torch.dtype, device: Any) -> "Measurement":
        """The same with tensors (*batch, N, ...) for values and sigma, whatever they were given as.

        Raises:
            InputError: not one value for every motion, or a sigma that is not positive and finite where something was
                measured.
        """
        shape = (*batch, motions)
        values = {key: torch.as_tensor(value, dtype=dtype, device=device) for key, value in self.values.items()}
        for key, value in values.items():
            if value.shape[: len(shape)] == shape:
                continue
            if value.shape[:1] != (motions,):
                raise InputError(
                    where=f"measurement {self.name!r}, {key}",
                    expected=f"shape {shape} and more",
                    found=tuple(value.shape),
                )
            values[key] = value.expand(*batch, *value.shape)
        sigma = torch.as_tensor(self.sigma, dtype=dtype, device=device).expand(shape)
        if not bool((torch.isnan(sigma) | ((sigma > 0) & torch.isfinite(sigma))).all()):
            raise InputError(
                where=f"measurement {self.name!r}, sigma", expected="positive, or NaN", found=float(sigma.min())
            )
        return replace(self, values=values, sigma=sigma)
