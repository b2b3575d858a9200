"""Outputs are whole or absent, whatever interrupts the writing."""

import json
import os
from pathlib import Path

import pytest

from rmis_calib.errors import InputError, OutputError, VideoError
from rmis_calib.io.atomic import atomic_directory, atomic_write, write_json, write_yaml
from rmis_calib.io.configs import load_yaml
from rmis_calib.io.outputs import MARKER

is_root = os.geteuid() == 0


def test_write_replaces_and_leaves_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    target.write_text("old")
    with atomic_write(target) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".json" and temporary.name.startswith(".")
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["result.json"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, ValueError, VideoError])
def test_interrupted_write_keeps_the_old_file(tmp_path: Path, error: type[BaseException]) -> None:
    target = tmp_path / "result.json"
    target.write_text("old")
    with pytest.raises(error), atomic_write(target) as temporary:
        temporary.write_text("half of the n")
        raise error
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["result.json"]


def test_mode_of_written_files_follows_the_umask(tmp_path: Path) -> None:
    mask = os.umask(0o027)
    try:
        write_json(tmp_path / "a.json", {})
        with atomic_directory(tmp_path / "out"):
            pass
    finally:
        os.umask(mask)
    assert (tmp_path / "a.json").stat().st_mode & 0o777 == 0o640
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o750


def test_a_full_disk_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"out\.npz: expected a writable place, found No space left"), \
         atomic_write(tmp_path / "out.npz"):  # fmt: skip
        raise OSError(28, os.strerror(28))
    assert os.listdir(tmp_path) == []


def test_json_and_yaml(tmp_path: Path) -> None:
    value = {"b": [1.5, None, True], "a": "µm", "small": 1e-7}
    write_json(tmp_path / "a.json", value)
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == value
    write_yaml(tmp_path / "a.yaml", value)
    assert load_yaml(tmp_path / "a.yaml") == value
    assert list(load_yaml(tmp_path / "a.yaml")) == ["b", "a", "small"]
    with pytest.raises(InputError, match="expected finite numbers or None"):
        write_json(tmp_path / "b.json", {"a": float("nan")})
    assert not (tmp_path / "b.json").exists()


def test_missing_folder_and_folder_as_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="expected a writable place, found No such file or directory"):
        write_json(tmp_path / "none" / "a.json", {})
    with pytest.raises(OutputError, match="expected a file to write, found a folder"):
        write_json(tmp_path, {})


@pytest.mark.skipif(is_root, reason="root writes everywhere")
def test_unwritable_folder(tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o500)
    with pytest.raises(OutputError, match="Permission denied"):
        write_json(folder / "a.json", {})
    with pytest.raises(OutputError, match="Permission denied"), atomic_directory(folder / "out"):
        pass


def test_unwritable_place_for_root_too() -> None:
    # The kernel refuses new files here to everyone.
    with pytest.raises(OutputError, match="expected a writable place"):
        write_json("/proc/rmis_calib.json", {})


def test_directory_appears_whole(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "out"
    with atomic_directory(target) as temporary:
        (temporary / "sub").mkdir()
        (temporary / "sub" / "a.txt").write_text("x")
        assert not target.exists()
    assert (target / "sub" / "a.txt").read_text() == "x"
    assert os.listdir(target.parent) == ["out"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, ValueError])
@pytest.mark.parametrize("overwrite", [False, True])
def test_interrupted_directory_leaves_nothing(tmp_path: Path, error: type[BaseException], overwrite: bool) -> None:
    target = tmp_path / "out"
    if overwrite:
        with atomic_directory(target) as temporary:
            (temporary / "old.txt").write_text("old")
    with pytest.raises(OutputError if error is OSError else error), atomic_directory(target, overwrite) as temporary:
        (temporary / "half.txt").write_text("x")
        raise error
    assert os.listdir(tmp_path) == (["out"] if overwrite else [])
    assert not overwrite or (target / "old.txt").read_text() == "old"


def test_directory_is_replaced_only_when_allowed(tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.mkdir()
    with atomic_directory(target) as temporary:  # empty: nothing is lost
        (temporary / "a.txt").write_text("1")
    with pytest.raises(OutputError, match="expected a new name, or --overwrite"), atomic_directory(target):
        pytest.fail("must refuse before any work")
    with atomic_directory(target, overwrite=True) as temporary:
        (temporary / "b.txt").write_text("2")
    assert sorted(os.listdir(target)) == [MARKER, "b.txt"]
    assert os.listdir(tmp_path) == ["out"]


def test_a_folder_filled_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    target = tmp_path / "out"
    with pytest.raises(OutputError, match="expected a new name, or --overwrite"), atomic_directory(target):
        target.mkdir()
        (target / "theirs.txt").write_text("x")
    assert os.listdir(target) == ["theirs.txt"]
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), KeyboardInterrupt()])
def test_a_failed_swap_restores_the_old_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    target = tmp_path / "out"
    with atomic_directory(target) as temporary:
        (temporary / "old.txt").write_text("old")
    rename = Path.rename

    def failing(self: Path, other: Path) -> Path:
        if self.name.endswith(".tmp") and other == target and not self.name.endswith(".old.tmp"):
            raise error
        return rename(self, other)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises((OutputError, KeyboardInterrupt)), atomic_directory(target, overwrite=True):
        pass
    assert os.listdir(tmp_path) == ["out"] and sorted(os.listdir(target)) == [MARKER, "old.txt"]


def test_the_current_folder_is_never_swapped_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inside = tmp_path / "work" / "inside"
    inside.mkdir(parents=True)
    monkeypatch.chdir(inside)
    for target in (inside, tmp_path / "work"):
        message = "the current folder or one above it"
        with pytest.raises(OutputError, match=message), atomic_directory(target, overwrite=True):
            pass
    (tmp_path / "file").write_text("x")
    message = "expected a folder to write, found a file"
    with pytest.raises(OutputError, match=message), atomic_directory(tmp_path / "file", overwrite=True):
        pass
