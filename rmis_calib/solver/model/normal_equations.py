"""Weighted normal equations: whiten every motion with the noise propagated from images and kinematics, and sum.

The residuals of one motion have the covariance S = D + G: D diagonal, from the image; G from the motion's pose noise,
which all rows share (`arm_T_rcm`) or the rows of one camera share (what each camera sees). In the form of residuals.py,
G_ij = sigma_mm^2 w_i.w_j + sigma_rad^2 a_i.a_j. This is the Schur complement of a latent pose error per motion:
eliminating xi from min |y - J xi|^2_D + |xi|^2_Sigma leaves y^T (D + J Sigma J^T)^-1 y.

S is evaluated at the *predicted* rows of the current estimate and held while the score J^T S^-1 r is driven to zero.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.errors import InputError
from rmis_calib.solver.model.batched_linalg import eliminate, forward_substitute
from rmis_calib.solver.model.compliance import basis
from rmis_calib.solver.model.grams import gram, gram_of_products
from rmis_calib.solver.model.linearised_rows import LinearisedRows
from rmis_calib.solver.model.measurement_rows import END, HEAD, LINE, OWN, MeasurementRows
from rmis_calib.solver.model.parameters import GIVEN_WAY, ParameterLayout, columns
from rmis_calib.solver.model.predicted_shaft import Shaft
from rmis_calib.solver.model.residuals import linearise
from rmis_calib.solver.model.state import State
from rmis_calib.solver.tensors import chunks


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


@dataclass(frozen=True)
class WeightedModel:
    """All that turns a state into normal equations: measurements of `b` trials, the parameters that explain them, and
    the noise that weights them.

    Attributes:
        measured: the measurements.
        layout: parameters and their priors.
        noise: variances.
        weight: in (0, 1], of each camera's measurements of a motion; None: all 1.
        chunk: motions (times trials) that are in work at once: bounds memory.
    """

    measured: MeasurementRows
    layout: ParameterLayout
    noise: NoiseModel
    weight: Float[Tensor, "c b n"] | None = None
    chunk: int = 4096

    def narrow(self, trials: slice, motions: slice) -> "WeightedModel":
        """The part of these trials and motions."""
        weight = None if self.weight is None else self.weight[:, trials, motions]
        measured = self.measured.narrow(trials, motions)
        return replace(
            self, measured=measured, layout=self.layout.take(trials), noise=self.noise.take(trials), weight=weight
        )

    def take_motions(self, index: Tensor) -> "WeightedModel":
        """The part of the motions `index`, the same for every trial."""
        weight = None if self.weight is None else self.weight[..., index]
        return replace(self, measured=self.measured.take_motions(index), weight=weight)

    def sample(self, most: int) -> tuple["WeightedModel", int]:
        """Every k-th motion, `most` of them or fewer, and k."""
        motions = self.measured.motions
        step = max(1, -(-motions // most))
        return (
            self if step == 1 else self.take_motions(torch.arange(0, motions, step, device=self.measured.p.device))
        ), step

    def take_trials(self, index: Tensor) -> "WeightedModel":
        """The trials `index`, in this order, repeated where it repeats them."""
        weight = None if self.weight is None else self.weight.index_select(1, index)
        measured = self.measured.take_trials(index)
        return replace(
            self, measured=measured, layout=self.layout.take(index), noise=self.noise.take(index), weight=weight
        )

    def parts(self) -> Iterator[tuple[slice, list[slice]]]:
        """Slices of trials, each with the slices of motions, that hold `chunk` motions or fewer."""
        return chunks(self.measured.trials, self.measured.motions, self.chunk)


@dataclass(frozen=True)
class Normal:
    """Normal equations of `b` trials, priors included.

    Attributes:
        H: information J^T S^-1 J.
        g: score J^T S^-1 r; the Gauss-Newton step is -H^-1 g.
        chi2: r^T S^-1 r.
        rows: number of measured rows.
        distance2: r^T S^-1 r of each motion.
        logdet: log det S, summed over motions.
        factor: the eliminated systems, for `frozen_chi2`, when asked for.
        linear: the rows that these are of, likewise.
    """

    H: Float[Tensor, "b p p"]
    g: Float[Tensor, "b p"]
    chi2: Float[Tensor, " b"]
    rows: Float[Tensor, " b"]
    distance2: Float[Tensor, "b n"]
    logdet: Float[Tensor, " b"]
    factor: Tensor | None = None
    linear: LinearisedRows | None = None

    @property
    def kept_factor(self) -> Tensor:
        """The factor of normal equations that were made with `keep`."""
        if self.factor is None:
            raise InputError(where="Normal.factor", expected="normal equations made with keep=True", found="none")
        return self.factor


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


def normal_equations(model: WeightedModel, state: State, keep: bool = False) -> Normal:
    """Normal equations, without priors, of motions that fit into memory at once.

    Args:
        keep: also return the linearised rows and the factor.
    """
    measured, layout = model.measured, model.layout
    linear, shaft = linearise(measured, state)
    p = layout.size
    factor = None
    if linear.r.requires_grad:
        image = image_variance(measured, model.noise)
        J = columns(layout, linear, shaft, measured, state)
        white, logdet = _whitened(model, linear, image, torch.cat((J, linear.r[:, None]), dim=1))
        sums = gram(white, None)[:, 0]
    else:
        white, factor = _eliminated(model, state, linear, shaft)
        logdet = factor.diagonal(dim1=0, dim2=1).log().sum((-2, -1))
        sums = _sums(model, white, None)[:, 0]
    return Normal(
        H=sums[:, :p, :p],
        g=sums[:, :p, p],
        chi2=sums[:, p, p],
        rows=measured.rows_ok.sum((0, 2)).to(sums.dtype),
        distance2=white[:, -1].square().sum(0),
        logdet=logdet,
        factor=factor if keep else None,
        linear=linear if keep else None,
    )


def summed_products(model: WeightedModel, white: Float[Tensor, "k q b n"]) -> Float[Tensor, "b p p"]:
    """Products of all columns, the residuals' last, from `whitened_columns` without further ones."""
    return _sums(model, white, None)[:, 0]


