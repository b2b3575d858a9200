"""opencv-json, opencv-yaml: OpenCV FileStorage, both directions, 4x4 rows in metres, with covariance."""

import cv2
import numpy as np

from rmis_calib.exports.answer import Answer
from rmis_calib.exports.hand_eye import about_frames


def json_content(answer: Answer) -> str:
    """JSON that OpenCV and every other JSON reader takes."""
    return _content(answer, cv2.FILE_STORAGE_FORMAT_JSON)


def yaml_content(answer: Answer) -> str:
    """YAML with OpenCV's matrix tags."""
    return _content(answer, cv2.FILE_STORAGE_FORMAT_YAML)


def _content(answer: Answer, storage_format: int) -> str:
    flags = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | storage_format
    storage = cv2.FileStorage("in memory", flags)
    first = answer.hand_eyes()[0]
    # A key, not a comment: JSON has no comments.
    storage.write("about", "; ".join([*answer.about(), *about_frames(first)]))
    storage.write("status", answer.result.status)
    storage.write("units", "m, rad")
    storage.write("camera_axes", first.axes)
    # What cv2.calibrateHandEye answers, by its names: the camera on the gripper that carries it.
    storage.write("R_cam2gripper", first.arm_T_camera[:3, :3])
    storage.write("t_cam2gripper", np.ascontiguousarray(first.arm_T_camera[:3, 3:]))
    for item in answer.hand_eyes():
        _write_matrix(storage, f"{item.camera}_T_{item.arm}", item.camera_T_arm, item.covariance)
        _write_matrix(storage, f"{item.arm}_T_{item.camera}", item.arm_T_camera, item.arm_covariance)
    return storage.releaseAndGetString()


def _write_matrix(storage: cv2.FileStorage, name: str, matrix: np.ndarray, covariance: np.ndarray | None) -> None:
    key = name.replace("/", "_").replace(".", "_").lstrip("_")  # FileStorage takes words only
    storage.write(key, np.ascontiguousarray(matrix))
    if covariance is not None:
        storage.write(f"covariance_{key}", np.ascontiguousarray(covariance))
