"""Nuisances: the error when each is ignored, and when it is estimated.

    python tests/benchmarks/bench_solver_nuisance.py [--trials 20]

Both arms follow smooth paths; pictures come from the true joints, kinematics from joint readings with constant
offsets and another clock.
"""

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch

from data_synth.kinematics import pose_noise
from data_synth.lines import _measure
from data_synth.scene import Scene, build_scene, poses_at
from data_synth.settings import LineStudyConfig, SceneSettings
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.solver import Problem, SolverSettings, solve
from rmis_calib.solver.estimate.relinearise import scan_clock
from rmis_calib.solver.settings import UnknownSettings
from tests.benchmarks.solver_common import REALISTIC, config, errors, rms, rotation_deg, translation_mm

FRAMES_PER_S = 10.0


@dataclass(frozen=True)
class Recorded:
    """Pictures and joint log of `trials` recordings of one smooth motion.

    Attributes:
        scene: geometry.
        times_s: (n,) of the frames.
        arrays: what the cameras measured, trials first.
        noise: (trials, n, 4, 4) noise of arm_T_rcm.
        offset: (6,) true minus read, laparoscope's joints first.
        clock_s, rate: the time in the joint log is that of the frame + clock_s (of all frames, or of each) + rate times
            the time from the middle.
    """

    scene: Scene
    times_s: np.ndarray
    arrays: dict
    noise: np.ndarray
    offset: np.ndarray
    clock_s: float | np.ndarray
    rate: float = 0.0

    def joints(self, times_s: np.ndarray) -> np.ndarray:
        """True joint values (..., 6) of the smooth path, amplitude 5 degrees and 10 mm."""
        home = np.concatenate((self.scene.laparoscope_home, self.scene.instrument_home))
        amplitude = np.array([np.deg2rad(5.0), np.deg2rad(5.0), 10.0] * 2)
        frequency = np.array([0.071, 0.113, 0.047, 0.131, 0.093, 0.061])
        phase = np.arange(6) * 1.1
        angle = (
            2.0
            * np.pi
            * times_s[..., None]
            * np.stack((frequency, 2.3 * frequency))[:, None].reshape(2, *(1,) * times_s.ndim, 6)
            + phase
        )
        return home + amplitude * (0.65 * np.sin(angle[0]) + 0.35 * np.sin(angle[1]))

    def poses(self, q: np.ndarray):
        return poses_at(self.scene, q[..., :3], q[..., 3:])

    def kinematics(self, joint_offset: torch.Tensor, clock: torch.Tensor, setup: torch.Tensor | None = None) -> Problem:
        """What a pipeline hands to the solver: both arms at these offsets, with derivatives by central differences."""
        trials = self.noise.shape[0]
        b = joint_offset.shape[0]
        offset_s, rate = clock.numpy().T[..., None]
        from_middle = self.times_s - 0.5 * (self.times_s[0] + self.times_s[-1])
        at = self.times_s + (offset_s - self.clock_s) + (rate - self.rate) * from_middle
        q = self.joints(at) - self.offset + joint_offset.numpy()[:, None]
        centre = self.poses(q)
        derivative = [
            self._displacement(centre, q, step * np.eye(6)[j], 2.0 * step)
            for j, step in enumerate([1e-5, 1e-5, 1e-3] * 2)
        ]
        later, earlier = self.joints(at + 1e-4) - self.joints(at), self.joints(at - 1e-4) - self.joints(at)
        by_offset = self._displacement(centre, q, 0.5 * (later - earlier), 2e-4)
        clock_derivative = np.stack((by_offset, by_offset * from_middle[:, None]), -1)
        arrays = {
            k: np.broadcast_to(v[:1], (b, *v.shape[1:]))
            if b != trials and isinstance(v, np.ndarray) and v.ndim > 1
            else v
            for k, v in self.arrays.items()
        }
        noise = self.noise if b == trials else np.broadcast_to(self.noise[:1], (b, *self.noise.shape[1:]))
        problem = Problem.from_arrays(
            arrays
            | {
                "arm_T_rcm": centre.arm_T_rcm @ noise,
                "rcm_v_axis": centre.rcm_v_axis,
                "rcm_s_end_mm": centre.rcm_s_end_mm,
                "rcm_p_head": centre.rcm_p_head,
            }
        )
        sigma = torch.tensor([np.deg2rad(0.5), np.deg2rad(0.5), 1.0] * 2, dtype=torch.float64)
        return replace(
            problem,
            joint_derivative=torch.as_tensor(np.stack(derivative, -1)), joint_offset_sigma=sigma.expand(b, 6),
            joint_offset_at=joint_offset,
            clock_derivative=torch.as_tensor(clock_derivative), clock_at=clock,
        )  # fmt: skip

    def _displacement(self, centre, q, step, length):
        """Rigid displacement of the shaft in rcm per unit (problem.py, `joint_derivative`)."""
        plus, minus = self.poses(q + step), self.poses(q - step)
        R = torch.as_tensor(centre.arm_T_rcm[..., :3, :3].copy())
        turn = matrix_to_rotvec(
            torch.as_tensor(minus.arm_T_rcm[..., :3, :3]).mT @ torch.as_tensor(plus.arm_T_rcm[..., :3, :3])
        ).numpy()
        shift = (R.mT @ torch.as_tensor(plus.arm_T_rcm[..., :3, 3] - minus.arm_T_rcm[..., :3, 3])[..., None])[
            ..., 0
        ].numpy()
        turn = turn + np.cross(centre.rcm_v_axis, plus.rcm_v_axis - minus.rcm_v_axis)
        shift = shift + centre.rcm_v_axis * (plus.rcm_s_end_mm - minus.rcm_s_end_mm)[..., None]
        return np.concatenate((turn, shift), -1) / length


