"""Traced strips measured at full resolution: contour lines, axis, end, and how sure it is that they are a shaft's."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.geometry import axis_from_contours, plane_normal_from_points
from rmis_calib.vision.coarse.search import StripCandidates
from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.coarse.trace import Trace
from rmis_calib.vision.detections import EndKind
from rmis_calib.vision.fine import confidence, edges, ends
from rmis_calib.vision.image.line_fit import LineFit, fit_lines
from rmis_calib.vision.image.pixel_mapping import Lens
from rmis_calib.vision.image.run_length import masked_median, smooth_over
from rmis_calib.vision.image.sampling import FullPicture
from rmis_calib.vision.settings import DetectorSettings

_POLYLINE = 24
_STRETCHES = 8
# Shading, blood and compression move points together over more than the blocks from which a line's uncertainty is
# estimated: of factors from 1 to 2 this one makes the errors of the presets most likely.
_LONG_ERRORS = 1.6


@dataclass(frozen=True, eq=False)
class MeasuredStrips:
    """Strips of all pictures, one list (1, m), with what was measured of them."""

    trace: Trace
    strips: Strips
    """Between the measured lines."""
    points: edges.EdgePoints
    fit: LineFit
    end: ends.ShaftEnd
    expected: ends.ExpectedEnd
    clear: Bool[Tensor, "1 m"]
    """Both contours are there, and converge no more than those of a cylinder."""
    plausible: Bool[Tensor, "1 m"]
    """`confidence.plausible`."""
    certain: Float[Tensor, "1 m"]
    """Probability that both are a shaft's."""

    def fields(
        self, valid: Bool[Tensor, "1 m"], certain: Float[Tensor, "1 m"], lens: Lens, settings: DetectorSettings
    ) -> dict[str, Tensor]:
        """The fields of `ShaftDetections`, but for the reason."""
        trace, strips, fit, end, expected = self.trace, self.strips, self.fit, self.end, self.expected
        focal = lens.focal_px
        along = torch.stack([fit.centre_t - fit.spread_t, fit.centre_t + fit.spread_t], -1)  # (b, k, 2, 2)
        lateral = fit.offset[..., None] + fit.slope[..., None] * along
        contour = lens.normalise(strips.points(along, lateral))
        middle = strips.contour(end.t[..., None]).mean(2)
        end_ideal = strips.points(end.t[..., None], middle)[:, :, 0]
        axis, end_xy = _axis(contour, lens.normalise(end_ideal), lens.camera is not None)
        stop = torch.where(end.valid, end.t, trace.end)
        share = torch.linspace(0, 1, _POLYLINE, device=stop.device)
        t = trace.start[..., None] + (stop - trace.start)[..., None] * share
        polyline = strips.points(t[:, :, None].expand(-1, -1, 2, -1), strips.contour(t))
        straight, t_block = self.points.bend(fit, _STRETCHES)
        place = t_block[:, :, None].expand(-1, -1, 2, -1)
        sigma = ((_LONG_ERRORS * fit.sigma_px).square() + settings.sigma_floor_px**2).sqrt() / focal
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
            contour_uv=_only(valid, lens.to_raw(polyline)),
            end_uv=_only(end_valid, lens.to_raw(end_ideal)),
            scatter_px=_only(valid, fit.scatter_px),
            straight_px=_only(valid, straight),
            straight_uv=_only(valid, lens.to_raw(strips.points(place, strips.contour(t_block)))),
            blur_px=_only(valid, self.points.blur_px),
        )


def measure(images: Tensor, found: StripCandidates, lens: Lens, settings: DetectorSettings) -> MeasuredStrips:
    """Sub-pixel contours, axis and end of the traced strips.

    Args:
        images: (b, 3, h, w), uint8 or floating point in [0, 1].
        found: strips of these pictures.
        lens: of the camera.
        settings: limits.
    """
    trace = found.trace
    decoded = images.contiguous(memory_format=torch.channels_last)  # a copy only of planar pictures
    picture = FullPicture(decoded, found.frame, lens)
    points, fit = _contours(picture, trace, settings)
    strips = replace(trace.strips, offset=fit.offset, slope=fit.slope)
    expected = ends.expect(found.verdict, trace)
    floor, blur = 5 * settings.sigma_floor_px, points.blur_px.mean(-1)
    end = ends.locate(picture, strips, expected.t, expected.reach_px, trace.width, blur, floor)
    offered = edges.at_stations(trace.sides, trace.t, points.t)
    share = (fit.inliers / offered.sum(-1).clamp(min=1)).amin(-1)
    reach = math.hypot(*images.shape[-2:])
    network = found.verdict.shaft[None]
    seen = confidence.features(trace, fit, share, reach, network, found.lit)
    certain = confidence.capped(confidence.probability(seen), trace)
    convergence = (fit.slope[..., 0] - fit.slope[..., 1]).abs()
    cylinder = convergence < math.tan(math.radians(settings.max_convergence_deg))
    clear = cylinder & (share > 0.15) & (fit.spread_t.amin(-1) > 0)
    plausible = confidence.plausible(trace, fit, share, reach, network)
    return MeasuredStrips(trace, strips, points, fit, end, expected, clear, plausible, certain)


def _contours(picture: FullPicture, trace: Trace, settings: DetectorSettings) -> tuple[edges.EdgePoints, LineFit]:
    """Edge points found roughly, then finely, and the lines through them."""
    strips = trace.strips
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
