"""Rendered recordings whose files say something wrong that no format can tell: what users bring.

Each is a recording of the simulation (`data_synth`), rendered, in which one thing was then changed; nobody states how
well the arms' bases or the RCM are known. The truth is in its reference.yaml.
"""

import csv
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from data_synth import load_synth_config, write_recording
from data_synth.presets import config_to_dict
from data_synth.settings import SynthConfig

Yaml = dict[str, Any]
STILL = {"motion": {"laparoscope": "unlogged"}}
MONO_STILL = STILL | {"camera": {"left": None}}
SMOOTH = {"kind": "smooth", "speed": 3.0, "joint_rate_hz": 100.0}
BUMP_DEG, STRETCH, BASE_OFF_MM = 3.0, 1.03, (4.0, -3.0, 3.0)


@dataclass(frozen=True)
class Broken:
    """What is rendered, beside the demo's settings, and what is changed in the files then."""

    rendered: Yaml = field(default_factory=dict)
    change: Callable[[Path], None] = lambda folder: None


def edited(path: Path, change: Callable[[Yaml], None]) -> None:
    content = yaml.safe_load(path.read_text())
    change(content)
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def each_camera(change: Callable[[Yaml], None]) -> Callable[[Path], None]:
    def change_all(content: Yaml) -> None:
        for side in ("right", "left"):
            if side in content:
                change(content[side])

    return lambda folder: edited(folder / "stereo.yaml", change_all)


def of_a_larger_picture(camera: Yaml) -> None:
    for key in ("fx", "fy", "cx", "cy"):
        camera[key] *= 1.125


def of_a_picture_before_its_crop(camera: Yaml) -> None:
    camera["cx"] += 60.0
    camera["cy"] += 40.0


def without_lens(camera: Yaml) -> None:
    camera["distortion"] = [0.0] * 5


def frame_times_stretched(folder: Path) -> None:
    with (folder / "frame_times.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    with (folder / "frame_times.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, *((i, repr(STRETCH * float(t))) for i, t in rows)])


def base_of_the_laparoscope_off(folder: Path) -> None:
    def change(robot: Yaml) -> None:
        for row, off_mm in zip(robot["arms"]["laparoscope"]["base_T_arm_base"], BASE_OFF_MM, strict=False):
            row[3] += off_mm

    edited(folder / "robot.yaml", change)


def bumped_half_way(folder: Path) -> None:
    """The camera turns about its own centre, which is a homography of the picture; the second half shows that."""
    camera = yaml.safe_load((folder / "stereo.yaml").read_text())["right"]
    K = np.array([[camera["fx"], 0.0, camera["cx"]], [0.0, camera["fy"], camera["cy"]], [0.0, 0.0, 1.0]])
    turn, _ = cv2.Rodrigues(np.deg2rad(BUMP_DEG) * np.array([0.6, 0.8, 0.0]))
    files = sorted((folder / "right").iterdir())
    for path in files[len(files) // 2 :]:
        picture = np.asarray(cv2.imread(str(path)))
        warped = cv2.warpPerspective(
            picture, K @ turn @ np.linalg.inv(K), picture.shape[1::-1], borderMode=cv2.BORDER_REPLICATE
        )
        cv2.imwrite(str(path), warped)


BROKEN: dict[str, Broken] = {
    "nothing wrong": Broken(),
    "nothing wrong, still": Broken(STILL),
    "intrinsics x 1.125, still": Broken(STILL, each_camera(of_a_larger_picture)),
    "crop not told, still": Broken(STILL, each_camera(of_a_picture_before_its_crop)),
    "lens ignored, mono, still": Broken(MONO_STILL, each_camera(without_lens)),
    "camera bumped, mono, still": Broken(
        {
            "motion": {"laparoscope": "unlogged"},
            "output": {"pictures": "images"},
            "camera": {"left": None, "right": {"distortion": (0.0,) * 5}},
        },
        bumped_half_way,
    ),
    "frame rate 3 % off": Broken({"motions": 90, "motion": SMOOTH}, frame_times_stretched),
    "joint offsets, clock 0.18 s": Broken(
        {
            "motions": 90,
            "motion": SMOOTH,
            "noise": {"joint_offset_deg": 0.35, "joint_offset_mm": 0.3, "clock_offset_s": 0.18},
        }
    ),
    "laparoscope base 4, -3, 3 mm off": Broken({}, base_of_the_laparoscope_off),
}


def without_sigmas(robot: Yaml) -> None:
    for key in [key for key in robot if "_sigma_" in key]:
        del robot[key]


def merged(settings: Yaml, changes: Yaml) -> Yaml:
    return settings | {
        key: merged(settings[key], value) if isinstance(value, dict) and isinstance(settings.get(key), dict) else value
        for key, value in changes.items()
    }


def write_broken(name: str, parent: Path, seed: int) -> Path:
    """The recording of this name, with its reference."""
    broken = BROKEN[name]
    folder = write_rendered(parent / name.replace(" ", "_"), broken.rendered, seed)
    broken.change(folder)
    return folder


def write_rendered(folder: Path, settings: Yaml, seed: int) -> Path:
    """A recording of the demo's settings with some changed, and its reference."""
    settings = merged(config_to_dict(load_synth_config("demo")), settings | {"seed": seed})
    write_recording(folder, SynthConfig(**settings))
    truth = yaml.safe_load((folder / "ground_truth.yaml").read_text())["camera_right_T_arm"]
    reference = {"camera_right_T_arm": truth, "sigma_deg": 0.0, "sigma_mm": 0.0}
    (folder / "reference.yaml").write_text(yaml.safe_dump(reference))
    edited(folder / "robot.yaml", without_sigmas)
    return folder