def record(
    trials: int,
    n: int,
    seed: int,
    offset=None,
    clock_s: float | np.ndarray = 0.0,
    stereo=(0.0, 0.0),
    rate: float = 0.0,
    wrist_mm: float = 10.0,
) -> tuple[Recorded, torch.Tensor]:
    """A recording and its true transform."""
    settings: LineStudyConfig = config(REALISTIC, trials, seed, scene=SceneSettings(wrist_length_mm=wrist_mm))
    scene = build_scene(settings.scene)
    generator = np.random.default_rng(seed)
    empty = Recorded(
        scene,
        np.arange(n) / FRAMES_PER_S,
        {},
        np.zeros(0),
        np.zeros(6) if offset is None else np.asarray(offset),
        clock_s,
        rate,
    )
    poses = empty.poses(np.broadcast_to(empty.joints(empty.times_s), (trials, n, 6)))
    right = scene.camera_right_T_arm @ poses.arm_T_rcm
    arrays = _measure(settings, scene, right, poses, generator, "right")
    arrays |= _measure(settings, scene, scene.camera_left_T_camera_right @ right, poses, generator, "left")
    given = np.broadcast_to(scene.camera_left_T_camera_right, (trials, 4, 4)) @ pose_noise(
        generator, (trials,), np.deg2rad(stereo[0]), stereo[1]
    )
    arrays |= {
        "camera_left_T_camera_right": given,
        "shaft_radius_mm": scene.shaft_radius_mm,
        "sigma_image": settings.pixel_noise_px / settings.focal_px,
    }
    arrays |= {
        "sigma_kinematics_mm": 0.3,
        "sigma_kinematics_rad": np.deg2rad(0.1),
        "sigma_stereo_mm": max(stereo[1], 1e-3),
        "sigma_stereo_rad": np.deg2rad(max(stereo[0], 1e-3)),
    }
    noise = pose_noise(generator, (trials, n), np.deg2rad(0.1), 0.3)
    return replace(empty, arrays=arrays, noise=noise), torch.as_tensor(
        np.broadcast_to(scene.camera_right_T_arm, (trials, 4, 4)).copy()
    )


