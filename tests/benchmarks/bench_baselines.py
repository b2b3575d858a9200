"""Hand-eye baselines: time of a batch, error, and coverage of the covariance; OpenCV's loop where the build has it.

Processor time, not wall time, so that other work on the machine does not count.
python tests/benchmarks/bench_baselines.py [--trials 10000] [--poses 20]
"""

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "baselines"))

import cv2
import numpy as np
from scenes import METHODS, Scene, errors, noisy, scene

QUANTILE_95 = 12.5916  # chi^2, 6 degrees of freedom
NOISE = {"board": {"camera": (0.002, 0.3)}, "robot": {"robot": (0.002, 0.3)}}
OPENCV_TRIALS = 300


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=10_000)
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--coverage-trials", type=int, default=1000)
    args = parser.parse_args()
    exact = scene(1, args.poses, trials=(args.trials,))
    data = noisy(exact, 2, **NOISE["board"])
    print(f"{args.trials} trials of {args.poses} poses, one batch; s of processor time\n")
    print("| method | without covariance | with | OpenCV's loop |\n| --- | --- | --- | --- |")
    data.solve("park", covariance=True)  # loads what torch loads once
    for method in METHODS:
        times = [timed(lambda method=method, full=full: data.solve(method, covariance=full)) for full in (False, True)]
        opencv = opencv_seconds(data, method)
        print(f"| {method} | {times[0]:.1f} | {times[1]:.1f} | {opencv} |", flush=True)
    print(f"\nnoise of 0.115 deg and 0.3 mm an axis, {args.coverage_trials} trials of {args.poses} poses\n")
    print("| method | board's noise: rms deg / mm | in the 95 % ellipsoid | robot's: rms deg / mm | in the ellipsoid |")
    print("| --- | --- | --- | --- | --- |")
    worst = 1.0
    for method in METHODS:
        cells = []
        for seed, noise in enumerate(NOISE.values()):
            rms, coverage = accuracy(
                noisy(scene(3, args.poses, trials=(args.coverage_trials,)), 4 + seed, **noise), method
            )
            worst = min(worst, coverage)
            cells += [f"{np.rad2deg(rms[0]):.3f} / {rms[1]:.2f}", f"{100 * coverage:.1f} %"]
        print(f"| {method} | {' | '.join(cells)} |", flush=True)
    return 0 if worst >= 0.90 else 1


def timed(run) -> float:
    start = time.process_time()
    run()
    return time.process_time() - start


def opencv_seconds(data: Scene, method: str) -> str:
    """OpenCV's time for as many trials one by one, extrapolated from the first ones."""
    hand_eye = getattr(cv2, f"CALIB_HAND_EYE_{method.upper()}", None)
    robot_world = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{method.upper()}", None)
    if hand_eye is None and robot_world is None:
        return "-"
    if not hasattr(cv2, "calibrateHandEye"):
        return f"not in OpenCV {cv2.__version__}"

    def loop() -> None:
        pairs = zip(data.base_T_flange[:OPENCV_TRIALS], data.camera_T_board[:OPENCV_TRIALS], strict=True)
        for A, C in pairs:
            parts = (A[:, :3, :3], A[:, :3, 3], C[:, :3, :3], C[:, :3, 3])
            if hand_eye is not None:
                cv2.calibrateHandEye(*parts, method=hand_eye)
            else:
                cv2.calibrateRobotWorldHandEye(*parts, method=robot_world)

    trials = len(data.base_T_flange)
    return f"{timed(loop) * trials / min(trials, OPENCV_TRIALS):.1f}"


def accuracy(data: Scene, method: str) -> tuple[np.ndarray, float]:
    """Root mean square errors (rad, mm) and the part of the trials inside the 95 % ellipsoid."""
    found = data.solve(method)
    apart = errors(found.flange_T_camera.numpy(), data.flange_T_camera)
    squared = np.einsum("ti,tij,tj->t", apart, np.linalg.inv(found.covariance.numpy()), apart)
    rms = np.sqrt((apart.reshape(-1, 2, 3) ** 2).sum(-1).mean(0))
    return rms, float((squared < QUANTILE_95).mean())


if __name__ == "__main__":
    sys.exit(main())
