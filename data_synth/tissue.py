"""The background: a lit, bumpy, wet tissue surface that stands still in base. Pixels only (torch, float32)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from data_synth.kinematics import Array, rigid, rotation_from_rotvec

COARSE_PX = 4
"""The surface is intersected at every fourth pixel and interpolated between: its relief is smooth at that scale."""
STRIP_NODES = 12
"""Coarse rows shaded at a time on a CPU."""
HALF_EXTENT_MM = 120.0
"""Half the side of the textured square; beyond it the texture is mirrored."""
TEXTURE_SIZE = 1024
REFERENCE_MM = 115.0
"""Distance at which the light gives the nominal brightness."""
GLOSS_SHARPNESS = 220.0


def filtered_noise(generator: np.random.Generator, size: int, low: float, high: float, slope: float = 1.0) -> Array:
    """Periodic noise (size, size) of unit variance with wave numbers between `low` and `high` per side, amplitude ~ k^-slope."""
    frequency = np.fft.fftfreq(size, 1.0 / size)
    k = np.hypot(frequency[:, None], frequency[None, :])
    band = (
        np.where(k > 0, np.maximum(k, 1e-9) ** -slope, 0.0)
        * np.exp(-((k / high) ** 2))
        * (1.0 - np.exp(-((k / low) ** 2)))
    )
    field = np.fft.ifft2(np.fft.fft2(generator.standard_normal((size, size))) * band).real
    return (field - field.mean()) / field.std()


@dataclass(frozen=True)
class Tissue:
    """Textures over the square: encoded colour (S, S, 3); slope x, slope y and gloss (S, S, 3); relief (1, 1, s, s), mm."""

    base_T_tissue: Array
    colour: Tensor
    shape: Tensor
    relief: Tensor


def build_tissue(seed: int, base_T_camera_home: Array, gamma: float, device: torch.device) -> Tissue:
    """Tissue behind the target, its z axis towards the camera."""
    generator = np.random.default_rng([seed, 1])
    camera_T_tissue = rigid(rotation_from_rotvec([np.pi, 0.0, 0.0]), [0.0, 0.0, 138.0])
    camera_T_tissue = camera_T_tissue @ rigid(rotation_from_rotvec([0.25, 0.12, 0.4]), [0.0, 0.0, 0.0])
    size, mm_per_texel = TEXTURE_SIZE, 2.0 * HALF_EXTENT_MM / TEXTURE_SIZE
    relief = 3.0 * filtered_noise(generator, size, 2.0, 9.0)
    fine = (
        relief
        + 0.22 * filtered_noise(generator, size, 15.0, 60.0, 1.5)
        + 0.03 * filtered_noise(generator, size, 60.0, 250.0)
    )
    slope_y, slope_x = np.gradient(fine, mm_per_texel)
    colour = _tissue_colour(generator, size) ** (1.0 / gamma)
    gloss = np.clip(0.6 + 0.3 * filtered_noise(generator, size, 3.0, 30.0), 0.0, 1.2)
    shape = np.stack([slope_x, slope_y, gloss], axis=-1)
    coarse = relief[:: size // 256, :: size // 256]

    def tensor(values: Array) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(values, dtype=np.float32), device=device)

    return Tissue(
        base_T_tissue=base_T_camera_home @ camera_T_tissue,
        colour=tensor(np.moveaxis(colour, 0, -1)),
        shape=tensor(shape),
        relief=tensor(coarse[None, None]),
    )


def _tissue_colour(generator: np.random.Generator, size: int) -> Array:
    """Linear reflectance (3, size, size): red to pink tissue, streaks of paler tissue, branching vessels."""

    def mix(a: Array, b: Array, weight: Array) -> Array:
        return a * (1.0 - weight) + b * weight

    def smooth_step(x: Array, low: float, high: float) -> Array:
        u = np.clip((x - low) / (high - low), 0.0, 1.0)
        return u * u * (3.0 - 2.0 * u)

    red, pink = np.array([0.42, 0.10, 0.075])[:, None, None], np.array([0.60, 0.26, 0.20])[:, None, None]
    pale, dark = np.array([0.62, 0.40, 0.25])[:, None, None], np.array([0.26, 0.03, 0.035])[:, None, None]
    colour = mix(red, pink, smooth_step(filtered_noise(generator, size, 2.0, 14.0), -0.8, 1.2))
    colour = mix(colour, pale, 0.6 * smooth_step(filtered_noise(generator, size, 3.0, 12.0), 0.9, 1.8))
    for low, high, width, strength in ((4.0, 14.0, 0.035, 0.75), (12.0, 45.0, 0.04, 0.5)):
        ridge = np.abs(filtered_noise(generator, size, low, high, 1.5))
        present = smooth_step(filtered_noise(generator, size, 2.0, 8.0), 0.0, 0.8)
        colour = mix(colour, dark, strength * present * (1.0 - smooth_step(ridge, width, 2.5 * width)))
    return colour * (1.0 + 0.05 * filtered_noise(generator, size, 40.0, 400.0, 0.3))


def coarse_nodes(width: int, height: int) -> tuple[Array, tuple[int, int]]:
    """Pixels (h * w, 2) of the coarse grid that covers the picture, and (h, w)."""
    rows, columns = (height - 2) // COARSE_PX + 2, (width - 2) // COARSE_PX + 2
    v, u = np.meshgrid(np.arange(rows) * COARSE_PX, np.arange(columns) * COARSE_PX, indexing="ij")
    return np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64), (rows, columns)


@dataclass(frozen=True)
class CoarseView:
    """The surface at the coarse nodes, (B, n) or (B, n, 3), in tissue coordinates, mm."""

    points: Tensor
    to_light: Tensor
    to_camera: Tensor
    light_distance: Tensor


def intersect(tissue: Tissue, rays: Tensor, tissue_T_camera: Tensor, camera_p_light: Tensor) -> CoarseView:
    """Where rays (n, 3) meet the relief, for poses (B, 4, 4): three steps of plane intersection at the height found before."""
    R, origin = tissue_T_camera[:, :3, :3], tissue_T_camera[:, None, :3, 3]
    direction = rays @ R.mT  # (B, n, 3)
    # A ray that would run above the surface for ever is bent down to it: the far field stays defined.
    down = torch.clamp(-direction[..., 2], min=0.05)
    height = torch.zeros_like(down)
    for _ in range(3):
        point = origin + ((origin[..., 2] - height) / down)[..., None] * direction
        grid = point[:, None, :, :2] / HALF_EXTENT_MM
        relief = tissue.relief.expand(len(point), -1, -1, -1)
        height = F.grid_sample(relief, grid, padding_mode="reflection", align_corners=False)[:, 0, 0]
    point = origin + ((origin[..., 2] - height) / down)[..., None] * direction
    light = (R @ camera_p_light)[:, None] + origin - point
    distance = light.norm(dim=-1)
    camera = origin - point
    return CoarseView(point, light / distance[..., None], camera / camera.norm(dim=-1, keepdim=True), distance)


def shade(tissue: Tissue, view: CoarseView, gain: Tensor, grid_size: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Encoded picture (B, H, W, 3), 0 to 1, of the surface; `gain` (B, n) multiplies the encoded brightness.

    Works in encoded values: a product of linear factors is a product of encoded ones, so only one root is taken a pixel.
    """
    half = F.normalize(view.to_light + view.to_camera, dim=-1)
    coarse = torch.cat([view.points[..., :2] / HALF_EXTENT_MM, view.to_light, half, gain[..., None]], dim=-1)
    coarse = coarse.mT.unflatten(-1, grid_size)
    # On the CPU in strips that stay in the cache: three times faster than whole pictures (0.4 against 1.3 ns a value).
    step = grid_size[0] if gain.is_cuda else STRIP_NODES
    picture = gain.new_empty(len(gain), *size, 3)
    for row in range(0, grid_size[0] - 1, step):
        nodes = coarse[:, :, row : row + step + 1]
        strip = picture[:, row * COARSE_PX : (row + step) * COARSE_PX]
        full = ((nodes.shape[2] - 1) * COARSE_PX + 1, (grid_size[1] - 1) * COARSE_PX + 1)
        fine = F.interpolate(nodes, size=full, mode="bilinear", align_corners=True)
        _shade_strip(tissue, fine[..., : strip.shape[1], : strip.shape[2]], strip)
    return picture


