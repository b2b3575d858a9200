"""Fit the weights of rmis_calib/vision/fine/confidence.py again, and check them on seeds that the fit has not seen.

    python tests/benchmarks/fit_confidence.py [--frames 10] [--seeds 1001 1002 1003 1004 1005 1006]

Every candidate of rendered frames counts, and every candidate of the labelled real frames (four times); in one view
and in two. Right is a candidate within three of its own sigma of a true shaft, whichever it is; on real frames, within
`REAL_PX` of a label.
"""

import argparse
import dataclasses

import numpy as np
import torch
from bench_vision_real_frames import DATA, distances_px, pictures, read_labels
from bench_vision_render import rms_px

from data_synth import load_synth_config, render_frames
from data_synth.world import build_world
from rmis_calib.geometry import Camera
from rmis_calib.vision import DetectorSettings, ShaftDetections, ShaftDetector
from rmis_calib.vision.fine import confidence

PRESETS = (
    "absent", "carbon", "blood", "hard", "brutal", "cholec", "two_instruments", "clean", "mild", "tissue", "smoke",
)  # fmt: skip
REAL_PX, REAL_WEIGHT = 12.0, 4.0
LOOKS = [DetectorSettings(min_confidence=0.0, second_look_below=below) for below in (0.0, 1.0)]
"""One view of every picture, and two."""


class Recorder:
    """Keeps the marks of every candidate beside the chance that they give, which tells candidates apart."""

    def __init__(self) -> None:
        self.rows: list[tuple[float, list[float]]] = []
        self._chance = confidence.probability

    def __call__(self, of: tuple[torch.Tensor, ...]) -> torch.Tensor:
        value = self._chance(of)
        self.rows += list(zip(value[0].tolist(), torch.stack(of, -1)[0].tolist(), strict=True))
        return value

    def marks_of(self, value: float) -> list[float]:
        return min(self.rows, key=lambda row: abs(row[0] - value))[1]


def rendered(recorder: Recorder, preset: str, seed: int, frames: int) -> list[tuple[list[float], bool, float, int]]:
    """(marks, right, weight, seed) of every candidate."""
    config = dataclasses.replace(load_synth_config(preset), seed=seed, motions=frames)
    images, truth = render_frames(config)
    own = build_world(config).cameras["right"].to_dict()
    k = [own[name] for name in ("fx", "fy", "cx", "cy")]
    camera = Camera.from_values(*k, own["distortion"], image_size=tuple(images.shape[-2:]))
    rows = []
    for settings in LOOKS:
        found = ShaftDetector(settings, camera=camera).detect(images)
        for frame, rank in found.valid.nonzero().tolist():
            points = found.contour_xy[frame, rank].double().numpy()
            shafts = [t.n_contour_read[frame] for t in (truth, *truth.others) if t.visible[frame]]
            orders = (points,) if found.direction_known[frame, rank] else (points, points[::-1])
            each = (float(rms_px(order, n[None], float(camera.focal))[0]) for n in shafts for order in orders)
            sigma = float(found.contour_sigma[frame, rank].square().mean().sqrt()) * float(camera.focal)
            marks = recorder.marks_of(float(found.confidence[frame, rank]))
            rows.append((marks, min(each, default=np.inf) < 3 * sigma, 1.0, seed))
        recorder.rows.clear()
    return rows


def real(recorder: Recorder) -> list[tuple[list[float], bool, float, int]]:
    """The same of the labelled real frames; stubs, which may be found or not, are left out."""
    labels, rows = read_labels(), []
    for key, image in pictures().items():
        for settings in LOOKS:
            found = ShaftDetector(settings).detect(torch.from_numpy(image).permute(2, 0, 1)[None].contiguous())
            for rank in found.valid[0].nonzero()[:, 0].tolist():
                error, kind = nearest(found, rank, labels.get(key, []))
                if kind != "stub":
                    marks = recorder.marks_of(float(found.confidence[0, rank]))
                    rows.append((marks, error < REAL_PX, REAL_WEIGHT, 0))
            recorder.rows.clear()
    return rows


def nearest(found: ShaftDetections, rank: int, labels: list[dict]) -> tuple[float, str]:
    """Largest distance, px, of the nearest label's points from the lines, and its kind."""
    each = [(float(distances_px(found, rank, label["contours"]).max()), label["kind"]) for label in labels]
    return min(each, default=(np.inf, ""))


def fit(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Ridge logistic regression by Newton's method; the first column, of ones, has no ridge."""
    ridge = np.diag([0.0] + [1.0] * (x.shape[1] - 1))
    b = np.zeros(x.shape[1])
    for _ in range(60):
        p = 1 / (1 + np.exp(-x @ b))
        curvature = (x.T * np.maximum(p * (1 - p), 1e-6) * weight) @ x + ridge
        b += np.linalg.solve(curvature, x.T @ (weight * (y - p)) - ridge @ b)
    return b


def main() -> None:
    parser = argparse.ArgumentParser(description="Fit the weights of the confidence.")
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1001, 1007)))
    options = parser.parse_args()
    recorder = Recorder()
    confidence.probability = recorder
    confidence.plausible = lambda trace, *_: torch.ones_like(
        trace.start_at_border
    )  # the gate would hide the false ones
    rows = [row for p in PRESETS for s in options.seeds for row in rendered(recorder, p, s, options.frames)]
    rows += real(recorder) if DATA.is_dir() else []
    x = np.array([[1.0, *marks] for marks, _, _, _ in rows])
    y, weight, seed = (np.array([row[i] for row in rows], dtype=float) for i in (1, 2, 3))
    print(f"{len(rows)} candidates, {int(y.sum())} right; base and weights {fit(x, y, weight).round(2)}")
    p = np.empty(len(y))
    for one in np.unique(seed):  # 0: the real frames
        held = seed == one
        p[held] = 1 / (1 + np.exp(-x[held] @ fit(x[~held], y[~held], weight[~held])))
    print("| confidence by a fit to the other seeds | candidates | mean | right |\n| --- | --- | --- | --- |")
    for low, high in ((0.0, 0.4), (0.4, 0.7), (0.7, 0.9), (0.9, 1.0)):
        some = (p >= low) & (p <= high)
        if not some.any():
            continue
        print(f"| {low} to {high} | {some.sum()} | {p[some].mean():.2f} | {y[some].mean():.2f} |")


if __name__ == "__main__":
    main()
