"""Checks of shaft observations, and their canonical form: rows that do not count are NaN."""

from collections.abc import Callable
from typing import Any

import numpy as np

from rmis_calib.errors import ObservationsError
from rmis_calib.io._checks import check_rigid
from rmis_calib.io._schemas import METRES

REQUIRED = ("arm_T_rcm", "rcm_v_axis")
_SIDES = ("right", "left")
_MEASURED = {"axis": (2, 2), "contour": (2, 2, 2), "end": (2,), "head": (2,)}
_SIGMA = {"axis": (), "contour": (2,), "end": (), "head": ()}
# Shapes after the first axis, the motions.
_SHAPES: dict[str, tuple[int, ...]] = {
    "arm_T_rcm": (4, 4),
    "rcm_v_axis": (3,),
    "rcm_s_end_mm": (),
    "rcm_p_head": (3,),
    "laparoscope_base_T_arm": (4, 4),
    **{f"{kind}_{side}": shape for kind, shape in _MEASURED.items() for side in _SIDES},
    **{f"sigma_{kind}_{side}": shape for kind, shape in _SIGMA.items() for side in _SIDES},
    **{f"end_{what}_{side}": () for what in ("kind", "sureness") for side in _SIDES},
}
_END_KINDS = (0, 1)
"""A tube's end and a ring."""
_LEVELS = tuple(f"sigma_{what}_{unit}" for what in ("kinematics", "camera", "stereo") for unit in ("mm", "rad"))
_INTRINSICS = ("sigma_focal", "sigma_centre", "sigma_lens")
_SETUP = ("sigma_setup_mm", "sigma_setup_rad")
_SCALARS = (
    "shaft_radius_mm",
    "sigma_image",
    "sigma_edge_bias",
    *_INTRINSICS,
    *_LEVELS,
    *_SETUP,
    "sigma_rcm_mm",
    "sigma_readout",
)
_NEEDS = {"contour": "shaft_radius_mm", "end": "rcm_s_end_mm", "head": "rcm_p_head"}
# Rounding of single precision stays below; a direction that was never normalised does not.
_UNIT_TOLERANCE = 1e-6
# An image coordinate of 10 is 84 degrees off axis. Points on a line may be far out, so the median decides.
_MAX_MEDIAN_COORDINATE = 10.0
_RADIUS_MM = (0.5, 15.0)
# No detector is off by a twentieth of the focal length (50 px at 1000), and no robot by 4.6 degrees a motion.
_MAX_SIGMA_IMAGE, _MAX_SIGMA_RAD = 0.05, 0.08
_MAX_SETUP_RAD = 1.0
"""Of a set-up that is hardly known."""
UNKNOWNS = ("unknown_names", "unknown_displacement", "unknown_at")
CLOCK, CLOCK_RATE = CLOCKS = ("clock_s", "clock_rate")
"""Names of the clock's offset and rate among `unknown_names`."""
# A second of clock, a radian or a millimetre of a joint: none turns the shaft by more than a turn or moves it by 10 m.
_MAX_TURN_RAD, _MAX_SHIFT_MM = 6.3, 1e4

Arrays = dict[str, Any]


def canonical(given: Arrays) -> Arrays:
    """Checked copies of what is given, with `valid_right` (and `valid_left` where there is a left array) filled in.

    Raises:
        ObservationsError: see `ShaftObservations`.
    """
    n = _motions(given)
    _check_needs(given)
    arrays = {name: _array(name, given[name], n) for name in _SHAPES if name in given}
    scalars = {name: _scalar(name, given[name]) for name in _SCALARS if name in given}
    if "camera_left_T_camera_right" in given:
        arrays["camera_left_T_camera_right"] = _extrinsics(given)
    known = _finite(arrays["arm_T_rcm"]) & _finite(arrays["rcm_v_axis"])
    if "laparoscope_base_T_arm" in arrays:
        known &= _finite(arrays["laparoscope_base_T_arm"])
    if "laparoscope_base_T_instrument_base" in given:
        arrays["laparoscope_base_T_instrument_base"] = _pose(given, "laparoscope_base_T_instrument_base")
    for side in _SIDES:
        if side == "right" or any(f"{kind}_{side}" in arrays for kind in _MEASURED):
            valid = _flags(f"valid_{side}", given.get(f"valid_{side}"), n) & known
            arrays[f"valid_{side}"] = _mask_side(arrays, side, valid)
    arrays |= _unknowns(given, n)
    _check_kinematics(arrays)
    for side in _SIDES:
        _check_image(arrays, side)
    return arrays | scalars


