"""Pairs of poses for hand-eye calibration with a board: what robot and camera programs write, in mm.

Two CSV files (t, x, y, z, qx, qy, qz, qw; robot and board), MoveIt samples, easy_handeye2 samples, or NumPy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rmis_calib.errors import InputError
from rmis_calib.io._csv import read_table
from rmis_calib.io.configs import check_regular, load_yaml_value

LengthUnit = Literal["m", "mm"]
_TO_MM = {"m": 1000.0, "mm": 1.0}
_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_MOVEIT, _EASY = ("effector_wrt_world", "object_wrt_sensor"), ("robot", "tracking")
_SETUPS = {"eye_in_hand": "eye_in_hand", "eye_on_base": "eye_to_hand"}
MOST_PAIRS = 500
"""Pairs that are kept of a longer stream."""
_UNIT_TOLERANCE = 1e-2
"""Largest deviation of a quaternion's length, and of an entry of R^T R, that is taken for rounding in a file."""
_PLAUSIBLE_MM = (3.0, 30_000.0)
"""Root mean square distances of the flange from its base, and of the board from the camera, in the world."""


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Poses of the robot and of the board at the same samples.

    Attributes:
        base_T_flange: (N, 4, 4) mm.
        camera_T_board: (N, 4, 4) mm.
        setup: eye_in_hand or eye_to_hand, as asked for or as the file says.
        notes: what was assumed or left out.
    """

    base_T_flange: np.ndarray
    camera_T_board: np.ndarray
    setup: str
    notes: list[str]


def read_pose_pairs(
    paths: Sequence[Path], setup: str | None = None, unit: LengthUnit | None = None, max_gap_s: float = 0.005
) -> PosePairs:
    """Read one file of pairs, or two CSV files: the robot's poses first, then the board's.

    Args:
        paths: one .npz (base_T_flange, camera_T_board) or YAML file, or two CSV files.
        setup: eye_in_hand or eye_to_hand; where not given, what the file says, else eye_in_hand.
        unit: of the file's lengths; where not given, mm in .npz and metres elsewhere, as ROS counts.
        max_gap_s: CSV rows pair with the nearest in time, at most this far apart.

    Raises:
        FileError: a file is absent or unreadable.
        InputError: it is none of these formats, a pose is no rigid transform, or lengths cannot be in this unit.
    """
    for path in paths:
        check_regular(path)
    notes: list[str] = []
    if len(paths) == 2:
        robot, board = _pair_csv(paths[0], paths[1], max_gap_s, notes)
        where = [str(path) for path in paths]
    elif len(paths) == 1 and paths[0].suffix == ".npz":
        (robot, board), unit = _read_npz(paths[0]), unit or "mm"
        where = [f"{paths[0]} {name}" for name in ("base_T_flange", "camera_T_board")]
    elif len(paths) == 1 and paths[0].suffix not in (".csv", ".txt", ".tum"):
        robot, board, setup = _read_samples(paths[0], setup, notes)
        where = [f"{paths[0]} {what}" for what in ("robot poses", "board poses")]
    else:
        expected = "one .npz or samples file, or two CSV files (the robot's poses, then the board's)"
        raise InputError(where="POSES", expected=expected, found=f"{len(paths)}: {', '.join(map(str, paths))}")
    unit = unit or "m"
    pairs = [_in_mm(poses, unit, place) for poses, place in zip((robot, board), where, strict=True)]
    if len(robot) > MOST_PAIRS:
        chosen = np.linspace(0, len(robot) - 1, MOST_PAIRS).round().astype(int)
        pairs = [poses[chosen] for poses in pairs]
        notes.append(f"{MOST_PAIRS} of {len(robot)} pairs were used, evenly spaced: neighbours in a stream add little")
    return PosePairs(pairs[0], pairs[1], setup or "eye_in_hand", notes)


def _in_mm(poses: np.ndarray, unit: LengthUnit, where: str) -> np.ndarray:
    scaled = poses.copy()
    scaled[:, :3, 3] *= _TO_MM[unit]
    distance = float(np.sqrt((scaled[:, :3, 3] ** 2).sum(-1).mean())) if len(scaled) else 0.0
    if distance > _PLAUSIBLE_MM[1] or 0 < distance < _PLAUSIBLE_MM[0]:
        other = "mm" if unit == "m" else "m"
        expected = f"positions in {unit} (pass --unit {other} if they are in {other})"
        raise InputError(where=where, expected=expected, found=f"a typical distance of {distance:.3g} mm")
    return scaled


def _pair_csv(robot: Path, board: Path, max_gap_s: float, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Each row of the board with the robot's nearest in time."""
    (robot_t, robot_poses), (board_t, board_poses) = (_read_csv(path, notes) for path in (robot, board))
    order = np.argsort(robot_t)
    robot_t, robot_poses = robot_t[order], robot_poses[order]
    after = np.searchsorted(robot_t, board_t).clip(1, max(len(robot_t) - 1, 1))
    after = np.minimum(after, len(robot_t) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(robot_t[before] - board_t) <= np.abs(robot_t[after] - board_t), before, after)
    gaps = np.abs(robot_t[nearest] - board_t)
    kept = gaps <= max_gap_s
    if kept.sum() < 3:
        expected = f"3 rows or more within {max_gap_s * 1e3:g} ms of a row of {robot} (--max-gap-ms)"
        raise InputError(
            where=str(board), expected=expected, found=f"{kept.sum()}; the median gap is {np.median(gaps):.3g} s"
        )
    if not kept.all():
        notes.append(
            f"{(~kept).sum()} of {len(kept)} board poses have no robot pose within {max_gap_s * 1e3:g} ms: left out"
        )
    return robot_poses[nearest[kept]], board_poses[kept]


