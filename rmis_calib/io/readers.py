"""A video, a folder of images or an image as something that decodes frames. Needs no torch."""

from pathlib import Path

from rmis_calib.errors import FileError, VideoError
from rmis_calib.io._eyes import EyeReader
from rmis_calib.io._images import SUFFIXES, ImageReader
from rmis_calib.io._video_file import VideoReader
from rmis_calib.io.configs import check_regular

VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".avi", ".webm", ".mpg", ".mpeg", ".ts", ".mts", ".wmv")
"""Files in which a search takes a video for granted; others are opened when they are named."""
PICTURE_SUFFIXES = SUFFIXES
"""Files that count as pictures."""

Reader = VideoReader | ImageReader | EyeReader
"""What decodes frames: `path`, `count`, `size` (height, width), `times_s`, `notes`, `read_all`, `read`."""


def open_reader(path: str | Path, expected_count: int | None = None) -> VideoReader | ImageReader:
    """Open and count, without decoding more than the first pictures.

    Args:
        path: the file or folder.
        expected_count: frames that a frame_times.csv lists: it outweighs what a video's header promises.

    Raises:
        FileError: nothing is there, or it is a pipe or a device.
        VideoError: it is empty, truncated or not what it seems.
    """
    path = Path(path)
    if not path.exists():
        raise FileError(where=str(path), expected="a video or a folder of images", found="nothing there")
    if not path.is_dir():
        check_regular(path)
    try:
        is_images = path.is_dir() or path.suffix.lower() in PICTURE_SUFFIXES
        return ImageReader(path) if is_images else VideoReader(path, expected_count)
    except PermissionError as error:
        raise VideoError(where=str(path), expected="a readable file", found=error.strerror) from error
