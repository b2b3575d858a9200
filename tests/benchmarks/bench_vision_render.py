"""Render and test: presets x (found, false, contour rms, axis angle, end, time), beside three OpenCV peers.

    python tests/benchmarks/bench_vision_render.py [--frames 40] [--presets clean mild hard]

Contour error: rms distance, px, of the two reported points of either contour from the true contour. A shaft counts as
found when that is below 3 px for the best of the candidates; `first` counts it only when it is the first candidate. A
false shaft is any candidate in a frame without one. Time is of detection alone, decoded pictures in, lines out.
"""

import argparse
import dataclasses
import tempfile
import time
from pathlib import Path

import av
import cv2
import numpy as np
import torch
import yaml
from vision_peers import PEERS, best_threshold, dark_mask, undistort

from data_synth import load_synth_config, write_recording
from rmis_calib.geometry import Camera
from rmis_calib.vision import ShaftDetections, ShaftDetector

PRESETS = (
    "clean", "mild", "tissue", "smoke", "barrel", "davinci_720", "davinci_sd", "two_instruments", "glare", "carbon",
    "blood", "hard", "brutal", "absent",
)  # fmt: skip
FOUND_PX = 3.0


def read_recording(folder: Path) -> tuple[np.ndarray, Camera, dict[str, np.ndarray]]:
    """Right pictures (n, h, w, 3), right camera, right truth."""
    source = folder / "right.mp4"
    if source.exists():
        with av.open(str(source)) as container:
            frames = np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
    else:
        frames = np.stack([cv2.imread(str(p))[..., ::-1] for p in sorted((folder / "right").iterdir())])
    stereo = yaml.safe_load((folder / "stereo.yaml").read_text())
    c, (width, height) = stereo["right"], stereo["image_size"]
    camera = Camera.from_values(c["fx"], c["fy"], c["cx"], c["cy"], c["distortion"], image_size=(height, width))
    truth = np.load(folder / "truth.npz")
    return frames, camera, {k[len("right_") :]: truth[k] for k in truth.files if k.startswith("right_")}


def contour_rms_px(points: np.ndarray, normals: np.ndarray, focal: float) -> float:
    """Rms distance of (edge, point, xy) from the lines (edge, 3)."""
    lines = normals / np.linalg.norm(normals[:, :2], axis=1, keepdims=True)
    homogeneous = np.concatenate([points, np.ones((2, 2, 1))], -1)
    return float(np.sqrt((np.einsum("epi,ei->ep", homogeneous, lines) ** 2).mean()) * focal)


def axis_angle_deg(points: np.ndarray, normal: np.ndarray) -> float:
    """Angle in the picture between the axis through two points and the true axis line."""
    direction = points[1] - points[0]
    true = np.array([normal[1], -normal[0]]) / np.linalg.norm(normal[:2])
    cosine = abs(direction @ true) / np.linalg.norm(direction)
    return float(np.rad2deg(np.arccos(min(1.0, cosine))))


@dataclasses.dataclass
class Tally:
    """One method on one preset."""

    visible: int = 0
    found: int = 0
    first: int = 0
    empty: int = 0
    false: int = 0
    seconds: float = 0.0
    rms: list[float] = dataclasses.field(default_factory=list)
    angle: list[float] = dataclasses.field(default_factory=list)
    end: list[float] = dataclasses.field(default_factory=list)
    within_3_sigma: list[bool] = dataclasses.field(default_factory=list)

    def row(self, preset: str, method: str, frames: int) -> str:
        def of(values: list[float], q: float, digits: int) -> str:
            return f"{np.quantile(values, q):.{digits}f}" if values else "-"

        share = f"{100 * self.found / self.visible:.0f} %" if self.visible else "-"
        first = f"{100 * self.first / self.visible:.0f} %" if self.visible else "-"
        calm = f"{100 * np.mean(self.within_3_sigma):.0f} %" if self.within_3_sigma else "-"
        return (
            f"| {preset} | {method} | {share} | {first} | {self.false}/{self.empty} | {of(self.rms, 0.5, 3)} | "
            f"{of(self.rms, 0.95, 3)} | {of(self.angle, 0.5, 3)} | {of(self.end, 0.5, 2)} | {calm} | "
            f"{1e3 * self.seconds / frames:.1f} |"
        )


