"""Studies: numbers against other code and by hand, resuming, own methods, own robots, outputs."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
import torch
from scipy.spatial.transform import Rotation

import rmis_calib as rc
from data_synth import LineStudyConfig, simulate_lines
from rmis_calib.cli import main
from rmis_calib.errors import InputError, OutputError
from rmis_calib.io import load_robot
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.solver import Problem, solve
from rmis_calib.studies import cells, measures
from rmis_calib.studies.builtin import SETTINGS
from rmis_calib.studies.registry import find_method
from rmis_calib.studies.settings import (
    MotionsStudySettings,
    NoiseStudySettings,
    PlanSettings,
    RunSettings,
    SetupSettings,
)
from rmis_calib.studies.simulation import Condition, make_setup, simulate

OWN = Path(__file__).with_name("own_things.py")
SMALL = {"positions_laparoscope": 2, "positions_instrument": 2, "sources": ("kinematics",)}


def small(trials: int = 3, **more) -> NoiseStudySettings:
    run = RunSettings(trials=trials, workers=1, extensions=more.pop("extensions", ()))
    settings = {"methods": ("global", "joint-contours"), "coefficients": (0.0, 0.5), "run": run} | SMALL | more
    return NoiseStudySettings(**settings)


def rigid(rotvec, translation) -> torch.Tensor:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), translation
    return torch.as_tensor(T)


def test_errors_are_those_of_the_paper_and_of_the_working_point() -> None:
    truth = rigid([0.3, -0.2, 0.9], [10.0, 20.0, 30.0])
    turned = rigid([0.0, 0.0, np.deg2rad(2.0)], [0.0, 0.0, 0.0])[:3, :3] @ truth[:3, :3]
    estimate = truth.clone()
    estimate[:3, :3], estimate[:3, 3] = turned, truth[:3, 3] + torch.tensor([3.0, 4.0, 0.0])
    e = measures.transform_errors(estimate, truth)
    assert float(measures.rotation_deg(e)) == pytest.approx(2.0)
    assert float(measures.translation_mm(e)) == pytest.approx(5.0)
    # 100 mm along x from the arm's origin, turned by 2 deg about z: (100 cos 2, 100 sin 2), then the shift.
    point = truth[:3, 3] + torch.tensor([100.0, 0.0, 0.0])
    by_hand = np.hypot(100 * np.cos(np.deg2rad(2)) - 100 + 3, 100 * np.sin(np.deg2rad(2)) + 4)
    assert float(measures.working_point_mm(estimate, truth, point)) == pytest.approx(by_hand)


def test_the_bound_in_measures_is_that_of_normal_errors() -> None:
    """Against NumPy draws of the errors themselves."""
    root = np.random.default_rng(3).normal(size=(6, 6)) * np.array([1e-3] * 3 + [0.5] * 3)[:, None]
    truth, point = rigid([0.3, -0.2, 0.9], [10.0, 20.0, 30.0]), torch.tensor([-3.0, 2.0, 100.0], dtype=torch.float64)
    bound = measures.bound_in_measures(torch.as_tensor(root @ root.T), truth, point)
    e = np.random.default_rng(4).normal(size=(100_000, 6)) @ root.T
    lever = point.numpy() - truth[:3, 3].numpy()
    moved = np.linalg.norm(e[:, 3:] + np.cross(e[:, :3], lever), axis=1)
    turned, shifted = np.degrees(np.linalg.norm(e[:, :3], axis=1)), np.linalg.norm(e[:, 3:], axis=1)
    for name, length in (("rotation", turned), ("translation", shifted), ("working_point", moved)):
        unit = "deg" if name == "rotation" else "mm"
        assert getattr(bound, f"{name}_rms_{unit}") == pytest.approx(np.sqrt((length**2).mean()), rel=0.02)
        assert getattr(bound, f"{name}_median_{unit}") == pytest.approx(np.median(length), rel=0.03)


def test_trials_are_those_of_the_generator_and_errors_those_of_the_solver(tmp_path) -> None:
    """The stored errors against the same trials simulated and solved here."""
    result = rc.study_noise(tmp_path / "out", small())
    rows = [row for row in result.table.to_pylist() if row["coefficient"] == 0.5 and row["cameras"] == "stereo"]
    rows = [row for row in rows if row["method"] == "joint-contours"]
    config = LineStudyConfig(
        trials=3, seed=rows[0]["seed"], positions_laparoscope=2, positions_instrument=2, pixel_noise_px=0.5,
        kinematics_noise_mm=0.5, kinematics_noise_deg=0.5,
    )  # fmt: skip
    data = simulate_lines(config)
    found = solve(Problem.from_arrays(data).only("contours"), SETTINGS).camera_right_T_arm.numpy()
    truth = data["truth"]["camera_right_T_arm"]
    for row, estimate, exact in zip(rows, found, truth, strict=True):
        angle = Rotation.from_matrix(estimate[:3, :3] @ exact[:3, :3].T).magnitude()
        assert row["rotation_error_deg"] == pytest.approx(np.degrees(angle), rel=1e-6)
        assert row["translation_error_mm"] == pytest.approx(np.linalg.norm(estimate[:3, 3] - exact[:3, 3]), rel=1e-9)


def test_joint_attains_the_bound_where_noise_is_small() -> None:
    """rms over the bound of 200 trials: 1 within 3 of its own standard errors, and a bias correction's few per cent."""
    setup = make_setup(SetupSettings())
    trials = simulate(setup, Condition("", 0.0, 2, 3, 216, levels=(("kinematics_noise_mm", 0.2),)), None, 200, 1)
    columns = cells.solve_trials(find_method("joint-contours"), trials, 2)
    bound = trials.bound(("contours",), 2)
    for measure, unit in (("rotation", "deg"), ("translation", "mm"), ("working_point", "mm")):
        rms = np.sqrt(np.mean(np.square(columns[f"{measure}_error_{unit}"])))
        assert 0.85 < rms / getattr(bound, f"{measure}_rms_{unit}") < 1.2


