"""Any study on the user's own robot, cameras and noise: rendered pictures against OpenCV's and SciPy's projection."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

import rmis_calib as rc
from data_synth import SceneSettings
from data_synth.truth import side_truth
from data_synth.world import build_world
from rmis_calib.cli import main
from rmis_calib.errors import InputError
from rmis_calib.io import load_robot
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.studies.pictures import staged
from rmis_calib.studies.prepare import prepare_pictures
from rmis_calib.studies.robot_noise import RobotNoise
from rmis_calib.studies.settings import (
    ComparisonStudySettings,
    EquipmentSettings,
    PictureSettings,
    PlanSettings,
    ReprojectionStudySettings,
    RunSettings,
    SetupSettings,
)
from rmis_calib.studies.simulation import make_setup

OWN = Path(__file__).with_name("own_things.py")
EYES = {
    "right": {"fx": 900.0, "fy": 899.0, "cx": 402.0, "cy": 296.0, "distortion": [-0.1, 0.02, 0.0003, -0.0002, 0.0]},
    "left": {"fx": 902.0, "fy": 901.0, "cx": 396.0, "cy": 301.0, "distortion": [-0.11, 0.02, 0.0, 0.0, 0.0]},
}
EXTRINSICS = [[1.0, 0.0, 0.0, 4.3], [0.0, 1.0, 0.0, 0.1], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def stereo_file(folder: Path, **changes) -> Path:
    content = {"image_size": [800, 600], **EYES, "camera_left_T_camera_right": EXTRINSICS} | changes
    path = folder / "stereo.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in content.items() if value is not None}))
    return path


def test_pictures_show_the_users_robot_through_the_users_cameras(tmp_path) -> None:
    """Head points of the truth against the program's own kinematics and OpenCV's projection, neither of which the
    generator shares."""
    equipment = EquipmentSettings(robot="dvrk-classic", stereo=stereo_file(tmp_path), target_mm=(5.0, -4.0, 90.0))
    for experiment in (0, 1):
        stage = staged(PictureSettings(), equipment, 6, 3, experiment)
        world = build_world(stage.config, stage.scene)
        scene, robot = stage.scene, load_robot("dvrk-classic")
        bases = {"laparoscope": scene.laparoscope.base_T_arm_base, "instrument": scene.instrument.base_T_arm_base}
        arms = {name: replace(robot.arms[name], base_T_arm_base=base) for name, base in bases.items()}
        arms["laparoscope"] = replace(arms["laparoscope"], end_T_tool=scene.laparoscope.end_T_tool)
        kinematics = RobotKinematics(replace(robot, arms=arms), "laparoscope", "instrument")
        laparoscope, instrument = (torch.as_tensor(x) for x in world.path.at(world.frame_times_s))
        assert laparoscope.shape == (6, 4) and instrument.shape == (6, 6)
        told = kinematics.instrument(instrument)
        camera_T_rcm = (
            torch.as_tensor(scene.camera_right_T_arm)
            @ torch.linalg.inv(kinematics.base_T_arm(laparoscope))
            @ told.base_T_rcm
        )
        head = (camera_T_rcm[:, :3, :3] @ told.rcm_p_head[..., None])[..., 0] + camera_T_rcm[:, :3, 3]
        eye = EYES["right"]
        K = np.array([[eye["fx"], 0.0, eye["cx"]], [0.0, eye["fy"], eye["cy"]], [0.0, 0.0, 1.0]])
        uv, _ = cv2.projectPoints(head.numpy(), np.zeros(3), np.zeros(3), K, np.array(eye["distortion"]))
        assert np.abs(side_truth(world, "right").head_uv - uv[:, 0]).max() < 0.02  # its file rounds pi/2 to 1.5708
    assert np.linalg.norm(stage.scene.camera_right_T_arm[:3, 3]) == pytest.approx(40.0)  # a random one in experiment 1


def test_one_camera_is_enough_for_pictures(tmp_path) -> None:
    one = EquipmentSettings(stereo=stereo_file(tmp_path, left=None, camera_left_T_camera_right=None))
    _, views = prepare_pictures(ReprojectionStudySettings(setup=one), ("mono", "stereo"))
    assert views == ("mono",)
    with pytest.raises(InputError, match="--cameras: expected mono: there is one camera"):
        prepare_pictures(ReprojectionStudySettings(setup=one), ("stereo",))


def test_ranges_are_those_of_the_rendered_motion() -> None:
    stage = staged(PictureSettings(), EquipmentSettings(rotation_range_deg=14.0, translation_range_mm=30.0), 40, 0, 0)
    laparoscope, instrument = build_world(stage.config, stage.scene).path.at(np.arange(40) * 0.5 + 1.25)
    for readings, home in ((laparoscope, stage.scene.laparoscope_home), (instrument, stage.scene.instrument_home)):
        far = np.abs(readings - home).max(0)
        assert (far <= np.array([np.deg2rad(7.0), np.deg2rad(7.0), 15.0]) + 1e-12).all()
        assert (far > 0.6 * np.array([np.deg2rad(7.0), np.deg2rad(7.0), 15.0])).all()


def test_a_shaft_whose_axis_is_reversed_in_the_table(tmp_path) -> None:
    """The Raven's table has it so. Its head is where the study wants it, and the axis points there from the RCM."""
    robots = Path(rc.__file__).resolve().parents[1] / "configs" / "robots"
    content = yaml.safe_load((robots / "rcm-3x3.yaml").read_text())
    content["arms"]["raven"] = yaml.safe_load((robots / "raven-ii.yaml").read_text())["arms"]["green"]
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(content))
    scene = make_setup(SetupSettings(robot=str(path), instrument_arm="raven")).scene
    robot = load_robot(path)
    arm = replace(robot.arms["raven"], base_T_arm_base=scene.instrument.base_T_arm_base)
    kinematics = RobotKinematics(replace(robot, arms={"raven": arm}), None, "raven")
    told = kinematics.instrument(torch.as_tensor(scene.instrument_home))
    camera_T_rcm = np.linalg.inv(scene.base_T_camera_home) @ told.base_T_rcm.numpy()
    head = camera_T_rcm[:3, :3] @ told.rcm_p_head.numpy() + camera_T_rcm[:3, 3]
    assert np.allclose(head, SceneSettings().target_mm, atol=1e-6)
    axis = camera_T_rcm[:3, :3] @ told.rcm_v_axis.numpy()
    towards = np.subtract(SceneSettings().target_mm, SceneSettings().instrument_rcm_mm)
    assert axis @ towards == pytest.approx(np.linalg.norm(towards), rel=1e-3)


