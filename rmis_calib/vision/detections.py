"""What the detector says of a batch of pictures, and how two looks at the same picture become one answer."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

# Score, as a fraction of the picture's width, from which a strip may be a shaft that this view does not show well: in
# pictures of the plain presets what lies beside the shafts scores less in nine of ten, in `hard` missed shafts do not.
_LEAD = 0.04
CLOSED_CONFIDENCE = 0.45
"""Most of a dark thing that something brighter closes before the border: tape, a square; or tissue over a shaft. Beside
a sure shaft it is not worth a second look, which found nothing more in `brutal` and the real frames."""


class FrameReason(IntEnum):
    """Outcome of one frame; `sentence` is what a report prints."""

    OK = 0
    BAD_PIXELS = 1
    NO_PICTURE = 2
    NO_STRAIGHT_EDGES = 3
    NOT_A_CYLINDER = 4
    TOO_SHORT = 5
    EDGES_UNCLEAR = 6
    AMBIGUOUS = 7
    LEFT_OUT = 8
    REPEATED = 9
    BACKGROUND = 10

    @property
    def sentence(self) -> str:
        """The reason in words."""
        return _SENTENCES[self]


_SENTENCES = {
    FrameReason.OK: "a shaft was found",
    FrameReason.BAD_PIXELS: "the frame has values that are not finite numbers",
    FrameReason.NO_PICTURE: "the frame is black, white or uniform",
    FrameReason.NO_STRAIGHT_EDGES: "no straight edges stand out",
    FrameReason.NOT_A_CYLINDER: "no two edges enclose a strip that differs from both sides, as a shaft does",
    FrameReason.TOO_SHORT: "what looks like a shaft is too short, or never reaches the border of the picture",
    FrameReason.EDGES_UNCLEAR: "too few sub-pixel edge points agree on two straight lines",
    FrameReason.AMBIGUOUS: "a strip was found, but its confidence is below the accepted minimum",
    FrameReason.LEFT_OUT: "the frame was left out: only every n-th was to be searched",
    FrameReason.BACKGROUND: "what looked like a shaft stood still while the instrument moved",
    FrameReason.REPEATED: "the picture repeats the one before although the joints moved",
}


class EndKind(IntEnum):
    """What a shaft ends at in the picture."""

    UNKNOWN = -1
    TUBE = 0
    """Where the dark tube stops and something else begins, such as a metal wrist."""
    RING = 1
    """The near rim of a ring that closes the tube."""
    BORDER = 2
    """Nothing: it leaves the field of view."""
    HIDDEN = 3
    """Nothing: something else covers it."""


@dataclass(frozen=True, eq=False)
class ShaftDetections:
    """Up to k shafts a frame, best first.

    Convention: normalised undistorted coordinates (x/z, y/z); without a camera they are pixels. Edge 0 is left of the
    axis, directed in the picture from the RCM side to the tip; points run in that direction. Where `valid` is
    false everything else is NaN or false.
    """

    valid: Bool[Tensor, "b k"]
    reason: Int[Tensor, " b"]
    """`FrameReason` of each frame."""
    contour_xy: Float[Tensor, "b k 2 2 2"]
    """[edge, point, xy]: two points a contour, one rms spread of its samples before and behind their centre."""
    contour_sigma: Float[Tensor, "b k 2"]
    """Standard deviation of either point of a contour across it; the errors of the two points are uncorrelated."""
    axis_xy: Float[Tensor, "b k 2 2"]
    """Two points of the projected axis: the bisector of the contour planes (the midline without a camera)."""
    axis_sigma: Float[Tensor, "b k"]
    end_xy: Float[Tensor, "b k 2"]
    """Projection of the point of the axis at which the shaft ends."""
    end_sigma: Float[Tensor, "b k"]
    """Standard deviation along the axis."""
    end_valid: Bool[Tensor, "b k"]
    """Whether the end is in view and was measured."""
    end_kind: Int[Tensor, "b k"]
    """`EndKind` of what is most probable."""
    end_sureness: Float[Tensor, "b k"]
    """Probability of that kind of end; of a tube's end or a ring, that it is near where it was measured."""
    direction_known: Bool[Tensor, "b k"]
    """Whether it is certain which side the tip is on."""
    confidence: Float[Tensor, "b k"]
    contour_uv: Float[Tensor, "b k 2 p 2"]
    """Contours as raw-pixel polylines from the border to the shaft's end, for pictures."""
    end_uv: Float[Tensor, "b k 2"]
    """The boundary as it was seen, raw pixels."""
    scatter_px: Float[Tensor, "b k 2"]
    """Robust standard deviation of one contour point about its line, px."""
    straight_px: Float[Tensor, "b k 2 n"]
    """Mean distance of the contour points of n stretches of each contour from its line, px, positive to the left of who
    walks towards the tip; NaN where there are few."""
    straight_uv: Float[Tensor, "b k 2 n 2"]
    """Where these stretches lie, raw pixels."""
    blur_px: Float[Tensor, "b k 2"]
    """Standard deviation of the blur of each contour, px."""

    def of_frames(self, which: Bool[Tensor, " b"] | Int[Tensor, " m"]) -> "ShaftDetections":
        """Those of the frames in the mask, or of these numbers."""
        return ShaftDetections(**{name: value[which] for name, value in vars(self).items()})

    def put(self, which: Bool[Tensor, " b"] | Int[Tensor, " m"], found: "ShaftDetections") -> None:
        """Write what was found into the frames in the mask, or of these numbers, in place of what is there."""
        for name, value in vars(self).items():
            value[which] = getattr(found, name)

    @classmethod
    def joined(cls, parts: Sequence["ShaftDetections"]) -> "ShaftDetections":
        """Frames of several batches, one after the other."""
        return cls(**{name: torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])})

    def surest_first(self) -> "ShaftDetections":
        """The same with the candidates of each frame in the order of their confidence."""
        order = torch.where(self.valid, self.confidence, -1.0).sort(dim=1, descending=True, stable=True).indices
        rows = torch.arange(order.shape[0], device=order.device)[:, None]
        return replace(self, **{name: value[rows, order] for name, value in vars(self).items() if value.ndim > 1})


