"""`make bench-check`: a few minutes of benchmarks against baseline.json; exit code 1 when one got worse or vanished.

    python tests/benchmarks/check.py [--update]

Accuracy is the rms error over the Cramer-Rao bound of the same trials; detection is on pictures rendered with fixed
seeds; times are processor times, each the least of several, over that of a NumPy or OpenCV operation between them.
`--update` writes the baseline anew: say why in the commit.
"""

import argparse
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import cv2
import numpy as np
import torch
from bench_vision_render import run_preset
from bench_vision_speed import drawn_picture, opencv_chain

from data_synth import load_synth_config
from rmis_calib.solver import SolverSettings, solve
from rmis_calib.vision import ShaftDetector
from tests.benchmarks import baseline
from tests.benchmarks.baseline import Metric
from tests.benchmarks.solver_common import (
    KNOWN_RADIUS,
    REALISTIC,
    Noise,
    config,
    errors,
    level,
    rms,
    rotation_deg,
    study,
    translation_mm,
)

TRIALS, FRAMES, REPEATS = 40, 16, 7
PRESETS = ("clean", "mild", "hard", "absent")
SOLVER = SolverSettings(unknowns=KNOWN_RADIUS)
SAME = 0.02
"""Tolerance of what is computed from fixed seeds: other versions of torch round otherwise."""
FEW = 0.10
"""Of a median over a few pictures."""
TIMES = 0.30
"""Of ratios of times: caches and cores differ from run to run."""


def accuracy() -> list[Metric]:
    """Error of `joint` over the bound, and the error of `global`, in trials from data_synth."""
    metrics = []
    cases: tuple[tuple[str, Noise, tuple[str, ...]], ...] = (
        ("realistic, contours and ends", REALISTIC, ("contours", "ends")),
        ("c = 1, contours and ends", level(1.0), ("contours", "ends")),
        ("realistic, axis lines", REALISTIC, ("axis",)),
    )
    for name, noise, kinds in cases:
        trials = study(config(noise, TRIALS, 1, 2, 3), kinds)
        for method in ("joint",) if "contours" in kinds else ("joint", "global"):
            e = errors(solve(trials.problem, SOLVER, method).camera_right_T_arm, trials.truth)
            for part, size, bound in (
                ("rotation", rms(rotation_deg(e)), trials.bound_deg),
                ("translation", rms(translation_mm(e)), trials.bound_mm),
            ):
                metrics.append(Metric(f"{method}, {part}, {name}", size / bound, "x Cramer-Rao bound", "lower", SAME))
    return metrics


def detection() -> list[Metric]:
    """Shafts found, false and how precise, in rendered pictures."""
    metrics = []
    with tempfile.TemporaryDirectory() as folder:
        for preset in PRESETS:
            synth = replace(load_synth_config(preset), motions=FRAMES)
            tally = run_preset(synth, Path(folder) / preset, with_peers=False)["ours"]
            if tally.visible:
                metrics.append(Metric(f"shafts found, {preset}", tally.found, "of those shown", "higher", SAME))
                metrics.append(Metric(f"contour error, {preset}", tally.quantile(0.5), "px, median", "lower", FEW))
            metrics.append(Metric(f"stray lines, {preset}", tally.stray / tally.frames, "a picture", "lower", SAME))
    return metrics


def least_seconds(*actions: Callable[[], object]) -> list[float]:
    """Least processor time of each, taken in turn."""
    for action in actions:
        action()
    times = np.full((REPEATS, len(actions)), np.inf)
    for i in range(REPEATS):
        for j, action in enumerate(actions):
            began = time.process_time()
            action()
            times[i, j] = time.process_time() - began
    return times.min(0).tolist()


def speed() -> list[Metric]:
    """Solver and detector over operations of NumPy and OpenCV."""
    trial = study(config(REALISTIC, 1, 0), ("axis", "contours", "ends")).problem
    batch = study(config(REALISTIC, 20, 5, 2, 3), ("contours", "ends")).problem
    blocks = np.random.default_rng(0).standard_normal((1728, 13, 13))
    blocks = blocks @ blocks.swapaxes(1, 2) + np.eye(13)
    methods = ("paper", "global", "joint")
    reference, *ours, many = least_seconds(
        lambda: np.linalg.inv(blocks),
        *(lambda method=method: solve(trial, SOLVER, method) for method in methods),
        lambda: solve(batch, SOLVER),
    )
    unit = "x numpy.linalg.inv of 1,728 13x13"
    metrics = [
        Metric(f"time of {method}, 1,728 motions", seconds / reference, unit, "lower", TIMES)
        for method, seconds in zip(methods, ours, strict=True)
    ]
    metrics.append(Metric("time of joint, 20 trials of 216 motions", many / reference, unit, "lower", TIMES))
    picture = drawn_picture()
    images = torch.from_numpy(picture).permute(2, 0, 1)[None].repeat(4, 1, 1, 1)
    detector = ShaftDetector()
    theirs, ours = least_seconds(lambda: opencv_chain(picture), lambda: detector.detect(images))
    return [*metrics, Metric("time of detection, 1280x720", ours / 4 / theirs, "x OpenCV's chain", "lower", TIMES)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true", help="write the baseline anew")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    print(f"Python {platform.python_version()}, torch {torch.__version__}, OpenCV {cv2.__version__}, one thread")
    known = {} if options.update else {metric.metric: metric for metric in baseline.read()}
    measured: list[Metric] = []
    for part in (accuracy, detection, speed):
        for metric in part():
            measured.append(metric)
            before = f"  (baseline {known[metric.metric].value:.4g})" if metric.metric in known else ""
            print(f"{metric.metric:48} {metric.value:9.4g} {metric.unit}{before}", flush=True)
    if options.update:
        baseline.write(measured)
        return 0
    faults = baseline.compare(measured, list(known.values()))
    for fault in faults:
        print(f"WORSE  {fault}")
    print(f"{len(measured)} metrics, {len(faults)} worse or missing")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
