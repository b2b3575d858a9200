"""Reading and changing the files of a recording folder."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests.benchmarks.broken_recordings import Yaml, each_camera, edited
from tests.benchmarks.changes.images import Picture, PictureChange


def eyes(folder: Path) -> list[str]:
    return [side for side in ("right", "left") if (folder / side).is_dir()]


def pictures_of(folder: Path, side: str) -> list[Path]:
    return sorted((folder / side).iterdir())


def read_table(path: Path) -> tuple[list[str], np.ndarray]:
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    return header, np.array(rows, dtype=float)


def write_table(path: Path, header: list[str], rows: np.ndarray) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *([f"{value:.12g}" for value in row] for row in rows)])


def joints(change: Callable[[list[str], np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Changes the rows of joints.csv, given their columns' names."""

    def apply(folder: Path) -> None:
        header, rows = read_table(folder / "joints.csv")
        write_table(folder / "joints.csv", header, change(header, rows))

    return apply


def column(words: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Changes the columns of joints.csv that have these words in their names."""

    def apply(header: list[str], rows: np.ndarray) -> np.ndarray:
        for i, name in enumerate(header):
            if words in name:
                rows[:, i] = change(rows[:, i])
        return rows

    return joints(apply)


def times(change: Callable[[np.ndarray], np.ndarray], of: tuple[str, ...] = ("frame_times.csv",)) -> Callable:
    def apply(folder: Path) -> None:
        for name in of:
            header, rows = read_table(folder / name)
            i = header.index("timestamp_s")
            rows[:, i] = change(rows[:, i])
            write_table(folder / name, header, rows[np.argsort(rows[:, i], kind="stable")])

    return apply


def pictures(change: PictureChange, told: Callable[[Yaml], Any] | None = None) -> Callable[[Path], None]:
    """Changes every picture (stored without loss), and with `told` every camera's entry in stereo.yaml."""

    def apply(folder: Path) -> None:
        generator = np.random.default_rng(0)
        size = (0, 0)
        for side in eyes(folder):
            for path in pictures_of(folder, side):
                picture = change(np.asarray(cv2.imread(str(path))), generator)
                size = picture.shape[1::-1]
                path.unlink()
                cv2.imwrite(str(path.with_suffix(".png")), picture)
        if told is not None:
            each_camera(told)(folder)
        edited(folder / "stereo.yaml", lambda stereo: stereo.update(image_size=list(size)))

    return apply


def some_pictures(change: Callable[[list[Picture], int], Picture]) -> Callable[[Path], None]:
    """Replaces every tenth picture by a function of all pictures and its number."""

    def apply(folder: Path) -> None:
        for side in eyes(folder):
            paths = pictures_of(folder, side)
            seen = [np.asarray(cv2.imread(str(path))) for path in paths]
            for i in range(5, len(paths), 10):
                cv2.imwrite(str(paths[i]), change(seen, i))

    return apply


def truth(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def apply(reference: Yaml) -> None:
        for key, value in reference.items():
            if np.shape(value) == (4, 4):
                reference[key] = change(np.array(value)).tolist()

    return lambda folder: edited(folder / "reference.yaml", apply)


def stated(name: str, **values: Any) -> Callable[[Path], None]:
    return lambda folder: edited(folder / name, lambda content: content.update(values))


def without_labels(folder: Path) -> None:
    """Labels would have to be moved along; they are for evaluation only."""
    (folder / "head_points.csv").unlink(missing_ok=True)
