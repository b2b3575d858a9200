"""Where the arms' bases are, as set-up joints or tips in two frames tell: chains composed here with NumPy and SciPy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_writing import BagWriter, write_bag
from scipy.spatial.transform import Rotation

from rmis_calib.convert import ConvertSettings, convert
from rmis_calib.convert.bases import with_logged_bases
from rmis_calib.convert.material import Placing, PoseLog
from rmis_calib.io.recording import load_recording
from rmis_calib.io.robot import load_robot
from rmis_calib.robot import Robot

CLASSIC = load_robot("dvrk-classic")
COUNT = 40


def pose(rotvec: object, t_m: object) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(np.array(rotvec)).as_matrix(), t_m
    return T


CART_T_ECM_BASE = pose([0.3, -0.2, 0.1], [0.1, 0.8, 0.5])
CART_T_PSM_BASE = pose([-0.4, 0.5, 0.2], [-0.15, 0.7, 0.45])
ECM_BASE_T_PSM_BASE = np.linalg.inv(CART_T_ECM_BASE) @ CART_T_PSM_BASE
STAMPS = [1_700_000_000_000_000_000 + k * 10_000_000 for k in range(COUNT)]
# Both tips move all the time; the endoscope's is logged 2 ms later than the instrument's.
ECM_BASE_T_TIP = [pose([0.1 + 0.01 * k, 0.2, 0.0], [0.01, 0.02, 0.1 + 0.001 * k]) for k in range(COUNT)]
PSM_BASE_T_TIP = [pose([0.5, 0.02 * k, 1.0], [0.03, -0.02 + 0.001 * k, 0.12]) for k in range(COUNT)]


def log(frame: str, transforms: list[np.ndarray], late_ns: int = 0) -> PoseLog:
    """Transforms in m as a topic logs them."""
    rows = [np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat()]) for T in transforms]
    return PoseLog(frame, [ns + late_ns for ns in STAMPS], rows)


def placed(placings: dict[Placing, PoseLog], robot: Robot = CLASSIC) -> tuple[Robot, list[str]]:
    notes: list[str] = []
    arms = ("laparoscope", "ECM"), ("instrument", "PSM1")
    return with_logged_bases(robot, *arms, placings, notes.append), notes


def inverse(transforms: list[np.ndarray]) -> list[np.ndarray]:
    return [np.linalg.inv(T) for T in transforms]


SOURCES = {
    "local/measured_cp of both set-up joints": {
        Placing("ECM", "base", True): log("Cart", [CART_T_ECM_BASE] * COUNT),
        Placing("PSM1", "base", True): log("Cart", [CART_T_PSM_BASE] * COUNT),
    },
    "SUJ/PSM1/measured_cp, in ECM": {
        Placing("ECM", "tip", True): log("ECM_base", ECM_BASE_T_TIP, 2_000_000),
        Placing("PSM1", "base", False): log("ECM", [T @ ECM_BASE_T_PSM_BASE for T in inverse(ECM_BASE_T_TIP)]),
    },
    "PSM1/measured_cp, in ECM": {
        Placing("ECM", "tip", True): log("ECM_base", ECM_BASE_T_TIP),
        Placing("PSM1", "tip", True): log("PSM1_base", PSM_BASE_T_TIP),
        Placing("PSM1", "tip", False): log(
            "ECM",
            [
                tip_T_ecm_base @ ECM_BASE_T_PSM_BASE @ T
                for tip_T_ecm_base, T in zip(inverse(ECM_BASE_T_TIP), PSM_BASE_T_TIP, strict=True)
            ],
        ),
    },
    "measured_cp of both arms, in Cart": {
        Placing("ECM", "tip", True): log("ECM_base", ECM_BASE_T_TIP),
        Placing("ECM", "tip", False): log("Cart", [CART_T_ECM_BASE @ T for T in ECM_BASE_T_TIP]),
        Placing("PSM1", "tip", True): log("PSM1_base", PSM_BASE_T_TIP),
        Placing("PSM1", "tip", False): log("Cart", [CART_T_PSM_BASE @ T for T in PSM_BASE_T_TIP]),
    },
}


@pytest.mark.parametrize("source", SOURCES)
def test_bases_of_every_source(source: str) -> None:
    robot, notes = placed(SOURCES[source])
    bases = [np.asarray(robot.arms[name].base_T_arm_base) for name in ("laparoscope", "instrument")]
    found = np.linalg.inv(bases[0]) @ bases[1]
    np.testing.assert_allclose(found[:3, :3], ECM_BASE_T_PSM_BASE[:3, :3], atol=1e-9)
    np.testing.assert_allclose(found[:3, 3], 1000 * ECM_BASE_T_PSM_BASE[:3, 3], atol=1e-6)
    # Counter-literal: the inverse, which is the endoscope's base in the instrument's, would be 300 mm off.
    assert np.linalg.norm(1000 * np.linalg.inv(ECM_BASE_T_PSM_BASE)[:3, 3] - found[:3, 3]) > 300
    assert robot.setup_sigma_mm == 50.0 and robot.setup_sigma_rad == pytest.approx(np.deg2rad(5.0))
    assert len(notes) == 1 and f"by {source}: a prior of 50 mm and 5 deg" in notes[0]


def test_what_does_not_tell_a_base_is_left_out() -> None:
    suj = SOURCES["local/measured_cp of both set-up joints"]
    slid = [pose([0, 0, 0], [0.0005 * k, 0, 0]) @ CART_T_PSM_BASE for k in range(COUNT)]
    robot, notes = placed(suj | {Placing("PSM1", "base", True): log("Cart", slid)})
    assert robot.arms["instrument"].base_T_arm_base is None
    assert "it moves by 9.8 mm and 0.0 deg: were set-up joints moved meanwhile?" in notes[0]
    same = {key: log("Cart", [np.eye(4)] * COUNT) for key in suj}
    robot, notes = placed(same)
    assert robot.setup_sigma_mm is None and "both bases at one place" in notes[0]
    zeros = PoseLog("Cart", STAMPS, [np.zeros(7)] * COUNT)  # a topic that was never filled
    robot, notes = placed(suj | {Placing("ECM", "base", True): zeros})
    assert robot.setup_sigma_mm is None and "no valid poses" in notes[0]
    frames = {Placing("ECM", "base", False): log("Cart", [CART_T_ECM_BASE] * COUNT)}
    robot, notes = placed(frames | {Placing("PSM1", "base", False): log("Table", [CART_T_PSM_BASE] * COUNT)})
    assert robot.setup_sigma_mm is None and notes[-1].startswith("where the arms' bases are is not logged")


def test_a_robot_that_states_its_bases_keeps_them() -> None:
    arms = {name: replace(arm, base_T_arm_base=pose([0, 0, 0], [7, 8, 9])) for name, arm in CLASSIC.arms.items()}
    robot, notes = placed(SOURCES["PSM1/measured_cp, in ECM"], replace(CLASSIC, arms=arms))
    assert robot.setup_sigma_mm is None and np.asarray(robot.arms["instrument"].base_T_arm_base)[0, 3] == 7
    assert "those of the robot's description" in notes[0]


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_bag_with_set_up_joints(rendered: Path, tmp_path: Path, kind: str) -> None:
    robot = yaml.safe_load((rendered / "robot.yaml").read_text())
    bases = {name: np.array(arm.pop("base_T_arm_base")) for name, arm in robot["arms"].items()}
    del robot["setup_sigma_mm"], robot["setup_sigma_deg"]
    (tmp_path / "unplaced.yaml").write_text(yaml.safe_dump(robot))
    drawn = pose([0.01, 0.02, -0.01], [0.02, -0.01, 0.03])  # what the set-up joints are off by

    def write_more(writer: BagWriter) -> None:
        for arm, name in (("laparoscope", "ECM"), ("instrument", "PSM1")):
            T = bases[arm] * np.array([[1, 1, 1, 1e-3]] * 3 + [[1, 1, 1, 1]])
            T = T @ drawn if arm == "instrument" else T
            for ns in STAMPS[:3]:
                quat = Rotation.from_matrix(T[:3, :3]).as_quat()
                writer.pose(f"/SUJ/{name}/local/measured_cp", ns, T[:3, 3], quat, "Cart", "Transform")

    bag = write_bag(rendered, tmp_path / ("a.bag" if kind == "ros1" else "a"), kind, more=write_more)
    notes = convert(bag, tmp_path / "out", ConvertSettings(robot=str(tmp_path / "unplaced.yaml")))
    assert any("by local/measured_cp of both set-up joints" in note for note in notes)
    written = yaml.safe_load((tmp_path / "out" / "robot.yaml").read_text())
    assert (written["setup_sigma_mm"], written["setup_sigma_deg"]) == (50.0, 5.0)
    recording = load_recording(tmp_path / "out")
    placed_arms = recording.robot.arms
    found = np.linalg.inv(placed_arms["laparoscope"].base_T_arm_base) @ placed_arms["instrument"].base_T_arm_base
    expected = np.linalg.inv(bases["laparoscope"]) @ bases["instrument"]
    np.testing.assert_allclose(np.linalg.norm((found - expected)[:3, 3]), np.sqrt(2**2 + 1 + 3**2) * 10, atol=1e-6)
