"""Pose pairs as robot and camera programs write them."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from rmis_calib.errors import InputError
from rmis_calib.io.pose_pairs import read_pose_pairs

RNG = np.random.default_rng(0)
N = 6
HEADER = "t,x,y,z,qx,qy,qz,qw"


def poses(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    matrices = np.tile(np.eye(4), (N, 1, 1))
    matrices[:, :3, :3] = Rotation.random(N, rng).as_matrix()
    matrices[:, :3, 3] = rng.normal(size=(N, 3)) * 150.0
    return matrices


ROBOT, BOARD = poses(1), poses(2)
TIMES = np.arange(N) * 0.5 + 1.7e9


def rows(matrices: np.ndarray, times: np.ndarray, scale: float = 1e-3) -> np.ndarray:
    quats = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
    return np.column_stack([times, matrices[:, :3, 3] * scale, quats])


def write_csv(path: Path, table: np.ndarray, header: str = HEADER, delimiter: str = ",") -> Path:
    np.savetxt(path, table, fmt="%.12g", delimiter=delimiter, header=header, comments="")
    return path


def message(matrix: np.ndarray) -> dict:
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
    position = dict(zip("xyz", (matrix[:3, 3] * 1e-3).tolist(), strict=True))
    return {"translation": position, "rotation": {"x": x, "y": y, "z": z, "w": w}}


def in_metres(matrix: np.ndarray) -> list[float]:
    scaled = matrix.copy()
    scaled[:3, 3] *= 1e-3
    return scaled.ravel().tolist()


def same(found, robot: np.ndarray = ROBOT, board: np.ndarray = BOARD) -> None:
    np.testing.assert_allclose(found.base_T_flange, robot, atol=1e-6)
    np.testing.assert_allclose(found.camera_T_board, board, atol=1e-6)


def test_two_csv_files_pair_by_time_and_not_by_row(tmp_path: Path) -> None:
    order = RNG.permutation(N)
    robot = write_csv(tmp_path / "robot.csv", rows(ROBOT, TIMES)[order])
    board = write_csv(tmp_path / "board.csv", rows(BOARD, TIMES + 0.002)[::-1])
    same(read_pose_pairs([robot, board]), ROBOT[::-1], BOARD[::-1])


def test_rows_without_a_partner_are_left_out_and_noted(tmp_path: Path) -> None:
    robot = write_csv(tmp_path / "robot.csv", rows(ROBOT, TIMES)[:4])
    board = write_csv(tmp_path / "board.csv", rows(BOARD, TIMES))
    found = read_pose_pairs([robot, board])
    same(found, ROBOT[:4], BOARD[:4])
    assert found.notes == ["2 of 6 board poses have no robot pose within 5 ms: left out"]
    with pytest.raises(
        InputError, match=r"3 rows or more within 5 ms of a row of .*robot.csv .*found 0; the median gap"
    ):
        read_pose_pairs([robot, write_csv(tmp_path / "late.csv", rows(BOARD, TIMES + 0.1))])


@pytest.mark.parametrize(
    ("header", "delimiter"), [("", ","), ("# t x y z qx qy qz qw", " "), ("", " "), (HEADER.replace(",", ";"), ";")]
)
def test_other_spellings_of_a_table(tmp_path: Path, header: str, delimiter: str) -> None:
    files = []
    for name, matrices in (("robot", ROBOT), ("board", BOARD)):
        path = write_csv(tmp_path / f"{name}.txt", rows(matrices, TIMES), header, delimiter)
        if not header:
            path.write_text(path.read_text().lstrip("\n"))
        files.append(path)
    same(read_pose_pairs(files))


def test_numpy(tmp_path: Path) -> None:
    np.savez(tmp_path / "pairs.npz", base_T_flange=ROBOT, camera_T_board=BOARD)
    same(read_pose_pairs([tmp_path / "pairs.npz"]))


def test_moveit_samples(tmp_path: Path) -> None:
    samples = [
        {"effector_wrt_world": in_metres(a), "object_wrt_sensor": in_metres(b)}
        for a, b in zip(ROBOT, BOARD, strict=True)
    ]
    (tmp_path / "samples.yaml").write_text(yaml.safe_dump(samples))
    found = read_pose_pairs([tmp_path / "samples.yaml"])
    same(found)
    assert found.setup == "eye_in_hand"


@pytest.mark.parametrize("kind", ["eye_in_hand", "eye_on_base"])
def test_easy_handeye2_samples_in_both_set_ups(tmp_path: Path, kind: str) -> None:
    # With eye_on_base, easy_handeye2 looks up the base in the effector and calls it robot.
    written = ROBOT if kind == "eye_in_hand" else np.linalg.inv(ROBOT)
    samples = [{"robot": message(a), "tracking": message(b)} for a, b in zip(written, BOARD, strict=True)]
    content = {"parameters": {"name": "x", "calibration_type": kind}, "samples": samples}
    path = tmp_path / "mine.samples"
    path.write_text(yaml.safe_dump(content))
    found = read_pose_pairs([path])
    same(found)
    assert found.setup == {"eye_in_hand": "eye_in_hand", "eye_on_base": "eye_to_hand"}[kind]
    # The sampler leaves the parameters empty: then the set-up must be told.
    path.write_text(yaml.safe_dump(content | {"parameters": {"calibration_type": ""}}))
    same(read_pose_pairs([path], setup=found.setup))
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match="calibration_type"):
        read_pose_pairs([path], setup="eye_in_hand" if kind == "eye_on_base" else "eye_to_hand")


def test_bad_files_are_named(tmp_path: Path) -> None:
    good = write_csv(tmp_path / "good.csv", rows(ROBOT, TIMES))
    bad_quat = rows(BOARD, TIMES)
    bad_quat[3, 4:] = 0.0
    zero = write_csv(tmp_path / "zero.csv", bad_quat)
    millimetres = write_csv(tmp_path / "mm.csv", rows(BOARD, TIMES, 1.0))
    unnamed = write_csv(tmp_path / "names.csv", rows(BOARD, TIMES), "t,x,y,z,qw,qx,qy,w")
    (tmp_path / "empty.yaml").write_text("samples: []")
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "other.npz", A=ROBOT)
    skewed = ROBOT.copy()
    skewed[2, 0, 0] += 0.5
    np.savez(tmp_path / "skewed.npz", base_T_flange=skewed, camera_T_board=BOARD)
    for paths, words in (
        ([good, zero], r"zero.csv line 5: expected a finite position and a unit quaternion"),
        ([good, millimetres], r"mm.csv: expected positions in m \(pass --unit mm"),
        ([good, unnamed], r"names.csv line 1: expected columns t, x, y, .* missing qz"),
        ([good], "one .npz or samples file, or two CSV files"),
        ([tmp_path / "empty.yaml"], "effector_wrt_world and object_wrt_sensor"),
        ([tmp_path / "text.npz"], "expected a NumPy .npz file"),
        ([tmp_path / "other.npz"], "base_T_flange and camera_T_board.*found A"),
        ([tmp_path / "skewed.npz"], "base_T_flange sample 3: expected a rigid transform"),
    ):
        with pytest.raises(InputError, match=words):
            read_pose_pairs(paths)


def test_a_long_stream_is_thinned_and_says_so(tmp_path: Path) -> None:
    times = np.arange(2000) * 0.03
    robot = write_csv(tmp_path / "robot.csv", rows(np.tile(ROBOT, (400, 1, 1))[:2000], times))
    board = write_csv(tmp_path / "board.csv", rows(np.tile(BOARD, (400, 1, 1))[:2000], times))
    found = read_pose_pairs([robot, board])
    assert len(found.base_T_flange) == len(found.camera_T_board) == 500
    assert found.notes == ["500 of 2000 pairs were used, evenly spaced: neighbours in a stream add little"]