def row(
    name: str,
    problem: Problem,
    truth: torch.Tensor,
    ignored: UnknownSettings,
    estimated: UnknownSettings,
    kinematics=None,
    start=None,
    report="",
):
    """Prints one line; returns the ratio of the two translation errors."""
    out = []
    for unknowns, callback, at in ((ignored, None, problem), (estimated, kinematics, start or problem)):
        solution = solve(at, SolverSettings(unknowns=unknowns), kinematics=callback)
        e = errors(solution.camera_right_T_arm, truth)
        sigma = float(solution.translation_sigma_mm.median())
        out.append((rms(rotation_deg(e)), rms(translation_mm(e)), sigma, solution))
    found = out[1][3].nuisances.get(report)
    text = (
        ""
        if found is None
        else " ".join(
            f"{v:+.4f}+-{s:.4f}{'(held)' if h else ''}"
            for v, s, h in zip(found.value[0].tolist(), found.sigma[0].tolist(), found.held[0].tolist(), strict=False)
        )
    )
    print(
        f"{name:34} | {out[0][0]:8.3f} {out[0][1]:8.3f} ({out[0][2]:.3f}) | "
        f"{out[1][0]:8.3f} {out[1][1]:8.3f} ({out[1][2]:.3f}) | {text}",
        flush=True,
    )


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--motions", type=int, default=300)
    args = parser.parse_args()
    t, n = args.trials, args.motions
    print(f"{t} trials of {n} motions, 0.3 px, 0.3 mm, 0.1 deg; contours and ends, stereo\n")
    print(f"{'':34} | ignored: deg, mm (sigma)    | estimated: deg, mm (sigma)  | first trial: value +- sigma")
    known = UnknownSettings(radius_sigma_relative=0.0, stereo=False, joint_offsets="never")
    zero_j, zero_c = torch.zeros(t, 6, dtype=torch.float64), torch.zeros(t, 2, dtype=torch.float64)

    def restricted(recorded):
        return lambda joints, clock: recorded.kinematics(joints, clock).only("contours", "ends")

    recorded, truth = record(t, n, 1)
    row("nothing wrong", restricted(recorded)(zero_j, zero_c), truth, known, known)
    deg = np.deg2rad(0.5)
    recorded, truth = record(t, n, 1, offset=[deg, -deg, 1.0, -deg, deg, -1.0])
    kinematics = restricted(recorded)
    row(
        "joint offsets 0.5 deg, 1 mm",
        kinematics(zero_j, zero_c),
        truth,
        known,
        replace(known, joint_offsets="always"),
        kinematics,
        report="joint_offset",
    )
    recorded, truth = record(t, n, 1)
    problem = restricted(recorded)(zero_j, zero_c)
    wrong = replace(problem, radius_mm=problem.radius_mm * 1.06)
    row("radius wrong by 6 %", wrong, truth, known, replace(known, radius_sigma_relative=0.06), report="radius")
    for clock in (0.04, 2.4):
        recorded, truth = record(t, n, 1, clock_s=clock)
        kinematics = restricted(recorded)
        offsets = torch.arange(-4.0, 4.01, 0.1, dtype=torch.float64)
        candidates = torch.stack((offsets, torch.zeros_like(offsets)), dim=-1)
        found, _ = scan_clock(recorded.kinematics, 6, candidates)
        start = kinematics(zero_j, zero_c + found)
        row(
            f"clock {clock} s (scan finds {float(found[0]):+.1f})",
            kinematics(zero_j, zero_c),
            truth,
            known,
            replace(known, clock=True),
            kinematics,
            start,
            report="clock",
        )
    recorded, truth = record(t, n, 1, stereo=(0.3, 0.3))
    problem = restricted(recorded)(zero_j, zero_c)
    row("stereo 0.3 deg, 0.3 mm", problem, truth, known, replace(known, stereo=True), report="stereo_rotation")
    return 0


if __name__ == "__main__":
    sys.exit(main())