def test_a_study_goes_on_where_it_stopped(tmp_path) -> None:
    whole = rc.study_noise(tmp_path / "whole", small())

    def interrupt(progress):
        if progress.done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rc.study_noise(tmp_path / "out", small(), progress=interrupt)
    first = {path: path.stat().st_mtime_ns for path in (tmp_path / "out/cells").glob("*.parquet")}
    assert len(first) == 4  # one coefficient: two methods, mono and stereo
    seen = []
    again = rc.study_noise(tmp_path / "out", small(), progress=seen.append)
    assert (seen[-1].done, seen[-1].total, seen[-1].stored) == (1, 1, 1)
    assert {path: path.stat().st_mtime_ns for path in first} == first
    assert again.table.equals(whole.table)


def test_other_settings_do_not_take_old_trials(tmp_path) -> None:
    def files(setup=None, methods=("global",), trials=3, extensions=(), coefficient=1.0) -> set[Path]:
        condition = Condition.on_grid("kinematics", coefficient, 2, 2)
        made = cells.make_cells(
            tmp_path, [condition], methods, ("mono",), setup or SetupSettings(), extensions, trials, 0
        )
        return {part.path for cell in made for part in cell.parts}

    assert files() == files()
    assert files() < files(methods=("global", "paper"))  # another method keeps what is there
    others = (
        files(SetupSettings(pixel_noise_px=2.0)),
        files(trials=4),
        files(extensions=(OWN,)),
        files(coefficient=1.01),
    )
    assert all(files().isdisjoint(other) for other in others)
    robot = tmp_path / "robot.yaml"
    robot.write_text("one")
    before = files(SetupSettings(robot=str(robot)))
    robot.write_text("another")
    assert before.isdisjoint(files(SetupSettings(robot=str(robot))))


def test_an_own_method_and_an_own_noise_source(tmp_path) -> None:
    settings = small(extensions=(OWN,), methods=("global", "nothing"), sources=("shifted",), coefficients=(1.0,))
    rows = rc.study_noise(tmp_path / "out", settings).table.to_pylist()
    exact = make_setup(SetupSettings()).scene.camera_right_T_arm
    for row in rows:
        if row["method"] == "nothing":
            assert row["translation_error_mm"] == pytest.approx(np.linalg.norm(exact[:3, 3]))
            assert row["status"] == "answered"
        else:  # arm_T_rcm is wrong by 10 mm along x of `arm`, so camera_right_T_arm is by -10 mm
            assert row["translation_error_mm"] == pytest.approx(10.0, abs=1.0)
        assert np.isnan(row["bound_translation_rms_mm"])


