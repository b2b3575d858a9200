"""Truth and sigma where encoders have constant offsets of a size that nobody states: five populations of robots.

    python tests/benchmarks/bench_solver_offset_sizes.py [--trials 100] [--scenes demo long] [--modes never always auto]

Each trial is one robot, each of whose revolute joints has a constant offset drawn with the population's 1 sigma, and
one recording, solved as `rmis-calib solve` does. `demo`: 60 motions over 10 deg and 20 mm, 0.05 px, 0.1 mm, 0.03 deg,
as `make demo`. `long`: 1,728 motions, 0.3 px, 0.3 mm, 0.1 deg. Insertions have none: theirs cannot be told from the
transform. Columns: trials whose truth lies in the 95 % ellipsoid; that are called trustworthy; of these, with the truth
beyond 3 sigma; median sigma; median error.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch

import rmis_calib as rc
from data_synth.kinematics import pose_noise
from data_synth.lines import _measure
from data_synth.scene import Scene, build_scene
from data_synth.settings import LineStudyConfig
from rmis_calib.config import parse_config
from rmis_calib.geometry.rotations import matrix_to_rotvec
from tests.benchmarks.bench_solver_misspecified import BEYOND_3_SIGMA, CAMERAS, INSIDE_95
from tests.benchmarks.bench_solver_nuisance import Recorded

SIZES_DEG = (0.0, 0.1, 0.3, 0.5, 1.0)
SCENES = {"demo": (60, 0.05, 0.1, 0.03), "long": (1728, 0.3, 0.3, 0.1)}
"""Motions; noise of pictures, px, and of the kinematics, mm and deg."""
JOINTS = [
    f"{arm}.{joint}" for arm in ("laparoscope", "instrument") for joint in ("yaw_rad", "pitch_rad", "insertion_mm")
]
HALF_RANGE = np.array([np.deg2rad(5.0), np.deg2rad(5.0), 10.0] * 2)
STEPS = (1e-5, 1e-5, 1e-3) * 2


def observed(scene: Scene, size_deg: float, noise: tuple, generator: np.random.Generator) -> rc.ShaftObservations:
    """One recording of a robot of the population."""
    motions, pixel_px, mm, deg = noise
    settings = LineStudyConfig(pixel_noise_px=pixel_px)
    home = np.concatenate((scene.laparoscope_home, scene.instrument_home))
    joints = home + HALF_RANGE * generator.uniform(-1.0, 1.0, (motions, 6))
    offset = np.deg2rad(size_deg) * generator.standard_normal(6) * np.array([1.0, 1.0, 0.0] * 2)
    arms = Recorded(scene, np.zeros(0), {}, np.zeros(0), offset, 0.0)
    true, read = arms.poses(joints), arms.poses(joints - offset)
    right = scene.camera_right_T_arm @ true.arm_T_rcm @ pose_noise(generator, (motions,), np.deg2rad(deg), mm)
    stereo = scene.camera_left_T_camera_right
    displacement = [
        arms._displacement(read, joints - offset, step * np.eye(6)[j], 2.0 * step) for j, step in enumerate(STEPS)
    ]
    laparoscope_T_base = np.linalg.inv(scene.laparoscope.base_T_arm_base)
    arrays = _measure(settings, scene, right, true, generator, "right")
    arrays |= _measure(settings, scene, stereo @ right, true, generator, "left")
    return rc.ShaftObservations(
        arm_T_rcm=read.arm_T_rcm,
        rcm_v_axis=np.broadcast_to(read.rcm_v_axis, (motions, 3)),
        rcm_s_end_mm=np.broadcast_to(read.rcm_s_end_mm, (motions,)),
        camera_left_T_camera_right=stereo,
        shaft_radius_mm=scene.shaft_radius_mm,
        laparoscope_base_T_arm=laparoscope_T_base @ read.base_T_arm,
        laparoscope_base_T_instrument_base=laparoscope_T_base @ scene.instrument.base_T_arm_base,
        sigma_setup_mm=0.0,
        sigma_setup_rad=0.0,
        sigma_rcm_mm=0.0,
        unknown_names=np.array(JOINTS),
        unknown_displacement=np.stack(displacement, axis=1),
        unknown_at=np.zeros(6),
        **{name: value for name, value in arrays.items() if "head" not in name},
        **CAMERAS,
    )


def errors(result: rc.CalibrationResult, truth: np.ndarray) -> tuple[float, float, float]:
    """Distance^2 in sigmas; deg, mm."""
    found, X = result.camera_right_T_arm.matrix, torch.as_tensor(truth)
    turn = matrix_to_rotvec((X[:3, :3] @ torch.as_tensor(found)[:3, :3].mT)[None])[0].numpy()
    gap = np.concatenate((turn, truth[:3, 3] - np.asarray(found)[:3, 3]))
    distance2 = float(gap @ np.linalg.solve(result.covariance, gap))
    return distance2, float(np.rad2deg(np.linalg.norm(turn))), float(np.linalg.norm(gap[3:]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--sizes-deg", nargs="+", type=float, default=list(SIZES_DEG))
    parser.add_argument("--modes", nargs="+", default=["auto"], choices=["never", "always", "auto"])
    parser.add_argument("--belief", type=float, default=1.0, help="probability that there are offsets at all")
    arguments = parser.parse_args()
    scene = build_scene(LineStudyConfig().scene)
    print(
        f"{'scene':6} {'offsets':>8} {'mode':7} {'in 95 %':>8} {'called ok':>9} {'ok, wrong':>9}  median sigma, error"
    )
    for name in arguments.scenes:
        for size_deg in arguments.sizes_deg:
            generator = np.random.default_rng(7)
            seen = [observed(scene, size_deg, SCENES[name], generator) for _ in range(arguments.trials)]
            for mode in arguments.modes:
                unknowns = {"joint_offsets": mode, "joint_offset_belief": arguments.belief}
                config = parse_config({"solver": {"unknowns": unknowns, "advice": {"motions": 0}}})
                results = [rc.solve(each, config, throw=False) for each in seen]
                found = np.array([errors(result, scene.camera_right_T_arm) for result in results])
                ok = np.array([result.status == "ok" for result in results])
                wrong = ok & (found[:, 0] > BEYOND_3_SIGMA)
                deg = np.median([result.rotation_sigma_deg for result in results])
                mm = np.median([result.translation_sigma_mm for result in results])
                print(
                    f"{name:6} {size_deg:4.1f} deg {mode:7} {100 * np.mean(found[:, 0] < INSIDE_95):7.1f}% "
                    f"{100 * ok.mean():8.1f}% {100 * wrong.mean():8.1f}%  {deg:.3f} deg {mm:.3f} mm, "
                    f"{np.median(found[:, 1]):.3f} deg {np.median(found[:, 2]):.3f} mm",
                    flush=True,
                )


if __name__ == "__main__":
    main()
