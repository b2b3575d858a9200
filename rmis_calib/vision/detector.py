"""The shaft detector: pictures in, contour lines, axis and shaft end out, with uncertainty and a reason per frame."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.errors import ShapeError
from rmis_calib.geometry import Camera
from rmis_calib.vision.coarse.guided import COARSER, trace_along, trace_near
from rmis_calib.vision.coarse.search import SearchTrace, StripCandidates, search
from rmis_calib.vision.coarse.strips import between, listed_between
from rmis_calib.vision.detections import EndKind, FrameReason, ShaftDetections, merge, needs_second_pass
from rmis_calib.vision.fine.expected import where_expected
from rmis_calib.vision.fine.measurement import measure
from rmis_calib.vision.image.canvas import Canvas, plan_canvas
from rmis_calib.vision.image.picking import pick_pictures
from rmis_calib.vision.image.pixel_mapping import Lens
from rmis_calib.vision.masks import checked_masks
from rmis_calib.vision.settings import DetectorSettings

_LEADS = 3
"""Strips beyond the sure shafts that ask for a second look: the fourth best of an operating scene is tissue."""


class ShaftDetector:
    """Finds instrument shafts in batches of pictures, on the device that the pictures are on."""

    def __init__(
        self,
        settings: DetectorSettings | None = None,
        camera: Camera | None = None,
        segment: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        """Keep the limits and the camera.

        Args:
            settings: defaults serve every picture that the project was tested on.
            camera: None leaves everything in pixels, with no undistortion.
            segment: maps pictures (b, 3, h, w) in [0, 1] to masks (b, h, w) or (b, 1, h, w), above 0.5 on shafts, and
                replaces the colour stage. None: the colour stage.
        """
        self.settings = settings or DetectorSettings()
        self.lens = Lens(camera)
        self.segment = segment
        self._canvases: dict[tuple[tuple[int, int], torch.device, int], Canvas] = {}

    def detect(self, images: Tensor, masks: Tensor | None = None) -> ShaftDetections:
        """Shafts of each picture.

        Args:
            images: (b, 3, h, w) RGB, uint8, or floating point in [0, 1].
            masks: (b, h, w), above 0.5 on shafts; take the place of the colour stage and of `segment`.

        Raises:
            ShapeError: another shape or dtype, a picture smaller than 64 px, or not of the camera's size; or masks that
                do not fit the pictures.
        """
        images, masks, broken = self._prepared(images, masks)
        twice = self.settings.second_look_below
        if masks is not None or twice == 0:
            return self._look(images, masks, broken, 1)[0]
        if twice == 1:
            return self._look(images, None, broken, 2)[0]
        found, stages = self._look(images, None, broken, 1)
        again = needs_second_pass(found, stages.leads[:, :_LEADS] / images.shape[-1], twice)
        if not bool(again.any()):
            return found
        second, _ = self._look(pick_pictures(images, again), None, broken[again], 2)
        found.put(again, merge(found.of_frames(again), second, twice))
        return found

    def look_along(self, images: Tensor, contour_n: Float[Tensor, "b 2 3"]) -> ShaftDetections:
        """The shaft of each picture near where it is expected: one candidate a frame.

        Its contours are followed along the expected ones, however much tissue, blood or glare hides in between. It is
        valid where the measured lines lie near the expected ones, which by chance they hardly do; the confidence counts
        that.

        Args:
            images: as in `detect`.
            contour_n: normals of both contours' planes, as `geometry.contour_planes` gives them.

        Raises:
            ShapeError: as in `detect`, or not two contours a picture.
        """
        images, _, broken = self._prepared(images, None)
        if contour_n.shape != (len(images), 2, 3):
            raise ShapeError(where="contour_n", expected=f"({len(images)}, 2, 3)", found=tuple(contour_n.shape))
        expected = contour_n.to(images.device, torch.float32)
        with torch.inference_mode():
            canvas = self._canvas(images)
            strip = between(self.lens.to_ideal_lines(expected), canvas)
            found = trace_along(images, canvas, self.settings, strip)
            strips = measure(images, found, self.lens, self.settings)
            clear = strips.clear & (found.scores > 0)[found.keep]
            fields = strips.fields(clear, strips.certain, self.lens, self.settings)
            fields = {name: _spread(value, found.keep) for name, value in fields.items()}
            both = ShaftDetections(reason=torch.zeros(len(images), dtype=torch.int64, device=images.device), **fields)
            width = _spread(strips.trace.width, found.keep) / self.lens.focal_px
            looked = where_expected(both, expected, width, broken, self.settings.min_confidence)
        return ShaftDetections(**{name: value.clone() for name, value in vars(looked).items()})

    def look_near(self, images: Tensor, contour_n: Float[Tensor, "b k 2 3"]) -> ShaftDetections:
        """Shafts near where they are known to be about, several a picture, as `detect` measures and judges them.

        At a third of the time of `detect` and less; but no others are looked for, and what is valid may be something
        else nearby: whether a place was good is left to the caller. The ranks are those of the places.

        Args:
            images: as in `detect`.
            contour_n: normals of both contours' planes, as `geometry.contour_planes` gives them; NaN for none.

        Raises:
            ShapeError: as in `detect`, or not two contours a place.
        """
        images, _, broken = self._prepared(images, None)
        checked_places(contour_n, images)
        expected = contour_n.to(images.device, torch.float32)
        with torch.inference_mode():
            canvas = self._canvas(images, COARSER)
            strips, keep = listed_between(self.lens.to_ideal_lines(expected), canvas)
            found = trace_near(images, canvas, self.settings, strips, keep)
            fields, _ = self._judged(images, found, broken)
            reason = torch.where(fields["valid"].any(1), int(FrameReason.OK), int(FrameReason.EDGES_UNCLEAR))
            reason = torch.where(broken, int(FrameReason.BAD_PIXELS), reason)
        return ShaftDetections(reason=reason, **{name: value.clone() for name, value in fields.items()})

    def explain(self, images: Tensor, masks: Tensor | None = None) -> tuple[ShaftDetections, SearchTrace]:
        """Shafts looked for in both views, and what each stage of the coarse search saw. Arguments and errors as in
        `detect`."""
        images, masks, broken = self._prepared(images, masks)
        return self._look(images, masks, broken, 2)

    def _prepared(self, images: Tensor, masks: Tensor | None) -> tuple[Tensor, Tensor | None, Bool[Tensor, " b"]]:
        """Pictures without infinities, masks that fit them, and which pictures were broken."""
        self._check(images)
        if masks is None and self.segment is not None:
            with torch.no_grad():
                scale = 1.0 / 255.0 if images.dtype == torch.uint8 else 1.0
                masks = self.segment(torch.nan_to_num(images.to(torch.float32) * scale))
        broken = torch.zeros(images.shape[0], dtype=torch.bool, device=images.device)
        if images.dtype != torch.uint8:
            broken = ~torch.isfinite(images).flatten(1).all(1)
            images = torch.nan_to_num(images.to(torch.float32), nan=0.0, posinf=0.0, neginf=0.0)
        return images, None if masks is None else checked_masks(masks, images), broken

    def _look(
        self, images: Tensor, masks: Tensor | None, broken: Bool[Tensor, " b"], views: int
    ) -> tuple[ShaftDetections, SearchTrace]:
        """Search in one view or two, and sub-pixel measurement."""
        with torch.inference_mode():
            found, stages = search(images, self._canvas(images), self.settings, views, masks)
            measured = self._measure(images, found, stages, broken)
        # Copied out of inference mode, whose tensors no gradient may be taken with respect to.
        return ShaftDetections(**{name: value.clone() for name, value in vars(measured).items()}), stages

    def _canvas(self, images: Tensor, coarser: int = 1) -> Canvas:
        """The small picture's place, planned once for each size and device, with pixels so many times as large."""
        size = (images.shape[2], images.shape[3])
        key = (size, images.device, coarser)
        if key not in self._canvases:
            factor = coarser * max(1, round(size[1] / self.settings.small_width_px))
            self._canvases[key] = plan_canvas(size, factor, self.lens, images.device)
        return self._canvases[key]

    def _check(self, images: Tensor) -> None:
        where = "images"
        if images.ndim != 4 or images.shape[1] != 3:
            raise ShapeError(where=where, expected="(b, 3, h, w) RGB", found=tuple(images.shape))
        if images.dtype != torch.uint8 and not images.dtype.is_floating_point:
            raise ShapeError(where=where, expected="uint8 or floating point in [0, 1]", found=images.dtype)
        size = (images.shape[2], images.shape[3])
        if images.shape[0] == 0 or min(size) < 64:
            raise ShapeError(where=where, expected="at least one picture of 64 x 64 px", found=tuple(images.shape))
        camera = self.lens.camera
        if camera is not None and tuple(camera.image_size) != size:
            raise ShapeError(where=where, expected=f"(height, width) of the camera, {camera.image_size}", found=size)

    def _measure(
        self, images: Tensor, found: StripCandidates, stages: SearchTrace, broken: Bool[Tensor, " b"]
    ) -> ShaftDetections:
        """Sub-pixel contours, axis and end of the searched strips, and why a frame shows none."""
        fields, clear = self._judged(images, found, broken)
        reason = _reason(stages, found.scores, clear, fields["valid"], broken)
        return ShaftDetections(reason=reason, **fields).surest_first()

    def _judged(
        self, images: Tensor, found: StripCandidates, broken: Bool[Tensor, " b"]
    ) -> tuple[dict[str, Tensor], Bool[Tensor, "b k"]]:
        """Sub-pixel contours, axis and end of the traced strips, as fields of `ShaftDetections`, and whether their
        contours are clear."""
        strips = measure(images, found, self.lens, self.settings)
        clear = strips.clear & ((found.scores > 0) & ~broken[:, None])[found.keep]
        valid = clear & strips.plausible & (strips.certain >= self.settings.min_confidence)
        fields = strips.fields(valid, strips.certain, self.lens, self.settings)
        return {name: _spread(value, found.keep) for name, value in fields.items()}, _spread(clear, found.keep)


