"""Render and test: presets x (found, false, contour rms, axis angle, end, time), beside three OpenCV peers.

    python tests/benchmarks/bench_vision_render.py [--frames 200] [--presets clean mild hard] [--keep FOLDER]

Contour error: rms distance, px, of the two reported points of either contour from the true contour, as the rows of the
picture show it; `at once` is the same against the shaft at the frame's own instant, which rows that are read one after
the other do not show (hard, brutal, cholec). Where a detection leaves open which side the tip is on, contours may be
exchanged. A shaft counts as found when that is below 3 px for the best of the candidates; `first` counts it only when
it is the first candidate.
False: any candidate in a frame that shows no shaft at all. Stray: candidates further than 3 px from every true shaft,
per frame. End: distance along the axis, median. Time is of detection alone, decoded pictures in, lines out: processor
time of one thread for every method (so that other programs do not count), median. `x better` is the lowest ratio, over
the peers, of the medians of the error on the frames that both found; peers that found under a tenth of the frames are
left out. A peer may find any of the shafts in the picture.

Four more tables: how far the confidence can be believed, how many ends are near, what strong barrel distortion costs,
and the goals.
`--benches 60` instead counts shafts and what is none on laboratory benches: chessboards, cases, rulers, cables, print.
Frames are streamed: memory does not depend on their number. `--keep` leaves the recordings for the next run.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from bench_vision_real_frames import END_PX, SURE, distances_px
from vision_peers import PEERS, best_threshold, dark_mask, undistort

from data_synth import load_synth_config, render_bench, write_recording
from data_synth.settings import SynthConfig
from rmis_calib.geometry import Camera
from rmis_calib.io import load_recording
from rmis_calib.vision import ShaftDetections, ShaftDetector

PRESETS = (
    "clean", "mild", "tissue", "smoke", "barrel", "davinci_720", "davinci_986", "davinci_sd", "two_instruments",
    "glare", "carbon", "blood", "cholec", "leaving", "hard", "brutal", "absent",
)  # fmt: skip
FOUND_PX, BENCH_PX, BATCH = 3.0, 4.0, 8
GOALS = {"clean": (0.05, 1.0), "brutal": (0.5, 0.9)}
MIDDLE_GOAL = (0.15, 0.98)
"""Median contour error, px, and share of shafts found."""
BINS = (0.0, 0.5, 0.7, 0.8, 0.9, 1.001)


@dataclass
class Shafts:
    """Every true shaft of one camera: the logged one first. (S, N, ...)."""

    n_contour: np.ndarray
    n_contour_read: np.ndarray
    n_axis: np.ndarray
    visible: np.ndarray
    axis_xy: np.ndarray
    end_xy: np.ndarray
    end_visible: np.ndarray

    @classmethod
    def read(cls, folder: Path) -> "Shafts":
        with np.load(folder / "truth.npz") as truth:
            prefixes = ["right_"]
            while f"right_other{len(prefixes) - 1}_visible" in truth.files:
                prefixes.append(f"right_other{len(prefixes) - 1}_")
            names = ("n_contour", "n_contour_read", "n_axis", "visible", "axis_xy", "end_xy", "end_visible")
            return cls(**{name: np.stack([truth[prefix + name] for prefix in prefixes]) for name in names})

    def errors_px(self, points: np.ndarray, frame: int, focal: float) -> np.ndarray:
        """(S,) contour error of (edge, point, xy) against every shaft; infinite for one of which too little shows to be
        asked for."""
        return np.where(self.visible[:, frame], self.any_errors_px(points, frame, focal), np.inf)

    def any_errors_px(self, points: np.ndarray, frame: int, focal: float) -> np.ndarray:
        """The same, also of those: a line on one is right where it is found all the same."""
        return rms_px(points, self.n_contour_read[:, frame], focal)

    def instant_px(self, points: np.ndarray, frame: int, focal: float) -> float:
        """Contour error against the logged shaft as it was at the frame's own instant."""
        return min(float(rms_px(order, self.n_contour[:1, frame], focal)[0]) for order in (points, points[::-1]))


def rms_px(points: np.ndarray, normals: np.ndarray, focal: float) -> np.ndarray:
    """(S,) rms distance of (edge, point, xy) from the lines (S, edge, 3)."""
    lines = normals / np.linalg.norm(normals[..., :2], axis=-1, keepdims=True)
    homogeneous = np.concatenate([points, np.ones((2, 2, 1))], -1)
    return np.sqrt((np.einsum("epi,sei->sep", homogeneous, lines) ** 2).mean((1, 2))) * focal


