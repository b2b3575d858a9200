"""What memory between the frames of a video saves, and whether it costs anything: against exact truth, beside a search
of every frame.

    python tests/benchmarks/bench_vision_memory.py [--presets mild hard] [--frames 64] [--speed 1] [--every 1 4]
        [--search-every 8] [--keep FOLDER]

Each preset is rendered as continuous video (30 frames a second); `speed` 1 is a hand of a few centimetres a second. Of
each row: share of the pictures that were searched from the start; shafts found (within 3 px), strays a picture, rms
contour error (median, 95 %) and median error of the end as in bench_vision_render.py, contours within 3 of their own
sigmas; sure: shafts of confidence 0.9 or more; processor time of one thread for a picture, without decoding.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from bench_vision_render import Shafts, Tally, count_ours

from data_synth import load_synth_config, write_recording
from data_synth.settings import MotionSettings
from rmis_calib.io import load_recording
from rmis_calib.pipeline.pictures.memory import RUN, detect_run
from rmis_calib.vision import ShaftDetections, ShaftDetector

BATCH, SURE = 8, 0.9


class CountingDetector(ShaftDetector):
    """Counts the pictures that are searched from the start."""

    searched = 0

    def detect(self, images: torch.Tensor, masks: torch.Tensor | None = None) -> ShaftDetections:
        self.searched += len(images)
        return super().detect(images, masks)


def render(folder: Path, preset: str, frames: int, speed: float) -> Path:
    path = folder / f"{preset}_{frames}_{speed:g}"
    if path.is_dir():
        return path
    config = load_synth_config(preset)
    motion = replace(MotionSettings(), kind="smooth", speed=speed)
    camera = replace(config.camera, left=None)
    return write_recording(path, replace(config, motions=frames, motion=motion, camera=camera))


def row(path: Path, every: int, search_every: int) -> str:
    recording, truth = load_recording(path), Shafts.read(path)
    images = torch.cat([batch.images for batch in recording.right.batches(RUN, every=every)])
    camera = recording.stereo.right.to(dtype=torch.float64)
    detector = CountingDetector(camera=camera)
    detector.detect(images[:2])
    detector.searched, parts = 0, []
    began = time.process_time()
    for first in range(0, len(images), RUN):
        run = images[first : first + RUN]
        if search_every == 1:
            parts += [detector.detect(few) for few in run.split(BATCH)]
        else:
            parts.append(detect_run(detector, run, search_every, BATCH))
    spent = time.process_time() - began
    tally, sure, first = Tally(), 0, 0
    for part in parts:
        for j in range(len(part.valid)):
            count_ours(tally, part, j, every * (first + j), truth, float(camera.focal))
        sure += int((part.valid & (part.confidence >= SURE)).sum())
        first += len(part.valid)
    calm = np.mean([graded[2] for graded in tally.graded if graded[1]]) if tally.rms else np.nan
    cells = [
        f"{100 * detector.searched / len(images):.0f} %", f"{100 * tally.found:.1f} %", f"{tally.stray / first:.2f}",
        f"{tally.quantile(0.5):.3f}", f"{tally.quantile(0.95):.3f}",
        f"{np.median(tally.end) if tally.end else np.nan:.2f}", f"{100 * calm:.0f} %", f"{sure}",
        f"{1e3 * spent / len(images):.1f}",
    ]  # fmt: skip
    return " | ".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--presets", nargs="+", default=["mild", "tissue", "two_instruments", "hard", "brutal"])
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--every", type=int, nargs="+", default=[1])
    parser.add_argument("--search-every", type=int, nargs="+", default=[8])
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    names = ("preset", "every", "search every", "searched", "found", "stray", "px", "px 95 %", "end px", "in 3 sigma")
    print("| " + " | ".join((*names, "sure", "ms")) + " |\n|" + " --- |" * (len(names) + 2))
    with tempfile.TemporaryDirectory() as folder:
        for preset in options.presets:
            path = render(options.keep or Path(folder), preset, options.frames, options.speed)
            for every in options.every:
                for n in (1, *options.search_every):
                    print(f"| {preset} | {every} | {n} | {row(path, every, n)} |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