def _shade_strip(tissue: Tissue, fine: Tensor, out: Tensor) -> None:
    """Shade pixels `out` (B, h, W, 3) from texture position, light, half vector and gain: `fine` (B, 9, h, W)."""
    grid = fine[:, :2].movedim(1, -1)
    colour, shape = _sample(tissue.colour, grid), _sample(tissue.shape, grid)
    slope_x, slope_y, gloss = shape.unbind(-1)
    normal_z = torch.rsqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
    facing = (fine[:, 4] - slope_x * fine[:, 2] - slope_y * fine[:, 3]) * normal_z
    mirror = (fine[:, 7] - slope_x * fine[:, 5] - slope_y * fine[:, 6]) * normal_z
    gain = fine[:, 8]
    brightness = gain * torch.sqrt(torch.clamp(facing, min=0.02))
    highlight = gloss * gain * torch.exp(GLOSS_SHARPNESS * (mirror - 1.0))
    torch.addcmul(highlight[..., None], colour, brightness[..., None], out=out)


def _sample(texture: Tensor, grid: Tensor) -> Tensor:
    """Bilinear samples (B, H, W, 3) of a texture (S, S, 3) at grid (B, H, W, 2), -1 to 1 across the square, mirrored beyond.

    On the CPU by OpenCV: measured 1.7 ms against 13 ms of torch's grid_sample for one picture of 640x480 on one core.
    """
    if texture.is_cuda:
        planes = texture.movedim(-1, 0)[None].expand(len(grid), -1, -1, -1)
        return F.grid_sample(planes, grid, padding_mode="reflection", align_corners=False).movedim(1, -1)
    texels = ((grid + 1.0) * (texture.shape[0] / 2) - 0.5).numpy()
    pictures = [cv2.remap(texture.numpy(), xy, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT) for xy in texels]
    return torch.from_numpy(np.stack(pictures))
