"""Drawings of cameras (what each sees, and how they lie to each other) and of robots (where the arms reach)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rmis_calib.geometry.cameras import Camera, StereoRig
from rmis_calib.io.atomic import atomic_write
from rmis_calib.kinematics.robot_check import ArmReport

_COLOURS = {"right": "#1f6fb4", "left": "#c05a12"}
_DEPTH_BASELINES, _DEPTH_MONO_MM = 8.0, 100.0
_POINTS_A_SIDE = 24


def draw_cameras(rig: StereoRig, path: Path) -> None:
    """Both cameras' fields of view, seen from above and from the side; lens distortion included.

    Args:
        rig: the cameras.
        path: picture to write (.png).

    Raises:
        OutputError: it cannot be written.
    """
    depth_mm = _DEPTH_MONO_MM
    views = {"right": (rig.right, np.eye(4))}
    if rig.left is not None and rig.camera_left_T_camera_right is not None:
        extrinsics = rig.camera_left_T_camera_right
        depth_mm = max(_DEPTH_BASELINES * float(extrinsics.t.norm()), 1.0)
        views["left"] = (rig.left, extrinsics.inverse().matrix.double().numpy())
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, across, title in zip(figure.subplots(1, 2), (0, 1), ("from above", "from the side"), strict=True):
        for side, (camera, right_T_camera) in views.items():
            _draw_frustum(axes, _outline(camera, depth_mm), right_T_camera, across, side)
        axes.set(
            xlabel="z of camera_right, mm", ylabel=f"{'xy'[across]} of camera_right, mm", title=title, aspect="equal"
        )
        axes.grid(alpha=0.3)
        if across == 1:
            axes.invert_yaxis()  # y points down
    figure.axes[0].legend(loc="upper left")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def draw_robot(arms: Sequence[ArmReport], path: Path) -> None:
    """Every arm in some poses, in `base` and from three sides: shafts from RCM to head point, or the frames' origins.

    Args:
        arms: from `check_robot`.
        path: picture to write (.png).

    Raises:
        OutputError: it cannot be written.
    """
    figure = Figure(figsize=(13.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (u, v) in zip(figure.subplots(1, 3), ((0, 1), (0, 2), (1, 2)), strict=True):
        for number, arm in enumerate(arms):
            for i, points in enumerate(arm.segments_mm):
                label = arm.name if i == 0 else None
                axes.plot(points[:, u], points[:, v], "-", color=f"C{number}", linewidth=1.0, label=label)
                axes.plot(points[-1, u], points[-1, v], ".", color=f"C{number}")
            if arm.is_instrument and len(arm.segments_mm):
                axes.plot(
                    arm.segments_mm[0, 0, u], arm.segments_mm[0, 0, v], "o", color=f"C{number}", markerfacecolor="none"
                )
        axes.set(xlabel=f"{'xyz'[u]} of base, mm", ylabel=f"{'xyz'[v]} of base, mm", aspect="equal")
        axes.grid(alpha=0.3)
    figure.axes[0].legend(loc="best")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def field_of_view_deg(camera: Camera) -> tuple[float, float]:
    """Angles between the middles of opposite edges of the picture, horizontal and vertical; NaN beyond a fold."""
    height, width = camera.image_size
    cx, cy = float(camera.cx), float(camera.cy)
    edges = torch.tensor([[-0.5, cy], [width - 0.5, cy], [cx, -0.5], [cx, height - 0.5]]).to(camera.fx)
    xy, valid = camera.undistort_points(edges)
    rays = torch.nn.functional.normalize(torch.nn.functional.pad(xy, (0, 1), value=1.0), dim=-1)
    cosines = (rays[[0, 2]] * rays[[1, 3]]).sum(-1).clamp(-1.0, 1.0)
    angles = torch.where(valid[[0, 2]] & valid[[1, 3]], torch.rad2deg(torch.acos(cosines)), torch.nan)
    return float(angles[0]), float(angles[1])


def _outline(camera: Camera, depth_mm: float) -> np.ndarray:
    """(4, n, 3) mm: the picture's four edges at a distance, in the camera's frame."""
    height, width = camera.image_size
    corners = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]])
    part = np.linspace(0.0, 1.0, _POINTS_A_SIDE)[:, None]
    edges = np.stack([corners[i] * (1 - part) + corners[(i + 1) % 4] * part for i in range(4)])
    xy, valid = camera.undistort_points(torch.from_numpy(edges).to(camera.fx))
    points = np.concatenate([xy.double().numpy(), np.ones((*edges.shape[:2], 1))], axis=-1) * depth_mm
    return np.where(valid.numpy()[..., None], points, np.nan)


def _draw_frustum(axes: Axes, outline: np.ndarray, right_T_camera: np.ndarray, across: int, side: str) -> None:
    centre = right_T_camera[:3, 3]
    for number, edge in enumerate(outline):
        points = edge @ right_T_camera[:3, :3].T + centre
        rays = np.stack([centre, points[0]])
        axes.plot(points[:, 2], points[:, across], color=_COLOURS[side], linewidth=1.2)
        axes.plot(rays[:, 2], rays[:, across], color=_COLOURS[side], linewidth=0.8)
        if number == 0:
            axes.plot(centre[2], centre[across], "o", color=_COLOURS[side], label=f"camera_{side}")
