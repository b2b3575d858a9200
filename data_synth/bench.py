"""Pictures of instruments over a laboratory bench, with exact truth: other surfaces, metals, lights and clutter than in
the operating scene, drawn anew in every picture. For training and testing detectors; no joints belong to them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from data_synth.clutter import draw_clutter
from data_synth.contours import front_point, to_image, view_cylinder
from data_synth.draw import Brush, InstrumentPoses, RayMap, draw_instrument
from data_synth.kinematics import Array
from data_synth.materials import Band, Finish, Surface
from data_synth.sensor import Sensor
from data_synth.settings_picture import CameraSettings

FOCAL = 1.15
"""Focal length over the picture's width."""
RADIUS_MM = 4.0
BEYOND = np.array([[-2.0], [1.0]])
"""So many widths a cast shadow reaches beyond the shaft's visible part, at its start and at its end."""
SHORTEST_VISIBLE_MM = 8.0
"""A shaft of which less is in the picture counts as not visible."""


@dataclass(frozen=True)
class BenchShaft:
    """The truth of one instrument in one picture, in pixels.

    Attributes:
        contour_uv: (2, 2, 2) [edge, point, uv] of either contour: where the shaft enters the picture and where it ends
            or leaves it; edge 0 left of the axis, directed to the tip.
        end_uv: (2,) where the shaft's near rim crosses the axis; it may lie outside the picture.
        ring: whether a bright ring closes the shaft.
        visible: whether enough of it is in the picture to see that it is one.
    """

    contour_uv: Array
    end_uv: Array
    ring: bool
    visible: bool


def render_bench(
    seed: int, count: int, height: int = 480, width: int = 640, most: int = 2
) -> tuple[Tensor, list[list[BenchShaft]]]:
    """Pictures (count, 3, H, W), uint8 RGB, each with up to `most` instruments, and the truth of each."""
    pictures, truth = [], []
    for i in range(count):
        generator = np.random.default_rng([seed, i, 77])
        picture, shafts = _picture(generator, height, width, int(generator.choice(most + 1)))
        pictures.append(picture)
        truth.append(shafts)
    return torch.stack(pictures).movedim(-1, 1).contiguous(), truth


def _picture(
    generator: np.random.Generator, height: int, width: int, instruments: int
) -> tuple[Tensor, list[BenchShaft]]:
    background = draw_clutter(generator, height, width)
    focal = FOCAL * width * generator.uniform(0.8, 1.3)
    poses = [_pose(generator, height, width, focal) for _ in range(instruments)]
    finishes = [_finish(generator) for _ in poses]
    for pose in poses:
        if generator.random() < 0.7:
            background = _cast_shadow(generator, background, pose, focal)
    picture = torch.from_numpy(background)[None].contiguous()
    light = torch.as_tensor(generator.uniform([-80, -80, -20], [80, 80, 20]), dtype=torch.float64)
    blur = generator.uniform(0.45, 1.6)
    brush = Brush(_rays(height, width, focal), light, blur, 2.2)
    for pose, finish in zip(poses, finishes, strict=True):
        draw_instrument(picture, brush, pose, finish)
    if generator.random() < 0.25:
        picture = picture @ picture.new_tensor([0.3, 0.59, 0.11])[:, None] * torch.ones(3)
    vignette = generator.uniform(0.0, 0.7)
    off = brush.rays.xy.square().sum(0)
    picture *= (1 - vignette * (off / off.max()) ** 1.2)[None, ..., None]
    settings = CameraSettings(
        width_px=width,
        height_px=height,
        noise_levels=generator.uniform(0.5, 6.0),
        colour_noise_levels=generator.uniform(0.0, 3.0),
        sharpening=generator.uniform(0.0, 0.8),
        bayer=bool(generator.random() < 0.3),
        jpeg_quality=int(generator.integers(40, 98)) if generator.random() < 0.6 else None,
    )
    sensor = Sensor(settings, int(generator.integers(2**31)), 1, torch.device("cpu"))
    shown = sensor.expose(picture, np.array([0]), "right")[0]
    centre = np.array([width - 1.0, height - 1.0]) / 2
    ringed = [bool(finish.bands and finish.bands[0].s_to_mm > 0) for finish in finishes]
    return shown, [_truth(p, focal, centre, ring) for p, ring in zip(poses, ringed, strict=True)]


def _rays(height: int, width: int, focal: float) -> RayMap:
    """Rays of a camera without distortion whose axis meets the middle of the picture."""
    v, u = np.mgrid[:height, :width].astype(np.float32)
    xy = torch.as_tensor(np.stack([u - (width - 1) / 2, v - (height - 1) / 2]) / focal)
    jacobian = torch.tensor([1.0, 0.0, 0.0, 1.0])[:, None, None].expand(4, height, width) / focal
    read_at = torch.arange(height, dtype=torch.float64) / height
    return RayMap(xy, jacobian.contiguous(), focal, read_at, 1.0 / focal)