def count_ours(
    tally: Tally, found: ShaftDetections, frame: int, n: int, truth: dict[str, np.ndarray], focal: float
) -> None:
    ranks = [k for k in range(found.valid.shape[1]) if bool(found.valid[frame, k])]
    if not truth["visible"][n]:
        tally.empty, tally.false = tally.empty + 1, tally.false + bool(ranks)
        return
    tally.visible += 1
    errors = [contour_rms_px(found.contour_xy[frame, k].double().numpy(), truth["n_contour"][n], focal) for k in ranks]
    if not errors or min(errors) > FOUND_PX:
        return
    best = int(np.argmin(errors))
    k = ranks[best]
    tally.found, tally.first = tally.found + 1, tally.first + (best == 0)
    tally.rms.append(errors[best])
    tally.angle.append(axis_angle_deg(found.axis_xy[frame, k].double().numpy(), truth["n_axis"][n]))
    sigma_px = float(found.contour_sigma[frame, k].square().mean().sqrt()) * focal
    tally.within_3_sigma.append(errors[best] < 3 * sigma_px)
    if bool(found.end_valid[frame, k]) and truth["end_visible"][n]:
        along = np.diff(truth["axis_xy"][n], axis=0)[0]
        miss = (found.end_xy[frame, k].double().numpy() - truth["end_xy"][n]) @ along / np.linalg.norm(along)
        tally.end.append(abs(float(miss)) * focal)


def count_peer(
    tally: Tally, lines: list[np.ndarray] | None, camera: Camera, n: int, truth: dict[str, np.ndarray]
) -> None:
    if not truth["visible"][n]:
        tally.empty, tally.false = tally.empty + 1, tally.false + (lines is not None)
        return
    tally.visible += 1
    if lines is None:
        return
    matrix = np.array([[float(camera.fx), 0, float(camera.cx)], [0, float(camera.fy), float(camera.cy)], [0, 0, 1]])
    points = np.stack([undistort(line, matrix, camera.distortion.numpy()) for line in lines])
    focal = float(camera.focal)
    either = [contour_rms_px(order, truth["n_contour"][n], focal) for order in (points, points[::-1])]
    if min(either) > FOUND_PX:
        return
    tally.found, tally.first = tally.found + 1, tally.first + 1
    tally.rms.append(min(either))
    directions = points[:, 1] - points[:, 0]
    directions[1] *= np.sign(directions[0] @ directions[1])
    middle, direction = points.mean((0, 1)), directions.sum(0)
    tally.angle.append(axis_angle_deg(np.stack([middle, middle + direction]), truth["n_axis"][n]))


def run_preset(preset: str, frames: int, folder: Path) -> list[str]:
    config = dataclasses.replace(load_synth_config(preset), motions=frames)
    pictures, camera, truth = read_recording(write_recording(folder / preset, config))
    detector, focal = ShaftDetector(camera=camera), float(camera.focal)
    tallies = {"ours": Tally()} | {name: Tally() for name in PEERS}
    detector.detect(torch.from_numpy(pictures[:8]).permute(0, 3, 1, 2).contiguous())  # warm-up
    for start in range(0, len(pictures), 8):
        batch = torch.from_numpy(pictures[start : start + 8]).permute(0, 3, 1, 2).contiguous()
        began = time.perf_counter()
        found = detector.detect(batch)
        tallies["ours"].seconds += time.perf_counter() - began
        for j in range(len(batch)):
            count_ours(tallies["ours"], found, j, start + j, truth, focal)
    for n, picture in enumerate(pictures):
        picture = np.ascontiguousarray(picture)
        level = best_threshold(picture)
        for name, peer in PEERS.items():
            began = time.perf_counter()
            lines = peer(picture, dark_mask(picture, level)[0])
            tallies[name].seconds += time.perf_counter() - began
            count_peer(tallies[name], lines, camera, n, truth)
    return [tally.row(preset, name, len(pictures)) for name, tally in tallies.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--presets", nargs="+", default=list(PRESETS))
    options = parser.parse_args()
    print(f"{options.frames} frames a preset, {torch.get_num_threads()} threads, torch {torch.__version__}")
    print("| preset | method | found | first | false | rms px | rms px 95 % | axis deg | end px | in 3 sigma | ms |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for preset in options.presets:
            for row in run_preset(preset, options.frames, Path(folder)):
                print(row, flush=True)


if __name__ == "__main__":
    main()