def test_a_method_that_fails_is_named(tmp_path) -> None:
    path = tmp_path / "broken.py"
    path.write_text("import rmis_calib as rc\n@rc.studies.method('broken')\ndef f(problem):\n    return 1 / 0\n")
    with pytest.raises(InputError, match="method broken: expected an answer, found ZeroDivisionError"):
        rc.study_noise(tmp_path / "out", small(extensions=(path,), methods=("broken",)))
    path = tmp_path / "bad.py"
    path.write_text("1 +\n")
    with pytest.raises(InputError, match=r"bad\.py: expected a Python file that can be run, found SyntaxError"):
        rc.study_noise(tmp_path / "other", small(extensions=(path,)))


def test_the_users_own_robot_is_placed_where_the_scene_wants_it(tmp_path) -> None:
    """Through the program's own kinematics, which the generator does not share."""
    setup = make_setup(SetupSettings(robot="dvrk-classic", target_mm=(5.0, -4.0, 90.0)))
    scene, robot = setup.scene, load_robot("dvrk-classic")
    placed = {"laparoscope": scene.laparoscope.base_T_arm_base, "instrument": scene.instrument.base_T_arm_base}
    arms = {name: replace(robot.arms[name], base_T_arm_base=base) for name, base in placed.items()}
    kinematics = RobotKinematics(replace(robot, arms=arms), "laparoscope", "instrument")
    base_T_arm = kinematics.base_T_arm(torch.as_tensor(scene.laparoscope_home))
    instrument = kinematics.instrument(torch.as_tensor(scene.instrument_home))
    camera_T_base = torch.as_tensor(scene.camera_right_T_arm) @ torch.linalg.inv(base_T_arm)
    camera_T_rcm = (camera_T_base @ instrument.base_T_rcm).numpy()
    head = camera_T_rcm[:3, :3] @ instrument.rcm_p_head.numpy() + camera_T_rcm[:3, 3]
    assert np.allclose(camera_T_rcm[:3, 3], [90.0, -40.0, 20.0], atol=1e-6)
    assert np.allclose(head, [5.0, -4.0, 90.0], atol=1e-3)  # its file rounds pi/2 to 1.5708
    trials = simulate(setup, Condition.on_grid("", 0.0, 2, 2), None, 1, 0)
    found = solve(trials.problem.only("contours"), SETTINGS).camera_right_T_arm
    assert float((found - trials.truth).abs().max()) < 1.0  # half a pixel of noise, 64 motions


