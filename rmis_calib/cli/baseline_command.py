"""`baseline`: hand-eye calibration with a board, by every method side by side."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from rmis_calib.cli import EXIT_NOT_TRUSTWORTHY, EXIT_OK
from rmis_calib.cli.console import say, summarise
from rmis_calib.io.configs import check_regular
from rmis_calib.io.outputs import BASELINE_FORMAT, check_apart, check_file, is_json_of

if TYPE_CHECKING:
    from rmis_calib.baselines import HandEye
    from rmis_calib.io.pose_pairs import PosePairs

MethodName = Literal["all", "tsai", "park", "horaud", "andreff", "daniilidis", "ata", "rcm", "shah", "li", "refine"]


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """Hand-eye calibration with a board, from pairs of poses: every published method side by side.

    POSES is one file of pairs (MoveIt or easy_handeye2 samples, or .npz with base_T_flange and camera_T_board), or
    two CSV files t,x,y,z,qx,qy,qz,qw: the robot's base_T_flange, then the board's camera_T_board. With all methods,
    the transforms printed are those of `refine`. Motion that cannot determine the mounting is named (exit code 1).
    """

    poses: tyro.conf.Positional[tuple[Path, ...]]
    """File of pairs, or two CSV files."""
    method: MethodName = "all"
    """One method, or all."""
    setup: Literal["eye_in_hand", "eye_to_hand"] | None = None
    """eye_in_hand (the camera is on the flange) or eye_to_hand (the board is). Default: what the file says, else
    eye_in_hand."""
    unit: Literal["m", "mm"] | None = None
    """Length unit of the files. Default: mm in .npz, m elsewhere."""
    max_gap_ms: float = 5.0
    """Rows of two CSV files pair with the nearest in time, at most this far apart."""
    rcm_base_mm: tuple[float, float, float] | None = None
    """Remote centre of motion in the base, for `rcm`."""
    rcm_board_mm: tuple[float, float, float] | None = None
    """The same point in the board."""
    out: Path | None = None
    """JSON file for all results."""
    overwrite: bool = False
    """Replace OUT, if it is a comparison that this program wrote."""

    def run(self) -> int:
        for path in self.poses:
            check_regular(path)
        if self.out is not None:
            check_apart(self.out, list(self.poses))
            check_file(self.out, is_json_of(BASELINE_FORMAT), self.overwrite)
        from rmis_calib.io.pose_pairs import read_pose_pairs

        pairs = read_pose_pairs(self.poses, self.setup, self.unit, self.max_gap_ms / 1e3)
        results = self._solve(pairs)
        chosen = results["refine" if self.method == "all" else self.method]
        _print_comparison(pairs, results)
        if not chosen.ok:
            for sentence in _reasons(pairs, chosen):
                say(sentence)
        else:
            _print_transforms(chosen)
        if self.out is not None:
            _write(self.out, pairs, results)
        what = f"baseline {' '.join(map(str, self.poses))}"
        summarise(what, *_facts(chosen), f"{len(pairs.base_T_flange)} pairs", self.out and f"written to {self.out}")
        return EXIT_OK if chosen.ok else EXIT_NOT_TRUSTWORTHY

    def _solve(self, pairs: "PosePairs") -> dict[str, "HandEye"]:
        from rmis_calib.baselines import METHODS, hand_eye

        centre: dict[str, Any] = {"base_p_rcm": self.rcm_base_mm, "board_p_rcm": self.rcm_board_mm}
        has_centre = self.rcm_base_mm is not None and self.rcm_board_mm is not None
        names = [name for name in METHODS if name != "rcm" or has_centre] if self.method == "all" else [self.method]
        return {
            name: hand_eye(pairs.base_T_flange, pairs.camera_T_board, name, setup=pairs.setup, **centre)
            for name in names
        }


def _print_comparison(pairs: "PosePairs", results: dict[str, "HandEye"]) -> None:
    """A row a method: the camera's pose, its sigma, and the residuals."""
    name = next(iter(next(iter(results.values())).transforms()))
    say(f"{len(pairs.base_T_flange)} pairs of poses, {pairs.setup}; the table is {name}")
    for note in pairs.notes:
        say(f"note: {note}")
    rows = [["method", "x mm", "y mm", "z mm", "qx", "qy", "qz", "qw", "1 sigma", "residual, rms"]]
    rows += [[method, *_row(result)] for method, result in results.items()]
    # Not a table of rich: in a log it would be cut at 80 columns.
    for row in rows:
        cells = [row[0].ljust(10), *(cell.rjust(9) for cell in row[1:8]), *(cell.ljust(20) for cell in row[8:])]
        say("  ".join(cells).rstrip())
    if "rcm" not in results and len(results) > 1 and pairs.setup == "eye_in_hand":
        say("rcm was left out: it needs --rcm-base-mm and --rcm-board-mm")


