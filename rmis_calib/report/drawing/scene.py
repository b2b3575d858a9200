"""The set-up in three dimensions, as lines, discs and ellipsoids that a page can turn (templates/scene.js).

The same scene as `rmis-calib view` shows, in `base`, mm; drawn without perspective, so that a millimetre is as long
everywhere and the outline of an ellipsoid is an exact ellipse.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.scene import PlacedCameras, Scene, advised_scene, place_cameras, scene_of
from rmis_calib.report.drawing.frames import spread
from rmis_calib.report.drawing.labels import MEASURES, place_labels
from rmis_calib.report.drawing.working_point import ellipse

MOST_MOTIONS = 60
"""Motions that the page can step through."""
SIGMAS = 3.0
"""Half axes of the ellipsoid, in sigmas, as in `rmis-calib view`."""
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100)
_LARGE_MM = 25.0
"""Longest half axis of the enlarged ellipsoid."""
_FRUSTUM_MM = 20.0
_LABELLED_LEFT = ("base", "head point")
"""Labels that try the left first: the axes and the shaft mostly lead to the right in the first view."""
YAW_RAD, PITCH_RAD = math.radians(-45.0), math.radians(23.0)
"""First view: from the side, a little from above (base's z is up)."""
SIZE = (960.0, 540.0)
"""Width and height of the drawing, in its own units."""
_FILL = 0.42
"""Part of the drawing's height from its middle that the farthest of what matters reaches to."""


@dataclass(frozen=True)
class SceneDrawing:
    """What the page draws.

    Attributes:
        data: for the page's script: plain values.
        shapes: the first view, for pages without a script: plain SVG attributes, the farthest first, the labels last.
        magnification: how many times larger than true the enlarged ellipsoid is; 1: there is none.
        sigma_mm: half axes of the true ellipsoid, the largest first; empty where it is unknown.
        has_answer: whether the cameras are placed.
    """

    data: dict[str, Any]
    shapes: tuple[dict[str, Any], ...]
    magnification: int
    sigma_mm: tuple[float, ...]
    has_answer: bool


def draw_scene(run: CalibrationRun) -> SceneDrawing | None:
    """The scene of a calibration; without an answer the arms alone, or None where not even these are told."""
    poses, result = run.poses, run.result
    has_answer = result.camera_right_T_arm is not None
    if not len(poses.frames) or not (has_answer or poses.setup_is_stated):
        return None
    frames = poses.frames[spread(len(poses.frames), MOST_MOTIONS)]
    scene = scene_of(run.recording, result if has_answer else None, frames)
    cameras = place_cameras(scene, run.recording, result) if has_answer else None
    advised = advised_scene(run.recording, result) if has_answer else None
    covariance = None if cameras is None else cameras.working_covariance
    sigma_mm, magnification = _sizes(covariance)
    data = {
        "frames": scene.frames.tolist(),
        "times_s": np.round(scene.times_s, 3).tolist(),
        "lines": _lines(scene, cameras, advised),
        "dots": [_line("trail", scene.end)],
        "discs": _discs(scene, cameras),
        "ellipsoids": _ellipsoids(cameras, magnification),
        "labels": MEASURES,
        "view": {"yaw": YAW_RAD, "pitch": PITCH_RAD, "size": list(SIZE)} | _fitted(scene, cameras),
    }
    return SceneDrawing(data, tuple(project(data, 0)), magnification, sigma_mm, has_answer)


def project(data: dict[str, Any], motion: int) -> list[dict[str, Any]]:
    """The shapes of one motion in the first view, the farthest first, labels last; scene.js does it for every view."""
    view = data["view"]
    right, up, towards = view_axes(view["yaw"], view["pitch"])
    centre, scale = np.array(view["centre"]), view["scale"]
    middle = np.array(view["size"]) / 2.0

    def flat(points: np.ndarray) -> np.ndarray:
        away = points - centre
        return middle + scale * np.stack([away @ right, -(away @ up)], axis=-1)

    shapes = []
    for line in data["lines"]:
        points = _at(line["points"], motion)
        depth = float(((points - centre) @ towards).mean())
        width = 2.0 * line["radius"] * scale if line["radius"] else None
        shapes.append({"kind": "line", "style": line["style"], "points": flat(points), "width": width, "depth": depth})
    for item in data["dots"]:
        points = np.array(item["points"])
        depth = float(((points - centre) @ towards).mean())
        shapes.append({"kind": "dots", "style": item["style"], "points": flat(points), "depth": depth})
    for item in data["ellipsoids"]:
        point = _at(item["centre"], motion)
        onto = scale * np.stack([right, -up])
        outline = flat(point) + item["sigmas"] * ellipse(onto @ _at(item["covariance"], motion) @ onto.T)
        depth = float((point - centre) @ towards)
        shapes.append({"kind": "outline", "style": item["style"], "points": outline, "depth": depth})
    for disc in data["discs"]:
        point = _at(disc["at"], motion)
        depth = float((point - centre) @ towards) + 1e-3
        shapes.append({"kind": "disc", "style": disc["style"], "points": flat(point[None]), "depth": depth})
    labelled = flat(np.array([_at(disc["at"], motion) for disc in data["discs"]]))
    return sorted(shapes, key=lambda shape: shape["depth"]) + _labels(data, labelled)


def _labels(data: dict[str, Any], points: Float[np.ndarray, "n 2"]) -> list[dict[str, Any]]:
    """The labels over everything else: the shaft would hide what it crosses."""
    discs = data["discs"]
    names, sides = [disc["name"] for disc in discs], [disc["side"] for disc in discs]
    places = place_labels(points, names, sides, tuple(data["view"]["size"]))
    return [
        {"kind": "label", "style": disc["style"], "points": point[None], "name": disc["name"], "place": place}
        | {"depth": math.inf}
        for disc, point, place in zip(discs, points, places, strict=True)
        if place is not None
    ]


def view_axes(yaw: float, pitch: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors of `base` to the right, up and towards who looks from an azimuth and an elevation."""
    towards = np.array([math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch)])
    right = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    return right, np.cross(towards, right), towards


def _at(values: Any, motion: int) -> np.ndarray:
    """The entry of a motion; of what does not move there is one."""
    return np.asarray(values[min(motion, len(values) - 1)], dtype=float)


def _lines(scene: Scene, cameras: PlacedCameras | None, advised: Scene | None) -> list[dict[str, Any]]:
    lines = []
    if scene.laparoscope_points is not None:
        lines.append(_line("laparoscope", scene.laparoscope_points))
    lines.append(_line("instrument", scene.instrument_points))
    lines.append(_line("shaft", np.stack([scene.rcm, scene.end], axis=1), scene.radius_mm))
    if cameras is not None:
        for side, pose in cameras.base_T_camera.items():
            corners, origin = _frustum(cameras, side, pose), pose[:, None, :3, 3]
            lines.append(_line("camera", corners[:, [0, 1, 2, 3, 0]]))
            for a, b in ((0, 1), (2, 3)):
                lines.append(_line("camera", np.concatenate([corners[:, [a]], origin, corners[:, [b]]], axis=1)))
    if advised is not None:
        lines.append(_line("advised", np.stack([advised.rcm, advised.end], axis=1), advised.radius_mm))
    axes = 40.0 * np.eye(3)
    lines += [
        _line(f"axis-{name}", np.stack([np.zeros(3), axis])[None]) for name, axis in zip("xyz", axes, strict=True)
    ]
    return lines


def _line(style: str, points: Float[np.ndarray, "*m p 3"], radius_mm: float = 0.0) -> dict[str, Any]:
    return {"style": style, "points": np.round(points, 2).tolist(), "radius": round(radius_mm, 3)}


def _discs(scene: Scene, cameras: PlacedCameras | None) -> list[dict[str, Any]]:
    points = {"base": np.zeros((1, 3)), "RCM": scene.rcm, "head point": scene.head}
    if scene.laparoscope_points is not None:
        points["arm"] = scene.base_T_arm[:, :3, 3]
    if cameras is not None:
        points |= {f"camera {side}": pose[:, :3, 3] for side, pose in cameras.base_T_camera.items()}
    return [
        {"style": name.replace(" ", "-").lower(), "name": name, "at": np.round(at, 2).tolist()}
        | {"side": -1 if name in _LABELLED_LEFT else 1}
        for name, at in points.items()
    ]


def _ellipsoids(cameras: PlacedCameras | None, magnification: int) -> list[dict[str, Any]]:
    if cameras is None or cameras.working_point is None or cameras.working_covariance is None:
        return []
    base = {
        "centre": np.round(cameras.working_point, 2).tolist(),
        "covariance": np.round(cameras.working_covariance, 6).tolist(),
    }
    items = [base | {"style": "sigma", "sigmas": SIGMAS}]
    if magnification > 1:
        items.append(base | {"style": "sigma-enlarged", "sigmas": SIGMAS * magnification})
    return items


def _sizes(covariance: Float[np.ndarray, "m 3 3"] | None) -> tuple[tuple[float, ...], int]:
    """Half axes of the ellipsoid, mm, and how many times it is to be enlarged."""
    if covariance is None:
        return (), 1
    half_axes = SIGMAS * np.sqrt(np.linalg.eigvalsh(covariance[0]).clip(0.0))[::-1]
    fitting = [factor for factor in _MAGNIFICATIONS if factor * half_axes[0] <= _LARGE_MM]
    return tuple(half_axes.tolist()), max(fitting, default=1)


def _frustum(cameras: PlacedCameras, side: str, pose: Float[np.ndarray, "m 4 4"]) -> Float[np.ndarray, "m 4 3"]:
    """Corners of a camera's picture, a little before it."""
    tall = math.tan(cameras.fov_rad[side] / 2.0)
    wide = tall * cameras.aspect[side]
    corners = _FRUSTUM_MM * np.array([[-wide, -tall, 1.0], [wide, -tall, 1.0], [wide, tall, 1.0], [-wide, tall, 1.0]])
    return np.einsum("mij,cj->mci", pose[:, :3, :3], corners) + pose[:, None, :3, 3]


def _fitted(scene: Scene, cameras: PlacedCameras | None) -> dict[str, Any]:
    """Middle and scale at which the shaft, the remote centre and the cameras fill the drawing."""
    points = [scene.rcm, scene.end, scene.head]
    if cameras is not None:
        points += [pose[:, :3, 3] for pose in cameras.base_T_camera.values()]
    every = np.concatenate(points)
    centre = (every.min(0) + every.max(0)) / 2.0
    reach = max(float(np.linalg.norm(every - centre, axis=1).max()), 1.0)
    return {"centre": np.round(centre, 2).tolist(), "scale": round(_FILL * SIZE[1] / reach, 5)}
