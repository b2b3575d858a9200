"""Pictures of a world: tissue, instruments, light, smoke, and the camera's ways. Draws with torch on any device; truth
is made elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
import torch
import torch.nn.functional as nnf
from torch import Tensor

from data_synth.cameras import Camera
from data_synth.draw import Brush, InstrumentPoses, RayMap, draw_instrument, shadow
from data_synth.foreground import LoopPoses, draw_loop
from data_synth.instruments import edge
from data_synth.kinematics import Array, rigid_inverse, transform_points
from data_synth.materials import other_finish, own_finish
from data_synth.props import OtherInstrument, TissueLoop
from data_synth.scene import ShaftInCamera
from data_synth.sensor import Sensor
from data_synth.settings import SynthConfig
from data_synth.textures import filtered_noise
from data_synth.tissue import REFERENCE_MM, Tissue, build_tissue, coarse_nodes, intersect, refine, shade, smear
from data_synth.truth import SideTruth, side_truth
from data_synth.world import World, build_world

CAMERA_RIGHT_P_LIGHT = np.array([2.5, -4.5, -1.0])
"""End of the light guide, between and above the two lenses, mm."""
OTHER_WRIST_RATIO = 0.9
SMOKE_COLOUR = (0.74, 0.73, 0.76)
READOUT_KNOTS = 9
SMOKE_SPEED = np.array([0.11, -0.07])
"""Drift of the smoke, pictures a second."""


_Swept = TypeVar("_Swept", InstrumentPoses, LoopPoses)


@dataclass(frozen=True)
class _View:
    """A camera's fixed maps on the device: rays of all pixels, of the coarse nodes (h, w, 3), and the light that passes
    (H, W, 1). A field holds the pixels of every second row."""

    side: str
    rays: RayMap
    coarse_rays: Tensor
    passed: Tensor
    parity: int | None = None
    """The first row, where only every second one is taken."""

    def field(self, parity: int) -> _View:
        """Every second row, from row `parity` on."""
        return replace(self, rays=self.rays.field(parity), passed=self.passed[parity::2], parity=parity)


class Renderer:
    """Renders frames of a world; the same world gives the same pictures."""

    def __init__(self, world: World, device: str | torch.device = "cpu") -> None:
        self.world = world
        self.device = torch.device(device)
        self.settings, self.look = world.config.camera, world.config.look
        seed, home = world.config.seed, world.scene.base_T_camera_home
        self.tissue: Tissue = build_tissue(seed, home, self.look, self.settings.gamma, self.device)
        self.sensor = Sensor(self.settings, seed, len(world.frame_times_s), self.device)
        self.views = {side: self._view(side, camera) for side, camera in world.cameras.items()}
        self.fields = {side: (view.field(0), view.field(1)) for side, view in self.views.items()}
        smoke = filtered_noise(np.random.default_rng([seed, 5]), 256, 1.0, 12.0, 1.2)
        self._smoke = self._tensor(np.clip(0.5 + 0.3 * smoke, 0.05, 1.0))[None, None]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the pictures."""
        return self.settings.height_px, self.settings.width_px

    def render(self, side: str, frames: Array) -> Tensor:
        """Pictures (B, H, W, 3), uint8 RGB, of one camera at frame indices (B,)."""
        with torch.inference_mode():
            return self.sensor.expose(self.encoded(side, frames), frames, side)

    def encoded(self, side: str, frames: Array) -> Tensor:
        """Encoded pictures (B, H, W, 3), 0 to 1, before the sensor; smeared by the exposure, woven of two fields."""
        times, delay = self.world.frame_times_s[frames], self.settings.field_delay_s
        if not delay:
            return self._picture(frames, times, self.views[side])
        picture = torch.empty((len(frames), *self.size, 3), device=self.device)
        for view in self.fields[side]:
            shift = (view.parity or 0) - 0.5
            picture[:, view.parity :: 2] = self._picture(frames, times + shift * delay, view)
        return picture

    def _picture(self, frames: Array, times: Array, view: _View) -> Tensor:
        """Picture of one exposure, or with rows read one after the other."""
        world, side = self.world, view.side
        offsets, weights = self._reading(len(view.coarse_rays))
        middle, times = times, times[:, None] + offsets  # (B, K)
        frames = np.broadcast_to(frames[:, None], times.shape)
        base_T_camera = np.einsum("rk,bkij->brij", weights, world.base_T_camera(side, times))  # (B, R, 4, 4)
        light = self._tensor(transform_points(world.camera_T_camera_right(side), CAMERA_RIGHT_P_LIGHT), torch.float64)
        brush = Brush(view.rays, light, self.settings.blur_px, self.settings.gamma)
        instruments = [
            (self._swept(partial(self._other_poses, side, other), times, weights), other_finish(other.kind))
            for other in world.props.others
        ]
        instruments.append((self.swept_poses(side, frames, times, weights), own_finish(self.look)))
        picture = self._background(view, base_T_camera, light, [poses for poses, _ in instruments])
        if self._spread_s:
            picture = smear(picture, self._tissue_motion_px(view, middle))
        for poses, finish in instruments:
            draw_instrument(picture, brush, poses, finish)
        for loop in world.props.loops:
            loop_poses = self._swept(partial(self._loop_poses, side, loop), times, weights)
            draw_loop(picture, brush, loop_poses, self.tissue)
        if self.look.smoke:
            self._blow_smoke(picture, view, times[:, 0])
        return picture.mul_(view.passed)

    @property
    def _spread_s(self) -> float:
        """Standard deviation of the instants of an exposure about its middle."""
        return self.settings.exposure_s / np.sqrt(12.0)

    def _reading(self, rows: int) -> tuple[Array, Array]:
        """When poses are computed (K,), relative to the frame, and their weights (R, K) for the groups of rows.

        Over a readout of some milliseconds motion is straight between nine instants to a thousandth of a pixel.
        """
        if not self.settings.readout_s:
            return np.zeros(1), np.ones((1, 1))
        at = (np.arange(rows) + 0.5) / rows - 0.5
        knots = np.linspace(at[0], at[-1], READOUT_KNOTS)
        weights = np.maximum(0.0, 1.0 - np.abs(at[:, None] - knots) / (knots[1] - knots[0]))
        return self.settings.readout_s * knots, weights

    def _swept(self, poses_at: Callable[[Array], _Swept], times: Array, weights: Array) -> _Swept:
        """Poses in the middle of the exposure at groups of rows, with those one sigma earlier and later."""
        mixture = self._tensor(weights, torch.float64)
        if not self._spread_s:
            return poses_at(times).between(mixture)
        early, middle, late = poses_at(times + self._spread_s * np.array([-1.0, 0.0, 1.0])[:, None, None]).unbind()
        return replace(middle.between(mixture), sweep=(early.between(mixture), late.between(mixture)))

    def _tissue_motion_px(self, view: _View, times: Array) -> Tensor:
        """How far the tissue moves in the middle of the picture over the exposure, 1 sigma, (B, 2); columns and rows of
        the view."""
        tissue = self.tissue.base_T_tissue @ np.array([0.0, 0.0, 0.0, 1.0])
        base_p = np.broadcast_to(tissue[:3], (len(times), 3))
        seen = []
        for sign in (-1.0, 1.0):
            camera_T_base = rigid_inverse(self.world.base_T_camera(view.side, times + sign * self._spread_s))
            p = transform_points(camera_T_base, base_p)
            seen.append(p[:, :2] / p[:, 2:])
        scale = [1.0, 1.0] if view.parity is None else [1.0, 0.5]
        return self._tensor(0.5 * view.rays.focal_px * (seen[1] - seen[0]) * scale)

    def _background(
        self, view: _View, base_T_camera: Array, light: Tensor, instruments: list[InstrumentPoses]
    ) -> Tensor:
        """Lit tissue with the instruments' shadows."""
        tissue_T_camera = self._tensor(rigid_inverse(self.tissue.base_T_tissue) @ base_T_camera)
        surface = intersect(self.tissue, view.coarse_rays, tissue_T_camera, light.float())
        gain = (REFERENCE_MM / surface.light_distance) ** (2.0 / self.settings.gamma)
        gain = torch.clamp(gain, max=2.0) * self.look.brightness
        if self.look.shadow:
            R, origin = tissue_T_camera[..., :3, :3], tissue_T_camera[..., None, :3, 3]
            camera_p_surface = (surface.points - origin) @ R
            dark = torch.stack([shadow(camera_p_surface, light, poses) for poses in instruments]).amax(0)
            gain = gain * (1.0 - self.look.shadow * dark)
        return shade(self.tissue, surface, gain, self.size, view.parity)

    def swept_poses(self, side: str, frames: Array, times: Array, weights: Array) -> InstrumentPoses:
        """The logged instrument in a camera over the exposures about `times`; `frames` and `times` are (B, K), mixed by
        weights (R, K)."""
        return self._swept(partial(self._own_poses, side, frames), times, weights)

    def _own_poses(self, side: str, frames: Array, times: Array) -> InstrumentPoses:
        """The logged instrument in a camera; `frames` (B, R) and `times` (..., B, R)."""
        shaft, camera_T_rcm = self.world.shaft(side, frames, times)
        return self._poses(shaft, camera_T_rcm[..., :3, 0], self.look.wrist_radius_ratio)

    def _other_poses(self, side: str, other: OtherInstrument, times: Array) -> InstrumentPoses:
        """An instrument that is not logged; its jaws stay in one plane of base."""
        near_side = np.swapaxes(self.world.base_T_camera(side, times)[..., :3, :3], -1, -2)[..., 0]
        return self._poses(self.world.other_shaft(side, other, times), near_side, OTHER_WRIST_RATIO)

    def _poses(self, shaft: ShaftInCamera, near_side: Array, wrist_ratio: float) -> InstrumentPoses:
        p, v = shaft.camera_p_rcm, shaft.camera_v_axis
        s_head = np.einsum("...i,...i->...", shaft.camera_p_head - p, v)
        sideways = np.cross(v, near_side)
        sideways /= np.linalg.norm(sideways, axis=-1, keepdims=True)
        tensors = [self._tensor(a, torch.float64) for a in (p, v, sideways, shaft.s_end_mm, s_head)]
        return InstrumentPoses(*tensors, radius=shaft.radius_mm, wrist_ratio=wrist_ratio)

    def _loop_poses(self, side: str, loop: TissueLoop, times: Array) -> LoopPoses:
        """Tissue in the foreground."""
        camera_T_base = rigid_inverse(self.world.base_T_camera(side, times))
        a, b = (self._tensor(transform_points(camera_T_base, p)) for p in (loop.base_p_a, loop.base_p_b))
        return LoopPoses(a, b, loop.radius_mm)

    def _blow_smoke(self, picture: Tensor, view: _View, times: Array) -> None:
        """Mix drifting smoke over the pictures, in place."""
        rows, columns = view.coarse_rays.shape[:2]
        v, u = np.meshgrid(np.linspace(-0.5, 0.5, rows), np.linspace(-0.5, 0.5, columns), indexing="ij")
        grid = np.stack([u, v], axis=-1) + (SMOKE_SPEED * times[:, None])[:, None, None]
        smoke = self._smoke.expand(len(times), -1, -1, -1)
        density = nnf.grid_sample(smoke, self._tensor(grid), padding_mode="reflection", align_corners=False)
        first, skip = (0, 1) if view.parity is None else (view.parity, 2)
        density = refine(density, first, skip)[:, 0, : picture.shape[1], : self.size[1], None]
        picture.lerp_(torch.tensor(SMOKE_COLOUR, device=self.device), self.look.smoke * density)

    def _tensor(self, values: Array, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.as_tensor(np.array(values, order="C"), dtype=dtype, device=self.device)

    def _view(self, side: str, camera: Camera) -> _View:
        v, u = np.meshgrid(np.arange(camera.height), np.arange(camera.width), indexing="ij")
        xy, jacobian = camera.rays(np.stack([u, v], axis=-1).astype(np.float64))
        coarse_xy, _ = camera.rays(coarse_nodes(camera.width, camera.height))
        coarse_rays = np.concatenate([coarse_xy, np.ones((*coarse_xy.shape[:2], 1))], axis=-1)
        rays = RayMap(
            self._tensor(np.moveaxis(xy, -1, 0)),
            self._tensor(np.moveaxis(jacobian.reshape(*xy.shape[:2], 4), -1, 0)),
            0.5 * (camera.fx + camera.fy),
            self._tensor(np.arange(camera.height) / camera.height, torch.float64),
            float(np.linalg.norm(jacobian[..., 0], axis=-1).max()),
        )
        passed = self._tensor(1.0 - self.settings.vignette * np.minimum((xy**2).sum(-1) / 0.36, 1.2) ** 1.3)
        if self.settings.round_field:
            off = np.hypot(u - (camera.width - 1.0) / 2.0, v - (camera.height - 1.0) / 2.0)
            passed *= edge(self._tensor(self.settings.round_field * camera.width / 2.0 - off), 1.5)
        return _View(side, rays, self._tensor(coarse_rays), passed[..., None])


def render_frames(
    config: SynthConfig, count: int | None = None, side: str = "right", device: str = "cpu"
) -> tuple[Tensor, SideTruth]:
    """Pictures in memory with their truth, for one camera.

    Args:
        config: what to render.
        count: number of frames instead of `config.motions`.
        side: "right" or "left".
        device: torch device that draws; the pictures stay there.

    Returns:
        pictures (N, 3, H, W) uint8 RGB, as the camera gives them (without H.264), and the truth of all N frames.
    """
    world = build_world(config if count is None else replace(config, motions=count))
    renderer, total = Renderer(world, device), len(world.frame_times_s)
    step = 16 if renderer.device.type == "cuda" else 1
    batches = [renderer.render(side, np.arange(i, min(i + step, total))) for i in range(0, total, step)]
    return torch.cat(batches).movedim(-1, 1).contiguous(), side_truth(world, side)
