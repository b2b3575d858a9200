"""surgsync: the calibration folders of a SurgSync / Open-H clip: camera_calibration and hand_eye_calibration.

The kinematics of SurgSync are drawn into rectified pictures of the left camera, so the registrations are of that camera
after OpenCV's stereoRectify, as dvrk_camera_registration measures them.
Source: dvrk_multimodal_data_collection, utils/data_load_config.py (keys), gen_rectify_resize.py (rectification).
"""

from typing import Any

import cv2
import numpy as np

from rmis_calib.errors import InputError
from rmis_calib.exports.answer import Answer
from rmis_calib.exports.formats.dvrk import registrations
from rmis_calib.exports.formats.markup import json_text, rows, yaml_text
from rmis_calib.exports.hand_eye import in_metres, rigid_inverse
from rmis_calib.geometry.cameras import Camera


def content(answer: Answer) -> dict[str, str]:
    """left.yaml, right.yaml, stereo_calib_params.json, both registrations, README.txt.

    Raises:
        InputError: no recording was given, it has one camera only, or a fisheye lens.
    """
    stereo = answer.placed().stereo
    if stereo.left is None or stereo.camera_left_T_camera_right is None:
        raise InputError(where="surgsync", expected="a recording with two cameras", found="one camera")
    left, right = stereo.left, stereo.right
    if "equidistant" in (left.model, right.model):
        expected = "cameras that OpenCV's stereoRectify takes (plumb_bob, rational_polynomial)"
        raise InputError(where="surgsync", expected=expected, found="equidistant")
    camera_left_T_camera_right = in_metres(stereo.camera_left_T_camera_right.matrix.numpy())
    camera_right_T_camera_left = rigid_inverse(camera_left_T_camera_right)
    R, T = camera_right_T_camera_left[:3, :3], camera_right_T_camera_left[:3, 3]
    height, width = left.image_size
    K_left, D_left, K_right, D_right = _matrix(left), _distortion(left), _matrix(right), _distortion(right)
    R1, R2, P1, P2 = cv2.stereoRectify(
        K_left, D_left, K_right, D_right, (width, height), R, T[:, None], flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
    )[:4]
    about = [*answer.about(), "R_stereo, T_stereo: right_p = R left_p + T, m (coordinates in left to those in right)"]
    extrinsics = {"R_stereo": _entry(R), "T_stereo": _entry(T[:, None])}
    files = {
        "camera_calibration/left.yaml": yaml_text(about, _camera_info("left", left, R1, P1) | extrinsics),
        "camera_calibration/right.yaml": yaml_text(about, _camera_info("right", right, R2, P2) | extrinsics),
        "camera_calibration/stereo_calib_params.json": json_text(
            {"baseline_m": float(np.linalg.norm(T)), "R": rows(R), "T": T.tolist()}
        ),
    }
    rectified_T_camera = np.eye(4)
    rectified_T_camera[:3, :3] = R1
    rectified_T_instrument_base = rectified_T_camera @ answer.camera_T_instrument_base("left")
    for name, text in registrations(answer, answer.settings.camera_left_frame, rectified_T_instrument_base).items():
        files[f"hand_eye_calibration/{name}"] = text
    said = [
        "hand_eye_calibration: pose of the instrument arm's base in the rectified left camera (stereoRectify of the",
        "two YAML files, alpha 0), m; -open-cv with OpenCV axes, -dVRK on the ECM's base with ISI axes; with the arms",
        f"as in frame {answer.placed().frame} of the recording.",
    ]
    files["README.txt"] = "\n".join([*about, *said, ""])
    return files


def _camera_info(name: str, camera: Camera, rectification: np.ndarray, projection: np.ndarray) -> dict[str, Any]:
    """The keys of a ROS camera_info file."""
    height, width = camera.image_size
    return {
        "image_width": width,
        "image_height": height,
        "camera_name": name,
        "camera_matrix": _entry(_matrix(camera)),
        "distortion_model": camera.model,
        "distortion_coefficients": _entry(_distortion(camera)[None]),
        "rectification_matrix": _entry(rectification),
        "projection_matrix": _entry(projection),
    }


def _entry(matrix: np.ndarray) -> dict[str, Any]:
    return {"rows": matrix.shape[0], "cols": matrix.shape[1], "data": np.asarray(matrix, dtype=float).ravel().tolist()}


def _matrix(camera: Camera) -> np.ndarray:
    fx, fy, cx, cy = (float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _distortion(camera: Camera) -> np.ndarray:
    return np.asarray(camera.distortion.numpy(), dtype=np.float64)
