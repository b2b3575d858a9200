"""Changes of cameras: their pictures, what stereo.yaml says of them, and the true answer along with it."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import yaml

from tests.benchmarks.broken_recordings import Yaml, edited
from tests.benchmarks.changes import images
from tests.benchmarks.changes.files import (
    column,
    eyes,
    pictures,
    pictures_of,
    stated,
    truth,
    without_labels,
)

MIRROR_X, MIRROR_Y, HALF_TURN = (np.diag((*signs, 1.0)) for signs in ((-1.0, 1, 1), (1.0, -1, 1), (-1.0, -1, 1)))
LENS = (-0.2, 0.05, 0.0, 0.0, 0.0)


def scaled_camera(scale: float) -> Callable[[Yaml], None]:
    def change(camera: Yaml) -> None:
        camera.update(fx=camera["fx"] * scale, fy=camera["fy"] * scale)
        camera.update(cx=(camera["cx"] + 0.5) * scale - 0.5, cy=(camera["cy"] + 0.5) * scale - 0.5)

    return change


def crop_told_in(name: str) -> Callable[[Path], None]:
    """Cut pictures, told by the principal point (stereo.yaml) or by the part that is left (recording.yaml)."""

    def apply(folder: Path) -> None:
        rows, columns = images.cut(np.asarray(cv2.imread(str(pictures_of(folder, "right")[0]))))
        whole = yaml.safe_load((folder / "stereo.yaml").read_text())["image_size"]

        def moved(camera: Yaml) -> None:
            camera.update(cx=camera["cx"] - columns.start, cy=camera["cy"] - rows.start)

        part = [columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start]
        pictures(lambda picture, _: picture[images.cut(picture)], moved if name == "stereo.yaml" else None)(folder)
        if name == "recording.yaml":
            stated(name, **{f"crop_{side}": part for side in eyes(folder)})(folder)
            stated("stereo.yaml", image_size=whole)(folder)

    return apply


def lens(undo: bool) -> Callable[[Path], None]:
    """Pictures undistorted (`undo`), or taken by a lens; stereo.yaml says it."""

    def apply(folder: Path) -> None:
        cameras = yaml.safe_load((folder / "stereo.yaml").read_text())
        for side in eyes(folder):
            camera = cameras[side]
            distortion = camera["distortion"] if undo else LENS
            for path in pictures_of(folder, side):
                picture = images.with_lens(np.asarray(cv2.imread(str(path))), camera, tuple(distortion), undo)
                path.unlink()
                cv2.imwrite(str(path.with_suffix(".png")), picture)
            camera["distortion"] = [0.0] * 5 if undo else list(LENS)
        (folder / "stereo.yaml").write_text(yaml.safe_dump(cameras))

    return apply


def framed(folder: Path) -> None:
    """Black borders at the left and at the right (a 4:3 picture on a 16:9 screen); the principal point moves along."""
    side = np.asarray(cv2.imread(str(pictures_of(folder, "right")[0]))).shape[1] // 8
    pictures(images.bordered, lambda camera: camera.update(cx=camera["cx"] + side))(folder)


def mirrored_world(folder: Path) -> None:
    """Everything as in a mirror, the robot and the left eye too: joints turn the other way, and what was the left
    camera stands at the right."""
    width = yaml.safe_load((folder / "stereo.yaml").read_text())["image_size"][0]

    def robot(content: Yaml) -> None:
        for arm in content["arms"].values():
            for key in ("base_T_arm_base", "end_T_tool"):
                if key in arm:
                    arm[key] = (MIRROR_Y @ np.array(arm[key]) @ MIRROR_Y).tolist()
            for joint in arm["joints"]:
                joint["alpha_rad"] *= -1
                joint["theta_rad"] *= -1
                joint["offset"] *= -1 if joint["type"] == "revolute" else 1
            if "head_point" in arm:
                arm["head_point"]["xyz_mm"][1] *= -1

    def camera(entry: Yaml) -> None:
        k1, k2, p1, p2, k3 = entry["distortion"]
        entry.update(cx=width - 1 - entry["cx"], distortion=[k1, k2, p1, -p2, k3])

    pictures(lambda picture, _: picture[:, ::-1].copy(), camera)(folder)
    edited(folder / "robot.yaml", robot)
    column("_rad", np.negative)(folder)
    truth(lambda T: MIRROR_X @ T @ MIRROR_Y)(folder)
    without_labels(folder)
    if "left" in eyes(folder):
        between_cameras(folder, lambda T: MIRROR_X @ T @ MIRROR_X)
        roles_exchanged(folder)


def turned_half(folder: Path) -> None:
    """The camera upside down; the eyes change sides with it."""
    width, height = yaml.safe_load((folder / "stereo.yaml").read_text())["image_size"]

    def camera(entry: Yaml) -> None:
        k1, k2, p1, p2, k3 = entry["distortion"]
        entry.update(cx=width - 1 - entry["cx"], cy=height - 1 - entry["cy"], distortion=[k1, k2, -p1, -p2, k3])

    pictures(lambda picture, _: picture[::-1, ::-1].copy(), camera)(folder)
    truth(lambda T: HALF_TURN @ T)(folder)
    without_labels(folder)
    if "left" in eyes(folder):
        between_cameras(folder, lambda T: HALF_TURN @ T @ HALF_TURN)
        roles_exchanged(folder)


def between_cameras(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    def apply(stereo: Yaml) -> None:
        stereo["camera_left_T_camera_right"] = change(np.array(stereo["camera_left_T_camera_right"])).tolist()

    edited(folder / "stereo.yaml", apply)


def pictures_exchanged(folder: Path) -> None:
    (folder / "left").rename(folder / "other")
    (folder / "right").rename(folder / "left")
    (folder / "other").rename(folder / "right")


def roles_exchanged(folder: Path) -> None:
    """What was the left camera is called right, in all files."""
    T = np.array(yaml.safe_load((folder / "stereo.yaml").read_text())["camera_left_T_camera_right"])
    edited(folder / "stereo.yaml", lambda content: content.update(right=content["left"], left=content["right"]))
    between_cameras(folder, np.linalg.inv)
    pictures_exchanged(folder)
    truth(lambda X: T @ X)(folder)
    without_labels(folder)


def without_left(stereo: Yaml) -> None:
    del stereo["left"], stereo["camera_left_T_camera_right"]


def one_eye(side: str) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        if side == "left":
            roles_exchanged(folder)
        without_labels(folder)
        edited(folder / "recording.yaml", lambda content: content.pop("left"))
        edited(folder / "stereo.yaml", without_left)
        for path in pictures_of(folder, "left"):
            path.unlink()
        (folder / "left").rmdir()

    return apply


def mirrored_untold(folder: Path) -> None:
    pictures(lambda picture, _: picture[:, ::-1].copy())(folder)
