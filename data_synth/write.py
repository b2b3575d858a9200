"""Write a synthetic recording with its truth: a folder that appears complete or not at all."""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import yaml
from av.video.stream import VideoStream

from data_synth.folders import check_replaceable, remove_listed, write_marker
from data_synth.kinematics import Array, pose_noise, rigid_inverse
from data_synth.motion import log_times
from data_synth.presets import config_to_dict
from data_synth.render import Renderer
from data_synth.scene import Scene
from data_synth.settings import OutputSettings, SynthConfig
from data_synth.truth import SideTruth, side_truth
from data_synth.world import World, build_world

Progress = Callable[[int, int], None]


def write_recording(
    path: str | Path,
    config: SynthConfig | None = None,
    *,
    scene: Scene | None = None,
    device: str = "cpu",
    overwrite: bool = False,
    on_progress: Progress | None = None,
) -> Path:
    """Render a recording into a new folder, with ground_truth.yaml and truth.npz.

    The folder is made under a temporary name beside its place and renamed when complete; an interrupted run leaves
    nothing.

    Args:
        path: folder to make.
        config: what to render; the defaults when None.
        scene: of other arms than those of the configuration (own_robot.py); the configuration then tells of the robot
            only its ranges of motion and noise.
        device: torch device that draws.
        overwrite: replace a folder that is already there, if all of it was written by this function.
        on_progress: called with (frames done, frames in all), a stereo pair counting once.

    Returns:
        the folder.

    Raises:
        FileExistsError: something is there and `overwrite` is False, or this function did not write all of it.
    """
    config = config or SynthConfig()
    target = Path(path)
    check_replaceable(target, overwrite)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.parent / f".{target.name}.partial-{os.getpid()}"
    partial.mkdir()
    try:
        world = build_world(config, scene)
        truths = {side: side_truth(world, side) for side in world.cameras}
        _write_tables(partial, world, truths)
        _write_pictures(partial, world, device, on_progress or (lambda done, total: None))
        write_marker(partial)
        check_replaceable(target, overwrite)
        old = partial.with_name(f"{partial.name}.old")
        if target.exists():
            target.rename(old)
        partial.rename(target)
        if old.exists():
            remove_listed(old)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return target


def _write_tables(folder: Path, world: World, truths: dict[str, SideTruth]) -> None:
    """Everything but the pictures."""
    config, scene = world.config, world.scene
    generator = np.random.default_rng([config.seed, 3])
    logged = config.motion.laparoscope != "unlogged"
    video = config.output.pictures == "video"
    recording = {"format": "rmis-calib/1", "robot": "robot.yaml", "stereo": "stereo.yaml"}
    recording |= {side: f"{side}.mp4" if video else side for side in world.cameras}
    recording |= {"joints": "joints.csv", "frame_times": "frame_times.csv"}
    recording |= {"laparoscope_arm": "laparoscope" if logged else None, "instrument_arm": "instrument"}
    recording |= {"shaft_diameter_mm": config.scene.shaft_diameter_mm + config.noise.shaft_diameter_error_mm}
    if config.camera.readout_told:
        recording["rolling_shutter_s"] = _first_to_last_row_s(world)
    _write_yaml(folder / "recording.yaml", recording)
    noise, told = config.noise, None
    if noise.joint_offset_told:
        told = {"revolute": float(np.deg2rad(noise.joint_offset_deg)), "prismatic": noise.joint_offset_mm}
    robot = scene.robot_dict("synthetic-rcm-3x3", laparoscope=logged, offset_sigma=told)
    _write_yaml(folder / "robot.yaml", robot)
    _write_yaml(folder / "stereo.yaml", _stereo(world, generator))
    header, rows, offsets = _joint_log(world, logged, generator)
    _write_csv(folder / "joints.csv", header, rows)
    timing_error_s = config.noise.timestamp_noise_s * generator.standard_normal(len(world.frame_times_s))
    stamps_s = np.sort(world.frame_times_s + timing_error_s)
    if config.camera.readout_told:
        stamps_s = stamps_s - 0.5 * _first_to_last_row_s(world)
    times = ((i, _text(t)) for i, t in enumerate(stamps_s))
    _write_csv(folder / "frame_times.csv", ["frame", "timestamp_s"], times)
    _write_head_points(folder / "head_points.csv", world, truths, generator)
    _write_yaml(folder / "ground_truth.yaml", ground_truth(world) | {"joint_offsets": offsets})
    arrays: dict[str, Any] = {f"{side}_{key}": value for side, t in truths.items() for key, value in t.arrays().items()}
    np.savez_compressed(folder / "truth.npz", **arrays, frame_times_s=world.frame_times_s)


def _first_to_last_row_s(world: World) -> float:
    """From the reading of the first row to that of the last: of all rows, less the time of one."""
    camera = world.config.camera
    return camera.readout_s * (camera.height_px - 1) / camera.height_px


def ground_truth(world: World) -> dict[str, Any]:
    """The content of ground_truth.yaml; per-frame truth is in truth.npz."""
    scene, config = world.scene, world.config
    camera_right_T_arm = scene.camera_right_T_arm
    if config.motion.laparoscope == "unlogged":
        camera_right_T_arm = rigid_inverse(world.base_T_camera("right", world.frame_times_s[0]))
    return {
        "camera_right_T_arm": camera_right_T_arm.tolist(),
        "camera_left_T_camera_right": scene.camera_left_T_camera_right.tolist(),
        "shaft_diameter_mm": 2.0 * scene.shaft_radius_mm,
        "shaft_end_offset_mm": scene.shaft_end_offset_mm,
        "clock_offset_s": config.noise.clock_offset_s,
        "frames": "truth.npz",
        "config": config_to_dict(config),
    }


