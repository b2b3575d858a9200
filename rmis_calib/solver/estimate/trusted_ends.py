"""Which shaft ends are measured at one and the same place of the instrument.

A detector calls the ring of the tube the end in one picture and the tip of the metal in the next, or an end where
something lies over the shaft. Such ends do not scatter about one place: they have several, and a level of noise that
explains them all takes the exact ones along, or rejects the contours of their pictures too. So before noise levels
are estimated, the place along the shaft where most ends lie is found (the shortest half of the offsets, which other
places and strays do not move while they are fewer; Rousseeuw & Leroy 1987), and ends elsewhere are left out. Ends
that have no common place are left out altogether.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.solver.model.measurement_rows import END, MeasurementRows
from rmis_calib.solver.model.normal_equations import NoiseModel
from rmis_calib.solver.model.residuals import linearise
from rmis_calib.solver.model.state import State

ELSEWHERE = 5.0
"""Distance from the common place, in robust sigmas, from which an end is one of something else."""
SCATTERED_MM = 5.0
"""Robust sigma along the shaft beyond which ends have no common place: a wrist's ring and its jaws are 10 mm apart."""
NORMAL_HALF = 1.349
"""Width of the shortest half of a normal distribution, in sigmas."""


def trusted_ends(measured: MeasurementRows, state: State, noise: NoiseModel) -> MeasurementRows:
    """The rows without ends that lie elsewhere than most, per trial; with no ends where none is left in any trial.

    Args:
        measured: of all cameras together: they see the same ends.
        state: an estimate that need not be exact.
        noise: assumed levels; only scatter that goes beyond them counts.
    """
    if not measured.has_ends:
        return measured
    offset, sigma = _offsets(measured, state, noise)
    ok = measured.end_ok
    centre, spread = shortest_half(offset, ok)
    expected = torch.where(ok, sigma, torch.nan).movedim(1, 0).flatten(1).nanmedian(1).values
    common = ~((spread > SCATTERED_MM) & (spread > ELSEWHERE * expected))
    near = (offset - centre[:, None]).abs() <= ELSEWHERE * torch.maximum(sigma, spread[:, None])
    kept = ok & (near & common[:, None] | ~torch.isfinite(centre)[:, None])
    return replace(measured, end_ok=kept) if bool(kept.any()) else measured.without_ends()


def _offsets(
    measured: MeasurementRows, state: State, noise: NoiseModel
) -> tuple[Float[Tensor, "c b n"], Float[Tensor, "c b n"]]:
    """Distance of each measured end from the predicted one along the shaft, and its sigma; mm."""
    linear, _ = linearise(measured, state)
    rows = [index for index, kind in enumerate(measured.row_kind) if kind == END]
    gain = linear.end[rows].abs().clamp_min(1e-12)
    of_pose = [
        (vectors[:, rows].square().sum(0) * variance[:, None])
        for vectors, variance in (
            (linear.w, noise.kinematics_mm + noise.camera_mm),
            (linear.a, noise.kinematics_rad + noise.camera_rad),
        )
    ]
    variance = measured.end_var * noise.end[:, None] + of_pose[0] + of_pose[1]
    return linear.r[rows] / gain, variance.sqrt() / gain


def shortest_half(
    value: Float[Tensor, "c b n"], known: Bool[Tensor, "c b n"]
) -> tuple[Float[Tensor, " b"], Float[Tensor, " b"]]:
    """Middle of the shortest interval that holds more than half of a trial's known values, and the sigma that a normal
    distribution of this half has; NaN where fewer than 4 are known."""
    ordered = torch.where(known, value, torch.inf).movedim(1, 0).flatten(1).sort(1).values
    count = known.sum((0, 2))[:, None]
    first = torch.arange(ordered.shape[1], device=value.device).expand_as(ordered)
    last = first + torch.div(count, 2, rounding_mode="floor")
    width = ordered.gather(1, last.clamp_max(ordered.shape[1] - 1)) - ordered
    width = torch.where(last < count, width, torch.inf)
    at = width.argmin(1, keepdim=True)
    low, shortest = ordered.gather(1, at), width.gather(1, at)
    enough = count >= 4
    centre = torch.where(enough, low + 0.5 * shortest, torch.nan)
    return centre[:, 0], torch.where(enough, shortest / NORMAL_HALF, torch.nan)[:, 0]
