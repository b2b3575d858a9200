"""Residuals as the tests take them (residual_tests.py): one number a motion for each kind, in units of its own noise.

A kind is a pattern z over the rows of a motion: the shaft's shift across itself in one camera is +1 on each of its line
rows, its turn -1 on the RCM's side and +1 on the tip's. With S the covariance of the rows, from image and kinematics,
the kind's residual in a motion is z^T S^-1 r, of variance z^T S^-1 z; and z^T S^-1 J is what the parameters take of it.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.solver.model.compliance import basis
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.normal_equations import summed_products, whitened_columns
from rmis_calib.solver.model.parameters import GIVEN_WAY, ParameterLayout
from rmis_calib.solver.model.residuals import linearise
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.observation_arrays import CAMERAS

CONTOURS = {"shift": (1, 1, 1, 1), "turn": (-1, 1, -1, 1), "width": (1, 1, -1, -1), "taper": (-1, 1, 1, -1)}
"""Patterns over both points of edge 0, then of edge 1; positive to the same side of the directed shaft. They span what
the offset and the angle of both edges do: a shift and a turn of the shaft, and what its edges do against each other."""
AXIS = {"shift": (1, 1), "turn": (-1, 1)}


@dataclass(frozen=True)
class TestedResiduals:
    """Residuals of `m` kinds in `b` trials of `n` motions, and what the fit takes of them.

    Attributes:
        names: `<kind>_<camera>` of each kind (`shift_right`).
        cameras: number of the camera of each; over the picture it is tested by where that one sees the shaft.
        score: residual over its variance; zero where nothing was measured.
        information: one over that variance; zero likewise.
        shared: `information` times the effect of each of the `p` parameters on the residual; 0 parameters: those of
            another estimate, of which nothing is known.
        own_score: of the parameters, by motion.
        own_information: of the parameters, of all these motions.
    """

    __test__ = False  # for pytest

    names: tuple[str, ...]
    cameras: tuple[int, ...]
    score: Float[Tensor, "m b n"]
    information: Float[Tensor, "m b n"]
    shared: Float[Tensor, "m b n p"]
    own_score: Float[Tensor, "b n p"]
    own_information: Float[Tensor, "b p p"]

    @classmethod
    def of_values(
        cls,
        names: tuple[str, ...],
        cameras: tuple[int, ...],
        values: Float[Tensor, "m b n"],
        sigma: Float[Tensor, "m b n"],
    ) -> "TestedResiduals":
        """Residuals that are no rows of the estimate, such as those against the picture; NaN where not measured.

        Args:
            names, cameras: of each kind.
            values: residual of each motion.
            sigma: its noise, 1 sigma, in the same unit; a common factor does not matter, as the scatter is measured.
        """
        known = torch.isfinite(values) & torch.isfinite(sigma)
        information = torch.where(known, torch.where(known, sigma, 1.0).square().reciprocal(), 0.0)
        score = torch.where(known, torch.where(known, values, 0.0) * information, 0.0)
        none = values.new_zeros(*values.shape, 0)
        return cls(names, cameras, score, information, none, none[0], values.new_zeros(values.shape[1], 0, 0))

    def take(self, trials: Int[Tensor, " k"]) -> "TestedResiduals":
        """Of some trials."""
        return replace(
            self,
            score=self.score[:, trials],
            information=self.information[:, trials],
            shared=self.shared[:, trials],
            own_score=self.own_score[trials],
            own_information=self.own_information[trials],
        )


def residuals_of(model: WeightedModel, state: State) -> TestedResiduals:
    """Every kind that an estimate is made of, at its state."""
    names, cameras = kinds_of(model.measured)
    trials = []
    for part, along in model.parts():
        at = state.take(part)
        each = zip(*(_scores(model.narrow(part, motions), at) for motions in along), strict=True)
        *by_motion, sums = each
        joined = [torch.cat(parts, dim=dim) for parts, dim in zip(by_motion, (2, 2, 2, 1), strict=True)]
        trials.append((*joined, torch.stack(sums).sum(0)))
    tensors = [torch.cat(parts, dim=dim) for parts, dim in zip(zip(*trials, strict=True), (1, 1, 1, 0, 0), strict=True)]
    return TestedResiduals(names, cameras, *tensors)


def kinds_of(measured: MeasurementRows) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Names and cameras of the kinds, in the order of `_patterns`."""
    lines = CONTOURS if measured.has_contours else AXIS
    kinds = [(name, c) for name in lines for c in range(measured.cameras)]
    if measured.has_ends:
        kinds += [("end", c) for c in range(measured.cameras)]
    if measured.has_heads:
        kinds += [(name, c) for name in ("head_u", "head_v") for c in range(measured.cameras)]
    names = [f"{name}_{CAMERAS[c]}" for name, c in kinds]
    own = [
        (rows.name if len(rows.ok) == 1 else f"{rows.name}[{index}]", rows.camera)
        for rows in measured.own
        for index in range(len(rows.ok))
    ]
    return (*names, *(name for name, _ in own)), (*(c for _, c in kinds), *(c for _, c in own))


