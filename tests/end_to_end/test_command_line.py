"""What every command shares: help, versions, pipes, full devices, and refusals that need no heavy import."""

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from rmis_calib.cli import COMMANDS, main

HEAVY = ("torch", "kornia", "scipy", "matplotlib", "pytorch_kinematics")


def run(argv: list[str], folder: Path, stdout: int = subprocess.PIPE) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rmis_calib", *argv]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    return subprocess.run(
        command, cwd=folder, stdout=stdout, stderr=subprocess.PIPE, text=True, env=environment, check=False
    )


@pytest.mark.parametrize("argv", [["--version"], ["-V"]])
def test_version(argv, capsys) -> None:
    assert main(argv) == 0
    assert capsys.readouterr().out.startswith("rmis-calib 0.")


@pytest.mark.parametrize("argv", [["help"], ["--help"], ["-h"]])
def test_help_lists_the_commands(argv, capsys) -> None:
    assert main(argv) == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in COMMANDS)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_help_of_every_command(name, capsys) -> None:
    assert main(["help", *name.split()]) == 0
    shown = capsys.readouterr().out
    assert f"usage: rmis-calib {name}" in shown
    assert main([*name.split(), "--help"]) == 0
    assert capsys.readouterr().out == shown


@pytest.mark.parametrize("argv", [["--help"], ["--version"], ["calibrate", "--help"], ["demo", "--help"]])
def test_help_into_a_closed_pipe_is_no_failure(argv, tmp_path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    result = run(argv, tmp_path, stdout=writer)
    os.close(writer)
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_a_full_device_is_one_clear_line(tmp_path) -> None:
    with open("/dev/full", "w") as full:
        result = run(["--help"], tmp_path, stdout=full.fileno())
    assert result.returncode == 2
    expected = (
        "rmis-calib: error: standard output: expected a place that can be written, found No space left on device\n"
    )
    assert result.stderr == expected


@pytest.mark.parametrize(
    "argv",
    [
        ["calibrate", "nowhere"],
        ["calibrate", "."],
        ["calibrate", "recording", "--every", "0"],
        ["calibrate", "recording", "--out", "recording"],
        ["calibrate", "recording", "--masks", "absent"],
        ["detect", "nowhere"],
        ["detect", "recording", "--out", "recording/right"],
        ["solve", "absent.npz"],
        ["evaluate", "absent.json", "recording"],
        ["synth", "recording"],
    ],
    ids=" ".join,
)
def test_refusals_import_nothing_heavy(argv, recording, tmp_path) -> None:
    code = (
        "import sys; from rmis_calib.cli import main; code = main(sys.argv[1:]); "
        f"print(code, *(name for name in {HEAVY!r} if name in sys.modules))"
    )
    if argv[0] == "synth":  # the generator draws with torch
        code = code.replace(repr(HEAVY), "('kornia',)")
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    result = subprocess.run(
        [sys.executable, "-c", code, *argv], cwd=tmp_path, capture_output=True, text=True, env=environment, check=False
    )
    assert result.stdout.split() == ["2"], result.stdout + result.stderr
    assert result.stderr.count("\n") == 1


def test_a_broken_recording_is_refused_without_torch(recording, tmp_path) -> None:
    (recording / "stereo.yaml").write_text("image_size: [640]")
    code = (
        "import sys; from rmis_calib.cli import main; print(main(['calibrate', 'recording']), 'torch' in sys.modules)"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, env=environment, check=False
    )
    assert result.stdout.split() == ["2", "False"], result.stderr


def test_where_the_recording_is_when_one_folder_too_high_is_named(recording, tmp_path, capsys) -> None:
    assert main(["calibrate", str(tmp_path)]) == 2
    assert f"did you mean {recording}?" in capsys.readouterr().err
    assert main(["calibrate", str(recording / "stereo.yaml")]) == 2
    assert "expected a recording: a folder with recording.yaml, found a file" in capsys.readouterr().err


def test_exit_code_of_an_ok_result_that_nobody_reads(demo_output, tmp_path) -> None:
    observations = demo_output / "calibration" / "observations.npz"
    reader, writer = os.pipe()
    os.close(reader)
    result = run(["solve", str(observations), "--out", "result.json"], tmp_path, stdout=writer)
    os.close(writer)
    assert (result.returncode, result.stderr) == (0, "")
    assert (tmp_path / "result.json").is_file()


def test_info_names_the_versions(capsys) -> None:
    assert main(["info"]) == 0
    shown = capsys.readouterr().out
    assert version("rmis-calib") in shown
    assert version("torch") in shown
