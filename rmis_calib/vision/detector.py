"""The shaft detector: pictures in, contour lines, axis and shaft end out, with uncertainty and a reason per frame."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.errors import ShapeError
from rmis_calib.geometry import Camera, axis_from_contours, plane_normal_from_points
from rmis_calib.vision.coarse.search import SearchTrace, StripCandidates, search
from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.coarse.trace import Trace
from rmis_calib.vision.detections import EndKind, FrameReason, ShaftDetections, merge, needs_second_pass
from rmis_calib.vision.fine import confidence, edges, ends
from rmis_calib.vision.image.canvas import Canvas, plan_canvas
from rmis_calib.vision.image.line_fit import LineFit, fit_lines
from rmis_calib.vision.image.pixel_mapping import Lens
from rmis_calib.vision.image.run_length import masked_median, smooth_over
from rmis_calib.vision.image.sampling import FullPicture
from rmis_calib.vision.masks import checked_masks
from rmis_calib.vision.settings import DetectorSettings

_POLYLINE = 24
_STRETCHES = 8
_LEADS = 3
"""Strips beyond the sure shafts that ask for a second look: the fourth best of an operating scene is tissue."""
# Shading, blood and compression move points together over more than the blocks from which a line's uncertainty is
# estimated: of factors from 1 to 2 this one makes the errors of the presets most likely.
_LONG_ERRORS = 1.6


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
        self._canvases: dict[tuple[tuple[int, int], torch.device], Canvas] = {}

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
        second, _ = self._look(images[again], None, broken[again], 2)
        better = merge(found.of_frames(again), second, twice)
        for name, value in vars(found).items():
            value[again] = getattr(better, name)
        return found

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

    def _canvas(self, images: Tensor) -> Canvas:
        """The small picture's place, planned once for each size and device."""
        size = (images.shape[2], images.shape[3])
        key = (size, images.device)
        if key not in self._canvases:
            factor = max(1, round(size[1] / self.settings.small_width_px))
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
        """Sub-pixel contours, axis and end of the traced strips."""
        trace, keep, scores = found.trace, found.keep, found.scores
        decoded = images.contiguous(memory_format=torch.channels_last)  # a copy only of planar pictures
        picture = FullPicture(decoded, found.frame, self.lens)
        points, fit = self._contours(picture, trace)
        strips = replace(trace.strips, offset=fit.offset, slope=fit.slope)
        expected = ends.expect(found.verdict, trace)
        floor, blur = 5 * self.settings.sigma_floor_px, points.blur_px.mean(-1)
        end = ends.locate(picture, strips, expected.t, expected.reach_px, trace.width, blur, floor)
        offered = edges.at_stations(trace.sides, trace.t, points.t)
        share = (fit.inliers / offered.sum(-1).clamp(min=1)).amin(-1)
        reach = math.hypot(*images.shape[-2:])
        certain = confidence.capped(confidence.probability(confidence.features(trace, fit, share, reach)), trace)
        convergence = (fit.slope[..., 0] - fit.slope[..., 1]).abs()
        cylinder = convergence < math.tan(math.radians(self.settings.max_convergence_deg))
        clear = cylinder & (share > 0.15) & ((scores > 0) & ~broken[:, None])[keep] & (fit.spread_t.amin(-1) > 0)
        plausible = confidence.plausible(trace, fit, share, reach)
        valid = clear & plausible & (certain >= self.settings.min_confidence)
        measured = self._assemble(trace, strips, points, fit, end, expected, valid, certain)
        reason = _reason(stages, scores, _spread(clear, keep), _spread(valid, keep), broken)
        fields = {name: _spread(value, keep) for name, value in measured.items()}
        return ShaftDetections(reason=reason, **fields).surest_first()

    def _contours(self, picture: FullPicture, trace: Trace) -> tuple[edges.EdgePoints, LineFit]:
        """Edge points found roughly, then finely, and the lines through them."""
        settings, strips = self.settings, trace.strips
        t = edges.place_samples(trace.on, trace.t, settings.edge_samples)
        lateral = edges.interpolate(trace.lateral, trace.t, t)
        step = torch.full_like(strips.offset, max(1.0, picture.images.shape[-1] / settings.small_width_px / 3))
        both = t[:, :, None].expand_as(lateral)
        use = edges.at_stations(trace.sides, trace.t, t)
        points = edges.rough(picture, strips, t, lateral, use, step)
        main = edges.at_stations(trace.main[:, :, None], trace.t, t).expand_as(both)
        # Beyond that a point belongs to something else: tissue, a stain, the edge of a stripe of glare.
        tolerance = 0.3 * points.blur_px + 0.01 * trace.width[..., None]
        line = fit_lines(both, points.lateral, points.valid.to(t.dtype), main, tolerance, 0.01)
        straight = line.offset[..., None] + line.slope[..., None] * both
        near = points.valid & ((points.lateral - straight).abs() < 4 * line.scatter_px[..., None])
        centre = straight + smooth_over(points.lateral - straight, near)
        points = edges.fine(picture, strips, t, centre, use, (points.blur_px / 1.3).clamp(1.0, 4.0))
        usual = masked_median(points.height, points.valid)[..., None].clamp(min=1e-6)
        weight = points.valid * (points.height / usual).clamp(0.3, 1.5)
        return points, fit_lines(both, points.lateral, weight, main, tolerance, 0.01)

    def _assemble(
        self,
        trace: Trace,
        strips: Strips,
        points: edges.EdgePoints,
        fit: LineFit,
        end: ends.ShaftEnd,
        expected: ends.ExpectedEnd,
        valid: Bool[Tensor, "b k"],
        certain: Float[Tensor, "b k"],
    ) -> dict[str, Tensor]:
        """The fields of `ShaftDetections`, but for the reason."""
        focal = self.lens.focal_px
        along = torch.stack([fit.centre_t - fit.spread_t, fit.centre_t + fit.spread_t], -1)  # (b, k, 2, 2)
        lateral = fit.offset[..., None] + fit.slope[..., None] * along
        contour = self._normalised(strips.points(along, lateral))
        middle = strips.contour(end.t[..., None]).mean(2)
        end_ideal = strips.points(end.t[..., None], middle)[:, :, 0]
        axis, end_xy = _axis(contour, self._normalised(end_ideal), self.lens.camera is not None)
        stop = torch.where(end.valid, end.t, trace.end)
        share = torch.linspace(0, 1, _POLYLINE, device=stop.device)
        t = trace.start[..., None] + (stop - trace.start)[..., None] * share
        polyline = strips.points(t[:, :, None].expand(-1, -1, 2, -1), strips.contour(t))
        straight, t_block = points.bend(fit, _STRETCHES)
        place = t_block[:, :, None].expand(-1, -1, 2, -1)
        sigma = ((_LONG_ERRORS * fit.sigma_px).square() + self.settings.sigma_floor_px**2).sqrt() / focal
        known = trace.start_at_border & ~trace.end_at_border
        end_valid = end.valid & valid & expected.in_view
        return dict(
            valid=valid,
            contour_xy=_only(valid, contour),
            contour_sigma=_only(valid, sigma),
            axis_xy=_only(valid, axis),
            axis_sigma=_only(valid, 0.5 * sigma.square().sum(-1).sqrt()),
            end_xy=_only(end_valid, end_xy),
            end_sigma=_only(end_valid, end.sigma_px / focal),
            end_valid=end_valid,
            end_kind=torch.where(valid, expected.kind, int(EndKind.UNKNOWN)),
            end_sureness=_only(valid, expected.sureness),
            direction_known=known & valid,
            confidence=_only(valid, certain),
            contour_uv=_only(valid, self.lens.to_raw(polyline)),
            end_uv=_only(end_valid, self.lens.to_raw(end_ideal)),
            scatter_px=_only(valid, fit.scatter_px),
            straight_px=_only(valid, straight),
            straight_uv=_only(valid, self.lens.to_raw(strips.points(place, strips.contour(t_block)))),
            blur_px=_only(valid, points.blur_px),
        )

    def _normalised(self, ideal: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
        return self.lens.normalise(ideal)


def _spread(listed: Tensor, keep: Bool[Tensor, "b k"]) -> Tensor:
    """Values of listed strips, (1, m, ...), at their frames and ranks, (b, k, ...); false, NaN or unknown elsewhere."""
    empty = False if listed.dtype == torch.bool else torch.nan if listed.is_floating_point() else int(EndKind.UNKNOWN)
    dense = torch.full((*keep.shape, *listed.shape[2:]), empty, dtype=listed.dtype, device=listed.device)
    dense[keep] = listed[0]
    return dense


def _only(mask: Bool[Tensor, "b k"], value: Float[Tensor, "b k ..."]) -> Float[Tensor, "b k ..."]:
    """The value where the mask holds, NaN elsewhere."""
    return torch.where(mask.reshape(*mask.shape, *[1] * (value.ndim - 2)), value, torch.nan)


def _axis(
    contour: Float[Tensor, "b k 2 2 2"], end: Float[Tensor, "b k 2"], calibrated: bool
) -> tuple[Float[Tensor, "b k 2 2"], Float[Tensor, "b k 2"]]:
    """Two points of the axis line, and the end moved from the rim that is seen to the axis behind it.

    In the plane of the axis the rim is nearer than the axis by the factor 1 - sin(half angle), at the same place along
    the axis.
    """
    middle = contour.mean(2)  # mean of the edges at either point
    if not calibrated:
        return middle, end
    normals = plane_normal_from_points(contour[..., 0, :], contour[..., 1, :])
    plane = axis_from_contours(normals, 1.0)
    n = plane.camera_n_axis
    size = n[..., :2].square().sum(-1).clamp(min=1e-12)
    off = ((middle * n[..., None, :2]).sum(-1) + n[..., None, 2]) / size[..., None]
    axis = middle - off[..., None] * n[..., None, :2]
    along = torch.linalg.cross(n, plane.camera_u)
    ray = torch.cat([end, torch.ones_like(end[..., :1])], -1)
    depth, shift = (ray * plane.camera_u).sum(-1), (ray * along).sum(-1)
    on_axis = plane.camera_u * depth[..., None] + along * (shift * (1 - plane.half_angle_rad.sin()))[..., None]
    return axis, on_axis[..., :2] / on_axis[..., 2:]


def _reason(stages: SearchTrace, scores: Tensor, clear: Tensor, valid: Tensor, broken: Tensor) -> Int[Tensor, " b"]:
    """The furthest stage that each frame reached."""
    weight = stages.seen.to(stages.unlike.dtype)
    total = weight.sum((1, 2)).clamp(min=1.0)
    mean = (stages.unlike * weight).sum((1, 2)) / total
    spread = ((stages.unlike - mean[:, None, None]).square() * weight).sum((1, 2)) / total
    evidence = stages.evidence
    reason = torch.full_like(scores[:, 0], FrameReason.AMBIGUOUS, dtype=torch.int64)
    for failed, why in (
        (~clear.any(1), FrameReason.EDGES_UNCLEAR),
        (~(scores > 0).any(1), FrameReason.TOO_SHORT),
        (~(evidence.on.any(-1) & evidence.strips.valid).any(1), FrameReason.NOT_A_CYLINDER),
        (~evidence.strips.valid.any(1), FrameReason.NO_STRAIGHT_EDGES),
        ((spread < 0.02**2) | ~stages.seen.flatten(1).any(1), FrameReason.NO_PICTURE),
        (broken, FrameReason.BAD_PIXELS),
    ):
        reason = torch.where(failed, int(why), reason)
    return torch.where(valid.any(1), int(FrameReason.OK), reason)
