"""Pictures of a world: tissue, instrument, vignette, sensor noise. Draws with torch on any device; truth is made elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from data_synth.cameras import Camera
from data_synth.draw import InstrumentPoses, RayMap, draw_instrument
from data_synth.kinematics import Array, rigid_inverse, transform_points
from data_synth.tissue import REFERENCE_MM, Tissue, build_tissue, coarse_nodes, intersect, shade
from data_synth.world import World

CAMERA_RIGHT_P_LIGHT = np.array([2.5, -4.5, -1.0])
"""End of the light guide, between and above the two lenses, mm."""
VIGNETTE = 0.55
"""Loss of encoded brightness at normalised radius 0.6."""


@dataclass(frozen=True)
class _View:
    """A camera's fixed maps on the device."""

    camera: Camera
    rays: RayMap
    coarse_rays: Tensor
    coarse_size: tuple[int, int]
    vignette: Tensor


class Renderer:
    """Renders frames of a world."""

    def __init__(self, world: World, device: str | torch.device = "cpu") -> None:
        self.world = world
        self.device = torch.device(device)
        self.gamma = world.config.camera.gamma
        home = world.scene.base_T_camera_home
        self.tissue: Tissue = build_tissue(world.config.seed, home, self.gamma, self.device)
        self.views = {side: self._view(camera) for side, camera in world.cameras.items()}
        self._noise = torch.randn(1 << 22, generator=torch.Generator().manual_seed(world.config.seed)).to(self.device)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the pictures."""
        camera = self.world.config.camera
        return camera.height_px, camera.width_px

    def _tensor(self, values: Array, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.as_tensor(np.array(values), dtype=dtype, device=self.device)

    def _view(self, camera: Camera) -> _View:
        v, u = np.meshgrid(np.arange(camera.height), np.arange(camera.width), indexing="ij")
        xy, jacobian = camera.rays(np.stack([u, v], axis=-1).astype(np.float64))
        nodes, coarse_size = coarse_nodes(camera.width, camera.height)
        coarse_xy, _ = camera.rays(nodes)
        coarse_rays = np.concatenate([coarse_xy, np.ones((len(coarse_xy), 1))], axis=-1)
        vignette = 1.0 - VIGNETTE * np.minimum((coarse_xy**2).sum(-1) / 0.36, 1.2) ** 1.3
        rays = RayMap(self._tensor(xy), self._tensor(jacobian.reshape(-1, 4)), 0.5 * (camera.fx + camera.fy))
        return _View(camera, rays, self._tensor(coarse_rays), coarse_size, self._tensor(vignette))

    def render(self, side: str, frames: Array) -> Tensor:
        """Pictures (B, H, W, 3), uint8 RGB, of one camera at frame indices (B,)."""
        with torch.inference_mode():
            picture = self._encoded(side, frames)
            return self._expose(picture, frames, side)

    def _encoded(self, side: str, frames: Array) -> Tensor:
        """Encoded pictures (B, H, W, 3), 0 to 1, without noise."""
        world, view, look = self.world, self.views[side], self.world.config.look
        times = world.frame_times_s[frames]
        light = transform_points(world.camera_T_camera_right(side), CAMERA_RIGHT_P_LIGHT)
        tissue_T_camera = rigid_inverse(self.tissue.base_T_tissue) @ world.base_T_camera(side, times)
        surface = intersect(self.tissue, view.coarse_rays, self._tensor(tissue_T_camera), self._tensor(light))
        gain = torch.clamp((REFERENCE_MM / surface.light_distance) ** (2.0 / self.gamma), max=2.0) * view.vignette
        size = (view.camera.height, view.camera.width)
        picture = shade(self.tissue, surface, gain, view.coarse_size, size)
        poses = self._instrument(side, frames, times)
        light_tensor = self._tensor(light, torch.float64)
        draw_instrument(
            picture, view.rays, poses, light_tensor, look.wrist_radius_ratio, world.config.camera.blur_px, self.gamma
        )
        return picture

    def _instrument(self, side: str, frames: Array, times: Array) -> InstrumentPoses:
        shaft, camera_T_rcm = self.world.shaft(side, frames, times)
        v = shaft.camera_v_axis
        s_head = np.einsum("ki,ki->k", shaft.camera_p_head - shaft.camera_p_rcm, v)
        sideways = np.cross(v, camera_T_rcm[:, :3, 0])
        sideways /= np.linalg.norm(sideways, axis=-1, keepdims=True)
        p, v, sideways, s_end, s_head = (
            self._tensor(a, torch.float64) for a in (shaft.camera_p_rcm, v, sideways, shaft.s_end_mm, s_head)
        )
        return InstrumentPoses(p, v, sideways, s_end, s_head, shaft.radius_mm)

    def _expose(self, picture: Tensor, frames: Array, side: str) -> Tensor:
        """Sensor noise and rounding: (B, H, W, 3) uint8."""
        levels = picture.mul_(255.0)
        sigma = self.world.config.camera.noise_levels
        if sigma > 0.0:
            count = levels[0].numel()
            generator = np.random.default_rng([self.world.config.seed, 2, int(frames[0]), side == "left"])
            for image in levels:
                start = int(generator.integers(0, len(self._noise) - count))
                image.add_(self._noise[start : start + count].view_as(image), alpha=sigma)
        return levels.add_(0.5).clamp_(0.0, 255.0).to(torch.uint8)
