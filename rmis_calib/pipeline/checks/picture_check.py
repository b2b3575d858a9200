"""Whether the pictures show the shaft where the answer predicts it: a summary, and what speaks against the answer.

Pictures scatter about the prediction by what the kinematics are off in each motion; a right answer leaves that scatter
a mean of zero, all along the shaft and all over the picture.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.answer.view_edges import ViewEdges
from rmis_calib.pipeline.checks.picture_edges import picture_edges
from rmis_calib.results import STATUS_SENTENCES, PictureCheck, PictureView

TOLERANCE_PX = 0.3
"""What an edge detector and a lens model may be off by, px in pictures up to 1000 px wide, and in proportion beyond."""
WIDE_TOLERANCE_PX = 0.5
"""The same of how far contours lie outside of their prediction: under strong glare edges of rendered shafts lie 0.35 px
outside of the true ones."""
SIGMAS = 4.0
"""Of a median, beyond the tolerance, from which it is no chance: some fifty are looked at."""
LEAST_SHARE = 0.25
"""Share of the stations below which no shaft is where it is predicted. Tissue shows an edge at a third of them, too,
but here and there: less than a tenth are in line."""
MOST_SPREAD_PX, MOST_SPREAD = 4.0, 4.0
"""Spread of the edges about the contours that is no noise of kinematics: px as `TOLERANCE_PX`, and in that of the
contours that were measured."""
IN_LINE_PX = 2.0
"""Of the median of a contour, px as `TOLERANCE_PX`: an edge that is in line with the others."""
LEAST_MOTIONS = 8
"""Fewest motions of which a median is judged."""
PLACES = (3, 4)
"""Rows and columns of the table over the picture."""
_NORMAL_MAD, _MEDIAN_OVER_MEAN = 1.4826, 1.2533
"""Standard deviation of a normal distribution over its median absolute deviation, and of the median over the mean's."""
_LEAST_GROUPS = 4


def with_picture_check(run: CalibrationRun, own_masks: bool = False) -> CalibrationRun:
    """The run with what its pictures show along the predicted contours; an answer that they contradict is not "ok".

    Args:
        run: to look at.
        own_masks: whether masks told the shaft: it need not be dark then.
    """
    if run.result.camera_right_T_arm is None:
        return run
    if own_masks:
        about = "not looked at: with masks of your own a shaft need not be dark"
        return replace(run, result=replace(run.result, picture=PictureCheck(None, (about,), {})))
    edges = picture_edges(run)
    check = picture_check(run, edges)
    result = replace(run.result, picture=check)
    if check.passed is False and result.trustworthy:
        message = f"{STATUS_SENTENCES['weak']}: the pictures contradict it: {'; '.join(check.sentences)}"
        result = replace(result, status="weak", message=message)
    return replace(run, result=result, picture_edges=edges)


def picture_check(run: CalibrationRun, edges: tuple[ViewEdges, ...]) -> PictureCheck:
    """The summary of all views of a run, from the edges in each."""
    views, doubts, judged, sizes = {}, [], False, {view.side: view.source.size for view in run.views}
    for found in edges:
        size = sizes[found.side]
        views[found.side] = view = _summary(found, size)
        if len(found.motions) >= LEAST_MOTIONS:
            judged = True
            measured = run.result.residuals.get(f"contour_{found.side}")
            noise_px = 0.0 if measured is None else _NORMAL_MAD * (measured.median or 0.0)
            said = _without_shaft(view, noise_px, size) or _doubts(found, run.groups[found.motions], size)
            doubts += [f"camera_{found.side}: {doubt}" for doubt in said]
    if not judged:
        return PictureCheck(None, (f"not judged: fewer than {LEAST_MOTIONS} used motions",), views)
    return PictureCheck(not doubts, tuple(doubts), views)


