"""Hundreds of damaged inputs: exit code 0, 1 or 2, one clear line, nothing half-written, bounded time and memory.

`RMIS_FUZZ=5000` runs more of them, from other seeds.
"""

import os
import random
import resource
import shutil
import time
from pathlib import Path

import pytest

import data_synth
from rmis_calib.cli import main

COUNT = int(os.environ.get("RMIS_FUZZ", "400"))
GROUPS = 20
TEXTS = ("recording.yaml", "stereo.yaml", "robot.yaml", "joints.csv", "frame_times.csv", "head_points.csv")
MOST_SECONDS, MOST_BYTES = 60.0, 2 << 30


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> Path:
    """A small recording that can be read, with too few motions to solve."""
    folder = tmp_path_factory.mktemp("tiny")
    eye = {"fx_px": 175.0, "fy_px": 175.0, "cx_px": 80.0, "cy_px": 60.0}
    camera = {"width_px": 160, "height_px": 120, "right": eye, "left": eye}
    config = data_synth.load_synth_config({"motions": 5, "camera": camera})
    data_synth.write_recording(folder / "recording", config)
    return folder


def flipped(data: bytes, dice: random.Random) -> bytes:
    """A few bytes changed."""
    out = bytearray(data)
    for _ in range(dice.randint(1, 8)):
        out[dice.randrange(len(out))] = dice.randrange(256)
    return bytes(out)


def mutate(path: Path, dice: random.Random) -> str:
    """Damage one file or folder, in one of many ways; returns what was done."""
    if not path.is_file() or path.stat().st_size > 1 << 24:
        return f"{path.name} as it was"  # damaged before
    data = path.read_bytes() or b" "
    ways = {
        "bytes flipped": lambda: path.write_bytes(flipped(data, dice)),
        "cut": lambda: path.write_bytes(data[: dice.randrange(len(data))]),
        "emptied": lambda: path.write_bytes(b""),
        "doubled": lambda: path.write_bytes(data + data),
        "shuffled": lambda: path.write_bytes(b"\n".join(dice.sample(lines := data.split(b"\n"), len(lines)))),
        "huge": lambda: os.truncate(path, 1 << 36),
        "noise": lambda: path.write_bytes(dice.randbytes(dice.randint(1, 5000))),
        "token": lambda: path.write_bytes(
            data.replace(dice.choice(data.split() or [b"x"]), dice.choice(TOKENS), dice.randint(1, 3))
        ),
        "folder": lambda: (path.unlink(), path.mkdir()),
        "loop": lambda: (path.unlink(), path.symlink_to(path.name)),
        "dangling": lambda: (path.unlink(), path.symlink_to("nowhere")),
        "pipe": lambda: (path.unlink(), os.mkfifo(path)),
        "gone": lambda: path.unlink(),
    }
    way = dice.choice(sorted(ways))
    ways[way]()
    return f"{path.name} {way}"


TOKENS = [
    *(b"", b"nan", b"-1", b"1e308", b"1e999", b"null", b"[]", b"{}", b"true", b"0x10", b"99999999999999999999"),
    *(
        b"<script>",
        b"!!python/object:os.system",
        b"&a [*a]",
        b"\xff\xfe",
        b"'",
        b'"',
        b"../../etc/passwd",
        b"/dev/zero",
    ),
]


def listing(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def check(argv: list[str], work: Path, out: Path, what: str, capsys) -> None:
    before = listing(work)
    start = time.monotonic()
    code = main(argv)
    seconds = time.monotonic() - start
    shown = capsys.readouterr()
    assert code in (0, 1, 2), f"{what}: exit {code}\n{shown.err}"
    assert "Traceback" not in shown.err and "a bug" not in shown.err, what
    assert seconds < MOST_SECONDS, f"{what}: {seconds:.0f} s"
    if code == 2:
        errors = [line for line in shown.err.splitlines() if line.startswith("rmis-calib: error: ")]
        assert len(errors) == 1 and len(errors[0]) < 1500, f"{what}: {shown.err}"
        assert not out.exists(), what
        assert listing(work) == before, what
    assert not any(".tmp" in name for name in listing(work)), what


@pytest.mark.parametrize("group", range(GROUPS))
def test_damaged_recordings(group: int, tiny: Path, tmp_path: Path, capsys) -> None:
    for number in range(group, COUNT * 3 // 5, GROUPS):
        dice = random.Random(number + 1000 * COUNT)
        work = tmp_path / str(number)
        recording = Path(shutil.copytree(tiny / "recording", work / "recording"))
        names = [name for name in (*TEXTS, "right.mp4", "left.mp4") if (recording / name).is_file()]
        what = "; ".join(mutate(recording / dice.choice(names), dice) for _ in range(dice.choice([1, 1, 1, 2])))
        command = dice.choice(["calibrate", "calibrate", "detect"])
        out = work / "out"
        check([command, str(recording), "--out", str(out), "--overlays", "0"], work, out, f"{number}: {what}", capsys)
        shutil.rmtree(work)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 < MOST_BYTES


@pytest.mark.parametrize("group", range(GROUPS))
def test_damaged_observations_and_results(group: int, demo_output: Path, tmp_path: Path, capsys) -> None:
    calibration = demo_output / "calibration"
    for number in range(group, COUNT * 2 // 5, GROUPS):
        dice = random.Random(number + 2000 * COUNT)
        work = tmp_path / str(number)
        work.mkdir()
        out = work / "out.json"
        if dice.random() < 0.75:
            path = Path(shutil.copy(calibration / "observations.npz", work / "o.npz"))
            argv = ["solve", str(path), "--out", str(out), "--method", dice.choice(["paper", "global", "joint"])]
        else:
            path = Path(shutil.copy(calibration / "result.json", work / "result.json"))
            argv = ["evaluate", str(path), str(demo_output / "recording"), "--out", str(out)]
        what = mutate(path, dice)
        check(argv, work, out, f"{number}: {what}", capsys)
        shutil.rmtree(work)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 < MOST_BYTES