def _sums(
    model: WeightedModel, white: Float[Tensor, "k q b n"], member: Float[Tensor, "b n g"] | None
) -> Float[Tensor, "b g p p"]:
    """Products of all columns, summed over the motions of each group, from whitened columns of the folded layout."""
    part = model.layout.folded.blocks.get(GIVEN_WAY)
    return gram(white, member) if part is None else gram_of_products(white, member, part, basis(model.measured.pose))


def membership(group: Int[Tensor, "b n"], count: int, dtype: torch.dtype) -> Float[Tensor, "b n g"]:
    """1 where a motion is of a group; none is for -1."""
    return torch.nn.functional.one_hot(group + 1, count + 1)[..., 1:].to(dtype)


def group_sums(
    model: WeightedModel, state: State, group: Int[Tensor, "b n"], count: int
) -> tuple[Float[Tensor, "b g p p"], Float[Tensor, "b g p"]]:
    """Information and score of `count` groups of motions, without priors; motions of no group (-1) do not count."""
    return member_sums(model, state, membership(group, count, state.t.dtype))


def member_sums(
    model: WeightedModel, state: State, member: Float[Tensor, "b n g"]
) -> tuple[Float[Tensor, "b g p p"], Float[Tensor, "b g p"]]:
    """Information and score, without priors, of groups that may overlap."""
    sums = []
    for trials, along in model.parts():
        at, total = state.take(trials), None
        for motions in along:
            part = model.narrow(trials, motions)
            linear, shaft = linearise(part.measured, at)
            white, _ = _eliminated(part, at, linear, shaft)
            found = _sums(part, white, member[trials, motions])
            total = found if total is None else total + found
        assert total is not None
        sums.append(total)
    joined = torch.cat(sums)
    return joined[..., :-1, :-1], joined[..., :-1, -1]


def whitened_columns(
    model: WeightedModel, state: State, linear: LinearisedRows, shaft: Shaft, more: Float[Tensor, "k m b n"]
) -> Float[Tensor, "k q b n"]:
    """L^-1 [more J r] of motions that fit into memory at once: further columns, those of the folded layout, and the
    residuals."""
    return _eliminated(model, state, linear, shaft, more)[0]


