"""What a failed test is likely to come from: score tests of what usually goes wrong.

Each cause has columns: what a unit of it would do to every row. With u their score and A their information, the
parameters of the fit eliminated, freeing the cause would lower chi^2 by u^T A^-1 u (Rao 1948); the more columns, the
less that means (Schwarz 1978: each costs the logarithm of the number of places). What an unknown of the fit already
took counts for its cause, in sigmas of its prior: a lens that is pulled from its nominal value is not exonerated by
fitting.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.assess.left_out import TESTED_MOTIONS, eliminated
from rmis_calib.solver.assess.tested_over import over_of
from rmis_calib.solver.estimate.map_estimate import MapEstimate
from rmis_calib.solver.model.batched_linalg import batch_last, cross, dot, rotate
from rmis_calib.solver.model.jacobian import columns_of
from rmis_calib.solver.model.linearised_rows import LinearisedRows
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.normal_equations import summed_products, whitened_columns
from rmis_calib.solver.model.predicted_shaft import Shaft, rcm_axes
from rmis_calib.solver.model.residuals import linearise
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.solution import ClockJump, GroupCheck

LENGTH_MM = 100.0
"""Distance from the RCM at which the bend of a unit is one."""
SEEN = 1e-4
"""Part of a direction's information that the fit must leave for it to count."""


def causes_of(
    fit: MapEstimate, groups: GroupCheck, jump: ClockJump | None, excess: Float[Tensor, " b"]
) -> dict[str, Float[Tensor, " b"]]:
    """By how much each cause would lower chi^2, less the price of its columns; NaN or absent where the data do not tell
    it.

    Args:
        fit: the estimate.
        groups: of neighbouring motions.
        jump: of the clock.
        excess: what the residuals exceed the noise by, as a factor on the variance.
    """
    model, step = fit.model.sample(TESTED_MOTIONS)
    state = fit.state.moved(model.layout.step(fit.bias))
    levels = model.noise.kinematics_mm.sqrt(), model.noise.kinematics_rad.sqrt()
    places = (over_of(model.measured, levels, None).cluster[:, -1] + 1.0).clamp_min(3.0)
    price, excess = places.log(), excess.clamp_min(1.0)
    sums, parts = _sums(model, state)
    own = slice(0, model.layout.size)
    H = sums[:, own, own] + torch.diag_embed(model.layout.sigma.square().reciprocal()) / step
    found = {}
    for name, part in parts.items():
        gain, freedom = _gain(sums, H, part)
        found[name] = gain * step / excess - freedom * price
    for name, index in _fitted(model).items():
        deviation, weight = (x[:, index] for x in fit.model.layout.prior(fit.state))
        found[name] = found[name] + torch.nan_to_num(weight * deviation.square()).sum(-1)
    if groups.count:
        found["camera moved"] = groups.change_sigmas.square() - 7.0 * price
    if jump is not None:
        found["clock jump"] = jump.sigmas.square() - 2.0 * price
    return found


def _fitted(model: WeightedModel) -> dict[str, list[int]]:
    """Parameters of the fit that are a cause themselves."""
    blocks = {name: list(range(part.start, part.stop)) for name, part in model.layout.blocks.items()}
    intrinsics = blocks.get("intrinsics", [])
    found = {
        "intrinsics": [index for index in intrinsics if index not in intrinsics[3::4]],
        "lens": intrinsics[3::4],
        "stereo": blocks.get("stereo_rotation", []) + blocks.get("stereo_translation", []),
    }
    return {name: index for name, index in found.items() if index}


def _sums(model: WeightedModel, state: State) -> tuple[Float[Tensor, "b q q"], dict[str, slice]]:
    """Products of the columns of the fit, of every cause, and of the residuals, summed over motions; and where each
    cause is."""
    total, places = [], {}
    for trials, along in model.parts():
        at, sums = state.take(trials), 0.0
        for motions in along:
            part = model.narrow(trials, motions)
            linear, shaft = linearise(part.measured, at)
            each = _columns(part.measured, at, linear, shaft)
            more = torch.cat(list(each.values())).transpose(0, 1)
            white = whitened_columns(part, at, linear, shaft, more)
            m = more.shape[1]
            start = 0
            for name, columns in each.items():
                places[name] = slice(model.layout.size + start, model.layout.size + start + len(columns))
                start += len(columns)
            sums = sums + summed_products(part, torch.cat((white[:, m:-1], white[:, :m], white[:, -1:]), dim=1))
        total.append(sums)
    return torch.nan_to_num(torch.cat(total)), places


def _columns(
    measured: MeasurementRows, state: State, linear: LinearisedRows, shaft: Shaft
) -> dict[str, Float[Tensor, "q k b n"]]:
    """Effect of a unit of each cause on every row, of those causes that the measurements tell of."""

    def effect(*names: str) -> Float[Tensor, "q k b n"]:
        return torch.cat([columns_of(name, linear, shaft, measured, state) for name in names])

    cameras = effect("intrinsics").unflatten(0, (-1, 4))  # focal length, centre x and y, lens of each
    found = {
        "intrinsics": cameras[:, :3].flatten(0, 1),
        "lens": cameras[:, 3],
        "tool": _bend(measured, state, linear, shaft),
    }
    found["tool"] = torch.cat((found["tool"], effect("rcm_offset")))
    if measured.cameras == 2:
        found["stereo"] = effect("stereo_rotation", "stereo_translation")
    if measured.clock is not None:
        found["clock"] = effect("clock_rate")
    if measured.setup is not None:
        found["setup"] = effect("setup")
    if measured.joint is not None and measured.joint.shape[1]:
        found["joint_offset"] = effect("joint_offset")
    return found


def _bend(measured: MeasurementRows, state: State, linear: LinearisedRows, shaft: Shaft) -> Float[Tensor, "2 k b n"]:
    """Effect of a bend of the shaft, the square of the distance from the RCM, in two directions fixed to `rcm`.

    A row is w.(tau + phi x s d), so that a = s d x w (residuals.py), which tells the s that it sees.
    """
    d, R = shaft.d[:, :1], batch_last(state.R, 2)[..., None]
    lever = cross(d, linear.w)
    s = dot(linear.a, lever) / dot(lever, lever).clamp_min(1e-30)
    return torch.stack(
        [dot(linear.w, rotate(R, e)[:, None]) * (s / LENGTH_MM).square() for e in rcm_axes(measured.R, measured.v)]
    )


def _gain(
    sums: Float[Tensor, "b q q"], H: Float[Tensor, "b p p"], part: slice
) -> tuple[Float[Tensor, " b"], Float[Tensor, " b"]]:
    """By how much freeing the columns `part` would lower chi^2, and in how many directions they are seen."""
    p, q, columns = H.shape[-1], part.stop - part.start, sums[:, part, part]
    unit = columns.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    within = columns + torch.diag_embed(unit.square().reciprocal())  # a prior, which `eliminated` takes off again
    top, bottom = torch.cat((H, sums[:, :p, part]), dim=-1), torch.cat((sums[:, part, :p], within), dim=-1)
    # Where the fit is, its own score vanishes.
    g = torch.cat((torch.zeros_like(H[:, 0]), sums[:, part, -1]), dim=-1)
    block = eliminated(torch.cat((top, bottom), dim=-2), g, unit, [*range(p, p + q)], [*range(p)], [])
    values, vectors = torch.linalg.eigh(block.A)
    along = (vectors.mT @ block.u[..., None])[..., 0]
    seen = values > SEEN
    return torch.where(seen, along.square() / values.clamp_min(SEEN), 0.0).sum(-1), seen.sum(-1).to(g)