def axis_angle_deg(points: np.ndarray, normal: np.ndarray) -> float:
    """Angle in the picture between the axis through two points and the true axis line."""
    direction = points[1] - points[0]
    true = np.array([normal[1], -normal[0]]) / np.linalg.norm(normal[:2])
    cosine = abs(direction @ true) / np.linalg.norm(direction)
    return float(np.rad2deg(np.arccos(min(1.0, cosine))))


@dataclass
class Tally:
    """One method on one preset."""

    visible: int = 0
    first: int = 0
    empty: int = 0
    false: int = 0
    stray: int = 0
    frames: int = 0
    seconds: list[float] = field(default_factory=list)
    """Per picture, one entry a batch."""
    rms: dict[int, float] = field(default_factory=dict)
    """By frame."""
    instant: list[float] = field(default_factory=list)
    angle: list[float] = field(default_factory=list)
    end: list[float] = field(default_factory=list)
    graded: list[tuple[float, bool, bool]] = field(default_factory=list)
    """Of every candidate: confidence, on a true shaft, within 3 of its own sigmas."""

    @property
    def found(self) -> float:
        return len(self.rms) / self.visible if self.visible else np.nan

    def quantile(self, q: float) -> float:
        return float(np.quantile(list(self.rms.values()), q)) if self.rms else np.nan

    def row(self, preset: str, method: str, better: float) -> str:
        def text(value: float, digits: int, unit: str = "") -> str:
            return f"{value:.{digits}f}{unit}" if np.isfinite(value) else "-"

        first = self.first / self.visible if self.visible else np.nan
        calm = np.mean([g[2] for g in self.graded if g[1]]) if any(g[1] for g in self.graded) else np.nan
        cells = [
            preset, method, text(100 * self.found, 1, " %"), text(100 * first, 1, " %"), f"{self.false}/{self.empty}",
            text(self.stray / max(self.frames, 1), 2), text(self.quantile(0.5), 3), text(self.quantile(0.95), 3),
            text(float(np.median(self.instant)) if self.instant else np.nan, 3),
            text(float(np.median(self.angle)) if self.angle else np.nan, 3),
            text(float(np.median(self.end)) if self.end else np.nan, 2), text(100 * calm, 0, " %"),
            text(better, 1), text(1e3 * float(np.median(self.seconds)), 1),
        ]  # fmt: skip
        return "| " + " | ".join(cells) + " |"


HEADER = (
    "preset", "method", "found", "first", "false", "stray", "rms px", "rms px 95 %", "at once px", "axis deg", "end px",
    "in 3 sigma", "x better", "ms",
)  # fmt: skip


def count_ours(tally: Tally, found: ShaftDetections, j: int, n: int, truth: Shafts, focal: float) -> None:
    """Frame n of the recording, j of the batch."""
    tally.frames += 1
    ranks = found.valid[j].nonzero()[:, 0].tolist()
    if not truth.visible[:, n].any():
        tally.empty, tally.false = tally.empty + 1, tally.false + bool(ranks)
    errors = np.full((len(ranks), truth.visible.shape[0]), np.inf)
    for i, k in enumerate(ranks):
        points = found.contour_xy[j, k].double().numpy()
        orders = (
            [points] if found.direction_known[j, k] else [points, points[::-1]]
        )  # which is left is not claimed then
        errors[i] = np.min([truth.errors_px(order, n, focal) for order in orders], axis=0)
        nearest = min(float(truth.any_errors_px(order, n, focal).min()) for order in orders)
        sigma_px = float(found.contour_sigma[j, k].double().square().mean().sqrt()) * focal
        tally.stray += nearest > FOUND_PX
        tally.graded.append((float(found.confidence[j, k]), nearest <= FOUND_PX, nearest < 3 * sigma_px))
    if not truth.visible[0, n]:
        return
    tally.visible += 1
    if not ranks or errors[:, 0].min() > FOUND_PX:
        return
    best = int(errors[:, 0].argmin())
    k = ranks[best]
    tally.first += best == 0
    tally.rms[n] = float(errors[best, 0])
    tally.instant.append(truth.instant_px(found.contour_xy[j, k].double().numpy(), n, focal))
    tally.angle.append(axis_angle_deg(found.axis_xy[j, k].double().numpy(), truth.n_axis[0, n]))
    if bool(found.end_valid[j, k]) and truth.end_visible[0, n]:
        along = np.diff(truth.axis_xy[0, n], axis=0)[0]
        miss = (found.end_xy[j, k].double().numpy() - truth.end_xy[0, n]) @ along / np.linalg.norm(along)
        tally.end.append(abs(float(miss)) * focal)