def _eliminated(
    model: WeightedModel,
    state: State,
    linear: LinearisedRows,
    shaft: Shaft,
    more: Float[Tensor, "k m b n"] | None = None,
) -> tuple[Float[Tensor, "k q b n"], Tensor]:
    """L^-1 [J r] of every motion, with S = L L^T and the columns of the folded layout, and the eliminated systems; in
    place, not for autograd. Further columns come before."""
    measured, layout = model.measured, model.layout.folded
    k, b, n = linear.r.shape
    first = k if more is None else k + more.shape[1]
    image = image_variance(measured, model.noise)
    augmented = torch.empty((k, first + layout.size + 1, b, n), dtype=linear.r.dtype, device=linear.r.device)
    covariance(linear.w, linear.a, image, measured.cameras, model.noise, augmented[:, :k], model.weight)
    if more is not None:
        augmented[:, k:first] = more
    columns(layout, linear, shaft, measured, state, out=augmented[:, first:-1])
    augmented[:, -1] = linear.r
    eliminate(augmented)
    factor = augmented[:, :k]
    pivots = factor.diagonal(dim1=0, dim2=1).permute(2, 0, 1)  # (k, b, n)
    return augmented[:, k:].mul_(pivots.rsqrt()[:, None]), factor


def _whitened(
    model: WeightedModel, linear: LinearisedRows, image: Float[Tensor, "k b n"], columns: Float[Tensor, "k q b n"]
) -> tuple[Float[Tensor, "k q b n"], Float[Tensor, " b"]]:
    """L^-1 columns, with S = L L^T as `covariance` writes it, and log det S summed over motions; for autograd, which
    does not follow what is done in place."""
    noise, c = model.noise, model.measured.cameras
    w, a = (x.permute(2, 3, 1, 0).contiguous() for x in (linear.w, linear.a))  # (b, n, k, 3)
    shift, turn = w @ w.mT, a @ a.mT
    camera = torch.arange(w.shape[-2], device=w.device) % c
    same = (camera[:, None] == camera).to(w.dtype)

    def at(variance: Tensor) -> Tensor:
        return variance[:, None, None, None]

    S = (at(noise.kinematics_mm) + at(noise.camera_mm) * same) * shift
    S = S + (at(noise.kinematics_rad) + at(noise.camera_rad) * same) * turn
    S = S + torch.diag_embed(image.permute(1, 2, 0))
    if model.weight is not None:
        weight = model.weight.permute(1, 2, 0)[..., camera]  # (b, n, k)
        S = torch.where(same > 0, S / weight[..., None], S)
    factor, _ = torch.linalg.cholesky_ex(S)
    white = torch.linalg.solve_triangular(factor, columns.permute(2, 3, 0, 1).contiguous(), upper=False)
    white = white.permute(2, 3, 0, 1).contiguous()
    return white, 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum((1, 2))


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


def accumulate(model: WeightedModel, state: State) -> Normal:
    """Normal equations with priors of any number of motions, a chunk at a time: memory does not grow with N.

    Motions stream: the sums over chunks are sums over machines just as well.
    """
    per_trial = []
    for trials, along in model.parts():
        at = state.take(trials)
        per_trial.append(_joined([normal_equations(model.narrow(trials, motions), at) for motions in along]))
    if len(per_trial) == 1:
        return with_prior(per_trial[0], model.layout, state)
    joined = {name: torch.cat([getattr(part, name) for part in per_trial]) for name in _sums_of(per_trial)}
    joined["distance2"] = torch.cat([part.distance2 for part in per_trial])
    return with_prior(replace(per_trial[0], **joined), model.layout, state)


def _joined(parts: list[Normal]) -> Normal:
    """Parts of the motions of the same trials."""
    if len(parts) == 1:
        return parts[0]
    sums = {name: torch.stack([getattr(part, name) for part in parts]).sum(0) for name in _sums_of(parts)}
    return replace(parts[0], **sums, distance2=torch.cat([part.distance2 for part in parts], dim=-1))


def _sums_of(parts: list[Normal]) -> list[str]:
    """What is a sum over motions in these parts."""
    return ["H", "g", "chi2", "rows", "logdet"]


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
