"""Shafts in consecutive pictures: every n-th is searched from the start, the others only where these say.

What is found depends on the recording alone: it is cut into runs of a fixed number of pictures, each of which is
searched by itself, whatever is under way beside it. A shaft that both neighbours show, alike and near each other, is
looked for between them. A picture in which one of them is not as it should be (hidden, gone, jumped, cut away,
doubtful) is searched from the start, and so are all pictures between neighbours that do not agree. So nothing is
carried over from picture to picture: a lost shaft is found again in the first picture that shows it.

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

RUN = 32
"""Pictures: five searches of a run together cost no more each than eight; 32 pictures of 1920 x 1080 are 200 MB."""
# How far one shaft may move from one searched picture to the next: its axis, in widths, its direction (sine), its
# width. What moves more is looked for nowhere between, as its way there is not known.
_SHIFT, _TURN, _WIDTH_RATIO = 1.5, 0.2, 0.7
# How far a shaft may lie off its expected place, and its width be off, in widths. Contours that are expected up to 0.2
# of the width off are measured as from any other start; from 0.3 on, a stripe of glare or a shadow may be found.
_NEAR, _WIDTH_OFF = 0.15, 0.06
# A shaft is as sure as where it was searched for, or as sure as those that are searched for once only.
_SURE, _LESS_SURE = 0.95, 0.05


def in_runs(batches: Iterator[FrameBatch]) -> Iterator[FrameBatch]:
    """The same pictures, `RUN` at a time; the last ones fewer."""
    indices: list[Tensor] = []
    images: list[Tensor] = []
    waiting = 0
    for batch in batches:
        for first in range(0, len(batch.indices), RUN):
            indices.append(batch.indices[first : first + RUN])
            images.append(batch.images[first : first + RUN])
            waiting += len(indices[-1])
            if waiting >= RUN:
                run = FrameBatch(torch.cat(indices), torch.cat(images))
                yield FrameBatch(run.indices[:RUN], run.images[:RUN])
                indices, images, waiting = [run.indices[RUN:]], [run.images[RUN:]], waiting - RUN
    if waiting:
        yield FrameBatch(torch.cat(indices), torch.cat(images))


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
    fields = {name: value.new_zeros(len(images), *value.shape[1:]) for name, value in vars(found).items()}
    _put(fields, places, found)
    spans = _Spans.between(found, places.to(found.valid.device))
    number, share, frame = spans.frames()
    left = torch.ones(len(images), dtype=torch.bool)
    left[places] = False
    if len(frame):
        looked = detector.look_near(images[frame.to(images.device)], spans.expected(number, share))
        good = spans.confirmed(looked, number, share)
        _put(fields, frame[good].cpu(), looked.of_frames(good).surest_first())
        left[frame[good].cpu()] = False
    again = left.nonzero()[:, 0]
    if len(again):
        _put(fields, again, _detect(detector, images, again, at_once))
    return ShaftDetections(**fields)


def _searched(count: int, search_every: int) -> Int64[Tensor, " a"]:
    """Places in a run of the pictures that are searched from the start: the first, the last, and some between."""
    spans = -(-(count - 1) // search_every)
    return torch.linspace(0, count - 1, spans + 1, dtype=torch.float64).round().long()


def _detect(detector: ShaftDetector, images: Tensor, places: Int64[Tensor, " n"], at_once: int) -> ShaftDetections:
    parts = [vars(detector.detect(images[which.to(images.device)])) for which in places.split(at_once)]
    return ShaftDetections(**{name: torch.cat([part[name] for part in parts]) for name in parts[0]})


def _put(fields: dict[str, Tensor], places: Int64[Tensor, " n"], found: ShaftDetections) -> None:
    for name, value in vars(found).items():
        fields[name][places.to(value.device)] = value


@dataclass(frozen=True, eq=False)
class _Spans:
    """Pictures between two that were searched, and which shafts these agree on: ranks are those of the first."""

    start: Int64[Tensor, " s"]
    end: Int64[Tensor, " s"]
    """Places of both in the run."""
    agree: Bool[Tensor, " s"]
    """Whether both show the same shafts, and say the same of them."""
    shaft: Bool[Tensor, "s k"]
    lines: Float[Tensor, "s 2 k 2 3"]
    """Contours in both pictures, as lines (a, b, c) with a^2 + b^2 = 1."""
    least: Float[Tensor, "s k"]
    """Confidence from which a shaft between is as sure as these."""
    first: ShaftDetections

    @classmethod
    def between(cls, found: ShaftDetections, places: Int64[Tensor, " a"]) -> "_Spans":
        """Spans from each searched picture to the next."""
        numbers = torch.arange(len(places), device=places.device)
        first, second = found.of_frames(numbers[:-1]), found.of_frames(numbers[1:])
        same = _alike(first, second)
        once = (~first.valid | (same.sum(2) == 1)).all(1) & (~second.valid | (same.sum(1) == 1)).all(1)
        partner = same.to(torch.int64).argmax(2)
        rows = torch.arange(len(partner), device=partner.device)[:, None]
        lines, others = _lines(first), _lines(second)[rows, partner]
        turned = ((lines[..., 0, :2] * others[..., 0, :2]).sum(-1) < 0)[..., None, None]
        return cls(
            places[:-1],
            places[1:],
            once & first.valid.any(1),
            first.valid,
            torch.stack([lines, torch.where(turned, -others.flip(-2), others)], 1),
            torch.minimum(first.confidence, second.confidence[rows, partner]).clamp(max=_SURE) - _LESS_SURE,
            first,
        )

    def frames(self) -> tuple[Int64[Tensor, " n"], Float[Tensor, " n"], Int64[Tensor, " n"]]:
        """Of all pictures between agreeing ones: number of the span, share of the way through it, place in the run."""
        place = torch.arange(int(self.end[-1]) + 1, device=self.start.device)
        number = torch.searchsorted(self.end, place).clamp(max=len(self.end) - 1)
        inside = (place > self.start[number]) & (place < self.end[number]) & self.agree[number]
        number, place = number[inside], place[inside]
        share = (place - self.start[number]) / (self.end - self.start)[number]
        return number, share, place

    def expected(self, number: Int64[Tensor, " n"], share: Float[Tensor, " n"]) -> Float[Tensor, "n k 2 3"]:
        """Where the contours should be, as lines; NaN for none."""
        lines = torch.lerp(self.lines[number, 0], self.lines[number, 1], share[:, None, None, None].to(self.lines))
        lines = lines / lines[..., :2].norm(dim=-1, keepdim=True)
        return torch.where(self.shaft[number][..., None, None], lines, torch.nan)

    def confirmed(
        self, looked: ShaftDetections, number: Int64[Tensor, " n"], share: Float[Tensor, " n"]
    ) -> Bool[Tensor, " n"]:
        """Pictures in which every shaft is where it was expected, as sure, as wide, and ends alike."""
        expected = self.expected(number, share)[..., None, :]  # (n, k, edge, 1, 3)
        points = looked.contour_xy
        forwards, backwards = (point_line_distance(p, expected).abs().amax((-2, -1)) for p in (points, points.flip(-3)))
        known = self.first.direction_known[number]
        off = torch.where(known, forwards, torch.minimum(forwards, backwards))
        width, wanted = (_width(lines, points.mean((2, 3))) for lines in (_lines(looked), expected[..., 0, :]))
        good = looked.valid & (off < _NEAR * width) & ((width - wanted).abs() < _WIDTH_OFF * width)
        good &= looked.confidence >= self.least[number]
        good &= _says(looked) == _says(self.first)[number]
        return (good | ~self.shaft[number]).all(1)


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
