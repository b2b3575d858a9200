"""The package as it is published: built twice to the same bytes, installed into an empty environment, and used."""

import hashlib
import os
import subprocess
import sys
import tomllib
import venv
import zipfile
from email.message import Message
from email.parser import Parser
from importlib.util import find_spec
from pathlib import Path

import pytest

from rmis_calib import __version__
from rmis_calib.cli.info import EXTRAS

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
SIMULATE = """
import numpy as np
from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig

arrays = simulate_lines(LineStudyConfig(trials=1, positions_laparoscope=2, positions_instrument=3))
truth = arrays.pop("truth")["camera_right_T_arm"][0]
np.savez("observations.npz", **{key: value[0] if np.ndim(value) else value for key, value in arrays.items()})
np.save("truth.npy", truth)
"""

pytestmark = pytest.mark.slow


def build(out: Path) -> dict[str, str]:
    """The SHA-256 of what `python -m build` makes of the tree, by file name."""
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)]
    environment = os.environ | {"SOURCE_DATE_EPOCH": "1700000000"}
    subprocess.run(command, check=True, capture_output=True, env=environment)
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in out.iterdir()}


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    if find_spec("build") is None or find_spec("hatchling") is None:
        pytest.skip("build and hatchling (extra dev) are absent")
    out = tmp_path_factory.mktemp("built")
    build(out)
    return out


@pytest.fixture(scope="module")
def metadata(built) -> Message:
    wheel = zipfile.ZipFile(next(built.glob("*.whl")))
    name = next(name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    return Parser().parsestr(wheel.read(name).decode())


def test_a_build_is_reproducible(built, tmp_path) -> None:
    first = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in built.iterdir()}
    assert sorted(Path(name).suffix for name in first) == [".gz", ".whl"]
    assert build(tmp_path) == first


def test_the_wheel_holds_what_the_programs_need(built) -> None:
    names = set(zipfile.ZipFile(next(built.glob("*.whl"))).namelist())
    assert {"rmis_calib/py.typed", "data_synth/py.typed", "rmis_calib/__init__.pyi"} <= names
    for file in ("configs/**/*.yaml", "rmis_calib/**/*.html", "rmis_calib/**/*.npz"):
        shipped = {str(path.relative_to(ROOT)) for path in ROOT.glob(file)}
        moved = {f"rmis_calib/{name}" if name.startswith("configs/") else name for name in shipped}
        assert shipped and moved <= names
    assert not [name for name in names if name.startswith(("tests", "docs"))]


def test_metadata_is_complete(metadata) -> None:
    assert (metadata["Name"], metadata["Version"]) == ("rmis-calib", __version__)
    assert metadata["Author"] == "rmis_calib developers"
    assert (metadata["License-Expression"], metadata["Requires-Python"]) == ("Apache-2.0", ">=3.11")
    assert metadata["Summary"] and metadata["Keywords"] and "# rmis_calib" in metadata.get_payload()
    assert not metadata.get_all("Project-URL")  # there is no public host to name
    assert set(metadata.get_all("Provides-Extra", [])) == {*EXTRAS, "all", "dev"}
    said = set(metadata.get_all("Classifier", []))
    assert {f"Programming Language :: Python :: 3.{minor}" for minor in (11, 12, 13)} <= said
    unknown = said - _known_classifiers()
    assert not unknown


def _known_classifiers() -> set[str]:
    from trove_classifiers import classifiers

    return set(classifiers)


def test_the_extras_hold_each_other() -> None:
    extras = PROJECT["optional-dependencies"]
    assert extras["all"] == ["rmis-calib[cluster,view,bags,onnx]"]
    assert "rmis-calib[all]" in extras["dev"]


def test_versions_are_the_same_everywhere() -> None:
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    newest = next(
        line for line in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines() if line[:3] == "## "
    )
    assert newest.split()[1] == __version__


def test_an_installed_wheel_works_outside_the_tree(built, tmp_path) -> None:
    home = tmp_path / "environment"
    venv.create(home, with_pip=True)
    python = home / "bin" / "python"
    install = [python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", next(built.glob("*.whl"))]
    subprocess.run(install, check=True, capture_output=True)
    site = next((home / "lib").glob("python3.*")) / "site-packages"
    # Only the dependencies: a line of a .pth file does not bring an editable install along.
    (site / "dependencies.pth").write_text(str(Path(pytest.__file__).parents[1]))
    empty = tmp_path / "elsewhere"
    empty.mkdir()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    def run(*command: str | Path) -> str:
        done = subprocess.run(command, cwd=empty, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    program = home / "bin" / "rmis-calib"
    assert str(site / "rmis_calib") in run(program, "info")
    run(python, "-c", SIMULATE)
    assert "ok: " in run(program, "solve", "observations.npz", "--out", "result.json")
    off = run(
        python,
        "-c",
        "import numpy as np, rmis_calib as rc; r = rc.CalibrationResult.read('result.json'); "
        "print(np.abs(r.camera_right_T_arm.matrix[:3, 3].numpy() - np.load('truth.npy')[:3, 3]).max())",
    )
    assert float(off) < 2.0
