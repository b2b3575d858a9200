"""Sub-pixel contour points at full resolution, in a narrow band along both traced contours.

Profiles are read across the contour, projected on the colour that separates the two sides, and compared with a blurred
step: level, height, place of the step and one slope on each side, because neither shaft nor tissue is of one tone. The
step's blur is found once a contour from the mean profile; then the place of every step is one small matrix product.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.fine.subpixel import step_columns, step_estimator
from rmis_calib.vision.image.line_fit import LineFit
from rmis_calib.vision.image.run_length import masked_median
from rmis_calib.vision.image.sampling import FullPicture

# Blurs tried, in steps of the profile: from sharper than a pixel to soft motion blur.
_BLURS = (0.5, 0.7, 0.95, 1.3, 1.8, 2.5, 3.4)
# The separating colour is averaged over a sixth of the contour before and behind. Over a sixteenth the contours of the
# preset carbon are 5 % better, but two more real shafts, out of focus and with little contrast, are lost.
_NEIGHBOURS = 6


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Contour points of each strip: station and lateral place, full-resolution ideal px."""

    t: Float[Tensor, "b k p"]
    lateral: Float[Tensor, "b k 2 p"]
    valid: Bool[Tensor, "b k 2 p"]
    height: Float[Tensor, "b k 2 p"]
    """Step across the contour along the separating colour, fraction of full scale."""
    blur_px: Float[Tensor, "b k 2"]
    """Standard deviation of the blur of the step."""

    def bend(self, line: LineFit, stretches: int) -> tuple[Float[Tensor, "b k 2 n"], Float[Tensor, "b k n"]]:
        """Mean distance from the line of the points of each of n stretches, and the stretches' stations.

        Points that are astray do not count; NaN where fewer than a quarter of a stretch's points do.
        """
        size = self.t.shape[-1] // stretches
        t = self.t[..., : size * stretches].unflatten(-1, (stretches, size))
        off = self.lateral - line.offset[..., None] - line.slope[..., None] * self.t[:, :, None]
        counts = self.valid & (off.abs() < 4 * line.scatter_px[..., None])
        off, counts = (v[..., : size * stretches].unflatten(-1, (stretches, size)) for v in (off, counts))
        number = counts.sum(-1)
        mean = torch.where(counts, off, 0.0).sum(-1) / number.clamp(min=1)
        return torch.where(number > size // 4, mean, torch.nan), t.mean(-1)


def place_samples(on: Bool[Tensor, "b k s"], t: Float[Tensor, " s"], count: int) -> Float[Tensor, "b k p"]:
    """Stations spread evenly over the stretches that are on."""
    share = on.to(t.dtype).cumsum(-1)
    total = share[..., -1:].clamp(min=1.0)
    target = (torch.arange(count, device=t.device, dtype=t.dtype) + 0.5) / count * total
    after = torch.searchsorted(share.contiguous(), target.contiguous()).clamp(max=t.shape[0] - 1)
    within = target - (share.gather(-1, after) - 1.0)
    return t[after] + (within - 0.5) * (t[1] - t[0])


def at_stations(
    mask: Bool[Tensor, "b k e s"], t: Float[Tensor, " s"], at: Float[Tensor, "b k p"]
) -> Bool[Tensor, "b k e p"]:
    """The value of masks at the nearest station."""
    index = ((at - t[0]) / (t[1] - t[0])).round().long().clamp(0, t.shape[0] - 1)
    return mask.gather(-1, index[:, :, None].expand(-1, -1, mask.shape[2], -1))


def interpolate(values: Float[Tensor, "b k 2 s"], t: Float[Tensor, " s"], at: Float[Tensor, "b k p"]) -> Tensor:
    """Linear interpolation of per-station values, (b, k, 2, p)."""
    place = ((at - t[0]) / (t[1] - t[0])).clamp(0, t.shape[0] - 1.001)[:, :, None].expand(-1, -1, 2, -1)
    low = place.floor().long()
    first, second = values.gather(-1, low), values.gather(-1, low + 1)
    return first + (second - first) * (place - low)


def _read_bands(
    picture: FullPicture,
    strips: Strips,
    t: Float[Tensor, "b k p"],
    lateral: Float[Tensor, "b k 2 p"],
    offsets: Float[Tensor, "b k 2 d"],
) -> tuple[Float[Tensor, "3 b k 2 p d"], Bool[Tensor, "b k 2 p"]]:
    """Colours across each contour, from inside (first) to outside (last), and whether all of it is in the picture."""
    middle = strips.points(t[:, :, None].expand_as(lateral), lateral)
    outward = torch.stack([strips.left, -strips.left], 2)
    return picture.read_across(middle, outward, offsets)


def _project(colours: Float[Tensor, "3 b k 2 p d"], use: Bool[Tensor, "b k 2 p"]) -> Float[Tensor, "b k 2 p d"]:
    """Colours along the direction, unit length, that separates outside from inside of each contour.

    The direction is that of the contrast in the neighbourhood: what lies beside a shaft changes along it, and may be
    darker than the shaft here and lighter there.
    """
    third = colours.shape[-1] // 3
    contrast = (colours[..., -third:].mean(-1) - colours[..., :third].mean(-1)) * use
    reach = contrast.shape[-1] // _NEIGHBOURS
    total = pad(contrast.cumsum(-1), (reach + 1, 0))
    ahead = torch.cat([total[..., 2 * reach + 1 :], total[..., -1:].expand(*total.shape[:-1], reach)], -1)
    direction = ahead - total[..., : contrast.shape[-1]]
    size = direction.square().sum(0).sqrt_().clamp_(min=1e-6)  # in a third of the time of `norm`
    red, green, blue = colours * (direction / size)[..., None]
    return red + green + blue


def steepest(profile: Float[Tensor, "*b d"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Place of the steepest rise, in profile steps from the middle, and the rise of a smoothed profile there."""
    size = profile.shape[-1]
    near, wide = profile[..., 3:-1] - profile[..., 1:-3], profile[..., 4:] - profile[..., :-4]
    slope = torch.add(wide, near, alpha=2) * (1 / 8)
    best = slope.argmax(-1, keepdim=True)
    inner = best.clamp(1, slope.shape[-1] - 2)
    before, here, after = (slope.gather(-1, inner + shift)[..., 0] for shift in (-1, 0, 1))
    bend = (2 * here - before - after).clamp(min=1e-9)
    top = inner[..., 0] + (0.5 * (after - before) / bend).clamp(-0.5, 0.5)
    return top + 2 - (size - 1) / 2, here


def rough(
    picture: FullPicture,
    strips: Strips,
    t: Tensor,
    lateral: Tensor,
    use: Tensor,
    step_px: Float[Tensor, "b k 2"],
) -> EdgePoints:
    """Steepest rise within eight steps of the traced contour; its softness sets the step of `fine`."""
    offsets = torch.arange(-8, 9, device=t.device, dtype=t.dtype) * step_px[..., None]
    colours, seen = _read_bands(picture, strips, t, lateral, offsets)
    seen &= use
    profile = _project(colours, seen)
    place, slope = steepest(profile)
    height = profile[..., -4:].mean(-1) - profile[..., :4].mean(-1)
    outward = t.new_tensor([1.0, -1.0])[:, None]
    blur = masked_median((height / slope.clamp(min=1e-4) / 2.5066).clamp(0.4, 6.0), seen) * step_px
    valid = seen & (slope > 0.25 * masked_median(slope, seen)[..., None]) & (slope > 2e-3)
    return EdgePoints(t, lateral + outward * place * step_px[..., None], valid, height, blur)


def fine(
    picture: FullPicture,
    strips: Strips,
    t: Float[Tensor, "b k p"],
    lateral: Float[Tensor, "b k 2 p"],
    use: Bool[Tensor, "b k 2 p"],
    step_px: Float[Tensor, "b k 2"],
) -> EdgePoints:
    """Place of a blurred step in each profile, by linear least squares around `lateral`."""
    offsets = torch.arange(-6, 7, device=t.device, dtype=t.dtype)
    colours, seen = _read_bands(picture, strips, t, lateral, offsets * step_px[..., None])
    seen &= use
    profile = _project(colours, seen)
    blur = _mean_blur(profile, seen, offsets)
    solve = step_estimator(offsets, blur)[..., 1:3, :]  # (b, k, 2, 2, d)
    height, bell = (profile @ solve.mT).unbind(-1)
    usual = masked_median(height, seen)[..., None]
    shift = -bell / height.clamp(min=1e-3)
    limit = 2.5 * blur[..., None]
    valid = seen & (height > 0.3 * usual) & (height > 5e-3) & (shift.abs() < limit)
    outward = t.new_tensor([1.0, -1.0])[:, None]
    place = lateral + outward * shift.clamp(-limit, limit) * step_px[..., None]
    return EdgePoints(t, place, valid, height, blur * step_px)


def _mean_blur(
    profile: Float[Tensor, "b k 2 p d"], use: Bool[Tensor, "b k 2 p"], offsets: Float[Tensor, " d"]
) -> Float[Tensor, "b k 2"]:
    """Blur, in steps, that explains the mean profile best; from a bank, with a parabola between its members."""
    weight = use[..., None].to(profile.dtype)
    mean = (profile * weight).sum(-2) / weight.sum(-2).clamp(min=1.0)
    bank = offsets.new_tensor(_BLURS)
    columns = step_columns(offsets, bank)  # (n, d, 5)
    explained = columns @ torch.linalg.pinv(columns)  # (n, d, d)
    residual = mean[..., None, :] - (explained @ mean[..., None, :, None])[..., 0]
    misfit = (residual**2).sum(-1)
    best = misfit.argmin(-1, keepdim=True).clamp(1, len(_BLURS) - 2)
    before, here, after = (misfit.gather(-1, best + shift)[..., 0] for shift in (-1, 0, 1))
    shift = (0.5 * (before - after) / (before + after - 2 * here).clamp(min=1e-12)).clamp(-1.0, 1.0)
    log_bank = bank.log()
    low = log_bank[best[..., 0]]
    return (
        low + shift * torch.where(shift > 0, log_bank[best[..., 0] + 1] - low, low - log_bank[best[..., 0] - 1])
    ).exp()