def _summary(found: ViewEdges, size: tuple[int, int]) -> PictureView:
    middle = _median(found.px.reshape(-1, 1))[0]
    of_contour = _median(found.px.reshape(-1, found.px.shape[-1]).T).reshape(*found.px.shape[:2], 1)
    in_line = np.abs(found.px - of_contour) < IN_LINE_PX * _scale(size)
    k1, k1_sigma = lens_error(found)
    return PictureView(
        motions=len(found.motions),
        stations=found.px.size,
        edge_share=float(in_line.mean()),
        median_px=middle,
        spread_px=_NORMAL_MAD * _median(np.abs(found.px.reshape(-1, 1) - middle))[0],
        right_px=_median(_of_motions(found.right_px))[0],
        outward_px=_median(_of_motions(found.outward_px))[0],
        along_right_px=_median(found.right_px),
        along_outward_px=_median(found.outward_px),
        bend_px=_median(bend(found.right_px)),
        lens_k1=k1 if np.isfinite(k1_sigma) else None,
        lens_k1_sigma=k1_sigma,
        by_place_right_px=tuple(np.split(_median(_by_place(found, size)), PLACES[0])),
    )


def _without_shaft(view: PictureView, noise_px: float, size: tuple[int, int]) -> list[str]:
    """Whether the pictures show no shaft there at all, in words."""
    if view.edge_share < LEAST_SHARE:
        share = f"edges in line at {100 * view.edge_share:.0f} % of the places along the predicted contours"
        return [f"the pictures show {share}: no shaft is where the answer predicts one"]
    if (view.spread_px or 0.0) > max(MOST_SPREAD_PX * _scale(size), MOST_SPREAD * noise_px):
        return [f"edges scatter by {view.spread_px:.1f} px about the predicted contours: they are not the shaft's"]
    return []


def _doubts(found: ViewEdges, group: Int[np.ndarray, " m"], size: tuple[int, int]) -> list[str]:
    """What speaks against the answer, in words, the plainest first."""
    scale, both = _scale(size), np.array([TOLERANCE_PX, WIDE_TOLERANCE_PX])
    over_all, along, wide, place, bent = (
        _beyond(values, group, tolerance * scale)
        for values, tolerance in (
            (np.concatenate([_of_motions(found.right_px), _of_motions(found.outward_px)], axis=1), both),
            (found.right_px, TOLERANCE_PX),
            (found.outward_px[:, :-1], WIDE_TOLERANCE_PX),  # a ring or a sleeve closes the tube
            (_by_place(found, size), TOLERANCE_PX),
            (bend(found.right_px), TOLERANCE_PX),
        )
    )
    doubts = []
    if over_all[0]:
        side = "right" if over_all[0] > 0 else "left"
        doubts.append(f"the shaft lies {abs(over_all[0]):.2f} px to the {side} of its prediction")
    if over_all[1] or wide.any():
        most = over_all[1] or wide[np.abs(wide).argmax()]
        where = "outside" if most > 0 else "inside"
        part = "" if over_all[1] else " along a part of it"
        causes = "its diameter or distance, focal length or lens"
        doubts.append(f"the shaft's contours lie {abs(most):.2f} px {where} of their prediction{part} ({causes})")
    if not over_all[0] and along.any():
        doubts.append(f"the shaft leaves its prediction along it by {np.abs(along).max():.2f} px")
    if not over_all[0] and place.any():
        where = f"by {np.abs(place).max():.2f} px in one part of the picture"
        doubts.append(f"the shaft lies beside its prediction {where} (focal length, crop or lens)")
    k1, sigma = lens_error(found)
    most_px = abs(k1) * np.nanmax(np.abs(bend(found.of_k1_px)), initial=0.0)
    if abs(k1) > SIGMAS * sigma and most_px > TOLERANCE_PX * scale:
        bends = f"contours are bent by up to {most_px:.2f} px, by where they lie"
        doubts.append(f"{bends}: as if k1 of the lens were off by {k1:+.2f}, or the shaft bent")
    elif bent.any():
        doubts.append(f"the shaft leaves a straight line by {np.abs(bent).max():.2f} px (bent, or the lens)")
    return doubts


