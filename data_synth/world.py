"""Everything that is true of one synthetic recording: scene, cameras, motion, and the poses at any time. float64
NumPy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data_synth.cameras import Camera, build_camera
from data_synth.kinematics import Array, pose_noise, rigid_inverse, transform_points
from data_synth.motion import JointPath, plan_path
from data_synth.props import HEAD_BEYOND_MM, RADIUS_MM, WRIST_MM, OtherInstrument, Props, hidden_by, place_props
from data_synth.scene import Scene, ShaftInCamera, build_scene, poses_at, shaft_in_camera
from data_synth.settings import SynthConfig

ABSENT_MM = 400.0
"""An instrument that is absent is withdrawn this far."""
SHOWN_MM = 12.0
"""At a stop that is in view, at least so much of the shaft is."""
VIEW_MARGIN = 0.03
"""A point counts as comfortably in view this far (normalised units) inside the picture's border."""


@dataclass(frozen=True)
class World:
    """The truth of a recording with N frames.

    Attributes:
        scene: arms and fixed transforms.
        cameras: by side, "right" and unless monocular "left".
        path: joint readings at any time.
        frame_times_s: (N,).
        rcm_noise: (N, 4, 4) what right-multiplies the kinematics' pose of the RCM frame to give the one that is seen.
        present: (N,) whether the logged instrument is there.
        props: other instruments and foreground tissue.
    """

    config: SynthConfig
    scene: Scene
    cameras: dict[str, Camera]
    path: JointPath
    frame_times_s: Array
    rcm_noise: Array
    present: NDArray[np.bool_]
    props: Props

    def camera_T_camera_right(self, side: str) -> Array:
        """Pose (4, 4) of the right camera in a camera."""
        return np.eye(4) if side == "right" else self.scene.camera_left_T_camera_right

    def base_T_camera(self, side: str, times_s: Array) -> Array:
        """Pose (..., 4, 4) of a camera at times (...)."""
        base_T_arm = self.scene.laparoscope.tool(self.path.at(times_s)[0])
        base_T_camera_right = base_T_arm @ rigid_inverse(self.scene.camera_right_T_arm)
        return base_T_camera_right @ rigid_inverse(self.camera_T_camera_right(side))

    def shaft(self, side: str, frames: Array, times_s: Array) -> tuple[ShaftInCamera, Array]:
        """The instrument in a camera, and camera_T_rcm (..., 4, 4), at times (...); `frames` (...) chooses the noise of
        the pose."""
        laparoscope, instrument = self.path.at(times_s)
        poses = poses_at(self.scene, laparoscope, instrument)
        camera_right_T_rcm = self.scene.camera_right_T_arm @ poses.arm_T_rcm @ self.rcm_noise[frames]
        camera_T_rcm = self.camera_T_camera_right(side) @ camera_right_T_rcm
        shaft = shaft_in_camera(self.scene, camera_T_rcm, poses)
        withdrawn = np.where(self.present[frames], 0.0, ABSENT_MM)
        head = shaft.camera_p_head - withdrawn[..., None] * shaft.camera_v_axis
        return replace(shaft, s_end_mm=shaft.s_end_mm - withdrawn, camera_p_head=head), camera_T_rcm

    def other_shaft(self, side: str, other: OtherInstrument, times_s: Array) -> ShaftInCamera:
        """An instrument that is not logged, in a camera at times (...)."""
        camera_T_base = rigid_inverse(self.base_T_camera(side, times_s))
        p = transform_points(camera_T_base, other.base_p_rcm)
        camera_p_head = transform_points(camera_T_base, other.head(times_s))
        length = np.linalg.norm(camera_p_head - p, axis=-1)
        v = (camera_p_head - p) / length[..., None]
        return ShaftInCamera(p, v, length - WRIST_MM, camera_p_head + HEAD_BEYOND_MM * v, RADIUS_MM)

    def in_sight(self, side: str, camera_T_base: Array, camera_p: Array) -> NDArray[np.bool_]:
        """Whether points (..., 3) of the instrument are seen: inside the picture and its bright field, not behind
        foreground tissue."""
        camera, settings = self.cameras[side], self.config.camera
        uv = camera.project(camera_p)
        seen = camera.contains(uv)
        if settings.round_field:
            centre = np.array([camera.width - 1.0, camera.height - 1.0]) / 2.0
            seen &= np.linalg.norm(np.nan_to_num(uv) - centre, axis=-1) < settings.round_field * camera.width / 2.0
        for loop in self.props.loops:
            seen &= ~hidden_by(loop, camera_T_base, camera_p)
        return seen


def build_world(config: SynthConfig, scene: Scene | None = None) -> World:
    """World of a configuration; the same seed gives the same world. `scene`: of other arms (own_robot.py) than those of
    the configuration."""
    generator = np.random.default_rng([config.seed, 0])
    scene = build_scene(config.scene) if scene is None else scene
    cameras = {"right": build_camera(config.camera, config.camera.right)}
    if config.camera.left is not None:
        cameras["left"] = build_camera(config.camera, config.camera.left)
    camera_T_camera_right = {"right": np.eye(4), "left": scene.camera_left_T_camera_right}

    def in_view(laparoscope: Array, instrument: Array) -> Array:
        poses = poses_at(scene, laparoscope, instrument)
        good = np.ones(len(laparoscope), dtype=bool)
        for side, camera in cameras.items():
            camera_T_rcm = camera_T_camera_right[side] @ scene.camera_right_T_arm @ poses.arm_T_rcm
            shaft = shaft_in_camera(scene, camera_T_rcm, poses)
            for point in (shaft.camera_p_head, shaft.axis_point(shaft.s_end_mm - SHOWN_MM)):
                good &= comfortably_in_view(camera, point)
        return good

    path, times = plan_path(config.motion, scene, config.motions, generator, in_view)
    sigma_rad = float(np.deg2rad(config.noise.kinematics_deg))
    rcm_noise = pose_noise(generator, (config.motions,), sigma_rad, config.noise.kinematics_mm)
    present = generator.random(config.motions) >= config.look.absent_fraction
    props = place_props(config.look, scene.base_T_camera_home, generator)
    times = _capture_times(times, config, generator)
    return World(config, scene, cameras, path, times, rcm_noise, present, props)


def _capture_times(nominal_s: Array, config: SynthConfig, generator: np.random.Generator) -> Array:
    """When frames (N,) are taken: the nominal times with gaps for dropped frames, and jitter that keeps their order."""
    noise, times = config.noise, nominal_s
    if noise.dropped_fraction and config.motion.kind == "smooth":
        arrived = np.cumsum(generator.geometric(1.0 - noise.dropped_fraction, len(times))) - 1
        times = nominal_s[0] + arrived / config.motion.frame_rate_hz
    return np.sort(times + noise.frame_jitter_s * generator.standard_normal(len(times)))


def comfortably_in_view(camera: Camera, p: Array) -> Array:
    """Whether points (..., 3) are inside the picture with a margin."""
    x_min, y_min, x_max, y_max = camera.bounds()
    z = np.maximum(p[..., 2], 1e-6)
    x, y = p[..., 0] / z, p[..., 1] / z
    inside_x = (x > x_min + VIEW_MARGIN) & (x < x_max - VIEW_MARGIN)
    return (p[..., 2] > 10.0) & inside_x & (y > y_min + VIEW_MARGIN) & (y < y_max - VIEW_MARGIN)
