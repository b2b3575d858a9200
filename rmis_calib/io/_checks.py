"""Checks on arrays that several files share."""

from collections.abc import Callable

import numpy as np

from rmis_calib.errors import InputError

Note = Callable[[str], None]
"""Takes one sentence about what was guessed or mended while a file was read; it ends up in the result."""

# The entries of R^T R may differ from the identity by this much: far above the rounding of a printed matrix of seven
# digits, far below any wrong one.
ORTHONORMAL_TOLERANCE = 1e-6
PRINTED_TOLERANCE = 1e-3
"""The same for a rotation that was printed with four decimals and more: rounding leaves it up to 2e-4 short."""


def check_rigid(matrix: np.ndarray, where: str, error: type[InputError], numbers: np.ndarray | None = None) -> None:
    """Refuse what is not a rigid transform.

    Args:
        matrix: (4, 4) or (N, 4, 4), finite.
        where: file and key, for the message; the number of the first bad item is added to it.
        error: class to raise.
        numbers: (N,), what to call the items; their index by default.

    Raises:
        error: the rotation is not orthonormal or a reflection, or the last row is not 0 0 0 1.
    """
    items = matrix.reshape(-1, 4, 4)
    R = items[:, :3, :3]
    deviation = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2), initial=0.0)
    orthonormal = f"an orthonormal rotation (R^T R = I within {ORTHONORMAL_TOLERANCE:g})"
    checks = (
        (deviation > ORTHONORMAL_TOLERANCE, orthonormal, lambda i: f"a deviation of {deviation[i]:.3g}"),
        (np.linalg.det(R) < 0, "a rotation (determinant +1)", lambda i: "a reflection (determinant -1)"),
        ((items[:, 3] != [0, 0, 0, 1]).any(axis=1), "a last row of 0, 0, 0, 1", lambda i: items[i, 3].tolist()),
    )
    for bad, expected, found in checks:
        if bad.any():
            i = int(bad.argmax())
            place = where if matrix.ndim == 2 else f"{where}[{i if numbers is None else numbers[i]}]"
            raise error(where=place, expected=expected, found=found(i))


def rigid_from_text(rows: list[list[float]], where: str, error: type[InputError], note: Note) -> np.ndarray:
    """A rigid transform (4, 4) as people print it: a rotation of 4 to 6 decimals is made orthonormal, with a note.

    Raises:
        error: it is no rigid transform even so.
    """
    matrix = np.array(rows, dtype=np.float64)
    R = matrix[:3, :3]
    deviation = float(np.abs(R.T @ R - np.eye(3)).max())
    if deviation <= PRINTED_TOLERANCE and np.linalg.det(R) > 0:
        left, _, right = np.linalg.svd(R)
        matrix[:3, :3] = left @ right
        if deviation > ORTHONORMAL_TOLERANCE:
            note(f"{where}: the rotation was printed with few digits (off by {deviation:.1g}) and made orthonormal")
    check_rigid(matrix, where, error)
    return matrix


def no_note(sentence: str) -> None:
    """The note-taker of callers who do not want one."""