def _read_csv(path: Path, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Times, s, and poses of a file with or without a header, separated by commas or blanks."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = file.readline(4096).lstrip("# \t").rstrip()
    if first[:1].isdigit() or first[:1] in "+-.":
        values = _headerless(path)
        notes.append(f"{path.name}: no header; columns taken as {', '.join(_COLUMNS)}")
        return values[:, 0], _from_quaternions(values[:, 1:4], values[:, 4:], str(path), 1)
    names = [name.strip() for name in first.replace(";", ",").replace("\t", ",").split(",")]
    if set(_COLUMNS) - set(names):
        if len(names) == 1 and len(first.split()) == len(_COLUMNS):
            values = _headerless(path)  # the header is a comment, the columns are separated by blanks
            return values[:, 0], _from_quaternions(values[:, 1:4], values[:, 4:], str(path), 2)
        missing = [name for name in _COLUMNS if name not in names]
        expected = f"columns {', '.join(_COLUMNS)}"
        raise InputError(where=f"{path} line 1", expected=expected, found=f"missing {', '.join(missing)}")
    table = read_table(path, note=notes.append)
    names = [name.lstrip("# ") for name in table.columns]
    t, *rest = (table.values[:, names.index(name)] for name in _COLUMNS)
    return t, _from_quaternions(np.stack(rest[:3], -1), np.stack(rest[3:], -1), str(path), 2)


def _headerless(path: Path) -> np.ndarray:
    text = path.read_text(encoding="utf-8-sig", errors="replace").replace(",", " ").replace(";", " ")
    rows = [(number, line.split()) for number, line in enumerate(text.splitlines(), 1) if line.split("#")[0].strip()]
    values = np.empty((len(rows), len(_COLUMNS)))
    for k, (number, fields) in enumerate(rows):
        try:
            values[k] = [float(field) for field in fields]
        except ValueError:
            found = f"{len(fields)} fields: {' '.join(fields)[:60]}"
            raise InputError(
                where=f"{path} line {number}", expected=f"8 numbers ({', '.join(_COLUMNS)})", found=found
            ) from None
    return values


def _from_quaternions(positions: np.ndarray, xyzw: np.ndarray, where: str, first_line: int) -> np.ndarray:
    """Poses (N, 4, 4); a quaternion that is no unit one is refused."""
    length = np.linalg.norm(xyzw, axis=-1)
    bad = ~(np.abs(length - 1) <= _UNIT_TOLERANCE) | ~np.isfinite(positions).all(-1)
    if bad.any():
        row = int(bad.argmax())
        found = f"({', '.join(f'{value:g}' for value in xyzw[row])})"
        place = f"{where} line {row + first_line}" if first_line else f"{where} sample {row + 1}"
        raise InputError(where=place, expected="a finite position and a unit quaternion x, y, z, w", found=found)
    x, y, z, w = (xyzw / length[:, None]).T
    rotation = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
    rotation += [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]
    rotation += [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = np.stack(rotation, -1).reshape(-1, 3, 3)
    poses[:, :3, 3] = positions
    return poses


def _from_matrices(values: Any, where: str) -> np.ndarray:
    """Poses (N, 4, 4), made exact rotations where a file has rounded them."""
    try:
        poses = np.asarray(values, dtype=np.float64).reshape(-1, 4, 4)
    except (TypeError, ValueError):
        raise InputError(where=where, expected="matrices of 16 numbers, row by row", found="something else") from None
    R = poses[:, :3, :3]
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max((1, 2))
    bad = ~(off <= _UNIT_TOLERANCE) | ~(np.linalg.det(R) > 0) | ~np.isfinite(poses).all((1, 2))
    bad |= np.abs(poses[:, 3] - [0, 0, 0, 1]).max(-1) > 1e-6
    if bad.any():
        row = int(bad.argmax())
        raise InputError(
            where=f"{where} sample {row + 1}", expected="a rigid transform", found=poses[row].round(4).tolist()
        )
    U, _, Vh = np.linalg.svd(R)
    poses[:, :3, :3] = U @ Vh
    poses[:, 3] = [0, 0, 0, 1]
    return poses


def _read_npz(path: Path) -> tuple[np.ndarray, np.ndarray]:
    expected = "arrays base_T_flange and camera_T_board of one shape (N, 4, 4)"
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, KeyError) as error:
        raise InputError(where=str(path), expected="a NumPy .npz file", found="another file") from error
    if not {"base_T_flange", "camera_T_board"} <= set(arrays):
        raise InputError(where=str(path), expected=expected, found=", ".join(sorted(arrays)) or "none")
    robot, board = arrays["base_T_flange"], arrays["camera_T_board"]
    if robot.shape != board.shape or robot.ndim != 3 or robot.shape[1:] != (4, 4):
        raise InputError(where=str(path), expected=expected, found=f"{robot.shape} and {board.shape}")
    return _from_matrices(robot, f"{path} base_T_flange"), _from_matrices(board, f"{path} camera_T_board")


def _read_samples(path: Path, setup: str | None, notes: list[str]) -> tuple[np.ndarray, np.ndarray, str | None]:
    """MoveIt: a list of 4x4 matrices, row by row. easy_handeye2: `samples` of translations and quaternions."""
    content = load_yaml_value(path, InputError)
    samples = content.get("samples") if isinstance(content, dict) else content
    if not isinstance(samples, list) or not all(isinstance(sample, dict) for sample in samples) or not samples:
        expected = f"samples with {' and '.join(_MOVEIT)} (MoveIt) or {' and '.join(_EASY)} (easy_handeye2)"
        raise InputError(where=str(path), expected=expected, found="something else")
    keys = _EASY if isinstance(content, dict) else _MOVEIT
    for number, sample in enumerate(samples, 1):
        if set(keys) - set(sample):
            found = ", ".join(map(str, sample)) or "nothing"
            raise InputError(where=f"{path} sample {number}", expected=f"keys {' and '.join(keys)}", found=found)
    if keys == _MOVEIT:
        poses = [_from_matrices([sample[key] for sample in samples], f"{path} {key}") for key in keys]
        return poses[0], poses[1], setup
    robot, board = (_from_transforms([sample[key] for sample in samples], f"{path} {key}") for key in keys)
    setup = _easy_setup(content, setup, path)
    if setup == "eye_to_hand":
        notes.append("easy_handeye2 writes flange_T_base for a camera that stands still: its robot poses were inverted")
        robot = np.linalg.inv(robot)
    return robot, board, setup


def _easy_setup(content: dict[str, Any], setup: str | None, path: Path) -> str:
    """The set-up of an easy_handeye2 file, whose robot poses depend on it."""
    parameters = content.get("parameters")
    said = _SETUPS.get(str(parameters.get("calibration_type"))) if isinstance(parameters, dict) else None
    if said and setup and said != setup:
        raise InputError(where=f"{path} calibration_type", expected=f"that of {setup}, as asked for", found=said)
    return setup or said or "eye_in_hand"


def _from_transforms(transforms: list[Any], where: str) -> np.ndarray:
    try:
        positions = [[float(item["translation"][axis]) for axis in "xyz"] for item in transforms]
        quats = [[float(item["rotation"][axis]) for axis in "xyzw"] for item in transforms]
    except (KeyError, TypeError, ValueError):
        expected = "translation {x, y, z} and rotation {x, y, z, w} in every sample"
        raise InputError(where=where, expected=expected, found="another form") from None
    return _from_quaternions(np.array(positions), np.array(quats), where, 0)
