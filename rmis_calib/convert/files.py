"""Pictures and videos of a source taken into a recording, without decoding them."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path


def take(file: Path, target: Path) -> None:
    """A file under a new name: linked where the disk allows it, so that nothing is copied, else copied."""
    try:
        os.link(file, target)
    except OSError:
        shutil.copyfile(file, target)


def take_pictures(files: Sequence[Path], folder: Path) -> None:
    """Pictures in this order, numbered anew, so that their names sort as they follow each other."""
    folder.mkdir()
    for number, file in enumerate(files):
        take(file, folder / f"{number:06d}{file.suffix.lower()}")
