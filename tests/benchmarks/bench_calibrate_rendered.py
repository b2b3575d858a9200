"""From rendered pictures to the answer: calibrations of ugly recordings, and of the same with wrong joints.

    python tests/benchmarks/bench_calibrate_rendered.py [--presets hard brutal] [--seeds 0 1 2 3] [--motions 60]
        [--joints as_they_are sign_turned reversed_in_time]

Each recording is calibrated as it is; with the first joint of the instrument's sign turned; and with the instrument's
joints reversed in time. The last two have no right answer: they must not end in a trustworthy one. 12 minutes.
Found: shafts of both cameras, of those in view, whose measured contours are within 3 px (rms) of the true ones.
"""

import argparse
import csv
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from bench_vision_render import FOUND_PX, rms_px

import rmis_calib as rc
from data_synth import load_synth_config, write_recording
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.calibration import run_calibration


def as_they_are(readings: np.ndarray) -> np.ndarray:
    return readings


def sign_turned(readings: np.ndarray) -> np.ndarray:
    return readings * np.where(np.arange(readings.shape[1]) == 0, -1.0, 1.0)


def reversed_in_time(readings: np.ndarray) -> np.ndarray:
    return readings[::-1]


def with_joints(recording: Path, folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> Path:
    """A copy of the recording whose instrument's readings (rows, joints) are changed."""
    copy = Path(shutil.copytree(recording, folder / change.__name__))
    with (copy / "joints.csv").open(newline="") as file:
        header, *rows = list(csv.reader(file))
    own = [i for i, name in enumerate(header) if name.startswith("instrument.")]
    table = np.array(rows, dtype=float)
    table[:, own] = change(table[:, own])
    with (copy / "joints.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, *table.tolist()])
    return copy


def found(run: CalibrationRun, truth_file: Path) -> str:
    """How many shafts in view were measured right, by the candidates that were taken."""
    right = in_view = 0
    with np.load(truth_file) as truth:
        for view, choice in zip(run.views, run.choices, strict=True):
            assert view.camera is not None
            n_contour = truth[f"{view.side}_n_contour_read"][run.poses.frames]
            visible = truth[f"{view.side}_visible"][run.poses.frames]
            detections = view.at(run.poses.frames)
            points = detections.contour_xy[range(len(visible)), choice.candidate.clamp(min=0)].double().numpy()
            for m in np.flatnonzero(visible & choice.taken.numpy()):
                orders = (points[m], points[m][::-1])
                off = min(float(rms_px(p, n_contour[m : m + 1], float(view.camera.focal))[0]) for p in orders)
                right += off < FOUND_PX
            in_view += int(visible.sum())
    return f"{right} of {in_view}"


def row(preset: str, seed: int, change: Callable[[np.ndarray], np.ndarray], folder: Path) -> str:
    recording = rc.load_recording(folder)
    run = run_calibration(recording)
    result = run.result
    measured = rc.evaluate(result, recording) if result.camera_right_T_arm is not None else None
    off = "-" if measured is None else f"{measured.rotation_error_deg:.2f} deg, {measured.translation_error_mm:.2f} mm"
    own = "-"
    if result.covariance is not None:
        turn, shift = (
            float(np.sqrt(np.trace(block))) for block in (result.covariance[:3, :3], result.covariance[3:, 3:])
        )
        own = f"{np.rad2deg(turn):.2f} deg, {shift:.2f} mm"
    used = f"{int(result.motions.used.sum())} of {len(result.motions.used)}"
    joints, shown = change.__name__.replace("_", " "), found(run, folder / "truth.npz")
    return f"| {preset} | {seed} | {joints} | {result.status} | {shown} | {used} | {off} | {own} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--presets", nargs="+", default=["hard", "brutal"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--motions", type=int, default=60)
    changes = {change.__name__: change for change in (as_they_are, sign_turned, reversed_in_time)}
    parser.add_argument("--joints", nargs="+", choices=changes, default=list(changes))
    options = parser.parse_args()
    print(
        "| preset | seed | joints | status | found | motions used | off | own 1 sigma |\n|" + " --- |" * 8, flush=True
    )
    for preset in options.presets:
        for seed in options.seeds:
            with tempfile.TemporaryDirectory() as temporary:
                config = replace(load_synth_config(preset), seed=seed, motions=options.motions)
                recording = write_recording(Path(temporary) / "recording", config)
                for change in (changes[name] for name in options.joints):
                    copy = with_joints(recording, Path(temporary), change)
                    print(row(preset, seed, change, copy), flush=True)


if __name__ == "__main__":
    main()
