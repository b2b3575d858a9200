"""What the README and the pages of docs/ say: their Python runs, in a folder where `make demo` has been run, and their
links lead somewhere. Blocks marked `py` instead of `python` need machines that tests do not have."""

import re
import shutil
from pathlib import Path
from types import ModuleType

import pytest
import yaml

import rmis_calib as rc

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in PAGES}
BLOCKS = [
    pytest.param(block, id=f"{name}-{number}")
    for name, text in TEXTS.items()
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL))
]
LINKS = [
    (name, target.partition("#")[0])
    for name, text in TEXTS.items()
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    if "://" not in target and not target.startswith("#")
]


@pytest.fixture(scope="module")
def beside_a_demo(demo_output, tmp_path_factory):
    """A folder with a demo that the pages' Python may write into."""
    return shutil.copytree(demo_output, tmp_path_factory.mktemp("pages") / "demo_output").parent


@pytest.mark.slow
@pytest.mark.parametrize("block", BLOCKS)
def test_python_on_the_pages_runs(block, beside_a_demo, monkeypatch):
    monkeypatch.chdir(beside_a_demo)
    exec(compile(block, "a page's block", "exec"), {"__name__": "page"})


def test_links_lead_to_files():
    assert len(LINKS) > 10
    broken = [(name, target) for name, target in LINKS if not (ROOT / name).parent.joinpath(target).exists()]
    assert not broken


def test_every_page_is_in_the_site():
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    listed = set(re.findall(r"([\w/]+\.md)", yaml.safe_dump(yaml.safe_load(text)["nav"])))
    assert listed == {page.name for page in (ROOT / "docs").glob("*.md")}


def test_everything_public_is_in_the_reference():
    entries = TEXTS["docs/python.md"].split()
    public = {name: getattr(rc, name) for name in rc.__all__}
    names = {
        name: value.__name__ if isinstance(value, ModuleType) else f"{value.__module__}.{value.__qualname__}"
        for name, value in public.items()
    }
    missing = [
        name
        for name, path in names.items()
        if not any(
            entry == path or path == entry.rpartition(".")[0] or entry.startswith(f"{path}.") for entry in entries
        )
        and path.rpartition(".")[0] not in entries
    ]
    assert not missing


def test_the_readme_fits_one_sitting():
    words = re.sub(r"```.*?```", "", TEXTS["README.md"], flags=re.DOTALL).split()
    assert len(words) < 900
