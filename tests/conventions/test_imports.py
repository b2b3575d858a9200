"""Who may import whom, and what importing the package must not load."""

import subprocess
import sys
import tomllib
from itertools import product
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CONFIGURATION = ROOT / "pyproject.toml"
LINT = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True, verbose=False))"
# Each takes from a tenth of a second to seconds to load.
HEAVY = {"torch", "kornia", "cv2", "av", "matplotlib", "pytorch_kinematics", "scipy", "data_synth"}


def contracted_modules() -> list[str]:
    """Every module that a contract names, as a path; a container is a package."""
    contracts = tomllib.loads(CONFIGURATION.read_text())["tool"]["importlinter"]["contracts"]
    layered = [contract for contract in contracts if contract["type"] == "layers"]
    containers = {container.replace(".", "/") for contract in layered for container in contract["containers"]}
    modules = {
        f"{container.replace('.', '/')}/{name.strip()}"
        for contract in layered
        for container in contract["containers"]
        for row in contract["layers"]
        for name in row.split("|")
        if "(" not in name
    }
    forbidden = [contract for contract in contracts if contract["type"] == "forbidden"]
    modules |= {name.replace(".", "/") for contract in forbidden for name in contract["source_modules"]}
    return [
        *(f"{path}/__init__.py" for path in containers),
        *(f"{path}.py" for path in modules - containers - {"data_synth"}),
    ]


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the contracts of pyproject.toml on the packages in a folder, in a process of its own."""
    return subprocess.run([sys.executable, "-c", LINT], cwd=folder, capture_output=True, text=True, check=False)


def imported_by(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return set(result.stdout.split())


def test_contracts_hold() -> None:
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout
    assert "0 broken" in result.stdout


def test_contracts_say_what_the_design_says() -> None:
    contracts = tomllib.loads(CONFIGURATION.read_text())["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract.get("containers") == ["rmis_calib"])
    rows = [[name.strip(" ()") for name in row.split("|")] for row in layers]
    assert rows == [
        ["cli"],
        ["live"],
        ["batches", "convert", "exports", "studies", "viewer"],
        ["report", "parallel"],
        ["pipeline"],
        ["results"],
        ["config"],
        ["baselines"],
        ["solver"],
        ["kinematics", "vision", "io"],
        ["geometry"],
        ["errors"],
    ]
    forbidden = set()
    for contract in contracts:
        if contract["type"] == "forbidden":
            forbidden |= set(product(contract["source_modules"], contract["forbidden_modules"]))
    assert ("data_synth", "rmis_calib") in forbidden
    # `cli` and `studies` may use the generator. `viewer` may not, and is listed when it exists.
    below = {name for row in rows for name in row} - {"cli", "studies", "viewer"}
    assert {(f"rmis_calib.{name}", "data_synth") for name in below} <= forbidden


@pytest.mark.parametrize(
    ("module", "statement", "broken"),
    [
        ("rmis_calib/geometry.py", "import rmis_calib.solver", "layers"),
        ("rmis_calib/vision/__init__.py", "import rmis_calib.io", "layers"),
        ("rmis_calib/kinematics.py", "def f():\n    from rmis_calib.io import x", "layers"),
        ("rmis_calib/pipeline.py", "import rmis_calib.cli", "layers"),
        ("rmis_calib/robot.py", "import rmis_calib.io", "a robot knows nothing of what uses it"),
        ("rmis_calib/geometry.py", "import rmis_calib.robot", "geometry knows nothing of robots"),
        ("rmis_calib/solver/__init__.py", "import data_synth", "only studies and cli use data_synth"),
        ("data_synth/__init__.py", "import rmis_calib.geometry", "data_synth is made of its own code"),
        ("rmis_calib/solver/model.py", "import rmis_calib.solver.estimate", "stages of the solver"),
        ("rmis_calib/solver/start.py", "import rmis_calib.solver.solution", "stages of the solver"),
        ("rmis_calib/vision/image.py", "import rmis_calib.vision.coarse", "stages of the detector"),
    ],
)
def test_contracts_break_when_they_should(tmp_path: Path, module: str, statement: str, broken: str) -> None:
    for path in ["data_synth/__init__.py", *contracted_modules()]:
        (tmp_path / path).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / path).write_text("")
    (tmp_path / "pyproject.toml").write_text(CONFIGURATION.read_text())
    assert lint_imports(tmp_path).returncode == 0
    (tmp_path / module).write_text(statement + "\n")
    result = lint_imports(tmp_path)
    assert result.returncode != 0
    assert any(broken in line and "BROKEN" in line for line in result.stdout.splitlines()), result.stdout


def test_importing_the_package_loads_nothing_heavy() -> None:
    assert not imported_by("import rmis_calib") & HEAVY


def test_settings_load_nothing_heavy() -> None:
    paths = sorted(ROOT.glob("rmis_calib/**/settings.py"))
    assert paths
    for path in paths:
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        assert not imported_by(f"import {module}") & HEAVY, module


def test_subpackages_export_lazily() -> None:
    for package in sorted(path.parent.name for path in ROOT.glob("rmis_calib/*/__init__.py")):
        assert not imported_by(f"import rmis_calib.{package}") & HEAVY, package
    code = "import rmis_calib.geometry as g; assert 'RigidTransform' in dir(g); g.RigidTransform"
    assert "torch" in imported_by(code)


def test_every_exported_name_exists() -> None:
    for package in ("geometry", "kinematics"):
        imported_by(f"import rmis_calib.{package} as p; [getattr(p, name) for name in p.__all__]")
