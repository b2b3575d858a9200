"""What limits a calibration of rendered recordings: the motions, the shutter, or the lines that are detected?

    python tests/benchmarks/bench_rendered_split.py [--presets hard] [--seeds 0 1 2] [--motions 60] [--keep FOLDER]

For each recording, first the Cramer-Rao bound (root of the trace: deg / mm) at its motions, with lines of LINE_PX and
ends of END_PX: with nothing else unknown; with all that `calibrate` takes as unknown but the encoders; with offsets of
0.1 deg (0.2 mm), and of 0.5 deg (1 mm). Then how far the whole estimate is off, its own 1 sigma, and the distance in
sigmas (3 sigma of 6 unknowns: 4.49): from true lines with that noise; from those that rows show which are read one
after the other, likewise; and from detected ones, of each picture the candidate that is nearest to the truth, so that
only measurement and solver count.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
import yaml

import rmis_calib as rc
from data_synth import load_synth_config, write_recording
from rmis_calib.config import CalibrationConfig
from rmis_calib.io import Recording, ShaftObservations
from rmis_calib.pipeline.answer.offsets import estimate_with_kinematics
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.arms.poses import motion_poses
from rmis_calib.pipeline.motions.association import Choice
from rmis_calib.pipeline.motions.observations import assemble
from rmis_calib.pipeline.pictures.detection import View, detect_recording, no_progress
from rmis_calib.solver import Problem, SolverSettings
from rmis_calib.solver.settings import UnknownSettings
from rmis_calib.studies.measures import cramer_rao_bound, transform_errors

LINE_PX, END_PX = 0.2, 0.35
"""Noise of a contour point and of an end, 1 sigma, as measured in the preset `hard` (`bench_vision_render.py`)."""
KINEMATICS = {"sigma_kinematics_mm": 0.1, "sigma_kinematics_rad": float(np.deg2rad(0.03))}
"""What the presets draw."""
END_OFFSET_MM, FAR_PX = -10.0, 3.0
EXACT = UnknownSettings(stereo=False, radius_sigma_relative=0.0, clock=False, joint_offsets="never")
AS_CALIBRATE = UnknownSettings(joint_offsets="never", readout="always")
BOUNDS = ((EXACT, 0.0), (AS_CALIBRATE, 0.0), (replace(AS_CALIBRATE, joint_offsets="always"), 0.1))
BOUNDS = (*BOUNDS, (replace(AS_CALIBRATE, joint_offsets="always"), 0.5))
"""Unknowns, and the 1 sigma of each revolute joint's offset, deg; a prismatic one's is 2 mm for each."""

Truth = dict[str, np.ndarray]


def distance_px(xy: np.ndarray, n: np.ndarray, focal: float) -> np.ndarray:
    """Rms distance (...) of points (..., edge, point, 2) from lines (..., edge, 3)."""
    n = n / np.linalg.norm(n[..., :2], axis=-1, keepdims=True)
    off = np.einsum("...epi,...ei->...ep", xy, n[..., :2]) + n[..., 2:]
    return focal * np.sqrt((off**2).mean((-2, -1)))


def nearest_to_truth(view: View, truth: Truth, frames: np.ndarray) -> Choice:
    """The candidate of each motion that is the shaft, where there is one within FAR_PX."""
    assert view.camera is not None
    found, focal = view.at(frames), float(view.camera.focal)
    n = truth[f"{view.side}_n_contour_read"][frames][:, None]
    xy = found.contour_xy.double().numpy()
    forwards, backwards = (distance_px(points, n, focal) for points in (xy, xy[..., ::-1, ::-1, :]))
    off = np.nan_to_num(np.minimum(forwards, backwards), nan=np.inf)
    off = np.where(found.valid.numpy() & truth[f"{view.side}_visible"][frames][:, None], off, np.inf)
    best, rows = off.argmin(1), np.arange(len(frames))
    candidate = np.where(off[rows, best] < FAR_PX, best, -1)
    return Choice(torch.as_tensor(candidate), torch.as_tensor((backwards < forwards)[rows, best]))


def with_true_lines(observations: ShaftObservations, truth: Truth, frames: np.ndarray, name: str) -> ShaftObservations:
    """The observations with true contours, where they are measured, on the lines `n_contour` or `n_contour_read`; and
    with true ends, at the frame's own instant."""
    arrays = {}
    for side in ("right", "left"):
        xy, n = truth[f"{side}_contour_xy"][frames], truth[f"{side}_{name}"][frames]
        n = n / np.linalg.norm(n[..., :2], axis=-1, keepdims=True)
        off = np.einsum("mepi,mei->mep", xy, n[..., :2]) + n[..., 2:]
        contour, end = xy - off[..., None] * n[:, :, None, :2], truth[f"{side}_end_xy"][frames]
        for key, value in ((f"contour_{side}", contour), (f"end_{side}", end)):
            arrays[key] = np.where(np.isfinite(getattr(observations, key)), value, np.nan)
    return replace(observations, **arrays)


