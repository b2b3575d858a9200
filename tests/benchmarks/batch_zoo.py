"""50 recordings that end in every way, made of four rendered ones; and whether a batch ended them so."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

import data_synth

BASES = {"good": "demo", "mono": "demo", "static": "static", "two": "two_instruments"}
"""Preset of each recording that the zoo is made of."""


def render(root: Path) -> dict[str, Path]:
    """Each base recording once, 24 motions."""
    made = {}
    for name, preset in BASES.items():
        config = replace(data_synth.load_synth_config(preset), motions=24)
        if name == "mono":
            config = replace(config, camera=replace(config.camera, left=None))
        made[name] = root / name
        data_synth.write_recording(made[name], config)
    return made


def zoo(root: Path, bases: dict[str, Path]) -> dict[str, str]:
    """50 recordings below `root`; how each must end."""
    expected = {}

    def copy(base: str, name: str, end: str) -> Path:
        expected[name] = end
        return Path(shutil.copytree(bases[base], root / name))

    for i in range(24):
        copy("good", f"good/case_{i:02d}", "ok")
    for i in range(6):
        copy("mono", f"mono/case_{i}", "*")
    for i in range(4):
        copy("static", f"static/case_{i}", "*")
    for i in range(4):
        copy("two", f"two/case_{i}", "*")
    for i in range(3):
        video = copy("good", f"bad/cut_{i}", "failed: input") / "right.mp4"
        video.write_bytes(video.read_bytes()[: 9000 + i])
    for i in range(2):
        (copy("good", f"bad/hostile_{i}", "failed: input") / "recording.yaml").write_text("a: !!python/name:os.system")
    (copy("good", "bad/no_joints", "failed: input") / "joints.csv").unlink()
    joints = copy("good", "bad/rests", "*") / "joints.csv"
    lines = joints.read_text().splitlines()
    joints.write_text(
        "\n".join([lines[0], *(f"{line.split(',')[0]},{lines[1].partition(',')[2]}" for line in lines[1:])])
    )
    swapped = copy("good", "bad/swapped", "not ok")
    (swapped / "right.mp4").rename(swapped / "x.mp4")
    (swapped / "left.mp4").rename(swapped / "right.mp4")
    (swapped / "x.mp4").rename(swapped / "left.mp4")
    os.symlink("right.mp4", copy("good", "bad/linked", "*") / "again.mp4")
    empty = root / "bad" / "empty"
    empty.mkdir()
    (empty / "recording.yaml").write_text("")
    expected["bad/empty"] = "failed: input"
    (copy("good", "bad/garbage", "failed: input") / "left.mp4").write_bytes(np.random.default_rng(0).bytes(50_000))
    huge(copy("good", "bad/huge", "failed: memory"))
    assert len(expected) == 50, len(expected)
    return expected


def huge(recording: Path) -> None:
    """Pictures that need more memory than a worker may take."""
    import yaml

    side = 14_000
    raw = yaml.safe_load((recording / "stereo.yaml").read_text())
    width, height = raw["image_size"]
    scale = side / width
    raw["image_size"] = [side, round(height * scale)]
    for camera in ("right", "left"):
        for key in ("fx", "fy", "cx", "cy"):
            raw[camera][key] *= scale
    (recording / "stereo.yaml").write_text(yaml.safe_dump(raw))
    picture = np.zeros((round(height * scale), side, 3), np.uint8)
    count = len((recording / "frame_times.csv").read_text().splitlines()) - 1
    text = (recording / "recording.yaml").read_text()
    for eye in ("right", "left"):
        folder = recording / eye
        folder.mkdir()
        cv2.imwrite(str(folder / "0000.png"), picture)
        for i in range(1, count):
            os.link(folder / "0000.png", folder / f"{i:04d}.png")
        text = text.replace(f"{eye}: {eye}.mp4", f"{eye}: {eye}")
    (recording / "recording.yaml").write_text(text)


def check_outcomes(out: Path, expected: dict[str, str]) -> None:
    rows = {row["name"]: row for row in json.loads((out / "summary.json").read_text())["recordings"]}
    wrong = []
    for name, end in expected.items():
        row = rows[name]
        found = f"failed: {row['failure']}" if row["outcome"] == "failed" else row["status"]
        rights = {"*": row["outcome"] == "finished", "not ok": found != "ok"}
        if not rights.get(end, found == end):
            wrong.append(f"{name}: expected {end}, found {found}: {row['message']}")
        if end in ("*", "not ok"):
            print(f"  {name}: {found}: {row['message'][:150]}")
    print(f"outcomes: {len(expected) - len(wrong)} of {len(expected)} as expected")
    print(*wrong, sep="\n")