def needs_second_pass(found: ShaftDetections, leads: Float[Tensor, "b k"], sure: float) -> Bool[Tensor, " b"]:
    """Pictures without a sure shaft, with a doubtful one, or with more that looks like one.

    Args:
        found: in one view.
        leads: scores of the strips that were measured, the best first, as fractions of the picture's width.
        sure: least confidence of a sure shaft.
    """
    is_sure = found.valid & (found.confidence >= sure)
    count = is_sure.sum(1, keepdim=True)
    beyond = torch.arange(leads.shape[1], device=leads.device) >= count
    doubtful = found.valid & ~is_sure & (found.confidence > CLOSED_CONFIDENCE)
    return (count[:, 0] == 0) | doubtful.any(1) | (beyond & (leads > _LEAD)).any(1)


def merge(first: ShaftDetections, second: ShaftDetections, sure: float) -> ShaftDetections:
    """The sure shafts of a first look, and of a second one what does not lie on them; as many as each look holds."""
    keep = first.valid & (first.confidence >= sure)
    known = _lies_on(second, first) | _lies_on(first, second).mT
    new = second.valid & ~(known & keep[:, None]).any(2)
    both = {name: torch.cat([getattr(first, name), value], 1) for name, value in vars(second).items() if value.ndim > 1}
    both["valid"] = torch.cat([keep, new], 1)
    both["reason"] = torch.where(both["valid"].any(1), int(FrameReason.OK), second.reason)
    ranked = ShaftDetections(**both).surest_first()
    return replace(ranked, **{n: v[:, : first.valid.shape[1]] for n, v in vars(ranked).items() if v.ndim > 1})


def _lies_on(these: ShaftDetections, others: ShaftDetections) -> Bool[Tensor, "b i j"]:
    """Whether the middle of each shaft lies between the contours of another that runs the same way."""
    middle = these.contour_xy.mean((2, 3))[:, :, None, None]  # (b, i, 1, 1, xy)
    point, along = others.contour_xy[:, :, :, 0], others.contour_xy[:, :, :, 1] - others.contour_xy[:, :, :, 0]
    relative = middle - point[:, None]  # (b, i, j, edge, xy)
    beside = relative[..., 0] * along[:, None, ..., 1] - relative[..., 1] * along[:, None, ..., 0]
    axis = [torch.nn.functional.normalize(d.axis_xy[:, :, 1] - d.axis_xy[:, :, 0], dim=-1) for d in (these, others)]
    parallel = torch.einsum("bic,bjc->bij", *axis).abs() > 0.95
    return (beside[..., 0] * beside[..., 1] < 0) & parallel
