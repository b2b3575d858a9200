"""Covariance of a motion's residuals, from the noise of images and kinematics, and distances in it.

The residuals of one motion have the covariance S = D + G: D diagonal, from the image; G from the motion's pose noise,
which all rows share (`arm_T_rcm`) or the rows of one camera share (what each camera sees). In the form of residuals.py,
G_ij = sigma_mm^2 w_i.w_j + sigma_rad^2 a_i.a_j. This is the Schur complement of a latent pose error per motion:
eliminating xi from min |y - J xi|^2_D + |xi|^2_Sigma leaves y^T (D + J Sigma J^T)^-1 y.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.model.batched_linalg import eliminate, forward_substitute
from rmis_calib.solver.model.linearised_rows import LinearisedRows
from rmis_calib.solver.model.measurement_rows import END, HEAD, LINE, OWN, MeasurementRows
from rmis_calib.solver.model.residuals import linearise
from rmis_calib.solver.model.state import State


@dataclass(frozen=True)
class NoiseModel:
    """Variances of one solve, per trial; image variances as factors on the measurements' nominal ones."""

    line: Float[Tensor, " b"]
    end: Float[Tensor, " b"]
    head: Float[Tensor, " b"]
    kinematics_mm: Float[Tensor, " b"]
    kinematics_rad: Float[Tensor, " b"]
    camera_mm: Float[Tensor, " b"]
    camera_rad: Float[Tensor, " b"]

    def take(self, index: Tensor | slice) -> "NoiseModel":
        return NoiseModel(**{name: value[index] for name, value in vars(self).items()})

    def put(self, index: Tensor, part: "NoiseModel") -> "NoiseModel":
        """These levels with those of the trials `index` replaced."""
        return NoiseModel(
            **{name: value.index_copy(0, index, getattr(part, name)) for name, value in vars(self).items()}
        )

    def repeat(self, times: int) -> "NoiseModel":
        return NoiseModel(**{name: value.repeat_interleave(times) for name, value in vars(self).items()})


def image_variance(measured: MeasurementRows, noise: NoiseModel) -> Float[Tensor, "k b n"]:
    """D: nominal variances times the factor of each kind; 1 for rows that were not measured (they are zero)."""
    factors = {LINE: noise.line, END: noise.end, HEAD: noise.head, OWN: torch.ones_like(noise.line)}
    scale = torch.stack([factors[kind] for kind in measured.row_kind])
    return torch.where(measured.rows_ok, measured.rows_var * scale[:, :, None], 1.0)


def covariance(
    w: Float[Tensor, "3 k b n"],
    a: Float[Tensor, "3 k b n"],
    image: Float[Tensor, "k b n"],
    cameras: int,
    noise: NoiseModel,
    out: Float[Tensor, "k k b n"],
    weight: Float[Tensor, "c b n"] | None = None,
) -> None:
    """Writes S into `out`. With a weight per camera and motion, that camera's block is inflated by 1/weight.

    Args:
        w, a: effects of a translation and a rotation of the shaft on each row (`residuals.LinearisedRows`).
        image: D.
        cameras: number of cameras; rows take turns between them.
    """
    apart = cameras > 1 and bool(((noise.camera_mm > 0) | (noise.camera_rad > 0)).any())
    shared_mm, shared_rad = noise.kinematics_mm, noise.kinematics_rad
    if not apart:
        shared_mm, shared_rad = shared_mm + noise.camera_mm, shared_rad + noise.camera_rad
    _add_gram(out, w, shared_mm, first=True)
    _add_gram(out, a, shared_rad)
    if apart or weight is not None:
        for c in range(cameras):
            block = out[c::cameras, c::cameras]
            if apart:
                _add_gram(block, w[:, c::cameras], noise.camera_mm)
                _add_gram(block, a[:, c::cameras], noise.camera_rad)
    out.diagonal(dim1=0, dim2=1).add_(image.permute(1, 2, 0))
    if weight is not None:
        for c in range(cameras):
            out[c::cameras, c::cameras].div_(weight[c])


def _add_gram(
    out: Float[Tensor, "k k b n"], vectors: Float[Tensor, "3 k b n"], variance: Float[Tensor, " b"], first: bool = False
) -> None:
    """Adds variance * vectors^T vectors of each motion to `out`; `first`: writes it."""
    scaled = (vectors * variance[:, None]).unsqueeze(2).unbind()
    for i, (left, right) in enumerate(zip(scaled, vectors.unbind(), strict=True)):
        if first and i == 0:
            torch.mul(left, right, out=out)
        else:
            out.addcmul_(left, right)


def frozen_chi2(factor: Float[Tensor, "k k b n"], r: Float[Tensor, "k b n"]) -> Float[Tensor, "b n"]:
    """r^T S^-1 r of each motion, for the S whose factor was kept."""
    pivots = factor.diagonal(dim1=0, dim2=1).permute(2, 0, 1)
    return (forward_substitute(factor, r).square() / pivots).sum(0)


def motion_distance2(measured: MeasurementRows, state: State, noise: NoiseModel) -> Float[Tensor, "b n"]:
    """Mahalanobis distance^2 of all measurements of each motion."""
    linear, _ = linearise(measured, state)
    return _distance2(linear.w, linear.a, linear.r, image_variance(measured, noise), measured.cameras, noise)


def camera_distance2(
    measured: MeasurementRows, state: State, noise: NoiseModel, linear: LinearisedRows | None = None
) -> tuple[Float[Tensor, "c b n"], Float[Tensor, "c b n"]]:
    """Mahalanobis distance^2 of each camera's measurements of a motion on their own, and how many rows they are.

    Args:
        linear: rows linearised at this state, where they are known.
    """
    linear = linearise(measured, state)[0] if linear is None else linear
    c, b = measured.cameras, measured.trials

    def apart(x: Tensor) -> Tensor:
        """(*, k c, b, n) -> (*, k, c b, n): cameras as trials of their own."""
        return x.unflatten(-3, (-1, c)).flatten(-3, -2)

    own = NoiseModel(**{name: value.repeat(c) for name, value in vars(noise).items()})
    image = apart(image_variance(measured, noise))
    distance2 = _distance2(apart(linear.w), apart(linear.a), apart(linear.r), image, 1, own)
    return distance2.unflatten(0, (c, b)), apart(measured.rows_ok).sum(0).to(linear.r.dtype).unflatten(0, (c, b))


def _distance2(
    w: Float[Tensor, "3 k b n"],
    a: Float[Tensor, "3 k b n"],
    r: Float[Tensor, "k b n"],
    image: Float[Tensor, "k b n"],
    cameras: int,
    noise: NoiseModel,
) -> Float[Tensor, "b n"]:
    """r^T S^-1 r of each motion."""
    k = r.shape[0]
    system = r.new_empty((k, k + 1, *r.shape[1:]))
    covariance(w, a, image, cameras, noise, system[:, :k])
    system[:, k] = r
    eliminate(system)
    pivots = system.diagonal(dim1=0, dim2=1).permute(2, 0, 1)
    return (system[:, -1].square() / pivots).sum(0)
