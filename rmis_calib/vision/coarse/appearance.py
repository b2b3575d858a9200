"""How unlike a dark neutral shaft each pixel of the small picture is, and where the picture ends.

No colour is hard-wired. A shaft is darker than what lies beside it, or less tinted with the scene's own colour (red
tissue, pink phantom, olive bench), or both; the scene's colour is taken from the picture. Both cues are ratios to the
brightness, so that the same step counts as much in a corner without light as in the middle.
"""

import torch
from jaxtyping import Bool, Float
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import interpolate

# Below this brightness (fraction of full scale) ratios drown in sensor noise.
_TONE_FLOOR = 0.06
# Weight of the tint against log brightness: slate-grey shafts on dark liver are up to 0.2 brighter in log brightness
# and 0.3 less tinted, so the tint must weigh at least 1; at 2 both real sets separate (tests/benchmarks).
_TINT_WEIGHT = 2.0
_LIT_TINT_WEIGHT = 3.0
# Below the scene's median log brightness: a cavity's depth gets a third of the light of tissue, and less.
_CAVITY_DARKER = 1.0
_BORDER_ROWS = 24
# Columns that stand for "no border here" before and after the hull: chords to the first lie beyond the second.
_ABSENT, _NOWHERE = 1e9, 1e6
_BLUR_PX = 1.4


def opponent_colours(rgb: Float[Tensor, "b 3 h w"]) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
    """Red against green and yellow against blue, over brightness, because noise in a dark shaft must not look like a
    tint.

    Written out rather than taken from kornia's colour spaces: of 108 labelled shafts 99 are found, and 2 places falsely
    so; with its YUV 99 and 6, YCbCr 97 and 4, Lab 91 and 1 (tests/benchmarks/bench_vision_colour.py).
    """
    red, green, blue = rgb.unbind(1)
    # In place wherever it can be: a batch's fresh pages cost more than its sums.
    value = rgb.amax(1).add_(_TONE_FLOOR)
    return (red - green).div_(value), (red + green).mul_(0.5).sub_(blue).div_(value)


def scene_tint(rgb: Float[Tensor, "b 3 h w"], seen: Bool[Tensor, "b h w"]) -> Float[Tensor, "b h w"]:
    """How much of the scene's own colour a pixel has: 0 for grey, up to about 1; half of the chroma for other hues."""
    warm, yellow = opponent_colours(rgb)
    weight = seen.to(rgb.dtype)
    total = weight.sum((1, 2)).clamp(min=1.0)
    mean_warm, mean_yellow = (warm * weight).sum((1, 2)) / total, (yellow * weight).sum((1, 2)) / total
    size = torch.sqrt(mean_warm.square() + mean_yellow.square()).clamp(min=1e-3)
    along = warm * (mean_warm / size)[:, None, None]
    along.addcmul_(yellow, (mean_yellow / size)[:, None, None])
    chroma = warm.mul_(warm).addcmul_(yellow, yellow).sqrt_()
    return chroma.add_(along).mul_(0.5)


def shaft_contrast(
    rgb: Float[Tensor, "b 3 h w"], seen: Bool[Tensor, "b h w"], count: int = 2
) -> tuple[Float[Tensor, "b views h w"], Float[Tensor, "b h w"]]:
    """One view or two of the picture, low on a shaft and higher beside it.

    The dark view, log brightness plus the scene's tint, is low on dark neutral shafts; a step of 0.1 is a tenth in
    brightness. The lit view is low on neutral shafts of any brightness, and high where it is too dark for a shaft in
    this light: a shaft with a stripe of glare, or before a cavity, has no steady contours in the dark view.

    Returns:
        `count` views, and log brightness alone, all smoothed.
    """
    tone, tint = smooth(torch.cat([rgb.amax(1).add_(_TONE_FLOOR).log_(), scene_tint(rgb, seen)])).chunk(2)
    dark = tone + _TINT_WEIGHT * tint
    if count == 1:
        return dark[:, None], tone
    usual = torch.where(seen, tone, torch.nan)[:, ::4, ::4].flatten(1).nanmedian(1).values
    cavity = (torch.nan_to_num(usual)[:, None, None] - _CAVITY_DARKER - tone).clamp_(min=0.0)
    return torch.stack([dark, cavity.add_(tint, alpha=_LIT_TINT_WEIGHT)], 1), tone