def _patterns(measured: MeasurementRows) -> Float[Tensor, "k m"]:
    """Pattern of each kind over all rows, which take turns between the cameras."""
    c, k = measured.cameras, len(measured.row_kind)
    lines = CONTOURS if measured.has_contours else AXIS
    out, points = [], measured.line_xy.shape[1]
    for pattern in lines.values():
        for camera in range(c):
            column = torch.zeros(k)
            column[camera : points * c : c] = torch.tensor(pattern, dtype=column.dtype)
            out.append(column)
    single = torch.eye(k)[points * c :]  # an end, a coordinate of a head, a component of the user's own: a row each
    built_in = c * (measured.has_ends + 2 * measured.has_heads)
    out += list(single[:built_in])
    start = built_in
    for rows in measured.own:
        out += [single[start + index * c + rows.camera] for index in range(len(rows.ok))]
        start += len(rows.ok) * c
    return torch.stack(out, dim=1).to(measured.p)


def _scores(model: WeightedModel, state: State) -> tuple[Tensor, ...]:
    """The tensors of `TestedResiduals`, of motions that fit into memory."""
    measured = model.measured
    linear, shaft = linearise(measured, state)
    z = _patterns(measured)[:, :, None, None] * measured.rows_ok[:, None]
    if measured.has_contours:  # where an axis line takes the place of the contours there is no width
        both, c = measured.line_ok.all(0), measured.cameras
        first = list(CONTOURS).index("width") * c
        z[:, first : first + 2 * c] *= both.repeat(2, 1, 1)
    white = whitened_columns(model, state, linear, shaft, z)
    m = z.shape[1]
    by_motion = white.permute(2, 3, 1, 0).contiguous()  # (b, n, m + q, k)
    kinds = by_motion[:, :, :m]
    products = kinds @ by_motion[:, :, m:].mT  # (b, n, m, q)
    own = (by_motion[:, :, m:-1] @ by_motion[:, :, -1:].mT)[..., 0]
    shared = _unfolded(model.layout, products[..., :-1], measured)
    own = _unfolded(model.layout, own[:, :, None], measured)[:, :, 0]
    score, information = products[..., -1].permute(2, 0, 1), kinds.square().sum(-1).permute(2, 0, 1)
    own_information = summed_products(model, white[:, m:])[:, :-1, :-1]
    return score, information, shared.permute(2, 0, 1, 3), own, own_information


def _unfolded(layout: ParameterLayout, x: Float[Tensor, "b n m q"], measured: MeasurementRows) -> Tensor:
    """Columns of the layout from those of the folded one."""
    part = layout.folded.blocks.get(GIVEN_WAY)
    if part is None:
        return x
    functions = basis(measured.pose).permute(1, 2, 0)[:, :, None, None]  # (b, n, 1, 1, f)
    products = (x[..., part, None] * functions).flatten(-2)
    return torch.cat((x[..., : part.start], products, x[..., part.stop :]), dim=-1)
