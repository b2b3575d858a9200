"""Pictures of several recordings searched together by one process a device, beside each worker searching its own.

    python tests/benchmarks/bench_device_batch.py [--device cpu] [--recordings 8] [--motions 48] [--width 320]
        [--frames 64] [--workers 2] [--repeats 1]

Small pictures, where the overhead of calls counts most. One line a run: wall and processor time of the whole batch (all
processes), and at the end whether every number that was found is the same to the last bit.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

import data_synth
from data_synth.settings import SynthConfig


def small_scene(width: int, motions: int, seed: int) -> SynthConfig:
    """The demo's scene through cameras of another picture size; one set-up, other motions for each seed."""
    config = data_synth.load_synth_config("demo")
    camera = config.camera
    scale = width / camera.width_px

    def scaled(one):
        # Pixel (0, 0) is the centre of the first pixel.
        centre = {key: (getattr(one, key) + 0.5) * scale - 0.5 for key in ("cx_px", "cy_px")}
        return replace(one, fx_px=scale * one.fx_px, fy_px=scale * one.fy_px, **centre)

    left = None if camera.left is None else scaled(camera.left)
    size = {"width_px": width, "height_px": round(camera.height_px * scale)}
    return replace(
        config, motions=motions, seed=seed, camera=replace(camera, right=scaled(camera.right), left=left, **size)
    )


def run(root: Path, out: Path, device: str, workers: int, frames: int) -> tuple[float, float]:
    """Wall and processor seconds of `batch --task detect`.

    Raises:
        SystemExit: a recording failed.
    """
    command = [sys.executable, "-m", "rmis_calib", "batch", str(root), "--out", str(out), "--task", "detect"]
    command += ["--device", device, "--overlays", "0", "--workers", str(workers), "--device-batch", str(frames)]
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ)
    if done.returncode != 0:
        sys.exit(done.stdout + done.stderr)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - start, used


def largest_difference(one: Path, other: Path) -> tuple[int, float]:
    """Files of lines compared, and the largest difference of any number; infinite where one is missing on a side."""
    files = sorted(path.relative_to(one) for path in one.glob("*/lines*.npz"))
    largest = 0.0
    for file in files:
        with np.load(one / file) as a, np.load(other / file) as b:
            for name in a.files:
                if a[name].dtype.kind not in "fiub":
                    continue
                x, y = a[name].astype(float), b[name].astype(float)
                if x.shape != y.shape or not np.array_equal(np.isnan(x), np.isnan(y)):
                    largest = float("inf")
                elif x.size:
                    largest = max(largest, float(np.nanmax(np.abs(x - y), initial=0.0)))
    return len(files), largest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    for name, default in (
        ("recordings", 8),
        ("motions", 48),
        ("width", 320),
        ("frames", 64),
        ("workers", 2),
        ("repeats", 1),
    ):
        parser.add_argument(f"--{name}", type=int, default=default)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bench_device_batch_") as folder:
        work = Path(folder)
        for i in range(asked.recordings):
            data_synth.write_recording(work / "root" / f"case_{i}", small_scene(asked.width, asked.motions, i))
        pictures = f"{2 * asked.motions} pictures, {asked.width} px wide"
        print(f"{asked.recordings} recordings of {pictures}; {asked.workers} workers")
        for repeat in range(asked.repeats):
            for name, frames in (("each its own", 0), (f"together, up to {asked.frames}", asked.frames)):
                wall, used = run(work / "root", work / f"{frames}_{repeat}", asked.device, asked.workers, frames)
                print(f"{name:>20}: {wall:6.1f} s, processor {used:6.1f} s", flush=True)
        files, off = largest_difference(work / "0_0", work / f"{asked.frames}_0")
        print(f"largest difference of a number in {files} files: {off:g}")
        if files == 0:
            sys.exit("nothing to compare")


if __name__ == "__main__":
    main()