def plain(name: str, value: Any) -> Any:
    """An array, or a number for a key that is one.

    Raises:
        ObservationsError: ragged lists, or not one number for a key that is one.
    """
    return _scalar(name, value) if name in _SCALARS else _as_array(name, value)


def _motions(given: Arrays) -> int:
    shape = np.shape(given["arm_T_rcm"])
    if len(shape) != 3 or shape[0] < 1:
        raise ObservationsError(where="arm_T_rcm", expected="shape (N, 4, 4) with N > 0", found=shape)
    return shape[0]


def _check_needs(given: Arrays) -> None:
    """An array that is of no use without another."""
    has_left = any(f"{kind}_left" in given for kind in _MEASURED)
    if not has_left and not any(f"{kind}_right" in given for kind in _MEASURED):
        expected = f"something measured in a picture: any of {', '.join(_MEASURED)}, with _right or _left"
        raise ObservationsError(where="observations", expected=expected, found="none")
    for side in _SIDES:
        for kind in _MEASURED:
            if f"{kind}_{side}" in given and kind in _NEEDS:
                _need(given, f"{kind}_{side}", _NEEDS[kind])
            if f"sigma_{kind}_{side}" in given:
                _need(given, f"sigma_{kind}_{side}", f"{kind}_{side}")
        for what in ("kind", "sureness"):
            if f"end_{what}_{side}" in given:
                _need(given, f"end_{what}_{side}", f"end_{side}")
    for name in ("laparoscope_base_T_instrument_base", *_SETUP):
        if name in given:
            _need(given, name, "laparoscope_base_T_arm")
    if has_left:
        _need(given, "a left array", "camera_left_T_camera_right")
    elif "valid_left" in given:
        raise ObservationsError(where="valid_left", expected="an array measured in the left image", found="none")


def _need(given: Arrays, name: str, other: str) -> None:
    if other not in given:
        raise ObservationsError(where=name, expected=f"{other} beside it", found="none")


def _as_array(name: str, value: Any) -> np.ndarray:
    try:
        return np.asarray(value)
    except ValueError as error:
        raise ObservationsError(where=name, expected="an array of numbers", found="ragged nested lists") from error


def _numbers(name: str, value: Any) -> np.ndarray:
    """A float64 copy.

    Raises:
        ObservationsError: not real numbers, or infinity.
    """
    array = _as_array(name, value)
    if array.dtype.kind not in "fiu":
        raise ObservationsError(where=name, expected="real numbers", found=f"dtype {array.dtype}")
    array = array.astype(np.float64)
    if np.isinf(array).any():
        found = f"infinity at {np.argwhere(np.isinf(array))[0].tolist()}"
        raise ObservationsError(where=name, expected="finite numbers, or NaN for what is not valid", found=found)
    return array


def _array(name: str, value: Any, n: int) -> np.ndarray:
    array, shape = _numbers(name, value), (n, *_SHAPES[name])
    if array.shape != shape:
        raise ObservationsError(where=name, expected=f"shape {shape}", found=array.shape)
    if name.startswith("sigma_"):
        bad = ~np.isnan(array) & (array <= 0)
        if bad.any():
            found = f"{array[bad][0]:g} at {np.argwhere(bad)[0].tolist()}"
            raise ObservationsError(where=name, expected="positive numbers, or NaN for sigma_image", found=found)
        if np.isfinite(array).any():
            _check_sigma(name, float(np.nanmedian(array)))
        return array
    array[~_finite(array)] = np.nan
    if name.startswith("end_kind"):
        _refuse(name, ~np.isnan(array) & ~np.isin(array, _END_KINDS), "0 (tube) or 1 (ring)", lambda i: f"{array[i]:g}")
    if name.startswith("end_sureness"):
        _refuse(name, (array < 0) | (array > 1), "a probability", lambda i: f"{array[i]:g}")
    return array