def weighted_tint(
    unlike: Float[Tensor, "b k *s"], tone: Float[Tensor, "b k *s"], lit: Bool[Tensor, "b k"]
) -> Float[Tensor, "b k *s"]:
    """The tint as it enters the dark view, read back from either view (from the lit one only where it is no cavity)."""
    lit = lit.reshape(*lit.shape, *[1] * (unlike.ndim - 2))
    return torch.where(lit, unlike * (_TINT_WEIGHT / _LIT_TINT_WEIGHT), unlike - tone)


def smooth(picture: Float[Tensor, "b h w"]) -> Float[Tensor, "b h w"]:
    """Gaussian blur of 1.4 px, the borders continued.

    Pictures go as channels of one: as a batch of single channels the same blur takes several times as long on a CPU.
    """
    channels = picture.expand(max(2, len(picture)), -1, -1)  # one channel alone goes another way, and is rounded so
    return gaussian_blur2d(channels[None], (9, 9), (_BLUR_PX, _BLUR_PX), border_type="replicate")[0, : len(picture)]


def field_of_view(
    rgb: Float[Tensor, "b 3 h w"], black_level: float, margin: int
) -> tuple[Bool[Tensor, "b h w"], Bool[Tensor, "b h w"]]:
    """The convex part of the picture that light reaches: without black borders and outside of a round field of view.

    Per row, black pixels are cut from the left and from the right; the cuts are then made convex, so that a black shaft
    that enters from the border does not bend the border.

    Returns:
        the field, and the field without a rim of `margin` pixels along black borders.
    """
    height, width = rgb.shape[-2:]
    lit = (rgb.amax(1) > black_level).to(torch.float32)
    columns = torch.arange(width, device=rgb.device, dtype=torch.float32)
    first = width - (lit * (width - columns)).amax(-1)
    last = (lit * (columns + 1)).amax(-1) - 1
    rows = torch.arange(height, device=rgb.device)
    empty = lit.sum(-1) < 0.25 * width  # a row that only an interlaced or half-black line reaches is no picture
    top = torch.where(empty, height, rows).amin(-1)
    bottom = torch.where(empty, -1, rows).amax(-1)
    cuts = torch.where(empty, torch.inf, torch.stack([first, -last]))
    left, right = _convex(cuts.flatten(0, 1)).unflatten(0, (2, -1)).unbind(0)
    right = -right
    field = []
    for rim in (0, margin):
        # Half of the rim along the border of the picture itself: its last rows may be half black.
        low, high = left + rim * (0.5 + 0.5 * (left > 0)), right - rim * (0.5 + 0.5 * (right < width - 1))
        first_row, last_row = top + rim * (0.5 + 0.5 * (top > 0)), bottom - rim * (0.5 + 0.5 * (bottom < height - 1))
        down = (rows >= first_row[:, None]) & (rows <= last_row[:, None])
        low = torch.where(down, low, torch.inf)
        field.append((columns >= low[..., None]) & (columns <= high[..., None]))
    return field[0], field[1]


def _convex(extent: Float[Tensor, "b h"]) -> Float[Tensor, "b h"]:
    """Largest convex function below `extent`, on a coarse grid of rows; infinite rows count as absent."""
    height = extent.shape[1]
    rows = torch.linspace(0, height - 1, _BORDER_ROWS, device=extent.device).round().long()
    # A column cut by noise in one row must not open the field: the median of three neighbours.
    padded = torch.cat([extent[:, :1], extent, extent[:, -1:]], 1)
    steady = padded.unfold(1, 3, 1)[:, rows].median(-1).values.clamp(max=_ABSENT)
    # Every chord between two rows, at all rows between them.
    first, last = torch.triu_indices(_BORDER_ROWS, _BORDER_ROWS, device=extent.device)
    y = rows.to(extent.dtype)
    a, b = y[first, None], y[last, None]
    share = ((y - a) / (b - a).clamp(min=1e-6)).clamp(0.0, 1.0)
    beyond = torch.where((y >= a) & (y <= b), 0.0, torch.inf)
    chord = (steady[:, first, None] * (1 - share)).add_(steady[:, last, None] * share).add_(beyond)
    hull = chord.amin(1).clamp(max=_NOWHERE)
    return interpolate(hull[:, None], size=height, mode="linear", align_corners=True)[:, 0]