def _pose(generator: np.random.Generator, height: int, width: int, focal: float) -> InstrumentPoses:
    """An instrument that comes from beside the picture or from behind the camera; its tip mostly in the picture."""
    depth = focal * 2 * RADIUS_MM / (width * np.exp(generator.uniform(np.log(0.03), np.log(0.2))))
    reach = 0.95 if generator.random() < 0.85 else 1.6
    head_uv = generator.uniform(-0.5, 0.5, 2) * reach * [width, height]
    head = np.append(head_uv / focal, 1.0) * depth
    # From the side of the picture that is farther off, or anyhow.
    angle = generator.uniform(0.0, 2 * np.pi)
    if generator.random() < 0.5:
        angle = np.arctan2(head_uv[1], head_uv[0]) + np.pi + generator.normal(0.0, 0.7)
    tilt = generator.uniform(-0.25, 0.6)
    v = np.array([np.cos(angle), np.sin(angle), tilt])
    v /= np.linalg.norm(v)
    wrist = generator.uniform(3.0, 16.0)
    side = np.cross(v, generator.normal(size=3))
    side /= np.linalg.norm(side)
    p_axis, v_axis, sideways = (torch.as_tensor(a, dtype=torch.float64)[None, None] for a in (head - 40.0 * v, v, side))
    s_end, s_head = (torch.tensor([[s]], dtype=torch.float64) for s in (40.0 - wrist, 40.0))
    ratio = generator.uniform(0.8, 1.0)
    return InstrumentPoses(p_axis, v_axis, sideways, s_end, s_head, radius=RADIUS_MM, wrist_ratio=ratio)


def _finish(generator: np.random.Generator) -> Finish:
    """Surfaces of an instrument: any dark tube, any wrist, often a ring between them, at times bands round the tube."""

    def surface(low: float, high: float, tint: float, shine: float, pattern: str = "plain") -> Surface:
        grey = np.exp(generator.uniform(np.log(low), np.log(high)))
        colour = np.clip(grey * (1.0 + tint * generator.uniform(-1.0, 1.0, 3)), 0.002, 0.95)
        sharpness = generator.uniform(5.0, 30.0)
        return Surface(tuple(colour.tolist()), shine * generator.uniform(0.0, 1.0), sharpness, pattern)  # pyright: ignore

    tube = surface(0.006, 0.07, 0.35, 0.08, str(generator.choice(["plain", "plain", "carbon"])))
    if generator.random() < 0.3:
        tube = replace(tube, glare=0.05 * np.exp(generator.uniform(0.0, 3.0)))
    if generator.random() < 0.2:  # hardly lit: a silhouette, as in pictures of masks
        tube = surface(0.001, 0.01, 0.2, 0.0)
    level = max(tube.reflectance)
    sleeve = surface(1.3 * level, 0.4, 0.1, 0.6, str(generator.choice(["plain", "metal"])))
    clevis = surface(max(0.04, level), 0.4, 0.1, 0.7, "clevis")
    bands = []
    if generator.random() < 0.45:
        ring = surface(max(0.12, 3 * level), 0.7, 0.1, 0.6)
        bands.append(Band(1.0, ring, 0.0, generator.uniform(0.4, 1.6)))
        if generator.random() < 0.6:  # beyond a ring the wrist's base may be as dark as the tube
            sleeve = replace(surface(0.8 * level, 1.6 * level, 0.1, 0.1), pattern="plain")
        if generator.random() < 0.4:
            second = generator.uniform(1.5, 4.0)
            bands.append(Band(1.0, surface(2 * level, 0.3, 0.1, 0.3), second, second + generator.uniform(0.3, 0.8)))
    for _ in range(generator.choice(3, p=[0.75, 0.15, 0.1])):
        start = -generator.uniform(6.0, 40.0)
        around = surface(0.02, 0.6, 1.0, 0.3)
        bands.append(Band(generator.uniform(1.0, 1.7), around, start, start + generator.uniform(2.0, 10.0)))
    return Finish(tube, sleeve, clevis, tuple(bands))


def _cast_shadow(generator: np.random.Generator, background: Array, pose: InstrumentPoses, focal: float) -> Array:
    """The background darkened by the instrument's shadow: its outline, moved and softened."""
    height, width = background.shape[:2]
    centre = np.array([width - 1.0, height - 1.0]) / 2
    contour = _truth(pose, focal, centre, False).contour_uv
    broad = np.linalg.norm(contour[0].mean(0) - contour[1].mean(0))
    along = contour[:, 1] - contour[:, 0]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    outline = np.concatenate([contour[0] + broad * BEYOND * along[0], (contour[1] + broad * BEYOND * along[1])[::-1]])
    outline = outline + generator.uniform(-1.6, 1.6, 2) * broad
    mask = np.zeros((height, width), np.float32)
    cv2.fillPoly(mask, [np.round(np.clip(outline, -4000, 4000) * 16).astype(np.int32)], 1.0, cv2.LINE_AA, 4)
    mask = cv2.GaussianBlur(mask, (0, 0), generator.uniform(1.5, 0.3 * broad + 2.0))
    return background * (1.0 - generator.uniform(0.15, 0.7) * mask[..., None])


def _truth(pose: InstrumentPoses, focal: float, centre: Array, ring: bool) -> BenchShaft:
    p, v = pose.p_axis[0, 0].numpy(), pose.v_axis[0, 0].numpy()
    view = view_cylinder(p, v, pose.radius)
    s = float(pose.s_end[0, 0]) - np.linspace(0.0, 400.0, 1601)[::-1]
    axis = p + s[:, None] * v
    inside = (np.abs(to_image(axis) * focal) <= centre + 0.5).all(-1)  # NaN behind the camera: not inside
    visible = int(inside.sum()) > 4 * SHORTEST_VISIBLE_MM
    seen = axis[inside] if visible else axis[-2:]
    contact = seen[[0, -1]] + np.array([-pose.radius, pose.radius])[:, None, None] * view.n_contour[:, None]
    end = to_image(front_point(axis[-1], view, pose.radius))
    return BenchShaft(to_image(contact) * focal + centre, end * focal + centre, ring, visible)