def test_what_cannot_be_rendered_is_named_before_anything_is(tmp_path, capsys) -> None:
    fisheye = {
        side: eye | {"distortion_model": "equidistant", "distortion": [0.1, 0.0, 0.0, 0.0]}
        for side, eye in EYES.items()
    }
    out = tmp_path / "out"
    words = ["study", "reprojection", "--out", str(out), "--workers", "1"]
    assert main([*words, "--stereo", str(stereo_file(tmp_path, **fisheye))]) == 2
    assert "--stereo: expected lenses of k1, k2, p1, p2, k3" in capsys.readouterr().err
    assert main([*words, "--target-mm", "80", "0", "60"]) == 2
    assert "--target-mm: expected a point well inside the right camera's picture" in capsys.readouterr().err
    assert main([*words, "--robot", "dvrk-classic", "--rotation-range-deg", "150"]) == 2
    assert "pitch: expected readings within its limits" in capsys.readouterr().err
    assert main([*words, "--source", "kinematics-camera"]) == 2
    assert "rendered pictures have noise of their own" in capsys.readouterr().err
    assert main(["study", "plan", "--target-mm", "300", "0", "60", "--out", str(out)]) == 2
    assert "--target-mm: expected a point in the right camera's picture" in capsys.readouterr().err
    assert not out.exists()


def test_an_own_noise_source_works_with_pictures(tmp_path) -> None:
    run = RunSettings(extensions=(OWN,), workers=1, trials=2)
    settings = ReprojectionStudySettings(pictures=PictureSettings(source="stiff", coefficient=2.0), run=run)
    prepare_pictures(settings, ("stereo",))  # loads the file
    noise = RobotNoise.of(settings.pictures)
    generator = np.random.default_rng(0)
    poses = noise.logged(np.broadcast_to(np.eye(4), (20_000, 4, 4)), generator)
    assert poses[:, :3, 3].std() == pytest.approx(0.4 * np.sqrt(2.0), rel=0.02)  # 0.2 mm a unit, both arms
    told = noise.extrinsics(np.eye(4), 20_000, generator)
    assert told[:, :3, 3].std() == pytest.approx(0.2, rel=0.02)
    arrays = {"arm_T_rcm": np.zeros((2, 3, 4, 4))}
    noise.disturb(arrays, generator)
    assert (arrays["arm_T_rcm"][..., 1, 3] == 2.0).all()
    board = {"base_T_arm": np.zeros((2, 3, 4, 4))}
    noise.disturb_board(board, generator)
    assert (board["base_T_arm"][..., 1, 3] == 2.0).all()
    with pytest.raises(InputError, match="expected disturb_board beside disturb"):
        rc.study_comparison(
            tmp_path / "x", ComparisonStudySettings(pictures=PictureSettings(source="shifted"), run=run)
        )


def test_an_own_noise_source_works_with_the_plan(tmp_path) -> None:
    """`shifted` adds 10 mm along one axis to every pose: no number of motions is enough for 1 mm, and the error says
    why."""
    run = RunSettings(trials=2, workers=1, extensions=(OWN,))
    settings = PlanSettings(methods=("global",), source="shifted", most_motions=64, run=run)
    result = rc.study_plan(tmp_path / "out", settings)
    assert not result.reached
    last = next(row for row in result.summary if row["motions"] == 64)
    assert last["translation_median_mm"] == pytest.approx(10.0, abs=3.0)
