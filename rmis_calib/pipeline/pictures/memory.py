"""Shafts in consecutive pictures: every n-th is searched from the start, the others only where these say.

What is found depends on the recording alone: it is cut into runs of a fixed number of pictures, each of which is
searched by itself, whatever is under way beside it. A shaft that both neighbours show, alike and near each other, is
looked for between them, where a cubic through four searched pictures puts it (with straight lines, of a video of which
every fourth frame is used, 69 % had to be searched, and not 19). A picture in which one of them is not as it should be
(hidden, gone, jumped, cut away, doubtful) is searched from the start, and so are all pictures between neighbours that
do not agree. Nothing is carried over from picture to picture: a lost shaft is found again in the first that shows it.

What two neighbours agree on is taken to be all that there is. A shaft that comes and goes between them, beside another
that stays, is not seen.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rmis_calib.geometry.lines import line_through_points, point_line_distance
from rmis_calib.io import FrameBatch
from rmis_calib.vision import ShaftDetections, ShaftDetector
from rmis_calib.vision.image.picking import pick_pictures

RUN = 32
"""Pictures: five searches of a run together cost no more each than eight; 32 pictures of 1920 x 1080 are 200 MB."""
# How far one shaft may move from one searched picture to the next: its axis, in widths, its direction (sine), its
# width. Of what moves more the way between is not known.
_SHIFT, _TURN, _WIDTH_RATIO = 2.5, 0.3, 0.7
# How far a shaft may lie off its expected place, and its width be off, in widths. Contours that are expected up to 0.2
# of the width off are measured as from any other start; from 0.3 on, a stripe of glare or a shadow may be found.
_NEAR, _WIDTH_OFF = 0.15, 0.06
# A shaft is as sure as where it was searched for, or as sure as those that are searched for once only.
_SURE, _LESS_SURE = 0.95, 0.05


def in_runs(batches: Iterator[FrameBatch]) -> Iterator[FrameBatch]:
    """The same pictures, `RUN` at a time; the last ones fewer."""
    parts: list[FrameBatch] = []
    waiting = 0
    for batch in batches:
        first = 0
        while first < len(batch.indices):
            part = slice(first, first + RUN - waiting)
            parts.append(FrameBatch(batch.indices[part], batch.images[part]))
            waiting += len(parts[-1].indices)
            first += len(parts[-1].indices)
            if waiting == RUN:
                yield _joined(parts)
                parts, waiting = [], 0
    if waiting:
        yield _joined(parts)


def _joined(parts: list[FrameBatch]) -> FrameBatch:
    if len(parts) == 1:
        return parts[0]
    return FrameBatch(torch.cat([part.indices for part in parts]), torch.cat([part.images for part in parts]))


def detect_run(detector: ShaftDetector, images: Tensor, search_every: int, at_once: int) -> ShaftDetections:
    """Shafts of consecutive pictures, (n, 3, h, w), as `ShaftDetector.detect` finds them in each.

    Args:
        detector: of the camera.
        images: as decoded.
        search_every: pictures from one that is searched from the start to the next, or a little less.
        at_once: most pictures that are searched together.
    """
    places = _searched(len(images), search_every)
    found = _detect(detector, images, places, at_once)
    if len(places) == len(images):
        return found
    empty = {name: value.new_zeros(len(images), *value.shape[1:]) for name, value in vars(found).items()}
    table, device = ShaftDetections(**empty), found.valid.device
    table.put(places.to(device), found)
    left = torch.ones(len(images), dtype=torch.bool)
    left[places] = False
    stretches = _stretches(found, places.to(device))
    if any(len(stretch.between) for stretch in stretches):
        confirmed, looked = _between(detector, images, stretches)
        table.put(confirmed.to(device), looked)
        left[confirmed] = False
    again = left.nonzero()[:, 0]
    if len(again):
        table.put(again.to(device), _detect(detector, images, again, at_once))
    return table


def _between(
    detector: ShaftDetector, images: Tensor, stretches: list["_Stretch"]
) -> tuple[Int64[Tensor, " m"], ShaftDetections]:
    """Places of the pictures that show what their neighbours agree on, and what is in these."""
    place = torch.cat([stretch.between for stretch in stretches])
    expected = torch.cat([stretch.expected() for stretch in stretches])
    if 2 * len(place) < len(images):
        looked = detector.look_near(pick_pictures(images, place), expected)
    else:  # to copy most of them takes longer than to prepare a few more
        everywhere = expected.new_full((len(images), *expected.shape[1:]), torch.nan)
        everywhere[place] = expected
        looked = detector.look_near(images, everywhere).of_frames(place)
    sizes = [len(stretch.between) for stretch in stretches]
    parts = zip(stretches, torch.arange(len(place)).split(sizes), expected.split(sizes), strict=True)
    good = torch.cat([stretch.confirmed(looked.of_frames(rows), lines) for stretch, rows, lines in parts])
    return place[good].cpu(), looked.of_frames(good).surest_first()


def _searched(count: int, search_every: int) -> Int64[Tensor, " a"]:
    """Places in a run of the pictures that are searched from the start: the first, the last, and some between."""
    spans = -(-(count - 1) // search_every)
    return torch.linspace(0, count - 1, spans + 1, dtype=torch.float64).round().long()


def _detect(detector: ShaftDetector, images: Tensor, places: Int64[Tensor, " n"], at_once: int) -> ShaftDetections:
    return ShaftDetections.joined([detector.detect(pick_pictures(images, which)) for which in places.split(at_once)])


@dataclass(frozen=True, eq=False)
class _Stretch:
    """Searched pictures that follow one another and agree: each on the same shafts, of which it says the same."""

    places: Int64[Tensor, " a"]
    """Of the pictures in the run, two at least."""
    found: ShaftDetections
    """What is in them; a shaft has the same rank in all."""
    lines: Float[Tensor, "a k 2 3"]
    """Contours as (a, b, c) with a^2 + b^2 = 1, all the same way round."""

    @property
    def between(self) -> Int64[Tensor, " n"]:
        """Places of the pictures between."""
        place = torch.arange(int(self.places[0]), int(self.places[-1]), device=self.places.device)
        return place[~torch.isin(place, self.places)]

    def expected(self) -> Float[Tensor, "n k 2 3"]:
        """Where the contours should be in the pictures between, as lines; NaN for none."""
        lines = torch.einsum("na,akec->nkec", _weights(self.between, self.places).to(self.lines), self.lines)
        lines = lines / lines[..., :2].norm(dim=-1, keepdim=True)
        return torch.where(self.found.valid[0][:, None, None], lines, torch.nan)

    def confirmed(self, looked: ShaftDetections, expected: Float[Tensor, "n k 2 3"]) -> Bool[Tensor, " n"]:
        """Pictures between in which every shaft is where it was expected, as sure, as wide, and ends alike."""
        points, line = looked.contour_xy, expected[..., None, :]
        forwards, backwards = (point_line_distance(p, line).abs().amax((-2, -1)) for p in (points, points.flip(-3)))
        off = torch.where(self.found.direction_known[0], forwards, torch.minimum(forwards, backwards))
        width, wanted = (_width(lines, points.mean((2, 3))) for lines in (_lines(looked), expected))
        good = looked.valid & (off < _NEAR * width) & ((width - wanted).abs() < _WIDTH_OFF * width)
        after = torch.searchsorted(self.places, self.between)
        sure = torch.minimum(self.found.confidence[after - 1], self.found.confidence[after])
        good &= looked.confidence >= sure.clamp(max=_SURE) - _LESS_SURE
        good &= _says(looked) == _says(self.found)[0]
        return (good | ~self.found.valid[0]).all(1)


def _stretches(found: ShaftDetections, places: Int64[Tensor, " a"]) -> list[_Stretch]:
    """The longest ones, of searched pictures of a run."""
    numbers = torch.arange(len(places), device=places.device)
    first, second = found.of_frames(numbers[:-1]), found.of_frames(numbers[1:])
    same = _alike(first, second)
    once = (~first.valid | (same.sum(2) == 1)).all(1) & (~second.valid | (same.sum(1) == 1)).all(1)
    agree = (once & first.valid.any(1)).tolist()
    partner = same.to(torch.int64).argmax(2)
    stretches = []
    start = 0
    for last in range(1, len(places)):
        if not agree[last - 1]:
            start = last
        elif last == len(agree) or not agree[last]:
            ranks = [torch.arange(found.valid.shape[1], device=places.device)]
            for step in range(start, last):
                ranks.append(partner[step][ranks[-1]])
            rows = numbers[start : last + 1]
            stretches.append(_stretch(found.of_frames(rows), torch.stack(ranks), places[rows]))
    return stretches


def _stretch(found: ShaftDetections, ranks: Int64[Tensor, "a k"], places: Int64[Tensor, " a"]) -> _Stretch:
    rows = torch.arange(len(ranks), device=ranks.device)[:, None]
    ordered = {name: value[rows, ranks] if value.ndim > 1 else value for name, value in vars(found).items()}
    found = ShaftDetections(**ordered)
    lines = _lines(found)
    exchanged = (lines[1:, :, 0, :2] * lines[:-1, :, 0, :2]).sum(-1) < 0
    turned = torch.cat([torch.zeros_like(exchanged[:1]), exchanged]).cumsum(0) % 2 > 0
    return _Stretch(places, found, torch.where(turned[..., None, None], -lines.flip(-2), lines))


def _weights(at: Int64[Tensor, " n"], knots: Int64[Tensor, " a"]) -> Float[Tensor, "n a"]:
    """Of values at the knots for the polynomial through the four nearest, two to either side where there are.

    Source: Lagrange's form of the interpolating polynomial.
    """
    count = min(4, len(knots))
    first = (torch.searchsorted(knots, at) - count // 2).clamp(0, len(knots) - count)
    window = first[:, None] + torch.arange(count, device=at.device)
    near = knots[window].to(torch.float64)  # (n, count)
    share = (at[:, None, None] - near[:, None]) / (near[:, :, None] - near[:, None])
    own = torch.eye(count, dtype=torch.bool, device=at.device)
    weights = near.new_zeros(len(at), len(knots))
    return weights.scatter_(1, window, torch.where(own, 1.0, share).prod(-1))


def _says(found: ShaftDetections) -> Int64[Tensor, "b k"]:
    """What is said of a shaft beyond its lines, as a number: direction, whether and how it ends."""
    kind = torch.where(found.end_valid, found.end_kind, -2)
    return 2 * kind.to(torch.int64) + found.direction_known


def _lines(found: ShaftDetections) -> Float[Tensor, "b k 2 3"]:
    return line_through_points(found.contour_xy[..., 0, :], found.contour_xy[..., 1, :])


def _width(lines: Float[Tensor, "b k 2 3"], at: Float[Tensor, "b k 2"]) -> Float[Tensor, "b k"]:
    """From one contour to the other near a point."""
    return point_line_distance(at[:, :, None], lines).diff(dim=2)[..., 0].abs()


def _alike(first: ShaftDetections, second: ShaftDetections) -> Bool[Tensor, "b i j"]:
    """Whether a shaft of one picture and one of another may be the same, a little later."""
    along = [torch.nn.functional.normalize(d.axis_xy[:, :, 1] - d.axis_xy[:, :, 0], dim=-1) for d in (first, second)]
    middle = [d.contour_xy.mean((2, 3)) for d in (first, second)]
    width = [(d.contour_xy[:, :, 0] - d.contour_xy[:, :, 1]).mean(2).norm(dim=-1) for d in (first, second)]
    here, there = along[0][:, :, None], along[1][:, None]
    step = middle[1][:, None] - middle[0][:, :, None]
    turn = _cross(here, there).abs()
    shift = torch.maximum(_cross(here, step).abs(), _cross(there, step).abs())
    smaller = torch.minimum(width[0][:, :, None], width[1][:, None])
    larger = torch.maximum(width[0][:, :, None], width[1][:, None])
    near = (turn < _TURN) & (shift < _SHIFT * smaller) & (smaller > _WIDTH_RATIO * larger)
    backwards = (here * there).sum(-1) < 0
    said = _says(first)[:, :, None] == _says(second)[:, None]
    both = first.valid[:, :, None] & second.valid[:, None]
    return both & near & said & ~(backwards & first.direction_known[:, :, None])


def _cross(a: Float[Tensor, "*#b 2"], b: Float[Tensor, "*#b 2"]) -> Float[Tensor, "*b"]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
