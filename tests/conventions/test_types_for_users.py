"""What `py.typed` promises: a type checker sees our types, and so a user's mistake."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import rmis_calib as rc

RIGHT = """
import rmis_calib as rc
from rmis_calib.solver import Problem, solve

recording = rc.load_recording("my_recording")
result = rc.calibrate(recording)
message: str = result.message
problem = Problem.from_observations(rc.ShaftObservations.load("observations.npz"))
count: int = problem.n_motions
status = solve(problem).status
"""
WRONG = (
    ("recording.no_such_attribute", "reportAttributeAccessIssue"),
    ("rc.calibrate()", "reportCallIssue"),
    ("rc.calibrate('a path')", "reportArgumentType"),
    ("problem.no_such_attribute", "reportAttributeAccessIssue"),
    ("solve(problem).no_such_attribute", "reportAttributeAccessIssue"),
    ("rc.no_such_name", "reportAttributeAccessIssue"),
    ("text: float = result.message", "reportAssignmentType"),
)


def test_a_type_checker_sees_mistakes_and_only_these(tmp_path: Path) -> None:
    pyright = shutil.which("pyright", path=str(Path(sys.executable).parent))
    if pyright is None:
        pytest.skip("pyright is not installed beside Python")
    lines = RIGHT.strip().splitlines()
    (tmp_path / "user.py").write_text("\n".join([*lines, *(statement for statement, _ in WRONG)]) + "\n")
    where = Path(rc.__file__).resolve().parent.parent
    settings = {"extraPaths": [str(where)], "reportUnusedExpression": "none", "pythonVersion": "3.11"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [pyright, "--outputjson", "--pythonpath", sys.executable, "user.py"]
    said = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    found = [
        (item["range"]["start"]["line"] - len(lines), item["rule"])
        for item in json.loads(said.stdout)["generalDiagnostics"]
        if item["severity"] == "error"
    ]
    assert found == [(line, rule) for line, (_, rule) in enumerate(WRONG)]


def test_every_public_name_loads() -> None:
    for name in rc.__all__:
        assert getattr(rc, name) is not None