def _stereo(world: World, generator: np.random.Generator) -> dict[str, Any]:
    """The content of stereo.yaml; the extrinsics carry the error of the calibration that made them."""
    noise = world.config.noise
    error = pose_noise(generator, (), float(np.deg2rad(noise.stereo_deg)), noise.stereo_mm)
    camera = world.config.camera
    content: dict[str, Any] = {"image_size": [camera.width_px, camera.height_px]}
    content |= {side: view.to_dict() for side, view in world.cameras.items()}
    if "left" in world.cameras:
        content["camera_left_T_camera_right"] = (world.scene.camera_left_T_camera_right @ error).tolist()
    return content


def _joint_log(
    world: World, logged: bool, generator: np.random.Generator
) -> tuple[list[str], Iterable[Sequence[str]], dict[str, float]]:
    """Header and rows of joints.csv, and the constant offset of every column: truth = reading + offset."""
    noise = world.config.noise
    times = log_times(world.frame_times_s, world.config.motion.joint_rate_hz)
    laparoscope, instrument = world.path.at(times)
    arms = {"laparoscope": (world.scene.laparoscope, laparoscope)} if logged else {}
    arms |= {"instrument": (world.scene.instrument, instrument)}
    columns = [f"{name}.{joint.column}" for name, (arm, _) in arms.items() for joint in arm.joints]
    readings = np.concatenate([values for _, values in arms.values()], axis=-1)

    def per_column(of_revolute_deg: float, of_prismatic_mm: float) -> Array:
        return np.array([np.deg2rad(of_revolute_deg) if c.endswith("_rad") else of_prismatic_mm for c in columns])

    offsets = per_column(noise.joint_offset_deg, noise.joint_offset_mm) * generator.standard_normal(len(columns))
    white = per_column(noise.joint_reading_deg, noise.joint_reading_mm) * generator.standard_normal(readings.shape)
    table = np.concatenate([times[:, None] + noise.clock_offset_s, readings - offsets + white], axis=-1)
    rows = ([_text(value) for value in row] for row in table)
    return ["timestamp_s", *columns], rows, dict(zip(columns, offsets.tolist(), strict=True))


def _write_head_points(path: Path, world: World, truths: dict[str, SideTruth], generator: np.random.Generator) -> None:
    """Head points with the noise of a label, in frames where every camera sees them."""
    uv = np.concatenate([truth.head_uv_read for truth in truths.values()], axis=-1)
    camera = world.config.camera
    limit = np.tile([camera.width_px - 1.0, camera.height_px - 1.0], len(truths))
    seen = ((uv >= 0.0) & (uv <= limit)).all(-1)
    uv = np.clip(uv + world.config.noise.head_point_px * generator.standard_normal(uv.shape), 0.0, limit)
    header = ["frame"] + [f"{axis}_{side}_px" for side in truths for axis in "uv"]
    _write_csv(path, header, ([str(i), *(f"{x:.3f}" for x in uv[i])] for i in np.flatnonzero(seen)))


def _write_pictures(folder: Path, world: World, device: str, on_progress: Progress) -> None:
    renderer, total = Renderer(world, device), len(world.frame_times_s)
    make = VideoWriter if world.config.output.pictures == "video" else ImageWriter
    rate = _frame_rate(world)
    writers = {side: make(folder / side, world.config.output, renderer.size, rate) for side in world.cameras}

    batch = 8 if renderer.device.type == "cuda" else 1

    def step(side: str, frames: Array) -> None:
        for picture in renderer.render(side, frames).cpu().numpy():
            writers[side].add(picture)

    with ThreadPoolExecutor(len(writers)) as pool:
        try:
            for first in range(0, total, batch):
                frames = np.arange(first, min(first + batch, total))
                list(pool.map(step, writers, [frames] * len(writers)))
                on_progress(int(frames[-1]) + 1, total)
        finally:
            for writer in writers.values():
                writer.close()


def _frame_rate(world: World) -> Fraction:
    motion = world.config.motion
    rate = motion.frame_rate_hz if motion.kind == "smooth" else 1.0 / motion.stop_period_s
    return Fraction(rate).limit_denominator(1001)


class VideoWriter:
    """H.264 with full chroma resolution, so that coloured edges stay where they are."""

    def __init__(self, path: Path, settings: OutputSettings, size: tuple[int, int], rate: Fraction) -> None:
        self._container = av.open(str(path.with_suffix(".mp4")), "w")
        # `ultrafast`: at this quality the files are as small as those of slower presets, at a third of their time.
        options = {"crf": str(settings.crf), "preset": "ultrafast"}
        self._stream: VideoStream = self._container.add_stream("libx264", rate=rate, options=options)
        self._stream.height, self._stream.width = size
        self._stream.pix_fmt = "yuv444p"

    def add(self, picture: np.ndarray) -> None:
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        self._container.mux(self._stream.encode())
        self._container.close()


class ImageWriter:
    """PNG files, numbered."""

    def __init__(self, path: Path, settings: OutputSettings, size: tuple[int, int], rate: Fraction) -> None:
        self._path, self._count = path, 0
        path.mkdir()

    def add(self, picture: np.ndarray) -> None:
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        encoder = av.CodecContext.create("png", "w")
        encoder.width, encoder.height, encoder.pix_fmt = frame.width, frame.height, "rgb24"
        encoder.time_base = Fraction(1, 1)
        packets = [bytes(packet) for packet in (*encoder.encode(frame), *encoder.encode(None))]
        (self._path / f"{self._count:06d}.png").write_bytes(b"".join(packets))
        self._count += 1

    def close(self) -> None:
        return


def _text(value: float) -> str:
    return f"{value:.9f}"


def _write_yaml(path: Path, content: dict[str, Any]) -> None:
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
