"""Weighted normal equations: whiten every motion with the covariance of its residuals, and sum.

S (motion_covariance.py) is evaluated at the *predicted* rows of the current estimate and held while the score
J^T S^-1 r is driven to zero.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.errors import InputError
from rmis_calib.solver.model.batched_linalg import eliminate
from rmis_calib.solver.model.compliance import basis
from rmis_calib.solver.model.grams import gram, gram_of_products
from rmis_calib.solver.model.jacobian import columns
from rmis_calib.solver.model.linearised_rows import LinearisedRows
from rmis_calib.solver.model.motion_covariance import covariance, image_variance
from rmis_calib.solver.model.parameters import GIVEN_WAY, ParameterLayout
from rmis_calib.solver.model.predicted_shaft import Shaft
from rmis_calib.solver.model.residuals import linearise
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel


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
