"""frame_times.csv and head_points.csv (docs/recording.md)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rmis_calib.errors import RecordingError
from rmis_calib.io._csv import Table, read_table, require_columns, require_increasing

_RIGHT = ("u_right_px", "v_right_px")
_LEFT = ("u_left_px", "v_left_px")


@dataclass(frozen=True, eq=False)
class HeadPoints:
    """Labelled positions of the instrument's head point, for some of the frames."""

    frames: np.ndarray
    """(M,) int, increasing."""
    uv_right: np.ndarray
    """(M, 2) px in the raw right image."""
    uv_left: np.ndarray | None
    """(M, 2) px in the raw left image; None where the file has no left columns."""

    def uv(self, side: str) -> np.ndarray | None:
        """Those in one camera's images: `right` or `left`."""
        return self.uv_left if side == "left" else self.uv_right


def read_frame_times(path: str | Path) -> np.ndarray:
    """Time of each frame, (N,) s.

    Raises:
        FileError: the file is absent or unreadable.
        RecordingError: `frame` is not 0 to N-1, a time is not finite, or time does not increase.
    """
    table = read_table(path)
    require_columns(table, ("frame", "timestamp_s"))
    frames = table.values[:, table.columns.index("frame")]
    bad = frames != np.arange(len(frames))
    if bad.any():
        row = int(bad.argmax())
        expected = f"{row} (0, 1, 2, ...)"
        raise RecordingError(where=table.where(row, "frame"), expected=expected, found=f"{frames[row]:g}")
    return require_increasing(table, "timestamp_s")


def read_head_points(path: str | Path, n_frames: int, image_size: tuple[int, int], stereo: bool) -> HeadPoints | None:
    """Head points of a recording; None for a file that labels no frame.

    Args:
        path: head_points.csv.
        n_frames: frames of the recording.
        image_size: (height, width), px.
        stereo: whether there is a left camera; left columns are refused without.

    Raises:
        FileError: the file is absent or unreadable.
        RecordingError: an unknown or missing column, a frame that does not exist or does not increase, or a position
            that is not finite or further from the image than its own size.
    """
    table = read_table(path, may_be_empty=True)
    has_left = stereo and any(column in _LEFT for column in table.columns)
    require_columns(table, ("frame", *_RIGHT, *(_LEFT if has_left else ())))
    if not len(table.values):
        return None
    frames = require_increasing(table, "frame")
    bad = (frames != np.round(frames)) | (frames < 0) | (frames >= n_frames)
    if bad.any():
        row = int(bad.argmax())
        expected = f"a frame of 0 to {n_frames - 1}"
        raise RecordingError(where=table.where(row, "frame"), expected=expected, found=f"{frames[row]:g}")
    uv_right = _positions(table, _RIGHT, image_size)
    uv_left = _positions(table, _LEFT, image_size) if has_left else None
    return HeadPoints(frames.astype(np.int64), uv_right, uv_left)


def _positions(table: Table, columns: tuple[str, str], image_size: tuple[int, int]) -> np.ndarray:
    height, width = image_size
    uv = table.values[:, [table.columns.index(column) for column in columns]]
    for i, side in enumerate((width, height)):
        # A head outside the picture has a position too, where tracking or simulation knows it.
        bad = (uv[:, i] < -side) | (uv[:, i] > 2 * side)
        if bad.any():
            row = int(bad.argmax())
            expected = f"a position of {-side} to {2 * side} px"
            raise RecordingError(where=table.where(row, columns[i]), expected=expected, found=f"{uv[row, i]:g}")
    return uv