def count_peer(tally: Tally, lines: list[np.ndarray] | None, camera: Camera, n: int, truth: Shafts) -> None:
    tally.frames += 1
    if not truth.visible[:, n].any():
        tally.empty, tally.false = tally.empty + 1, tally.false + (lines is not None)
        return
    tally.visible += 1
    if lines is None:
        return
    matrix = np.array([[float(camera.fx), 0, float(camera.cx)], [0, float(camera.fy), float(camera.cy)], [0, 0, 1]])
    points = np.stack([undistort(line, matrix, camera.distortion.numpy()) for line in lines])
    either = np.stack([truth.errors_px(order, n, float(camera.focal)) for order in (points, points[::-1])]).min(0)
    if either.min() > FOUND_PX:
        tally.stray += 1
        return
    tally.first += 1
    tally.rms[n] = float(either.min())
    directions = points[:, 1] - points[:, 0]
    directions[1] *= np.sign(directions[0] @ directions[1])
    middle, direction = points.mean((0, 1)), directions.sum(0)
    axis = np.stack([middle, middle + direction])
    tally.angle.append(axis_angle_deg(axis, truth.n_axis[int(either.argmin()), n]))


def times_better(ours: Tally, peer: Tally) -> float:
    """Ratio of the medians on the frames that both found; infinite for a peer that found hardly any."""
    common = sorted(ours.rms.keys() & peer.rms.keys())
    if len(common) < max(1, 0.1 * peer.visible):
        return np.inf
    medians = [float(np.median([tally.rms[n] for n in common])) for tally in (peer, ours)]
    return medians[0] / medians[1]


def rendered(config: SynthConfig, folder: Path) -> Path:
    """The recording of the right camera, rendered unless it is there."""
    config = replace(config, camera=replace(config.camera, left=None))
    if not folder.exists():
        total = config.motions

        def show(done: int, _: int) -> None:
            if done % 50 == 0 or done == total:
                print(f"{folder.name}: rendered {done}/{total}", file=sys.stderr, flush=True)

        write_recording(folder, config, on_progress=show)
    return folder


def batches(folder: Path, camera: Camera, tally: Tally) -> Iterator[tuple[torch.Tensor, list[int], ShaftDetections]]:
    """Pictures, their numbers, and what was found in them; the time goes into the tally."""
    source, detector, warm = load_recording(folder).right, ShaftDetector(camera=camera), False
    for batch in source.batches(BATCH):
        if not warm:
            detector.detect(batch.images)
            warm = True
        began = time.thread_time()
        found = detector.detect(batch.images)
        tally.seconds.append((time.thread_time() - began) / len(batch.indices))
        yield batch.images, batch.indices.tolist(), found
        if (int(batch.indices[-1]) + 1) % (5 * BATCH) == 0:
            print(f"{folder.name}: {int(batch.indices[-1]) + 1}/{source.count}", file=sys.stderr, flush=True)


def run_preset(config: SynthConfig, folder: Path, with_peers: bool = True) -> dict[str, Tally]:
    """Tallies of this detector and of its peers on one preset."""
    rendered(config, folder)
    camera, truth = load_recording(folder).stereo.right, Shafts.read(folder)
    focal = float(camera.focal)
    tallies = {"ours": Tally()} | ({name: Tally() for name in PEERS} if with_peers else {})
    for images, numbers, found in batches(folder, camera, tallies["ours"]):
        for j, n in enumerate(numbers):
            count_ours(tallies["ours"], found, j, n, truth, focal)
            if not with_peers:
                continue
            picture = np.ascontiguousarray(images[j].permute(1, 2, 0).numpy())
            level = best_threshold(picture)
            for name, peer in PEERS.items():
                began = time.thread_time()
                lines = peer(picture, dark_mask(picture, level)[0])
                tallies[name].seconds.append(time.thread_time() - began)
                count_peer(tallies[name], lines, camera, n, truth)
    return tallies


def print_confidence(graded: list[tuple[float, bool, bool]]) -> None:
    """Reliability: what a confidence is worth."""
    print("\n| confidence | candidates | mean | on a true shaft | within 3 sigma |\n| --- | --- | --- | --- | --- |")
    table = np.array(graded, dtype=float).reshape(-1, 3)
    for low, high in pairwise(BINS):
        part = table[(table[:, 0] >= low) & (table[:, 0] < high)]
        if len(part):
            mean, right, calm = part.mean(0)
            name = f"{low:.1f} to {min(high, 1.0):.1f}"
            print(f"| {name} | {len(part)} | {mean:.2f} | {100 * right:.1f} % | {100 * calm:.1f} % |")