def test_the_users_own_cameras(tmp_path) -> None:
    stereo = tmp_path / "stereo.yaml"
    one = "{fx: 500.0, fy: 500.0, cx: 319.5, cy: 239.5, distortion: [0, 0, 0, 0, 0]}"
    T = [[1.0, 0, 0, -7.0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
    stereo.write_text(f"image_size: [640, 480]\nright: {one}\nleft: {one}\ncamera_left_T_camera_right: {T}\n")
    setup = make_setup(SetupSettings(stereo=stereo))
    assert (setup.config.focal_px, setup.config.half_width_px, setup.config.half_height_px) == (500.0, 320.0, 240.0)
    assert np.allclose(setup.scene.camera_left_T_camera_right, T)
    stereo.write_text(f"image_size: [640, 480]\nright: {one}\n")
    assert make_setup(SetupSettings(stereo=stereo)).cameras == 1
    with pytest.raises(InputError, match="one camera"):
        rc.study_noise(tmp_path / "out", small(setup=SetupSettings(stereo=stereo), cameras=("stereo",)))


def test_the_command_leaves_everything_that_a_paper_needs(tmp_path, capsys) -> None:
    out = tmp_path / "out"
    words = [
        "study",
        "noise",
        "--trials",
        "2",
        "--coefficients",
        "0",
        "1",
        "--positions-instrument",
        "2",
        "--workers",
        "1",
    ]
    assert main([*words, "--positions-laparoscope", "2", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "Noise in kinematics: median error, deg / mm" in shown
    with (out / "trials.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 2 * 2 * 4 * 2  # sources, coefficients, mono and stereo, methods, trials
    assert len({row["seed"] for row in rows}) == 1
    table = pyarrow.parquet.read_table(out / "trials.parquet")
    assert table.num_rows == len(rows)
    assert table.schema.metadata[b"command"].startswith(b"rmis-calib study noise --trials 2")
    with (out / "summary.csv").open() as file:
        last = [row for row in csv.DictReader(file) if row["method"] == "global"][-1]
    mine = [float(row["rotation_error_deg"]) for row in rows if row["method"] == "global"][-2:]
    assert float(last["rotation_median_deg"]) == pytest.approx(np.median(mine))
    record = json.loads((out / "study.json").read_text())
    assert record["study"] == "noise"
    assert record["seed"] == 0
    assert record["versions"]["torch"]
    assert (out / "noise.pdf").read_bytes().startswith(b"%PDF")
    page = (out / "index.html").read_text()
    assert "pointermove" in page
    assert "src=" not in page  # nothing is loaded
    assert "rmis_calib" in page


def test_motions_are_split_over_the_arms_in_every_way(tmp_path) -> None:
    run = RunSettings(trials=1, workers=1)
    settings = MotionsStudySettings(methods=("joint-contours",), positions=(6, 3), cameras=("mono",), run=run)
    result = rc.study_motions(tmp_path / "out", settings)
    splits = [(r["laparoscope_positions"], r["instrument_positions"], r["motions"]) for r in result.summary]
    assert splits == [(1, 3, 27), (3, 1, 27), (1, 6, 216), (2, 3, 216), (3, 2, 216), (6, 1, 216)]
    assert [table.title.partition(":")[0] for table in result.tables] == [
        "Both arms move", "Instrument alone", "Laparoscope alone"
    ]  # fmt: skip
    both = next(panel for panel in result.figures[0].rows[0] if panel.title == "both arms move")
    lines = {series.name: series.x for series in both.series}
    assert lines["joint, contours"] == (216.0,)  # a product that is prime has no such split
    assert lines["joint, contours, other splits"] == (216.0,)


def test_the_plan_finds_the_number_of_motions(tmp_path) -> None:
    """Of a method that is off by 10 mm / sqrt(N): 1 mm takes 100 motions. Tried: 96, 128, then 104, 112 and 120."""
    run = RunSettings(trials=2, workers=1, extensions=(OWN,))
    settings = PlanSettings(methods=("root-of-n",), wanted_mm=1.0, most_motions=200, run=run)
    result = rc.study_plan(tmp_path / "out", settings)
    assert result.reached
    assert result.sentences[0].startswith(
        "104 motions are enough for 1 mm at the working point: in 90 % of 2 simulated recordings (stereo) the error is "
        "below 0.98 mm"
    )
    assert {row["motions"] for row in result.summary} == {
        4,
        6,
        8,
        12,
        16,
        24,
        32,
        48,
        64,
        96,
        104,
        112,
        120,
        128,
        192,
        200,
    }
    decides = next(c for c in result.figures[0].rows[0][0].series if c.name == "90 % of recordings are below")
    assert decides.middle == pytest.approx([10.0 / np.sqrt(n) for n in decides.x])
    result = rc.study_plan(tmp_path / "out", replace(settings, wanted_mm=0.5))
    assert not result.reached
    assert "200 motions are not enough for 0.5 mm" in result.sentences[0]
    assert "expect to need about 400" in result.sentences[0]  # (10 / 0.5)^2


def test_folders_of_others_are_left_alone(tmp_path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("years")
    with pytest.raises(OutputError, match="a folder with other content"):
        rc.study_noise(tmp_path / "mine", small())
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_mistakes_are_one_clear_line(tmp_path, capsys) -> None:
    assert main(["study", "nois"]) == 2
    assert "did you mean noise?" in capsys.readouterr().err
    assert main(["study", "noise", "--methods", "papr", "--out", str(tmp_path / "x")]) == 2
    assert "did you mean paper?" in capsys.readouterr().err
    assert main(["study", "noise", "--trials", "0"]) == 2
    assert "--trials: expected 1 or more, found 0" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
