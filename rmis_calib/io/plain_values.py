"""Values as JSON files hold them: arrays are lists, a transform is its frames and rows, and an unknown number is null.

The types are for fields of pydantic models: they read what a file holds and what Python holds, and write plain values.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, ConfigDict, PlainSerializer, PlainValidator, WithJsonSchema

from rmis_calib.geometry.rigid import RigidTransform

FILE_PART = ConfigDict(use_attribute_docstrings=True, populate_by_name=True, extra="ignore")
"""Of a model that is part of a file; keys that another version wrote are passed over."""
_NUMBER = {"type": ["number", "null"]}
_FINITE = {"type": "number"}


def finite_or_none(value: Any) -> Any:
    """Plain JSON values: arrays as lists, numbers that are not finite as None."""
    if isinstance(value, dict):
        return {str(key): finite_or_none(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _listed(value)
    if isinstance(value, (list, tuple)):
        return [finite_or_none(item) for item in value]
    if isinstance(value, np.generic):
        return finite_or_none(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def _listed(array: np.ndarray) -> Any:
    """Nested lists, None for what is not finite; without a Python step for every number."""
    if array.dtype.kind == "O":
        return finite_or_none(array.tolist())
    if array.dtype.kind == "f" and not (finite := np.isfinite(array)).all():
        array = array.astype(object)
        array[~finite] = None
    return array.tolist()


def _floats(value: Any) -> np.ndarray:
    """Numbers as float64, NaN for null."""
    if isinstance(value, list) and set(map(type, value)) <= {float, int, type(None)}:
        return np.array(value, dtype=np.float64)  # the same as below, in a fifth of the time
    try:
        array = np.asarray(value)
    except ValueError:  # ragged rows
        array = np.asarray("")
    if array.dtype.kind not in "fiu" and not (array.dtype.kind == "O" and all(map(_is_number, array.flat))):
        raise ValueError("numbers or null, in rows of one length")
    return array.astype(np.float64)


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))


def _vector(value: Any) -> np.ndarray:
    if (array := _floats(value)).ndim != 1:
        raise ValueError("a list of numbers or null")
    return array


def _square(value: Any) -> np.ndarray:
    array = _floats(value)
    if array.ndim != 2 or array.shape[0] != array.shape[1]:
        raise ValueError("a square matrix: as many rows as columns")
    return array


def _covariance(value: Any) -> np.ndarray:
    if (array := _floats(value)).shape != (6, 6):
        raise ValueError("6 rows of 6 numbers")
    return array


def _of_kind(kinds: str, expected: str) -> PlainValidator:
    def read(value: Any) -> np.ndarray:
        array = np.asarray(value)
        if array.ndim != 1 or (array.size and array.dtype.kind not in kinds):
            raise ValueError(expected)
        return array.astype(bool if kinds == "b" else np.int64)

    return PlainValidator(read)


def _transform(value: Any) -> RigidTransform:
    if isinstance(value, RigidTransform):
        return value
    if not isinstance(value, Mapping):
        raise ValueError("dst, src and matrix of a rigid transform")
    return RigidTransform.from_dict(value)


def _list_of(size: int | None = None, item: Mapping[str, Any] = _NUMBER) -> dict[str, Any]:
    """JSON schema of a list, of that many entries where there is a size."""
    bounds = {} if size is None else {"minItems": size, "maxItems": size}
    return {"type": "array", "items": dict(item), **bounds}


_PLAIN = PlainSerializer(finite_or_none)

Number = Annotated[float | None, BeforeValidator(finite_or_none)]
"""A number; None where it is unknown."""
Vector = Annotated[np.ndarray, PlainValidator(_vector), _PLAIN, WithJsonSchema(_list_of())]
"""(N,) float64, NaN where unknown."""
Square = Annotated[np.ndarray, PlainValidator(_square), _PLAIN, WithJsonSchema(_list_of(item=_list_of()))]
"""(n, n) float64."""
Covariance6 = Annotated[np.ndarray, PlainValidator(_covariance), _PLAIN, WithJsonSchema(_list_of(6, _list_of(6)))]
"""(6, 6) float64."""
Flags = Annotated[
    np.ndarray,
    _of_kind("b", "a list of true and false"),
    _PLAIN,
    WithJsonSchema(_list_of(item={"type": "boolean"})),
]
"""(N,) bool."""
Indices = Annotated[
    np.ndarray,
    _of_kind("iu", "a list of whole numbers"),
    _PLAIN,
    WithJsonSchema(_list_of(item={"type": "integer"})),
]
"""(N,) int64."""
Transform = Annotated[
    RigidTransform,
    PlainValidator(_transform),
    PlainSerializer(RigidTransform.to_dict),
    WithJsonSchema(
        {
            "type": "object",
            "properties": {
                "dst": {"type": "string", "description": "Frame that the transform maps to."},
                "src": {"type": "string", "description": "Frame that the transform maps from."},
                "matrix": _list_of(4, _list_of(4, _FINITE))
                | {"description": "Homogeneous 4x4 matrix, rows; it maps coordinates in src, mm, to dst, mm."},
                "quat_wxyz": _list_of(4, _FINITE)
                | {"description": "The rotation as a unit quaternion w, x, y, z, w >= 0."},
                "translation_mm": _list_of(3, _FINITE) | {"description": "Where the origin of src is, in dst, mm."},
            },
            "required": ["dst", "src", "matrix", "quat_wxyz", "translation_mm"],
        }
    ),
]
"""A rigid transform with its frames, mm."""
Plain = Annotated[dict[str, Any], _PLAIN]
"""Keys with plain values, whatever they are."""
