"""Weighted normal equations: whiten every motion with the noise propagated from images and kinematics, and sum.

The residuals of one motion have the covariance S = D + G: D diagonal, from the image; G from the motion's pose noise,
which all rows share (`arm_T_rcm`) or the rows of one camera share (what each camera sees). In the form of residuals.py,
G_ij = sigma_mm^2 w_i.w_j + sigma_rad^2 a_i.a_j. This is the Schur complement of a latent pose error per motion:
eliminating xi from min |y - J xi|^2_D + |xi|^2_Sigma leaves y^T (D + J Sigma J^T)^-1 y.

S is evaluated at the *predicted* rows of the current estimate and held while the score J^T S^-1 r is driven to zero.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import InputError
from rmis_calib.solver.model.batched_linalg import eliminate, forward_substitute
from rmis_calib.solver.model.measurement_rows import END, HEAD, LINE, MeasurementRows
from rmis_calib.solver.model.parameters import ParameterLayout, columns
from rmis_calib.solver.model.residuals import Rows, State, linearise


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

    def repeat(self, times: int) -> "NoiseModel":
        return NoiseModel(**{name: value.repeat_interleave(times) for name, value in vars(self).items()})


@dataclass(frozen=True)
class Normal:
    """Normal equations of `b` trials, priors included.

    Attributes:
        H: information J^T S^-1 J.
        g: score J^T S^-1 r; the Gauss-Newton step is -H^-1 g.
        chi2: r^T S^-1 r.
        rows: number of measured rows.
        distance2: r^T S^-1 r of each motion.
        factor: the eliminated systems, for `frozen_chi2`, when asked for.
        linear: the rows that these are of, likewise.
    """

    H: Float[Tensor, "b p p"]
    g: Float[Tensor, "b p"]
    chi2: Float[Tensor, " b"]
    rows: Float[Tensor, " b"]
    distance2: Float[Tensor, "b n"]
    factor: Tensor | None = None
    linear: Rows | None = None

    @property
    def kept_factor(self) -> Tensor:
        """The factor of normal equations that were made with `keep`."""
        if self.factor is None:
            raise InputError(where="Normal.factor", expected="normal equations made with keep=True", found="none")
        return self.factor


def image_variance(packed: MeasurementRows, noise: NoiseModel) -> Float[Tensor, "k b n"]:
    """D: nominal variances times the factor of each kind; 1 for rows that were not measured (they are zero)."""
    factors = {LINE: noise.line, END: noise.end, HEAD: noise.head}
    scale = torch.stack([factors[kind] for kind in packed.row_kind])
    return torch.where(packed.rows_ok, packed.rows_var * scale[:, :, None], 1.0)


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
        w, a: effects of a translation and a rotation of the shaft on each row (`residuals.Rows`).
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


def normal_equations(
    packed: MeasurementRows,
    state: State,
    layout: ParameterLayout,
    noise: NoiseModel,
    weight: Tensor | None = None,
    keep: bool = False,
) -> Normal:
    """Normal equations of motions that fit into memory at once.

    Args:
        weight: (c, b, n) in (0, 1] of each camera's measurements of a motion.
        keep: also return the rows and the factor.
    """
    rows, shaft = linearise(packed, state)
    k, b, n = rows.r.shape
    p = layout.size
    augmented = torch.empty((k, k + p + 1, b, n), dtype=rows.r.dtype, device=rows.r.device)
    covariance(rows.w, rows.a, image_variance(packed, noise), packed.cameras, noise, augmented[:, :k], weight)
    columns(layout, rows, shaft, packed, state, out=augmented[:, k:-1])
    augmented[:, -1] = rows.r
    eliminate(augmented)
    pivots = augmented.diagonal(dim1=0, dim2=1).permute(2, 0, 1)  # (k, b, n)
    white = augmented[:, k:].mul_(pivots.rsqrt()[:, None])
    gram = torch.matmul(white.permute(0, 2, 1, 3), white.permute(0, 2, 3, 1)).sum(0)  # (b, p + 1, p + 1)
    return Normal(
        H=gram[:, :p, :p],
        g=gram[:, :p, p],
        chi2=gram[:, p, p],
        rows=packed.rows_ok.sum((0, 2)).to(gram.dtype),
        distance2=white[:, -1].square().sum(0),
        factor=augmented[:, :k] if keep else None,
        linear=rows if keep else None,
    )


def frozen_chi2(factor: Float[Tensor, "k k b n"], r: Float[Tensor, "k b n"]) -> Float[Tensor, "b n"]:
    """r^T S^-1 r of each motion, for the S whose factor was kept."""
    pivots = factor.diagonal(dim1=0, dim2=1).permute(2, 0, 1)
    return (forward_substitute(factor, r).square() / pivots).sum(0)


def with_prior(normal: Normal, layout: ParameterLayout, state: State) -> Normal:
    """Adds the Gaussian priors."""
    deviation, weight = layout.prior(state)
    return replace(
        normal,
        H=normal.H + torch.diag_embed(weight),
        g=normal.g + weight * deviation,
        chi2=normal.chi2 + (weight * deviation.square()).sum(-1),
    )


def accumulate(
    packed: MeasurementRows,
    state: State,
    layout: ParameterLayout,
    noise: NoiseModel,
    chunk: int,
    weight: Tensor | None = None,
) -> Normal:
    """Normal equations with priors of any number of motions, `chunk` at a time: memory does not grow with N.

    Motions stream: the sums over chunks are sums over machines just as well.
    """
    trials, motions = packed.trials, packed.motions
    step_n = min(motions, chunk)
    step_b = max(1, chunk // step_n)
    per_trial = []
    for b in range(0, trials, step_b):
        bs = slice(b, min(b + step_b, trials))
        part_state, part_layout, part_noise = state.take(bs), layout.take(bs), noise.take(bs)
        parts = []
        for n in range(0, motions, step_n):
            ns = slice(n, min(n + step_n, motions))
            part_weight = None if weight is None else weight[:, bs, ns]
            parts.append(normal_equations(packed.narrow(bs, ns), part_state, part_layout, part_noise, part_weight))
        per_trial.append(_joined(parts))
    if len(per_trial) == 1:
        return with_prior(per_trial[0], layout, state)
    names = ("H", "g", "chi2", "rows", "distance2")
    joined = {name: torch.cat([getattr(part, name) for part in per_trial]) for name in names}
    return with_prior(replace(per_trial[0], **joined), layout, state)


def _joined(parts: list[Normal]) -> Normal:
    """Parts of the motions of the same trials."""
    if len(parts) == 1:
        return parts[0]
    sums = {name: torch.stack([getattr(part, name) for part in parts]).sum(0) for name in ("H", "g", "chi2", "rows")}
    return replace(parts[0], **sums, distance2=torch.cat([part.distance2 for part in parts], dim=-1))


def motion_distance2(packed: MeasurementRows, state: State, noise: NoiseModel) -> Float[Tensor, "b n"]:
    """Mahalanobis distance^2 of all measurements of each motion."""
    rows, _ = linearise(packed, state)
    return _distance2(rows.w, rows.a, rows.r, image_variance(packed, noise), packed.cameras, noise)


def camera_distance2(
    packed: MeasurementRows, state: State, noise: NoiseModel, rows: Rows | None = None
) -> tuple[Float[Tensor, "c b n"], Float[Tensor, "c b n"]]:
    """Mahalanobis distance^2 of each camera's measurements of a motion on their own, and how many rows they are.

    Args:
        rows: linearised at this state, where they are known.
    """
    rows = linearise(packed, state)[0] if rows is None else rows
    c, b = packed.cameras, packed.trials

    def apart(x: Tensor) -> Tensor:
        """(*, k c, b, n) -> (*, k, c b, n): cameras as trials of their own."""
        return x.unflatten(-3, (-1, c)).flatten(-3, -2)

    own = NoiseModel(**{name: value.repeat(c) for name, value in vars(noise).items()})
    image = apart(image_variance(packed, noise))
    distance2 = _distance2(apart(rows.w), apart(rows.a), apart(rows.r), image, 1, own)
    return distance2.unflatten(0, (c, b)), apart(packed.rows_ok).sum(0).to(rows.r.dtype).unflatten(0, (c, b))


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
