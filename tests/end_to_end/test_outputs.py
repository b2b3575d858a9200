"""No command loses a file: outputs never touch inputs, and only what the program wrote is ever replaced."""

import hashlib
import json
import os
import random
import shutil
from pathlib import Path

import numpy as np
import pytest

import data_synth
import rmis_calib as rc
from rmis_calib.cli import main
from rmis_calib.errors import OutputError
from rmis_calib.io.outputs import MARKER, check_apart


def contents(folder: Path) -> dict[str, str]:
    """Digest of every file below a folder, links as what they say."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = os.readlink(path)
        elif path.is_file():
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


@pytest.fixture(scope="module")
def observations(demo_output) -> Path:
    return demo_output / "calibration" / "observations.npz"


@pytest.mark.parametrize(
    "argv",
    [
        "calibrate recording --out recording --overwrite",
        "calibrate recording --out . --overwrite",
        "calibrate recording --out recording/right --overwrite",
        "calibrate recording --out recording/new",
        "calibrate recording --out link --overwrite",
        "calibrate link --out recording --overwrite",
        "calibrate recording --out outside/videos --overwrite",
        "detect recording --out recording/right --overwrite",
        "detect recording/right.mp4 --out recording --overwrite",
        "detect recording/right.mp4 --out recording/right.mp4 --overwrite",
        "solve o.npz --out o.npz --overwrite",
        "solve o.npz --out hard.npz --overwrite",
        "solve o.npz --out soft.npz --overwrite",
        "solve o.npz --out notes.txt --overwrite",
        "evaluate result.json recording --out result.json --overwrite",
        "evaluate result.json recording --out recording/ground_truth.yaml --overwrite",
        "evaluate result.json recording --out recording/e.json",
        "evaluate result.json recording --out notes.txt --overwrite",
        "synth outside --overwrite",
        "synth recording_of_another --overwrite --motions 4",
        "demo --out home --overwrite",
    ],
)
def test_hostile_outputs_are_refused_and_nothing_changes(
    argv, recording, observations, demo_output, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(observations, "o.npz")
    os.link("o.npz", "hard.npz")
    os.symlink("o.npz", "soft.npz")
    os.symlink("recording", "link")
    Path("notes.txt").write_text("mine")
    shutil.copy(demo_output / "calibration" / "result.json", "result.json")
    Path("outside/videos").mkdir(parents=True)
    shutil.move("recording/right.mp4", "outside/videos/right.mp4")
    os.symlink(tmp_path / "outside/videos/right.mp4", "recording/right.mp4")
    for name in ("home/recording", "home/calibration", "recording_of_another"):
        Path(name).mkdir(parents=True)
        Path(name, "recording.yaml").write_text("mine")
    before = contents(tmp_path)
    assert main(argv.split()) == 2, capsys.readouterr()
    assert capsys.readouterr().err.count("\n") == 1
    assert contents(tmp_path) == before


def test_a_default_output_is_fresh_and_beside_the_input(recording, observations, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(observations, "o.npz")
    (tmp_path / "recording_calibration").mkdir()
    (tmp_path / "recording_calibration" / "mine.txt").write_text("mine")
    assert main(["calibrate", "recording", "--overlays", "0"]) == 1  # four motions are too few: a result, not ok
    assert (tmp_path / "recording_calibration_2" / "result.json").is_file()
    assert main(["detect", "recording", "--overlays", "0"]) == 0
    assert (tmp_path / "recording_lines" / "lines.csv").is_file()
    assert main(["solve", "o.npz"]) == 0 and main(["solve", "o.npz"]) == 0
    assert {"o_result.json", "o_result_2.json"} <= set(os.listdir(tmp_path))
    assert (tmp_path / "recording_calibration" / "mine.txt").read_text() == "mine"


def test_own_output_is_replaced_and_others_files_in_it_are_not(recording, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    argv = ["detect", str(recording), "--out", str(out), "--overlays", "1"]
    assert main(argv) == 0
    assert main(argv) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*argv, "--overwrite"]) == 0
    (out / "overlays" / "mine.txt").write_text("mine")
    assert main([*argv, "--overwrite"]) == 2
    assert "found overlays/mine.txt, which is not of this program" in capsys.readouterr().err
    (out / "overlays" / "mine.txt").unlink()
    with (out / "lines.csv").open("a") as file:
        file.write("my remark")
    assert main([*argv, "--overwrite"]) == 2
    assert "lines.csv (changed since it was written)" in capsys.readouterr().err
    (out / "lines.csv").unlink()
    (out / "lines.csv").symlink_to(recording / "joints.csv")
    assert main([*argv, "--overwrite"]) == 2
    assert json.loads((out / MARKER).read_text())["format"] == "rmis-calib-output/1"


def random_tree(root: Path, dice: random.Random) -> list[Path]:
    """Folders, files, and soft and hard links to them, at random."""
    folders, files = [root], []
    for number in range(dice.randint(4, 14)):
        parent = dice.choice(folders)
        path = parent / dice.choice(["a", "b", "c.npz", "d.json", "recording", "right.mp4"])
        if os.path.lexists(path):
            continue
        kind = dice.randint(0, 4)
        if kind <= 1:
            path.write_bytes(dice.randbytes(number + 1))
            files.append(path)
        elif kind == 2:
            path.mkdir()
            folders.append(path)
        elif kind == 3:
            path.symlink_to(dice.choice([*folders, *files]))
        elif files:
            os.link(dice.choice([file for file in files if not file.is_symlink()]), path)
    return [*folders, *files, root / "new", dice.choice(folders) / "new"]


@pytest.mark.parametrize("seed", range(120))
def test_whatever_the_command_line_no_foreign_file_is_touched(
    seed, rendered_pairs, observations, tmp_path, monkeypatch, capsys
) -> None:
    dice = random.Random(seed)
    root = tmp_path / "root"
    root.mkdir()
    places = random_tree(root, dice)
    inputs = {"recording": root / "in", "npz": root / "in.npz", "result": root / "in.json"}
    shutil.copytree(rendered_pairs, inputs["recording"])
    (inputs["recording"] / MARKER).unlink()
    shutil.copy(observations, inputs["npz"])
    shutil.copy(observations.parent / "result.json", inputs["result"])
    monkeypatch.chdir(dice.choice([path for path in places if path.is_dir()]))
    places += [inputs["recording"], inputs["recording"] / "right.mp4", inputs["npz"], inputs["result"]]
    before = contents(root)
    del before["in.json"]  # the program wrote it, so that --overwrite may replace it
    commands = [
        ["solve", str(inputs["npz"]), "--method", "paper"],
        ["evaluate", str(inputs["result"]), str(inputs["recording"])],
        ["detect", str(inputs["recording"] / "right.mp4"), "--overlays", "0"],
        ["detect", str(inputs["recording"]), "--every", "4", "--overlays", "0"],
        ["calibrate", str(inputs["recording"]), "--every", "4", "--overlays", "0"],
    ]
    weights = [8, 8, 2, 1, 1]
    for argv in dice.choices(commands, weights, k=3):
        out = dice.choice(places)
        argv = [*argv, "--out", str(out), *(["--overwrite"] if dice.random() < 0.7 else [])]
        assert main(argv) in (0, 1, 2), argv
        after = contents(root)
        assert {name: after.get(name) for name in before} == before, argv
    assert "Traceback" not in capsys.readouterr().err


def test_python_functions_keep_foreign_files_too(observations, tmp_path) -> None:
    mine = tmp_path / "mine"
    mine.write_text("mine")
    loaded = rc.ShaftObservations.load(observations)
    result = rc.solve(loaded, throw=False)
    for write in (result.write, loaded.save):
        with pytest.raises(OutputError, match="found another file"):
            write(mine)
    assert mine.read_text() == "mine"
    for write, name in ((result.write, "r.json"), (loaded.save, "o.npz")):
        write(tmp_path / name)
        write(tmp_path / name)  # what it wrote itself is replaced
    np.savez(tmp_path / "mine.npz", arm_T_rcm=np.eye(4))
    with pytest.raises(OutputError):
        loaded.save(tmp_path / "mine.npz")
    with pytest.raises(FileExistsError):
        data_synth.write_recording(tmp_path, data_synth.load_synth_config({"motions": 1}), overwrite=True)


def test_one_file_by_two_names_is_one(tmp_path) -> None:
    inside = tmp_path / "in" / "deep"
    inside.mkdir(parents=True)
    file = inside / "o.npz"
    file.write_text("x")
    os.link(file, tmp_path / "hard.npz")
    (tmp_path / "soft").symlink_to(tmp_path / "in")
    for out in (file, tmp_path / "hard.npz", tmp_path / "soft" / "deep" / "o.npz", tmp_path / "in", tmp_path):
        with pytest.raises(OutputError):
            check_apart(out, [file])
    for out in (tmp_path / "soft" / "new", tmp_path / "in" / "deep" / "new"):
        with pytest.raises(OutputError):
            check_apart(out, [tmp_path / "in"])
        check_apart(out, [file])
