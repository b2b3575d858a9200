"""Signed residuals over the picture, the time and the joints, coloured by group of neighbouring motions."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rmis_calib.report.charts.panel import BOTTOM, LEFT, TOP, Chart, Path, PictureArea, Scale, dots, range_of, strokes
from rmis_calib.report.charts.signed import KINDS, ResidualEvidence, SignedResiduals

COLOURS = 8
"""Colours of groups; more groups begin again."""
# Points of a chart up to here; beyond, every k-th with the largest ones, so that a page of a million motions stays one.
_MOST_POINTS, _ALWAYS = 600, 60
_SCALES_SHOWN = 6.0
"""Residuals beyond this many robust scales are drawn at the edge instead of flattening the rest."""
_NORMAL_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute value
_STICK = 0.04
"""Length of a residual of one robust scale in the picture's chart, in picture widths."""
_PICTURE_WIDTH, _OVER_TIME, _OVER_JOINT = 260.0, (500.0, 230.0), (300.0, 150.0)


@dataclass(frozen=True)
class ResidualFigure:
    """One kind of residual, drawn.

    Attributes:
        kind: key of `KINDS`.
        title: what it is; meaning: of a positive one.
        over_picture: a chart a camera; over_time; over_joints: one for each joint that moved.
        mean_px: of the used ones, with its sign; mean_sigma_px: of that mean, as if they were independent.
        scale_px: robust scale of the used ones.
        enlarged: how many times longer than true the sticks in the pictures are.
        beyond: residuals outside of the drawn range; drawn, total: of how many points how many.
    """

    kind: str
    title: str
    meaning: str
    over_picture: tuple[Chart, ...]
    over_time: Chart
    over_joints: tuple[Chart, ...]
    mean_px: float
    mean_sigma_px: float
    scale_px: float
    enlarged: float
    beyond: int
    drawn: int
    total: int


def residual_figures(evidence: ResidualEvidence | None) -> tuple[ResidualFigure, ...]:
    """A figure for each kind of residual."""
    return () if evidence is None else tuple(_figure(kind, evidence) for kind in evidence.kinds)


def robust_scale(px: Float[np.ndarray, " n"]) -> float:
    """1.4826 x the median absolute residual."""
    return _NORMAL_MAD * float(np.median(np.abs(px)))