def _row(result: "HandEye") -> list[str]:
    from rmis_calib.geometry import matrix_to_quat

    if not result.ok:
        return [f"not answered: {_status(result).name.lower().replace('_', ' ')}"]
    X = result.mount_T_camera
    w, x, y, z = matrix_to_quat(X[:3, :3]).tolist()
    sigma = f"{float(result.rotation_sigma_deg):.3g} deg, {float(result.translation_sigma_mm):.3g} mm"  # type: ignore[arg-type]
    rms = [float(values.square().mean().sqrt()) for values in (result.residual_deg, result.residual_mm)]
    numbers = [f"{value:.3f}" for value in X[:3, 3].tolist()] + [f"{value:.6f}" for value in (x, y, z, w)]
    return [*numbers, sigma, f"{rms[0]:.3g} deg, {rms[1]:.3g} mm"]


def _status(result: "HandEye") -> Any:
    from rmis_calib.baselines import HandEyeStatus

    return HandEyeStatus(int(result.status))


def _facts(result: "HandEye") -> list[str]:
    """The camera's pose in one line, or why there is none."""
    if not result.ok:
        return [_row(result)[0]]
    name, pose = next(iter(result.transforms())), _row(result)
    return [
        f"{name} by {result.method}: t = ({', '.join(pose[:3])}) mm, q_xyzw = ({', '.join(pose[3:7])})",
        f"1 sigma {pose[7]}",
    ]


def _reasons(pairs: "PosePairs", result: "HandEye") -> list[str]:
    """Why there is no answer, and which other reading of the poses would give one."""
    import torch

    from rmis_calib.baselines import fits_inverted

    status = _status(result)
    reasons = [f"no trustworthy result: {status.sentence}"]
    if not status.is_degenerate:
        robot, board = torch.from_numpy(pairs.base_T_flange), torch.from_numpy(pairs.camera_T_board)
        if fits_inverted(robot, board, pairs.setup):
            reasons.append(
                "The poses do fit if either base_T_flange or camera_T_board is inverted: a file holds the opposite"
                " direction, or --setup is the other one."
            )
    return reasons


def _print_transforms(result: "HandEye") -> None:
    """Both transforms in both directions, and the noise that explains the residuals."""
    from rmis_calib.geometry import matrix_to_quat

    share = 100 * float(result.robot_rotation_share)
    rotation, shift = float(result.rotation_noise_deg), float(result.translation_noise_mm)
    say("\nestimated noise of the poses, 1 sigma an axis")
    say(f"  {rotation:.3g} deg ({share:.0f} % of the variance from the robot), {shift:.3g} mm\n")
    for name, transform in result.transforms().items():
        rows = ["".join(f"{x:10.6f}" for x in row[:3]) + f"{row[3]:12.4f}" for row in transform[:3].tolist()]
        w, x, y, z = matrix_to_quat(transform[:3, :3]).tolist()
        say(f"{name}, mm ({result.method})   quaternion xyzw {x:.6f} {y:.6f} {z:.6f} {w:.6f}")
        for row in rows:
            say(f"  {row}")


def _write(out: Path, pairs: "PosePairs", results: dict[str, "HandEye"]) -> None:
    from rmis_calib.io import write_json

    def plain(tensor: Any) -> Any:
        return None if tensor is None or bool(tensor.isnan().any()) else tensor.tolist()

    methods = {
        name: {
            "status": _status(result).name.lower(),
            "message": _status(result).sentence,
            "transforms_mm": {key: plain(value) for key, value in result.transforms().items()},
            "covariance": plain(result.covariance),
            "residual_deg": plain(result.residual_deg),
            "residual_mm": plain(result.residual_mm),
            "rotation_noise_deg": plain(result.rotation_noise_deg),
            "translation_noise_mm": plain(result.translation_noise_mm),
        }
        for name, result in results.items()
    }
    write_json(out, {"format": BASELINE_FORMAT, "setup": pairs.setup, "notes": pairs.notes, "methods": methods})