def lens_error(found: ViewEdges) -> tuple[float, float]:
    """k1 that the bend of the contours asks for beside the camera's, and its 1 sigma from the scatter of the motions.

    A radial distortion bends lines towards or away from the middle of the picture, the more the farther they pass from
    it; neither the kinematics nor the answer can.
    """
    G, y = bend(found.of_k1_px), bend(found.right_px)
    known = np.isfinite(G) & np.isfinite(y)
    G, y = np.where(known, G, 0.0), np.where(known, y, 0.0)
    total = float((G * G).sum())
    if not total:
        return 0.0, np.inf
    k1 = float((G * y).sum()) / total
    score = (G * (y - k1 * G)).sum(1)
    count = int(known.any(1).sum())
    return k1, float(np.sqrt((score**2).sum() * count / max(count - 1, 1))) / total


def _scale(size: tuple[int, int]) -> float:
    """How many times wider than 1000 px pictures are."""
    return max(1.0, size[1] / 1000.0)


def bend(px: Float[np.ndarray, "m b"]) -> Float[np.ndarray, "m b"]:
    """What a straight line along the shaft leaves of each motion; NaN where fewer than four stretches are known."""
    x = np.broadcast_to(np.arange(px.shape[1], dtype=float), px.shape)
    weight = np.isfinite(px).astype(float)
    y = np.nan_to_num(px)
    total = np.maximum(weight.sum(1, keepdims=True), 1.0)
    x = x - (weight * x).sum(1, keepdims=True) / total
    y = y - (weight * y).sum(1, keepdims=True) / total
    slope = (weight * x * y).sum(1, keepdims=True) / np.maximum((weight * x * x).sum(1, keepdims=True), 1e-9)
    return np.where((weight > 0) & (weight.sum(1, keepdims=True) >= 4), y - slope * x, np.nan)


def _of_motions(px: Float[np.ndarray, "m b"]) -> Float[np.ndarray, "m 1"]:
    """The median of each motion."""
    return _median(px.T)[:, None]


def _by_place(found: ViewEdges, size: tuple[int, int]) -> Float[np.ndarray, "m k"]:
    """The median of `right_px` of each motion in each part of the picture, row by row; NaN for none."""
    rows, columns = PLACES
    height, width = size
    with np.errstate(invalid="ignore"):
        row = np.floor((found.stretch_uv[..., 1] + 0.5) / height * rows)
        column = np.floor((found.stretch_uv[..., 0] + 0.5) / width * columns)
    cells = [np.where((row == r) & (column == c), found.right_px, np.nan) for r in range(rows) for c in range(columns)]
    return np.concatenate([_of_motions(cell) for cell in cells], axis=1)


def _beyond(
    values: Float[np.ndarray, "m k"], group: Int[np.ndarray, " m"], tolerance_px: float | Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Medians over motions that neither the tolerance nor chance explains; 0 for the others.

    Chance is what the scatter of the motions, and that of groups of neighbours, which share errors, leave to a median.
    """
    count = np.isfinite(values).sum(0)
    middle = _median(values)
    scatter = _NORMAL_MAD * _median(np.abs(values - middle))
    sigma = _MEDIAN_OVER_MEAN * scatter / np.sqrt(np.maximum(count, 1))
    of_groups = np.stack([_median(values[group == g]) for g in np.unique(group)])
    groups = np.isfinite(of_groups).sum(0)
    with np.errstate(invalid="ignore"):
        away = np.nansum((of_groups - middle) ** 2, axis=0) / np.maximum(groups - 1, 1) / np.maximum(groups, 1)
    sigma = np.where(groups >= _LEAST_GROUPS, np.maximum(sigma, np.sqrt(away)), sigma)
    told = (count >= LEAST_MOTIONS) & (np.abs(middle) > tolerance_px + SIGMAS * sigma)
    return np.where(told, middle, 0.0)


def _median(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " k"]:
    """Median of each column without NaN; NaN for none."""
    known = np.isfinite(values).any(0)
    return np.where(known, np.nanmedian(np.where(known, values, 0.0), axis=0), np.nan)
