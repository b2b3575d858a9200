"""The README's Python runs as it stands there, in a folder where `make demo` has been run."""

import re
from pathlib import Path

import pytest

README = Path(__file__).resolve().parents[2] / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_there_are_blocks():
    assert len(BLOCKS) == 2


@pytest.mark.slow
@pytest.mark.parametrize("block", BLOCKS, ids=["recording", "observations"])
def test_python_of_the_readme_runs(block, demo_output, monkeypatch, capsys):
    monkeypatch.chdir(demo_output.parent)
    exec(compile(block, "README.md", "exec"), {})
    assert capsys.readouterr().out