def drawn_points(px: Float[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
    """Which residuals are drawn: all, or every k-th and the largest."""
    if len(px) <= _MOST_POINTS:
        return np.arange(len(px))
    regular = np.arange(0, len(px), -(-len(px) // (_MOST_POINTS - _ALWAYS)))
    return np.union1d(regular, np.argsort(-np.abs(px))[:_ALWAYS])


def _figure(residual: SignedResiduals, evidence: ResidualEvidence) -> ResidualFigure:
    counted = residual.px[residual.used] if residual.used.any() else residual.px
    scale = robust_scale(counted)
    largest = float(np.abs(counted).max())
    limit = (min(1.05 * largest, _SCALES_SHOWN * scale) if scale > 0.0 else 1.05 * largest) or 1.0
    shown = residual.at(drawn_points(residual.px))
    enlarged = rounded_factor(_STICK * evidence.picture_size[1] / max(scale, 1e-9))
    title, meaning = KINDS[residual.kind]
    times_s = evidence.times_s[shown.motion]
    by_time = bool(np.isfinite(times_s).all()) and len(shown.px) > 1 and float(np.ptp(times_s)) > 0.0
    over = (times_s, "time, s") if by_time else (shown.motion.astype(float), "frame")
    return ResidualFigure(
        kind=residual.kind,
        title=title,
        meaning=meaning,
        over_picture=tuple(
            _over_picture(
                shown.at(np.flatnonzero(shown.is_left == side)), evidence.picture_size, limit, enlarged, title
            )
            for side in (False, True)
            if (shown.is_left == side).any()
        ),
        over_time=_over(*over, shown, limit, _OVER_TIME, title),
        over_joints=tuple(
            _over(readings[shown.motion], label, shown, limit, _OVER_JOINT, title)
            for label, readings in evidence.joints.items()
        ),
        mean_px=float(counted.mean()),
        mean_sigma_px=float(counted.std() / max(1.0, np.sqrt(len(counted)))),
        scale_px=scale,
        enlarged=enlarged,
        beyond=int((np.abs(residual.px) > limit).sum()),
        drawn=len(shown.px),
        total=len(residual.px),
    )


def rounded_factor(factor: float) -> float:
    """The next smaller of 1, 2, 5, 10, 20, ... or, below 1, of 0.5, 0.2, 0.1, ..."""
    power = 10.0 ** np.floor(np.log10(max(factor, 1e-6)))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * power <= factor * (1 + 1e-9)) * power)


def _over_picture(
    shown: SignedResiduals, size: tuple[int, int], limit: float, enlarged: float, title: str
) -> Chart:  # fmt: skip
    """Each residual as a stick where it was measured, across or along the shaft, in the direction of its sign."""
    area = PictureArea(size, _PICTURE_WIDTH)
    start = area.places(shown.uv)
    end = start + shown.px.clip(-limit, limit)[:, None] * enlarged * area.scale * shown.across_uv
    side = "left" if shown.is_left.any() else "right"
    paths = []
    for name, which in _groups(shown):
        paths += [Path(f"stick {name}", strokes(start[which], end[which])), Path(f"foot {name}", dots(*start[which].T))]
    words = f"{title} over the {side} picture: sticks {enlarged:g} times as long as the residuals"
    return area.chart(words, f"{side} picture, × {enlarged:g}", paths)


def _over(
    values: Float[np.ndarray, " n"],
    label: str,
    shown: SignedResiduals,
    limit: float,
    size: tuple[float, float],
    title: str,
) -> Chart:
    """Residuals over one quantity: discs of the right camera, squares of the left; hollow where not used."""
    width, height = size
    box = (LEFT, TOP, width - 4.0, height - BOTTOM)
    across = Scale(*range_of(values), box[0] + 4.0, box[2] - 4.0)
    up = Scale(-1.12 * limit, 1.12 * limit, box[3], box[1])
    x, y = across(values), up(shown.px.clip(-limit, limit))
    outside = np.abs(shown.px) > limit
    paths = []
    for name, group in _groups(shown):
        for side, shape in ((False, "disc"), (True, "square")):
            for used in (True, False):
                which = group & (shown.is_left == side) & (shown.used == used)
                if which.any():
                    paths.append(Path(f"dot {shape} {name}", dots(x[which], y[which])))
                    if not used:
                        paths.append(Path(f"hole {shape}", dots(x[which], y[which])))
    if outside.any():
        paths.append(Path("beyond", _arrows(x[outside], y[outside], np.sign(shown.px[outside]))))
    return Chart(
        words=f"{title} over {label}",
        width=width,
        height=height,
        box=box,
        title="",
        label=label,
        x_ticks=across.ticks(5 if width > 400 else 3),
        y_ticks=up.ticks(4),
        zero=up.at(0.0),
        framed=False,
        paths=tuple(paths),
    )


def _groups(shown: SignedResiduals) -> list[tuple[str, np.ndarray]]:
    """Class and members of each group that is there."""
    numbers = np.where(shown.group < 0, -1, shown.group % COLOURS)
    return [(f"group-{number}" if number >= 0 else "group-none", numbers == number) for number in np.unique(numbers)]


def _arrows(x: np.ndarray, y: np.ndarray, sign: np.ndarray) -> str:
    """Small arrows upwards (+) and downwards (-) at the edge, beyond which a residual lies."""
    return "".join(
        f"M{a - 3:.1f} {b + 4 * s:.1f}l3 {-4 * s:.0f}l3 {4 * s:.0f}" for a, b, s in zip(x, y, sign, strict=True)
    )
