"""Exact contours, axis, end and head point in every frame, from poses alone: no drawing code takes part. float64
NumPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from data_synth.contours import contact_points, front_point, to_image, view_cylinder, visible_interval
from data_synth.kinematics import Array, rigid, rigid_inverse
from data_synth.scene import ShaftInCamera
from data_synth.world import World

POLYLINE_POINTS = 64
"""Points of each contour in raw pixels, where distortion bends it."""
SHORTEST_VISIBLE_MM = 5.0
"""A shaft of which less is in the picture counts as not visible."""


@dataclass(frozen=True)
class SideTruth:
    """What one camera sees of the instrument in N frames; `xy` is normalised undistorted, `uv` raw pixels. NaN where
    not visible.

    Edge 0 is left of the axis, directed in the picture from the RCM to the tip; of two points the RCM side comes first.

    Attributes:
        camera_T_rcm: (N, 4, 4) true pose of the RCM frame.
        camera_p_rcm: (N, 3) its origin, on the axis, mm.
        camera_v_axis: (N, 3) unit direction of the axis.
        s_end_mm: (N,) true coordinate of the shaft's end along the axis.
        n_contour: (N, 2, 3) unit normals of the two contour planes.
        n_contour_read: (N, 2, 3) the same of the straight lines that fit the contours best as the picture shows them,
            whose rows are read one after the other. The rows' mean instant is the frame's: to the one who looks at a
            single picture, the difference is an error that no detector can avoid.
        n_axis: (N, 3) unit normal of the axis plane.
        contour_xy: (N, 2, 2, 2) first and last visible point of each edge.
        contour_uv: (N, 2, P, 2) points along each edge where it can be in the picture.
        contour_visible: (N, 2, P) which of them are inside the picture and its bright field and not hidden by tissue.
        axis_xy: (N, 2, 2) first and last visible point of the axis.
        end_xy: (N, 2) projection of the end circle's centre.
        end_uv: (N, 2) the same in raw pixels.
        end_front_xy: (N, 2) where the visible rim of the end crosses the axis' line.
        end_front_uv: (N, 2) the same in raw pixels.
        head_xy: (N, 2) projection of the head point.
        head_uv: (N, 2) the same in raw pixels.
        head_uv_read: (N, 2) where the picture shows it, whose rows are read one after the other.
        visible: (N,) whether enough of the shaft is in the picture.
        end_visible: (N,) whether the shaft's end is.
        others: the same of every instrument that is not logged; their RCM frame is parallel to the camera.
    """

    camera_T_rcm: Array
    camera_p_rcm: Array
    camera_v_axis: Array
    s_end_mm: Array
    n_contour: Array
    n_contour_read: Array
    n_axis: Array
    contour_xy: Array
    contour_uv: Array
    contour_visible: Array
    axis_xy: Array
    end_xy: Array
    end_uv: Array
    end_front_xy: Array
    end_front_uv: Array
    head_xy: Array
    head_uv: Array
    head_uv_read: Array
    visible: Array
    end_visible: Array

    others: tuple[SideTruth, ...] = ()

    def arrays(self) -> dict[str, Array]:
        """All arrays by name, those of other instruments as other0_..., other1_..."""
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "others"}
        more = {f"other{i}_{name}": a for i, other in enumerate(self.others) for name, a in other.arrays().items()}
        return own | more


def side_truth(world: World, side: str) -> SideTruth:
    """Truth of one camera over all frames."""
    times = world.frame_times_s
    frames = np.arange(len(times))

    def own_at(at: Array) -> ShaftInCamera:
        return world.shaft(side, np.broadcast_to(frames.reshape(-1, *[1] * (at.ndim - 1)), at.shape), at)[0]

    others = []
    for other in world.props.others:
        camera_T_port = rigid(np.eye(3), world.other_shaft(side, other, times).camera_p_rcm)
        others.append(_shaft_truth(world, side, partial(world.other_shaft, side, other), camera_T_port))
    _, camera_T_rcm = world.shaft(side, frames, times)
    return replace(_shaft_truth(world, side, own_at, camera_T_rcm), others=tuple(others))


def _shaft_truth(world: World, side: str, shaft_at: Callable[[Array], ShaftInCamera], camera_T_rcm: Array) -> SideTruth:
    """Truth of one shaft, given at times (N, ...), in one camera."""
    camera, shaft = world.cameras[side], shaft_at(world.frame_times_s)
    camera_T_base = rigid_inverse(world.base_T_camera(side, world.frame_times_s))
    p, v, radius = shaft.camera_p_rcm, shaft.camera_v_axis, shaft.radius_mm
    view = view_cylinder(p, v, radius)
    low, high = visible_interval(p, v, 0.0, shaft.s_end_mm, camera.extent())
    some = high > low
    low, high = np.where(some, low, np.nan), np.where(some, high, np.nan)
    s = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, POLYLINE_POINTS)
    axis = p[:, None] + s[..., None] * v[:, None]  # (N, P, 3)
    contact = axis[:, :, None] + np.array([-radius, radius])[:, None] * view.n_contour[:, None]
    lines = np.moveaxis(np.concatenate([contact, axis[:, :, None]], axis=2), 1, 2)  # (N, 3, P, 3): both edges, axis
    seen = world.in_sight(side, camera_T_base[:, None, None], lines)
    visible = some & (seen[:, :2].mean(-1) * (high - low)[:, None] > SHORTEST_VISIBLE_MM).all(-1)
    xy = to_image(np.where(visible[:, None, None, None], lines, np.nan))
    ends = _seen_ends(xy, seen)
    end = shaft.axis_point(shaft.s_end_mm)
    front = front_point(end, view, radius)
    n_contour_read = view.n_contour
    if world.config.camera.readout_s:
        read = _as_read(world, side, shaft_at, s, seen[:, :2] & visible[:, None, None])
        n_contour_read = _straight(read, view.n_contour)
    end_visible = visible & world.in_sight(side, camera_T_base, front)
    end, front = (np.where(end_visible[:, None], point, np.nan) for point in (end, front))
    return SideTruth(
        camera_T_rcm=camera_T_rcm,
        camera_p_rcm=p,
        camera_v_axis=v,
        s_end_mm=shaft.s_end_mm,
        n_contour=view.n_contour,
        n_contour_read=n_contour_read,
        n_axis=view.n_axis,
        contour_xy=ends[:, :2],
        contour_uv=camera.pixels(xy[:, :2]),
        contour_visible=seen[:, :2] & visible[:, None, None],
        axis_xy=ends[:, 2],
        end_xy=to_image(end),
        end_uv=camera.project(end),
        end_front_xy=to_image(front),
        end_front_uv=camera.project(front),
        head_xy=to_image(shaft.camera_p_head),
        head_uv=camera.project(shaft.camera_p_head),
        head_uv_read=_head_as_read(world, side, shaft_at),
        visible=visible,
        end_visible=end_visible,
    )


def _as_read(
    world: World, side: str, shaft_at: Callable[[Array], ShaftInCamera], s: Array, seen: NDArray[np.bool_]
) -> Array:
    """Points (N, 2, P, 2) of both contours at axis coordinates `s` (N, P), each at the instant at which its row is
    read; only where they are `seen`, else NaN."""
    settings, camera = world.config.camera, world.cameras[side]
    frame_times = world.frame_times_s[:, None, None]
    times = np.broadcast_to(frame_times, seen.shape)
    xy = np.full((*seen.shape, 2), np.nan)
    for _ in range(3):  # a row's instant moves its point by a fraction of a row
        shaft = shaft_at(times)
        view = view_cylinder(shaft.camera_p_rcm, shaft.camera_v_axis, shaft.radius_mm)
        axis = shaft.camera_p_rcm + s[:, None, :, None] * shaft.camera_v_axis
        contact = contact_points(axis, view, shaft.radius_mm)  # (N, 2, P, 2, 3): of the first two, the own edge
        xy = to_image(np.stack([contact[:, edge, :, edge] for edge in (0, 1)], axis=1))
        row = np.nan_to_num(camera.pixels(xy)[..., 1])
        times = frame_times + settings.readout_s * ((row + 0.5) / settings.height_px - 0.5)
    return np.where(seen[..., None], xy, np.nan)


def _head_as_read(world: World, side: str, shaft_at: Callable[[Array], ShaftInCamera]) -> Array:
    """The head point (N, 2), raw pixels, at the instant at which its row is read."""
    settings, times = world.config.camera, world.frame_times_s
    uv = world.cameras[side].project(shaft_at(times).camera_p_head)
    for _ in range(3 if settings.readout_s else 0):  # as in `_as_read`
        row = np.nan_to_num(uv[:, 1]).clip(0.0, settings.height_px - 1.0)
        at = times + settings.readout_s * ((row + 0.5) / settings.height_px - 0.5)
        uv = world.cameras[side].project(shaft_at(at).camera_p_head)
    return uv


def _straight(xy: Array, n_contour: Array) -> Array:
    """Unit normals (N, 2, 3) of the planes through the lines that fit points (N, 2, P, 2) best, least squares across
    the line; turned like `n_contour`, which also stands in where there is no point."""
    some = np.isfinite(xy[..., 0])
    count = np.maximum(some.sum(-1), 1)[..., None]
    centre = np.nan_to_num(xy).sum(-2) / count
    off = np.where(some[..., None], xy - centre[..., None, :], 0.0)
    across = np.linalg.eigh(np.swapaxes(off, -1, -2) @ off)[1][..., 0]
    line = np.concatenate([across, -(across * centre).sum(-1, keepdims=True)], axis=-1)
    line *= np.sign((line * n_contour).sum(-1, keepdims=True)) / np.linalg.norm(line, axis=-1, keepdims=True)
    return np.where((some.sum(-1) > 1)[..., None], line, n_contour)


def _seen_ends(xy: Array, seen: Array) -> Array:
    """First and last visible point (N, L, 2, 2) of polylines (N, L, P, 2)."""
    first = seen.argmax(-1)
    last = seen.shape[-1] - 1 - seen[..., ::-1].argmax(-1)
    index = np.stack([first, last], axis=-1)[..., None]
    return np.take_along_axis(xy, index, axis=-2)
