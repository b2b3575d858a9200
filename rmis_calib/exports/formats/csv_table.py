"""csv: a row a transform, both directions and both cameras, with covariance."""

import csv
import io

from rmis_calib.exports.answer import Answer
from rmis_calib.exports.hand_eye import HandEye, quat_xyzw

_POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_AXES = ("rx", "ry", "rz", "x", "y", "z")
COLUMNS = (
    "transform", "to_frame", "from_frame", "camera_axes", "status", "about", *_POSE,
    *(f"r{i}{j}" for i in range(3) for j in range(3)), *(f"cov_{a}_{b}" for a in _AXES for b in _AXES),
)  # fmt: skip
"""Covariances in rad and m: R = exp(dphi) R^, t = t^ + dt; empty where not known."""


def content(answer: Answer) -> str:
    """The table."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for hand_eye in answer.hand_eyes():
        writer.writerows(_rows(answer, hand_eye))
    return stream.getvalue()


def _rows(answer: Answer, item: HandEye) -> list[list[object]]:
    rows: list[list[object]] = []
    for to_frame, from_frame, matrix, covariance in (
        (item.camera, item.arm, item.camera_T_arm, item.covariance),
        (item.arm, item.camera, item.arm_T_camera, item.arm_covariance),
    ):
        R, t = matrix[:3, :3], matrix[:3, 3]
        known = [""] * 36 if covariance is None else covariance.ravel().tolist()
        named = [f"{to_frame}_T_{from_frame}", to_frame, from_frame, item.axes]
        said = [answer.result.status, "; ".join(answer.about())]
        rows.append([*named, *said, *t.tolist(), *quat_xyzw(R), *R.ravel().tolist(), *known])
    return rows