def _check_sigma(name: str, sigma: float) -> None:
    """Refuse a sigma whose size says that it is in pixels or degrees."""
    most_rad = _MAX_SETUP_RAD if name in _SETUP else _MAX_SIGMA_RAD
    if name.endswith("_rad") and sigma > most_rad:
        hint, expected = "looks like degrees; multiply by pi / 180", f"at most {most_rad} rad"
    elif not name.endswith(("_rad", "_mm", "_focal", "_lens")) and sigma > _MAX_SIGMA_IMAGE:
        hint, expected = "looks like pixels; divide by the focal length", f"at most {_MAX_SIGMA_IMAGE} focal lengths"
    else:
        return
    raise ObservationsError(hint, where=name, expected=expected, found=f"{sigma:g}")


def _scalar(name: str, value: Any) -> float:
    array = _numbers(name, value)
    if array.size != 1 or not np.isfinite(array).all():
        found = f"shape {array.shape}" if array.size != 1 else "NaN"
        raise ObservationsError(where=name, expected="one finite number", found=found)
    number = float(array.item())
    if name == "shaft_radius_mm" and not _RADIUS_MM[0] <= number <= _RADIUS_MM[1]:
        hint = METRES if 0 < number < _RADIUS_MM[0] else ""
        expected = f"a radius of {_RADIUS_MM[0]} to {_RADIUS_MM[1]} mm"
        raise ObservationsError(hint, where=name, expected=expected, found=f"{number:g}")
    # A point without any error has infinite weight; kinematics without error are a thing to assume.
    if number < 0 or (name == "sigma_image" and number == 0):
        expected = "a positive number" if name == "sigma_image" else "zero or a positive number"
        raise ObservationsError(where=name, expected=expected, found=f"{number:g}")
    if name.startswith("sigma_"):
        _check_sigma(name, number)
    return number


def _pose(given: Arrays, name: str) -> np.ndarray:
    """One rigid transform."""
    array = _numbers(name, given[name])
    if array.shape != (4, 4) or np.isnan(array).any():
        found = array.shape if array.shape != (4, 4) else "NaN"
        raise ObservationsError(where=name, expected="16 finite numbers of shape (4, 4)", found=found)
    check_rigid(array, name, ObservationsError)
    return array


def _extrinsics(given: Arrays) -> np.ndarray:
    name = "camera_left_T_camera_right"
    array = _pose(given, name)
    baseline_mm = float(np.linalg.norm(array[:3, 3]))
    if 0 < baseline_mm < 0.1:
        raise ObservationsError(METRES, where=name, expected="a baseline in mm", found=f"{baseline_mm:g}")
    return array


def _unknowns(given: Arrays, n: int) -> Arrays:
    """The three arrays about offsets of joints and clock, or none; and their sigmas, where these are given."""
    present = [name for name in (*UNKNOWNS, "unknown_sigma") if name in given]
    if not present:
        return {}
    for other in UNKNOWNS:
        _need(given, present[0], other)
    names = _as_array("unknown_names", given["unknown_names"])
    if names.ndim != 1 or names.dtype.kind != "U" or len(names) == 0 or len(set(names.tolist())) < len(names):
        found = f"shape {names.shape}, dtype {names.dtype}"
        raise ObservationsError(where="unknown_names", expected="different names in one row", found=found)
    for name in names.tolist():
        if name not in CLOCKS and not name.endswith(("_rad", "_mm")):
            expected = f"{CLOCK}, {CLOCK_RATE}, or a joint's name that ends in its unit, _rad or _mm"
            raise ObservationsError(where="unknown_names", expected=expected, found=repr(name))
    out: Arrays = {"unknown_names": names.copy()}
    for name, shape in (("unknown_displacement", (n, len(names), 6)), ("unknown_at", (len(names),))):
        array = _numbers(name, given[name])
        if array.shape != shape or np.isnan(array).any():
            found = array.shape if array.shape != shape else "NaN"
            raise ObservationsError(where=name, expected=f"finite numbers of shape {shape}", found=found)
        out[name] = array
    if "unknown_sigma" in given:
        array = _numbers("unknown_sigma", given["unknown_sigma"])
        if array.shape != (len(names),) or bool((array < 0).any()):
            found = array.shape if array.shape != (len(names),) else f"{np.nanmin(array):g}"
            expected = f"numbers of shape {(len(names),)}, not negative (NaN: not known)"
            raise ObservationsError(where="unknown_sigma", expected=expected, found=found)
        out["unknown_sigma"] = array
    size = np.abs(out["unknown_displacement"][:, names != CLOCK_RATE])  # the unit of a rate is the whole recording
    turn, shift = (float(part.max(initial=0.0)) for part in (size[..., :3], size[..., 3:]))
    if turn > _MAX_TURN_RAD or shift > _MAX_SHIFT_MM:
        found = f"{turn:.3g} and {shift:.3g}"
        expected = f"at most {_MAX_TURN_RAD} rad and {_MAX_SHIFT_MM:g} mm a unit (rotation first)"
        raise ObservationsError(where="unknown_displacement", expected=expected, found=found)
    return out


