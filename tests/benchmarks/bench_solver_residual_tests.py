"""The list of residual tests: false alarms with the right model, and how often what is wrong is told and named first.

    python tests/benchmarks/bench_solver_residual_tests.py [--right 320] [--trials 20] [--motions 216]

Scenes of bench_solver_misspecified.py (0.3 px; 0.3 mm, 0.1 deg), and recordings of 19 s at 10 Hz for the clock. Each
error is solved as `calibrate` does (cameras with priors, unknowns freed by evidence), and `believed` (cameras exact, no
further unknowns). Columns: trials in which some test fails; of these, how many name the right cause first, and among
three; trials that are called trustworthy with the truth beyond 3 sigma; the commonest first cause.
"""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch

from rmis_calib.config import parse_config
from rmis_calib.geometry.rotations import matrix_to_rotvec, rotvec_to_matrix
from rmis_calib.pipeline.answer.records.tests_in_words import ranked_causes
from rmis_calib.solver import Problem, Solution, solve
from rmis_calib.solver.solution import take_solved
from tests.benchmarks.bench_solver_misspecified import BEYOND_3_SIGMA, CAMERAS, ERRORS, EXACT, Arrays, scene
from tests.benchmarks.bench_solver_nuisance import record


def knocked(arrays: Arrays, _: np.random.Generator) -> Arrays:
    """The camera is turned by 3 deg on its arm half-way: the poses that are told are those as if it were not."""
    X = arrays["truth"]["camera_right_T_arm"]
    turn = np.eye(4)
    turn[:3, :3] = rotvec_to_matrix(torch.deg2rad(torch.tensor([2.0, -1.5, 1.66], dtype=torch.float64))).numpy()
    poses, half = arrays["arm_T_rcm"].copy(), arrays["arm_T_rcm"].shape[1] // 2
    poses[:, half:] = (np.linalg.inv(X) @ turn @ X)[:, None] @ poses[:, half:]
    return arrays | {"arm_T_rcm": poses}


def swapped(arrays: Arrays, _: np.random.Generator) -> Arrays:
    """The right pictures are called left."""
    names = {"right": "left", "left": "right"}
    pairs = [
        (f"{kind}_{side}", f"{kind}_{names[side]}") for kind in ("axis", "contour", "end", "valid") for side in names
    ]
    return arrays | {to: arrays[of] for to, of in pairs if of in arrays}


CASES = {
    "k1 = -0.05 ignored": ("lens", ERRORS["k1 = -0.05 ignored"]),
    "focal length 1 % off": ("intrinsics", ERRORS["focal length 1 % off"]),
    "centre 10 px off": ("intrinsics", ERRORS["centre 10 px off"]),
    "camera turned 3 deg": ("camera moved", knocked),
    "base 3 mm, 0.5 deg off": ("setup", ERRORS["base 3 mm, 0.5 deg off"]),
    "bent shaft 1 mm": ("tool", ERRORS["bent shaft 1 mm"]),
    "cameras swapped": ("stereo", swapped),
}
"""The cause that should be named, and what makes the error."""
BELIEVED = {"compliance": "never", "rcm_offset": "never", "clock_rate": "never", "doubt": 0.0}


def problem_of(arrays: Arrays, cameras: dict) -> Problem:
    given = {key: value for key, value in arrays.items() if key != "truth" and "head" not in key}
    given = {key: value for key, value in given.items() if key not in (*EXACT, "sigma_rcm_mm")}
    return Problem.from_arrays(given | cameras).only("axis", "contours", "ends")


def right(name: str, trials: int, motions: int) -> None:
    """False alarms."""
    began = time.process_time()
    found = solve(problem_of(scene(name, trials, motions, 0.3), CAMERAS), parse_config({}).solver)
    assert found.tests is not None
    failed = found.tests.failed
    which = Counter(found.tests.names[index] for index in torch.nonzero(failed)[:, 1].tolist())
    took = time.process_time() - began
    print(
        f"right model, {name}, {motions} motions: {int(failed.any(-1).sum())} of {trials} trials fail a test "
        f"({len(found.tests.names)} tests), {took:.0f} s {[tuple(name) for name, _ in which.most_common(3)]}",
        flush=True,
    )


def row(what: str, cause: str, mode: str, found: Solution, truth: torch.Tensor) -> None:
    assert found.tests is not None
    fails = found.tests.failed.any(-1)
    told = [ranked_causes(take_solved(found, torch.tensor([index]))) for index in torch.nonzero(fails)[:, 0].tolist()]
    T = found.camera_right_T_arm
    gap = torch.cat((matrix_to_rotvec(truth[:, :3, :3] @ T[:, :3, :3].mT), truth[:, :3, 3] - T[:, :3, 3]), dim=-1)
    distance2 = (gap * torch.linalg.solve(found.covariance, gap[..., None])[..., 0]).sum(-1)
    wrong = (found.verdict == 0) & (distance2 > BEYOND_3_SIGMA)
    first, three = (sum(cause in each[:k] for each in told) for k in (1, 3))
    common = Counter(each[0] if each else "none" for each in told).most_common(2)
    print(
        f"{what:24} {mode:10} fails {int(fails.sum()):3d} of {len(fails)}, {cause} first {first:3d}, in three "
        f"{three:3d}; ok but wrong {int(wrong.sum())}, ok {int((found.verdict == 0).sum())}; first: {common}",
        flush=True,
    )


def clock(trials: int, rate: float) -> None:
    """The frame rate is written wrong."""
    recorded, truth = record(trials, 192, 4, stereo=(0.05, 0.05), rate=rate)

    def kinematics(joints: torch.Tensor, at: torch.Tensor, *_: torch.Tensor) -> Problem:
        return recorded.kinematics(joints, at).only("axis", "contours", "ends")

    start = kinematics(*(torch.zeros(trials, width, dtype=torch.float64) for width in (6, 2)))
    for mode, more in (("calibrate", {}), ("believed", BELIEVED)):
        settings = parse_config({"solver": {"unknowns": {"joint_offsets": "never", **more}}}).solver
        row(f"frame rate {100 * rate:.0f} % off", "clock", mode, solve(start, settings, kinematics=kinematics), truth)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--right", type=int, default=320)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--motions", type=int, default=216)
    arguments = parser.parse_args()
    for name in ("moving", "still") if arguments.right else ():
        right(name, arguments.right, 125)
    if not arguments.trials:
        return
    clock(arguments.trials, 0.03)
    for what, (cause, change) in CASES.items():
        arrays = change(scene("moving", arguments.trials, arguments.motions, 0.3, what), np.random.default_rng(0))
        truth = torch.as_tensor(arrays["truth"]["camera_right_T_arm"])
        for mode, cameras, more in (("calibrate", CAMERAS, {}), ("believed", {}, BELIEVED)):
            settings = parse_config({"solver": {"unknowns": more}}).solver
            row(what, cause, mode, solve(problem_of(arrays, cameras), settings), truth)


if __name__ == "__main__":
    main()
