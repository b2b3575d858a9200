"""Shaft observations: the solver's own input, as arrays in memory and as an .npz file (docs/observations.md)."""

import math
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.errors import FileError, ObservationsError
from rmis_calib.io import _observation_checks as checks
from rmis_calib.io.atomic import atomic_write
from rmis_calib.io.configs import check_regular, did_you_mean
from rmis_calib.io.outputs import OBSERVATIONS_FORMAT, check_file, is_npz_with


@dataclass(frozen=True, eq=False, kw_only=True)
class ShaftObservations:
    """What was seen of the shaft in N motions, and where the kinematics say that it was.

    Image points are normalised and undistorted (x/z, y/z). Given arrays are copied as float64. After construction
    validity and finiteness are one: a row that holds a NaN, or whose motion is not valid in that camera, is NaN
    throughout, and `valid_right` and `valid_left` say in which motions a camera measured anything at all.

    Raises:
        ObservationsError: a shape, dtype or unit that cannot be right, infinity, a rotation that is not one, a
            direction that is not unit, two points of a line that coincide, a sigma that is not positive, or an array
            without another that it needs.
    """

    arm_T_rcm: np.ndarray
    """(N, 4, 4), mm."""
    rcm_v_axis: np.ndarray
    """(N, 3), unit, RCM towards tip."""
    axis_right: np.ndarray | None = None
    """(N, 2, 2): [point (RCM side first), xy] of the axis line. Of axis lines, contours, ends and head points any will
    do, in one camera or two."""
    axis_left: np.ndarray | None = None
    """(N, 2, 2)."""
    camera_left_T_camera_right: np.ndarray | None = None
    """(4, 4), mm; needed by every left array."""
    contour_right: np.ndarray | None = None
    """(N, 2, 2, 2): [edge, point (RCM side first), xy]; needs `shaft_radius_mm`."""
    contour_left: np.ndarray | None = None
    """(N, 2, 2, 2)."""
    shaft_radius_mm: float | None = None
    end_right: np.ndarray | None = None
    """(N, 2): where the shaft ends, on its axis; needs `rcm_s_end_mm`."""
    end_left: np.ndarray | None = None
    """(N, 2)."""
    end_kind_right: np.ndarray | None = None
    """(N,): what the shaft ends at, 0 for the tube's own end, 1 for a ring that closes it; NaN where unknown."""
    end_kind_left: np.ndarray | None = None
    """(N,)."""
    end_sureness_right: np.ndarray | None = None
    """(N,): probability that it ends there, 0 to 1; NaN where that is unknown."""
    end_sureness_left: np.ndarray | None = None
    """(N,)."""
    rcm_s_end_mm: np.ndarray | None = None
    """(N,): nominal distance of the shaft's end from the RCM along the axis, known up to one constant."""
    head_right: np.ndarray | None = None
    """(N, 2): the head point; needs `rcm_p_head`."""
    head_left: np.ndarray | None = None
    """(N, 2)."""
    rcm_p_head: np.ndarray | None = None
    """(N, 3), mm."""
    unknown_names: np.ndarray | None = None
    """(U,) names of constant offsets of the kinematics that can be estimated: a joint's column (`<arm>.<joint>_rad` or
    `_mm`) or `clock_s`, in that unit; `clock_rate`: by how much the joints' clock runs faster than the video's. The
    three arrays come together."""
    unknown_displacement: np.ndarray | None = None
    """(N, U, 6): how a unit of each offset displaces the shaft as a rigid body, in `rcm`: rotation vector, rad, then
    translation, mm. A change dv of `rcm_v_axis` counts as the rotation v x dv, a change ds of `rcm_s_end_mm` as the
    translation v ds."""
    unknown_at: np.ndarray | None = None
    """(U,) offsets at which the kinematics in this file were evaluated."""
    unknown_sigma: np.ndarray | None = None
    """(U,) 1 sigma of each joint's offset about zero, rad or mm; 0: there is none; NaN, or no such array: nobody states
    it."""
    laparoscope_base_T_arm: np.ndarray | None = None
    """(N, 4, 4), mm: forward kinematics of the laparoscope's arm in its own base. With it the set-up, the pose of the
    instrument's base in the laparoscope's, can be an unknown."""
    laparoscope_base_T_instrument_base: np.ndarray | None = None
    """(4, 4), mm: the set-up that `arm_T_rcm` was evaluated at, where somebody states it. Absent beside
    `laparoscope_base_T_arm`: unknown; `arm_T_rcm` is then evaluated at the identity."""
    valid_right: np.ndarray | None = None
    """(N,) bool; after construction always an array."""
    valid_left: np.ndarray | None = None
    """(N,) bool; None where there is no left array."""
    sigma_image: float | None = None
    """One sigma of a point across its line, normalised units."""
    sigma_kinematics_mm: float | None = None
    """Per axis, of `arm_T_rcm`, right perturbation."""
    sigma_kinematics_rad: float | None = None
    sigma_camera_mm: float | None = None
    """Per axis, of the pose that each camera sees."""
    sigma_camera_rad: float | None = None
    sigma_stereo_mm: float | None = None
    """Per axis, of `camera_left_T_camera_right`."""
    sigma_stereo_rad: float | None = None
    sigma_edge_bias: float | None = None
    """Of an error that all pictures of a camera share: each contour point is off across its line by the same amount in
    every motion (lens model, edge detector), normalised units. It does not average out."""
    sigma_readout: float | None = None
    """Of the time from reading a row of the picture to reading the one that is a focal length farther down, s; None or
    0: all rows are read at once."""
    sigma_focal: float | None = None
    """Of each camera's focal length, relative."""
    sigma_centre: float | None = None
    """Of each camera's principal point, per axis, in focal lengths."""
    sigma_lens: float | None = None
    """Of each camera's radial distortion k1."""
    sigma_setup_mm: float | None = None
    """Of the stated set-up, per axis, right perturbation; None: as the settings of the solver say."""
    sigma_setup_rad: float | None = None
    sigma_rcm_mm: float | None = None
    """Of the distance at which the shaft's axis passes the RCM, per axis across it; None: as the settings of the solver
    say."""
    sigma_axis_right: np.ndarray | None = None
    """(N,): one sigma of both points across the line, normalised units; NaN: `sigma_image`. The others likewise."""
    sigma_axis_left: np.ndarray | None = None
    """(N,)."""
    sigma_contour_right: np.ndarray | None = None
    """(N, 2), per edge."""
    sigma_contour_left: np.ndarray | None = None
    """(N, 2)."""
    sigma_end_right: np.ndarray | None = None
    """(N,), along the axis."""
    sigma_end_left: np.ndarray | None = None
    """(N,)."""
    sigma_head_right: np.ndarray | None = None
    """(N,), per coordinate."""
    sigma_head_left: np.ndarray | None = None
    """(N,)."""

    def __post_init__(self) -> None:
        given = {name: getattr(self, name) for name in OBSERVATION_KEYS if getattr(self, name) is not None}
        for name, value in checks.canonical(given).items():
            object.__setattr__(self, name, value)

    @property
    def n_motions(self) -> int:
        """N, valid or not."""
        return len(self.arm_T_rcm)

    @property
    def has_left(self) -> bool:
        """Whether there is any measurement in a left camera."""
        return self.valid_left is not None

    def to_arrays(self) -> dict[str, np.ndarray]:
        """What is present, by the keys of the file; scalars as 0-d arrays."""
        present = {name: getattr(self, name) for name in OBSERVATION_KEYS}
        return {name: np.asarray(value) for name, value in present.items() if value is not None}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any]) -> "ShaftObservations":
        """Observations from arrays, or nested lists, by the keys of the file.

        Raises:
            ObservationsError: a key is unknown or missing, or an array is wrong.
        """
        for name in arrays:
            if name not in OBSERVATION_KEYS:
                found = f"an unknown one{did_you_mean(name, list(OBSERVATION_KEYS))}"
                raise ObservationsError(where=f"key {name!r}", expected="a known key", found=found)
        missing = [name for name in checks.REQUIRED if name not in arrays]
        if missing:
            expected = f"keys {', '.join(checks.REQUIRED)}"
            raise ObservationsError(where="observations", expected=expected, found=f"no {', '.join(missing)}")
        return cls(**{name: checks.plain(name, value) for name, value in arrays.items()})

    @classmethod
    def load(cls, path: str | Path) -> "ShaftObservations":
        """Read an .npz file.

        Raises:
            FileError: the file is absent or unreadable.
            ObservationsError: it is truncated, of another kind, or an array in it is wrong.
        """
        arrays = _read_npz(Path(path))
        arrays.pop("format", None)  # says which program wrote it
        try:
            return cls.from_arrays(arrays)
        except ObservationsError as error:
            raise ObservationsError(str(error), where=str(path)) from error

    def save(self, path: str | Path) -> None:
        """Write an .npz file, whole or not at all; one that this program wrote earlier is replaced.

        Raises:
            OutputError: another file is there, or it cannot be written.
        """
        check_file(Path(path), is_npz_with("format"), overwrite=True)
        arrays = self.to_arrays() | {"format": np.array(OBSERVATIONS_FORMAT)}
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]