def checked_places(contour_n: Tensor, images: Tensor) -> None:
    """Refuse places that do not fit the pictures.

    Raises:
        ShapeError: not two contours a place, or not for each picture.
    """
    shape = tuple(contour_n.shape)
    if len(shape) != 4 or shape[0] != len(images) or shape[1] == 0 or shape[2:] != (2, 3):
        raise ShapeError(where="contour_n", expected=f"({len(images)}, k, 2, 3)", found=shape)


def _spread(listed: Tensor, keep: Bool[Tensor, "b k"]) -> Tensor:
    """Values of listed strips, (1, m, ...), at their frames and ranks, (b, k, ...); false, NaN or unknown elsewhere."""
    empty = False if listed.dtype == torch.bool else torch.nan if listed.is_floating_point() else int(EndKind.UNKNOWN)
    dense = torch.full((*keep.shape, *listed.shape[2:]), empty, dtype=listed.dtype, device=listed.device)
    dense[keep] = listed[0]
    return dense


def _reason(stages: SearchTrace, scores: Tensor, clear: Tensor, valid: Tensor, broken: Tensor) -> Int[Tensor, " b"]:
    """The furthest stage that each frame reached."""
    lost = ~valid.any(1)
    uniform = lost.clone()
    uniform[lost] = _uniform(stages.unlike[lost], stages.seen[lost])
    evidence = stages.evidence
    reason = torch.full_like(scores[:, 0], FrameReason.AMBIGUOUS, dtype=torch.int64)
    for failed, why in (
        (~clear.any(1), FrameReason.EDGES_UNCLEAR),
        (~(scores > 0).any(1), FrameReason.TOO_SHORT),
        (~(evidence.on.any(-1) & evidence.strips.valid).any(1), FrameReason.NOT_A_CYLINDER),
        (~evidence.strips.valid.any(1), FrameReason.NO_STRAIGHT_EDGES),
        (uniform, FrameReason.NO_PICTURE),
        (broken, FrameReason.BAD_PIXELS),
    ):
        reason = torch.where(failed, int(why), reason)
    return torch.where(lost, reason, int(FrameReason.OK))


def _uniform(unlike: Float[Tensor, "m h w"], seen: Bool[Tensor, "m h w"]) -> Bool[Tensor, " m"]:
    """Whether a picture is of one tone, or has no field of view."""
    weight = seen.to(unlike.dtype)
    total = weight.sum((1, 2))
    mean = (unlike * weight).sum((1, 2)) / total.clamp(min=1.0)
    spread = ((unlike - mean[:, None, None]).square() * weight).sum((1, 2)) / total.clamp(min=1.0)
    return (spread < 0.02**2) | (total == 0)
