"""Fit the weights of rmis_calib/vision/fine/confidence.py again, and check them on seeds that the fit has not seen.

    python tests/benchmarks/fit_confidence.py [--frames 10] [--seeds 1001 1002 1003 1004 1005 1006] [--benches 6]

Every candidate of rendered frames counts, of benches (a quarter), and of the labelled real frames (four times); in one
view and in two. The contours' six weights are fitted first; then, with the logarithmic odds that they give as one
feature, the three of the network, which knows rendered scenes better than real ones and must not displace them.
Right is a candidate within three of its own sigma, or `FOUND_PX`, of a true shaft, whichever it is; on real frames,
within `REAL_PX` of a label. Each seed, and each set of real frames, is judged by a fit to the others.
"""

import argparse
import dataclasses
from itertools import pairwise

import numpy as np
import torch
from bench_vision_real_frames import DATA, distances_px, pictures, read_labels
from bench_vision_render import BENCH_PX, FOUND_PX, rms_px

from data_synth import load_synth_config, render_bench, render_frames
from data_synth.world import build_world
from rmis_calib.geometry import Camera
from rmis_calib.vision import DetectorSettings, ShaftDetections, ShaftDetector
from rmis_calib.vision.fine import confidence

PRESETS = (
    "absent", "carbon", "blood", "hard", "brutal", "cholec", "two_instruments", "clean", "mild", "tissue", "smoke",
    "leaving",
)  # fmt: skip
REAL_PX, REAL_WEIGHT, BENCH_WEIGHT = 12.0, 4.0, 0.25
CONTOURS = 6
"""Features that come before the network's."""
Row = tuple[list[float], bool, float, str]
"""Marks of a candidate, whether it is right, its weight, and the seed or the set that it is from."""
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


def rendered(recorder: Recorder, preset: str, seed: int, frames: int) -> list[Row]:
    """Every candidate of one preset and seed."""
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
            rows.append((marks, min(each, default=np.inf) < max(3 * sigma, FOUND_PX), 1.0, str(seed)))
        recorder.rows.clear()
    return rows


def benches(recorder: Recorder, seed: int, count: int) -> list[Row]:
    """The same of laboratory benches."""
    images, truth = render_bench(seed, count)
    rows = []
    for settings in LOOKS:
        for i, shafts in enumerate(truth):
            found = ShaftDetector(settings).detect(images[i : i + 1])
            for rank in found.valid[0].nonzero()[:, 0].tolist():
                each = (float(distances_px(found, rank, s.contour_uv).max()) for s in shafts if s.visible)
                marks = recorder.marks_of(float(found.confidence[0, rank]))
                rows.append((marks, min(each, default=np.inf) < BENCH_PX, BENCH_WEIGHT, str(seed)))
            recorder.rows.clear()
    return rows


def real(recorder: Recorder) -> list[Row]:
    """The same of the labelled real frames; stubs, which may be found or not, are left out."""
    labels, rows = read_labels(), []
    for key, image in pictures().items():
        for settings in LOOKS:
            found = ShaftDetector(settings).detect(torch.from_numpy(image).permute(2, 0, 1)[None].contiguous())
            for rank in found.valid[0].nonzero()[:, 0].tolist():
                error, kind = nearest(found, rank, labels.get(key, []))
                if kind != "stub":
                    marks = recorder.marks_of(float(found.confidence[0, rank]))
                    rows.append((marks, error < REAL_PX, REAL_WEIGHT, key[0].rsplit("/", 1)[0]))
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


def fit_in_turn(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Base and weights: the contours' features as `fit` has them, all scaled, and the network's."""
    contours = fit(x[:, : 1 + CONTOURS], y, weight)
    odds = np.clip(x[:, : 1 + CONTOURS] @ contours, -8, 8)
    base, scale, *network = fit(np.column_stack([np.ones(len(y)), odds, x[:, 1 + CONTOURS :]]), y, weight)
    return np.r_[base + scale * contours[0], scale * contours[1:], network]


def print_reliability(title: str, p: np.ndarray, y: np.ndarray) -> None:
    """What a confidence is worth."""
    print(f"\n| {title} | candidates | mean | right |\n| --- | --- | --- | --- |")
    for low, high in pairwise((0.0, 0.2, 0.4, 0.5, 0.7, 0.8, 0.9, 1.0)):
        some = (p >= low) & (p <= high)
        if some.any():
            print(f"| {low} to {high} | {some.sum()} | {p[some].mean():.2f} | {y[some].mean():.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description="Fit the weights of the confidence.")
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1001, 1007)))
    parser.add_argument("--benches", type=int, default=6)
    options = parser.parse_args()
    torch.set_num_threads(1)
    recorder = Recorder()
    confidence.probability = recorder
    confidence.capped = lambda certain, _: certain  # by its own chance the recorder knows a candidate
    confidence.plausible = lambda trace, *_: torch.ones_like(
        trace.start_at_border
    )  # the gate would hide the false ones
    rows = [row for p in PRESETS for s in options.seeds for row in rendered(recorder, p, s, options.frames)]
    rows += [row for s in options.seeds for row in benches(recorder, s, options.benches)]
    rows += real(recorder) if DATA.is_dir() else []
    x = np.array([[1.0, *marks] for marks, _, _, _ in rows])
    y, weight = (np.array([row[i] for row in rows], dtype=float) for i in (1, 2))
    seed = np.array([row[3] for row in rows])
    print(f"{len(rows)} candidates, {int(y.sum())} right; base and weights {fit_in_turn(x, y, weight).round(2)}")
    p, alone = np.empty(len(y)), np.empty(len(y))
    for one in np.unique(seed):
        held = seed == one
        train = x[~held], y[~held], weight[~held]
        p[held] = 1 / (1 + np.exp(-x[held] @ fit_in_turn(*train)))
        alone[held] = 1 / (1 + np.exp(-x[held, : 1 + CONTOURS] @ fit(train[0][:, : 1 + CONTOURS], *train[1:])))
    for name, some in (("rendered", weight == 1), ("benches", weight == BENCH_WEIGHT), ("real", weight == REAL_WEIGHT)):
        if some.any():
            losses = (-np.log(np.where(y == 1, q, 1 - q)[some].clip(1e-4)).mean() for q in (p, alone))
            print("\n{}: loss {:.3f}, without the network {:.3f}".format(name, *losses))
            print_reliability(f"{name}, by a fit to the others", p[some], y[some])


if __name__ == "__main__":
    main()
