"""Synthetic recordings, rendered once a session."""

import shutil
from pathlib import Path

import pytest

import data_synth
from rmis_calib.cli import main


@pytest.fixture(scope="session")
def rendered_pairs(tmp_path_factory) -> Path:
    """A recording of 4 stereo motions: enough to read, too few to calibrate."""
    path = tmp_path_factory.mktemp("rendered") / "recording"
    data_synth.write_recording(path, data_synth.load_synth_config({"motions": 4, "seed": 5}))
    return path


@pytest.fixture
def recording(rendered_pairs, tmp_path) -> Path:
    """A copy of it that a test may damage."""
    return Path(shutil.copytree(rendered_pairs, tmp_path / "recording"))


@pytest.fixture(scope="session")
def demo_output(made_once) -> Path:
    """`rmis-calib demo` as `make demo` runs it: 60 motions, stereo, 640x480, 0.1 mm / 0.03 deg of kinematic noise."""

    def make(folder: Path) -> None:
        assert main(["demo", "--out", str(folder / "demo_output")]) == 0

    return made_once("demo", make) / "demo_output"
