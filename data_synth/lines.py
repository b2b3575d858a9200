"""Lines without pictures: batched Monte-Carlo trials of the calibration's input, with its truth. float64 NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np

from data_synth.contours import contact_points, line_through, to_image, view_cylinder, visible_interval
from data_synth.kinematics import Arm, Array, pose_noise, random_rotations, rigid, rigid_inverse, transform_points
from data_synth.motion import joint_grid
from data_synth.scene import Poses, Scene, build_scene, half_range, moved_from, poses_at
from data_synth.settings import LineStudyConfig

SHORTEST_VISIBLE_MM = 10.0
"""A shaft of which less is in the picture is not measured."""
BENT_LENGTH_MM, STATIONS = 60.0, 32
"""Length before its end over which a bent shaft sags, and places along it that a straight line is laid through."""


def simulate_lines(
    config: LineStudyConfig, readings: tuple[Array, Array] | None = None, scene: Scene | None = None
) -> dict[str, Any]:
    """Observations of `config.trials` independent trials in the keys of an observations file, each with a leading
    trials axis.

    Noise: the given `arm_T_rcm` is the true one right-multiplied by (exp(eps), eps); each camera sees the true pose of
    the RCM frame, right-multiplied in the same way and independently (`camera_noise_*`); the given stereo extrinsics
    are the true ones right-multiplied once a trial; then every image point gets isotropic Gaussian noise.

    Args:
        config: scene, noise and number of trials.
        readings: of the laparoscope's and of the instrument's joints, (N, J) each, rad and mm; otherwise those of the
            configuration's motion.
        scene: other arms than those of the configuration's scene (own_robot.py).

    Returns:
        arrays (trials, N, ...) and scalars, plus `truth`: camera_right_T_arm (trials, 4, 4), camera_left_T_camera_right
        (trials, 4, 4), arm_T_rcm (trials, N, 4, 4) without noise, camera_right_T_rcm and camera_left_T_rcm
        (trials, N, 4, 4) as the pictures see them, and shaft_end_offset_mm. Rows that are not in the picture are NaN
        and not valid.
    """
    generator = np.random.default_rng(config.seed)
    scene = build_scene(config.scene) if scene is None else scene
    poses = _true_poses(config, scene, generator) if readings is None else poses_at(scene, *readings)
    trials, n = config.trials, poses.rcm_v_axis.shape[-2]
    camera_right_T_arm = _hand_eye(config, scene, generator)[:, None]
    camera_right_T_rcm = scene.camera_right_T_arm @ poses.arm_T_rcm
    arm_T_rcm = np.broadcast_to(rigid_inverse(camera_right_T_arm) @ camera_right_T_rcm, (trials, n, 4, 4))

    def noise(shape: tuple[int, ...], source: str) -> Array:
        sigma_deg, sigma_mm = getattr(config, f"{source}_noise_deg"), getattr(config, f"{source}_noise_mm")
        return pose_noise(generator, shape, np.deg2rad(sigma_deg), sigma_mm)

    seen_right = camera_right_T_rcm @ noise((trials, n), "camera")
    seen_left = scene.camera_left_T_camera_right @ camera_right_T_rcm @ noise((trials, n), "camera")
    stereo = np.broadcast_to(scene.camera_left_T_camera_right, (trials, 4, 4))
    out: dict[str, Any] = {
        "arm_T_rcm": arm_T_rcm @ noise((trials, n), "kinematics"),
        "rcm_v_axis": np.broadcast_to(poses.rcm_v_axis, (trials, n, 3)).copy(),
        "rcm_s_end_mm": np.broadcast_to(poses.rcm_s_end_mm, (trials, n)).copy(),
        "rcm_p_head": np.broadcast_to(poses.rcm_p_head, (trials, n, 3)).copy(),
        "camera_left_T_camera_right": stereo @ noise((trials,), "stereo"),
        "shaft_radius_mm": scene.shaft_radius_mm,
    }
    out |= _chains(scene, poses, camera_right_T_arm)
    out |= _sigmas(config)
    out |= _measure(config, scene, seen_right, poses, generator, "right")
    out |= _measure(config, scene, seen_left, poses, generator, "left")
    out["truth"] = {
        "camera_right_T_arm": camera_right_T_arm[:, 0],
        "camera_left_T_camera_right": stereo.copy(),
        "arm_T_rcm": arm_T_rcm.copy(),
        "camera_right_T_rcm": seen_right,
        "camera_left_T_rcm": seen_left,
        "shaft_end_offset_mm": scene.shaft_end_offset_mm,
    }
    return out


def _chains(scene: Scene, poses: Poses, camera_right_T_arm: Array) -> dict[str, Array]:
    """Of every trial, the laparoscope's kinematics from its own base, (trials, N, 4, 4), and where the instrument's
    base is in it, (trials, 4, 4)."""
    trials, n = len(camera_right_T_arm), poses.rcm_v_axis.shape[-2]
    laparoscope_T_base = rigid_inverse(scene.laparoscope.base_T_arm_base)
    base_T_camera = poses.base_T_arm @ rigid_inverse(scene.camera_right_T_arm)
    chain = laparoscope_T_base @ base_T_camera @ camera_right_T_arm
    setup = laparoscope_T_base @ scene.instrument.base_T_arm_base
    return {
        "laparoscope_base_T_arm": np.broadcast_to(chain, (trials, n, 4, 4)).copy(),
        "laparoscope_base_T_instrument_base": np.broadcast_to(setup, (trials, 4, 4)).copy(),
    }


def _sigmas(config: LineStudyConfig) -> dict[str, float]:
    """The noise as an observations file states it."""
    sigmas = {"sigma_image": config.pixel_noise_px / config.focal_px}
    for source in ("kinematics", "camera", "stereo"):
        sigmas[f"sigma_{source}_mm"] = getattr(config, f"{source}_noise_mm")
        sigmas[f"sigma_{source}_rad"] = float(np.deg2rad(getattr(config, f"{source}_noise_deg")))
    sigmas |= {"sigma_setup_mm": 0.0, "sigma_setup_rad": 0.0, "sigma_rcm_mm": 0.0}
    return sigmas


def _true_poses(config: LineStudyConfig, scene: Scene, generator: np.random.Generator) -> Poses:
    """Poses of all motions, (N, ...) on a grid and (trials, N, ...) at random."""
    if config.motion == "grid":
        laparoscope = joint_grid(config.positions_laparoscope)
        instrument = joint_grid(config.positions_instrument)
        laparoscope, instrument = (
            np.repeat(laparoscope, len(instrument), axis=0),
            np.tile(instrument, (len(laparoscope), 1)),
        )
    else:
        shape = (config.trials, config.random_motions, 3)
        moving = float(config.positions_laparoscope > 1)
        laparoscope = moving * generator.uniform(-1.0, 1.0, shape)
        instrument = generator.uniform(-1.0, 1.0, shape)
    return poses_at(
        scene,
        _readings(config, scene.laparoscope, scene.laparoscope_home, laparoscope),
        _readings(config, scene.instrument, scene.instrument_home, instrument),
    )


def _readings(config: LineStudyConfig, arm: Arm, home: Array, unit: Array) -> Array:
    """Readings (..., J) of an arm whose moving joints are off home by `unit` (..., 3) of half their range."""
    return moved_from(home, unit * half_range(arm, config.rotation_range_deg, config.translation_range_mm))


def _hand_eye(config: LineStudyConfig, scene: Scene, generator: np.random.Generator) -> Array:
    """The unknown of every trial, (trials, 4, 4)."""
    if not config.random_hand_eye:
        return np.broadcast_to(scene.camera_right_T_arm, (config.trials, 4, 4)).copy()
    directions = generator.standard_normal((config.trials, 3))
    length = np.linalg.norm(scene.camera_right_T_arm[:3, 3])
    translations = length * directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return rigid(random_rotations(generator, (config.trials,)), translations)


def _measure(
    config: LineStudyConfig, scene: Scene, camera_T_rcm: Array, poses: Poses, generator: np.random.Generator, side: str
) -> dict[str, Array]:
    """What one camera measures: two points on the axis and on each contour, the shaft's end, the head point; RCM side
    first."""
    p_axis = camera_T_rcm[..., :3, 3]
    v_axis = np.einsum("...ij,...j->...i", camera_T_rcm[..., :3, :3], np.broadcast_to(poses.rcm_v_axis, p_axis.shape))
    half_width, half_height = config.half_width_px / config.focal_px, config.half_height_px / config.focal_px
    bounds = (-half_width, -half_height, half_width, half_height)
    s_end = np.broadcast_to(poses.rcm_s_end_mm + scene.shaft_end_offset_mm, p_axis.shape[:-1])
    low, high = visible_interval(p_axis, v_axis, 0.0, s_end, bounds)
    valid = high - low > SHORTEST_VISIBLE_MM
    low, high = np.where(valid, low, np.nan), np.where(valid, high, np.nan)
    axis_points, directions = _shaft_between(config, camera_T_rcm, poses, (low, high, s_end))
    view = view_cylinder(axis_points, directions, scene.shaft_radius_mm)
    contour = contact_points(axis_points, view, scene.shaft_radius_mm).swapaxes(-2, -3)  # (..., edge, station, 3)
    end = np.where((valid & (high == s_end))[..., None], p_axis + s_end[..., None] * v_axis, np.nan)
    head = transform_points(camera_T_rcm, np.broadcast_to(poses.rcm_p_head, p_axis.shape))
    sigma = config.pixel_noise_px / config.focal_px

    measured = {"axis": to_image(axis_points), "contour": to_image(contour)}
    if config.shaft_sag_mm:
        measured = {name: line_through(image) for name, image in measured.items()}
    measured |= {"end": to_image(end), "head": to_image(head)}
    noisy = {name: image + sigma * generator.standard_normal(image.shape) for name, image in measured.items()}
    return {f"{name}_{side}": value for name, value in noisy.items()} | {f"valid_{side}": valid}


def _shaft_between(
    config: LineStudyConfig, camera_T_rcm: Array, poses: Poses, interval: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Points of the shaft's axis from one coordinate to another, (..., k, 3), and its direction at each: both ends of a
    straight shaft, STATIONS of a bent one.

    Args:
        interval: first and last coordinate, and that of the shaft's end, mm from the RCM.
    """
    low, high, s_end = interval
    R, p = camera_T_rcm[..., :3, :3], camera_T_rcm[..., None, :3, 3]
    rcm_v = np.broadcast_to(poses.rcm_v_axis, (*camera_T_rcm.shape[:-2], 3))
    v = np.einsum("...ij,...j->...i", R, rcm_v)[..., None, :]
    if not config.shaft_sag_mm:
        s = np.stack([low, high], axis=-1)[..., None]
        return p + s * v, np.broadcast_to(v, (*s.shape[:-1], 3))
    s = low[..., None, None] + np.linspace(0.0, 1.0, STATIONS)[:, None] * (high - low)[..., None, None]
    side = np.array([1.0, 0.0, 0.0]) - rcm_v[..., :1] * rcm_v
    side = np.einsum("...ij,...j->...i", R, side / np.linalg.norm(side, axis=-1, keepdims=True))[..., None, :]
    before_end = (s_end[..., None, None] - s) / BENT_LENGTH_MM
    off = 4.0 * config.shaft_sag_mm * before_end * (1.0 - before_end)
    slope = 4.0 * config.shaft_sag_mm * (2.0 * before_end - 1.0) / BENT_LENGTH_MM
    direction = v + slope * side
    return p + s * v + off * side, direction / np.linalg.norm(direction, axis=-1, keepdims=True)