def _flags(name: str, value: Any, n: int) -> np.ndarray:
    if value is None:
        return np.ones(n, dtype=bool)
    array = np.asarray(value)
    if array.shape != (n,):
        raise ObservationsError(where=name, expected=f"shape {(n,)}", found=array.shape)
    if array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
        raise ObservationsError(where=name, expected="true or false", found=f"dtype {array.dtype} with other values")
    return array.astype(bool)


def _finite(array: np.ndarray) -> np.ndarray:
    """(N,): rows without a NaN (nothing is infinite). A sum along the row: ten times faster than `isfinite.all`."""
    flat = array.reshape(len(array), -1)
    return ~np.isnan(flat @ np.ones(flat.shape[1]))


def _mask_side(arrays: Arrays, side: str, valid: np.ndarray) -> np.ndarray:
    """Blank what does not count in one image; returns where anything is left."""
    measured = np.zeros_like(valid)
    for kind in _MEASURED:
        name = f"{kind}_{side}"
        if name not in arrays:
            continue
        counts = valid & _finite(arrays[name])
        if kind in ("end", "head"):
            counts &= _finite(arrays[_NEEDS[kind]])
        arrays[name][~counts] = np.nan
        measured |= counts
    return measured


def _check_kinematics(arrays: Arrays) -> None:
    T, v = arrays["arm_T_rcm"], arrays["rcm_v_axis"]
    for name in ("arm_T_rcm", "laparoscope_base_T_arm"):
        if name in arrays:
            known = np.flatnonzero(_finite(arrays[name]))
            check_rigid(arrays[name][known], name, ObservationsError, known)
    norm = np.linalg.norm(v, axis=1)
    _refuse("rcm_v_axis", np.abs(norm - 1) > _UNIT_TOLERANCE, "a unit vector", lambda i: f"length {norm[i]:.6g}")
    lengths = {"arm_T_rcm": T[:, :3, 3]} | {key: arrays[key] for key in ("rcm_p_head", "rcm_s_end_mm") if key in arrays}
    for name, values in lengths.items():
        largest = np.nanmax(np.abs(values), initial=0.0)
        if 0 < largest < 1.0:
            found = f"nothing above {largest:.3g}"
            raise ObservationsError(METRES, where=name, expected="lengths in mm", found=found)


def _check_image(arrays: Arrays, side: str) -> None:
    for kind in _MEASURED:
        name, array = f"{kind}_{side}", arrays.get(f"{kind}_{side}")
        if array is None:
            continue
        seen = np.abs(array[np.isfinite(array)])
        if len(seen) and np.median(seen) > _MAX_MEDIAN_COORDINATE:
            found = f"a median of {np.median(seen):.4g}"
            raise ObservationsError("looks like pixels", where=name, expected="normalised x/z, y/z", found=found)
        if kind in ("axis", "contour"):
            points = array.reshape(len(array), -1, 2, 2)
            same = (points[:, :, 0] == points[:, :, 1]).all(axis=-1).any(axis=-1)
            _refuse(name, same, "two points that differ", lambda i, p=points: f"{p[i, 0, 0].tolist()} twice")
        if kind == "contour":
            same = (array[:, 0] == array[:, 1]).all(axis=(1, 2))
            _refuse(name, same, "two edges that differ", lambda i: "one edge twice")


def _refuse(name: str, bad: np.ndarray, expected: str, found: Callable[[int], str]) -> None:
    if bad.any():
        i = int(bad.argmax())
        raise ObservationsError(where=f"{name}[{i}]", expected=expected, found=found(i))