def with_noise(observations: ShaftObservations, focal: float) -> ShaftObservations:
    """The observations with noise of LINE_PX and END_PX."""
    rng, arrays = np.random.default_rng(0), {}
    for kind, px in (("contour", LINE_PX), ("end", END_PX)):
        for key in (f"{kind}_right", f"{kind}_left"):
            xy = getattr(observations, key)
            arrays[key] = xy + px / focal * rng.standard_normal(xy.shape)
    return replace(observations, **arrays)


def bounds(exact: ShaftObservations, unknowns: KinematicUnknowns, X: torch.Tensor) -> str:
    """The Cramer-Rao bound for each of BOUNDS."""
    shown = []
    for asked, offset_deg in BOUNDS:
        told = replace(exact, **KINEMATICS)
        if asked is EXACT:
            told = replace(told, sigma_edge_bias=0.0, sigma_focal=0.0, sigma_centre=0.0, sigma_lens=0.0)
        base = Problem.from_observations(told).only("contours", "ends").flatten_batch()
        size = {True: np.deg2rad(offset_deg), False: 2.0 * offset_deg}
        sigma = torch.tensor([size[name.endswith("rad")] for name in unknowns.columns], dtype=torch.float64)
        at = unknowns.linearised(base, torch.zeros_like(sigma)[None], torch.zeros(1, 2, dtype=torch.float64), sigma)
        shown.append(blocks(cramer_rao_bound(at, X[None], END_OFFSET_MM, SolverSettings(unknowns=asked))[0]))
    return " | ".join(shown)


def blocks(covariance: torch.Tensor) -> str:
    turn, shift = (float(block.trace().sqrt()) for block in (covariance[:3, :3], covariance[3:, 3:]))
    return f"{np.rad2deg(turn):.2f} / {shift:.2f}"


def estimated(observations: ShaftObservations, unknowns: KinematicUnknowns, X: torch.Tensor) -> str:
    """Off, own 1 sigma, distance in sigmas and verdict of the whole estimate."""
    solution, _ = estimate_with_kinematics(observations, CalibrationConfig(), unknowns)
    error = transform_errors(solution.camera_right_T_arm.reshape(4, 4), X)
    covariance = solution.covariance.reshape(6, 6)
    off = f"{float(torch.rad2deg(error[:3].norm())):.2f} / {float(error[3:].norm()):.2f}"
    sigmas = float((error @ torch.linalg.solve(covariance, error)).sqrt())
    return f"{off} | {blocks(covariance)} | {sigmas:.1f}"


def row(folder: Path) -> str:
    recording: Recording = rc.load_recording(folder)
    with np.load(folder / "truth.npz") as file:
        truth: Truth = dict(file)
    X = torch.tensor(yaml.safe_load((folder / "ground_truth.yaml").read_text())["camera_right_T_arm"]).double()
    config, poses = CalibrationConfig(), motion_poses(recording)
    views = detect_recording(recording, config, no_progress)
    choices = tuple(nearest_to_truth(view, truth, poses.frames) for view in views)
    detected = assemble(recording, poses, views, choices, config)
    unknowns = KinematicUnknowns(recording, poses.frames, config.device)
    exact, read = (with_true_lines(detected, truth, poses.frames, name) for name in ("n_contour", "n_contour_read"))
    focal = float(recording.stereo.right.focal)
    told = {}
    for kind, px in (("contour", LINE_PX), ("end", END_PX)):
        for key in (f"sigma_{kind}_right", f"sigma_{kind}_left"):
            told[key] = np.full_like(getattr(exact, key), px / focal)
    parts = [bounds(replace(exact, **told), unknowns, X)]
    parts += [estimated(lines, unknowns, X) for lines in (with_noise(exact, focal), with_noise(read, focal), detected)]
    return " | ".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--presets", nargs="+", default=["hard"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--motions", type=int, default=60)
    parser.add_argument("--keep", type=Path, help="folder for the recordings; those that it has are not rendered again")
    options = parser.parse_args()
    columns = [
        "preset",
        "seed",
        "bound, nothing else unknown",
        "as calibrate, exact encoders",
        "offsets of 0.1 deg",
        "of 0.5 deg",
    ]
    columns += [f"{lines}: {what}" for lines in ("true", "as read", "detected") for what in ("off", "own", "sigmas")]
    print("| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns), flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        for preset in options.presets:
            for seed in options.seeds:
                folder = (options.keep or Path(temporary)) / f"{preset}_{seed}"
                if not folder.exists():
                    write_recording(folder, replace(load_synth_config(preset), seed=seed, motions=options.motions))
                print(f"| {preset} | {seed} | {row(folder)} |", flush=True)


if __name__ == "__main__":
    main()