def print_ends(ours: dict[str, Tally]) -> None:
    """Ends in view of found shafts: how many were given, and how near."""
    print(
        f"\n| preset | shafts found | ends given | within {END_PX:.0f} px | 90 % px |\n| --- | --- | --- | --- | --- |"
    )
    for preset, tally in ours.items():
        if tally.end:
            near = sum(px <= END_PX for px in tally.end)
            print(f"| {preset} | {len(tally.rms)} | {len(tally.end)} | {near} | {np.quantile(tally.end, 0.9):.2f} |")


def print_barrel(folder: Path, frames: int) -> None:
    """Precision under k1 = -0.35 against the same scene through a lens without distortion."""
    barrel = replace(load_synth_config("barrel"), motions=frames)
    straight = replace(barrel.camera, right=replace(barrel.camera.right, distortion=(0.0,) * 5))
    bent_tally = run_preset(barrel, folder / "barrel", with_peers=False)["ours"]
    straight_tally = run_preset(replace(barrel, camera=straight), folder / "barrel_straight", with_peers=False)["ours"]
    print("\n| lens | found | rms px | rms px 95 % |\n| --- | --- | --- | --- |")
    for name, tally in (("k1 = -0.35", bent_tally), ("no distortion", straight_tally)):
        quantiles = f"{tally.quantile(0.5):.4f} | {tally.quantile(0.95):.4f}"
        print(f"| {name} | {100 * tally.found:.1f} % | {quantiles} |")
    cost = 100 * (bent_tally.quantile(0.5) / straight_tally.quantile(0.5) - 1)
    print(f"\nprecision cost of the distortion: {cost:.0f} % (goal: at most 20 %)")


def print_goals(ours: dict[str, Tally]) -> None:
    """What was asked for beside what came out."""
    print("\n| preset | rms px | goal | found | goal | met |\n| --- | --- | --- | --- | --- | --- |")
    for preset, tally in ours.items():
        if not tally.visible:
            share = tally.false / max(tally.empty, 1)
            print(f"| {preset} | - | - | false: {100 * share:.1f} % | 0.5 % | {'yes' if share <= 0.005 else 'no'} |")
            continue
        rms, found = GOALS.get(preset, MIDDLE_GOAL)
        met = tally.quantile(0.5) <= rms and tally.found >= found
        cells = [f"{tally.quantile(0.5):.3f}", f"{rms}", f"{100 * tally.found:.1f} %", f"{100 * found:.0f} %"]
        print(f"| {preset} | {' | '.join(cells)} | {'yes' if met else 'no'} |")


def print_benches(count: int) -> None:
    """Shafts found on benches, within 4 px of either contour, and candidates that lie on none."""
    images, truth = render_bench(777001, count)
    detector, visible, found, false, sure = ShaftDetector(), 0, 0, 0, 0
    for i, shafts in enumerate(truth):
        seen = detector.detect(images[i : i + 1])
        ranks, used = set(seen.valid[0].nonzero()[:, 0].tolist()), set()
        for shaft in (s for s in shafts if s.visible):
            on = {k for k in ranks if distances_px(seen, k, shaft.contour_uv).max() < BENCH_PX}
            visible, found, used = visible + 1, found + bool(on), used | on
        false += len(ranks - used)
        sure += sum(float(seen.confidence[0, k]) > SURE for k in ranks - used)
    print(f"{count} benches: {found} of {visible} shafts found, {false} false candidates, {sure} of them above {SURE}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--presets", nargs="+", default=list(PRESETS))
    parser.add_argument("--keep", type=Path, help="folder for the recordings, used again by the next run")
    parser.add_argument("--no-barrel", action="store_true", help="leave out the comparison of lenses")
    parser.add_argument("--no-peers", action="store_true", help="this detector alone")
    parser.add_argument("--benches", type=int, help="benches with clutter, instead of the presets")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    if options.benches:
        return print_benches(options.benches)
    print(f"{options.frames} frames a preset, torch {torch.__version__}, OpenCV {cv2.__version__}\n")
    print("| " + " | ".join(HEADER) + " |\n|" + " --- |" * len(HEADER), flush=True)
    ours: dict[str, Tally] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = (options.keep or Path(temporary)) / str(options.frames)
        for preset in options.presets:
            config = replace(load_synth_config(preset), motions=options.frames)
            tallies = run_preset(config, folder / preset, with_peers=not options.no_peers)
            ours[preset] = tallies["ours"]
            better = {name: times_better(ours[preset], t) for name, t in tallies.items() if name != "ours"}
            for name, tally in tallies.items():
                print(tally.row(preset, name, better.get(name, min(better.values(), default=np.nan))), flush=True)
        print_confidence([grade for tally in ours.values() for grade in tally.graded])
        print_ends(ours)
        if not options.no_barrel:
            print_barrel(folder, options.frames)
    print_goals(ours)


if __name__ == "__main__":
    main()
