"""How close contours come to the Cramer-Rao bound of an edge line, from the picture's white noise and blur alone.

    python tests/benchmarks/bench_vision_bound.py [--trials 24]

An edge of height B (root of the sum of squares over the colours) and blur b tells, per pixel of its length,
B^2 / (2 sqrt(pi) b noise^2) about its place; a line at one rms spread before or behind its centre then has twice
the variance of its mean. Drawn bars at random angles; level, height, blur and slopes are known to the bound and unknown
to the detector.
"""

import argparse
import math
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "vision"))
from drawn_bars import draw_bar

from rmis_calib.vision import ShaftDetector

INSIDE, OUTSIDE = (40.0, 42.0, 45.0), (170.0, 110.0, 100.0)


def one_cell(noise: float, blur_px: float, trials: int, detector: ShaftDetector) -> tuple[float, float, float]:
    """Measured rms error, claimed standard deviation without its floor, bound; px."""
    height_squared = float(sum((o - i) ** 2 for i, o in zip(INSIDE, OUTSIDE, strict=True)))
    per_px = height_squared / (2 * math.sqrt(math.pi) * blur_px * (noise**2 + 1 / 12))  # 1/12: rounding to levels
    generator = np.random.default_rng(7)
    squares, claims, bounds = [], [], []
    for trial in range(trials):
        angle, offset = generator.uniform(0, 360), generator.uniform(0, 1)
        bar = draw_bar(
            angle, blur_px=blur_px, noise_levels=noise, offset_px=offset, inside=INSIDE, outside=OUTSIDE, seed=trial
        )
        found = detector.detect(bar.batch)
        points = found.contour_xy[0, 0].double().numpy() - bar.centre
        lateral = points @ bar.left
        squares.append(np.stack([lateral[0] - bar.width_px / 2, lateral[1] + bar.width_px / 2]) ** 2)
        length = math.sqrt(3) * np.linalg.norm(points[:, 1] - points[:, 0], axis=-1)
        bounds.append(2 / (per_px * length))
        claims.append(found.contour_sigma[0, 0].double().numpy() ** 2 - detector.settings.sigma_floor_px**2)
    return tuple(math.sqrt(float(np.mean(values))) for values in (squares, claims, bounds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=24)
    trials = parser.parse_args().trials
    detector = ShaftDetector()
    print(f"{trials} bars a row, torch {torch.__version__}")
    print("| noise, levels | blur px | rms error px | claimed px | bound px | error / bound |")
    print("| --- | --- | --- | --- | --- | --- |")
    for noise, blur_px in ((1.0, 0.7), (3.0, 0.7), (10.0, 0.7), (3.0, 1.2), (10.0, 1.2), (10.0, 2.5)):
        error, claim, bound = one_cell(noise, blur_px, trials, detector)
        print(f"| {noise} | {blur_px} | {error:.4f} | {claim:.4f} | {bound:.4f} | {error / bound:.2f} |", flush=True)


if __name__ == "__main__":
    main()