_LARGEST_BYTES = 4 << 30
"""Of all arrays of a file: six million motions of everything that can be measured."""
CLOCK, CLOCK_RATE = CLOCKS = checks.CLOCKS
"""Names of the clock's offset and rate among `unknown_names`."""
OBSERVATION_KEYS: tuple[str, ...] = tuple(field.name for field in fields(ShaftObservations))


def _check_sizes(path: Path, archive: zipfile.ZipFile) -> None:
    """Refuse arrays that are larger than any recording, or than their own data, before memory is taken for them.

    Raises:
        ObservationsError: names the array.
    """
    total = 0
    for member in archive.infolist():
        total += member.file_size
        if total > _LARGEST_BYTES:
            expected = f"arrays of {_LARGEST_BYTES / 2**30:g} GB in all at most"
            raise ObservationsError(where=str(path), expected=expected, found=f"more by {member.filename}")
        if not member.filename.endswith(".npy"):
            continue
        with archive.open(member) as data:
            version = np.lib.format.read_magic(data)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(data)
            there = member.file_size - data.tell()
        if not dtype.hasobject and math.prod(shape) * dtype.itemsize != there:
            found = f"{there} bytes for shape {shape} of {dtype}"
            raise ObservationsError(
                where=f"{path}: {member.filename[:-4]}", expected="as many numbers as promised", found=found
            )


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    check_regular(path)
    try:
        with path.open("rb") as file:
            if not zipfile.is_zipfile(file):
                found = "an empty file (0 bytes)" if path.stat().st_size == 0 else "another kind of file, or a cut one"
                raise ObservationsError(where=str(path), expected="a complete .npz archive", found=found)
            file.seek(0)
            with zipfile.ZipFile(file) as archive:
                _check_sizes(path, archive)
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
    except OSError as error:
        raise FileError(where=str(path), expected="a readable .npz archive", found=error.strerror) from error
    except ObservationsError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, NotImplementedError) as error:
        found = f"a damaged one ({' '.join(str(error).split())})"
        raise ObservationsError(where=str(path), expected="a complete .npz archive", found=found) from error
