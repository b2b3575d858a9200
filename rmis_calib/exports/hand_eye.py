"""The answer as other programs want it: metres, quaternions xyzw, one camera with its axes named.

Millimetres turn into metres here and nowhere else in this package.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rmis_calib.exports.settings import AXES_IN_WORDS, Axes

MM_PER_M = 1000.0
ISI_R_OPENCV: Float[np.ndarray, "3 3"] = np.diag([-1.0, -1.0, 1.0])
"""Axes of the da Vinci's camera frame: x left, y up, z forward, as seen on the surgeon's display.
Source: dVRK documentation, camera calibration, "Hand-eye calibration"."""
WRITTEN_BY = "written by rmis-calib"
"""In every file of an export, so that it is known as one of this program's."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """One camera on one arm."""

    camera: str
    """Name of the camera's frame in the file."""
    arm: str
    """Name of the arm's frame in the file."""
    axes: Axes
    camera_T_arm: Float[np.ndarray, "4 4"]
    """m."""
    covariance: Float[np.ndarray, "6 6"] | None
    """Rotation first: R = exp(dphi) R^, t = t^ + dt of `camera_T_arm`; rad and m."""

    @property
    def arm_T_camera(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the camera in the arm's frame, m: what ROS calls the transform from parent arm to child camera."""
        return rigid_inverse(self.camera_T_arm)

    @property
    def arm_covariance(self) -> Float[np.ndarray, "6 6"] | None:
        """Covariance of `arm_T_camera` in the same order and units.

        Source: the inverse of (exp(dphi) R, t + dt) is (exp(-R^T dphi) R^T, -R^T t - R^T dt - R^T [t]x dphi) to first
        order.
        """
        if self.covariance is None:
            return None
        R, t = self.camera_T_arm[:3, :3], self.camera_T_arm[:3, 3]
        J = np.block([[-R.T, np.zeros((3, 3))], [-R.T @ _skew(t), -R.T]])
        return J @ self.covariance @ J.T


def with_isi_axes(hand_eye: HandEye) -> HandEye:
    """The same camera with the da Vinci's axes."""
    isi_T_camera = np.eye(4)
    isi_T_camera[:3, :3] = ISI_R_OPENCV
    isi_T_arm = isi_T_camera @ hand_eye.camera_T_arm
    covariance = turned_covariance(hand_eye.covariance, ISI_R_OPENCV)
    return HandEye(hand_eye.camera, hand_eye.arm, "isi", isi_T_arm, covariance)


def turned_covariance(
    covariance: Float[np.ndarray, "6 6"] | None, new_R_camera: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "6 6"] | None:
    """Covariance of `new_T_camera @ camera_T_arm`: left perturbations turn with the rotation."""
    if covariance is None:
        return None
    J = np.kron(np.eye(2), new_R_camera)
    return J @ covariance @ J.T


def rigid_inverse(a_T_b: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """`b_T_a`."""
    b_T_a = np.eye(4)
    b_T_a[:3, :3] = a_T_b[:3, :3].T
    b_T_a[:3, 3] = -a_T_b[:3, :3].T @ a_T_b[:3, 3]
    return b_T_a


def in_metres(a_T_b: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """A transform with its translation in mm, as one in m."""
    return a_T_b * np.where(np.arange(4) == 3, [[1.0 / MM_PER_M], [1.0 / MM_PER_M], [1.0 / MM_PER_M], [1.0]], 1.0)


def covariance_in_metres(covariance_mm: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """Rad and mm to rad and m."""
    scale = np.repeat([1.0, 1.0 / MM_PER_M], 3)
    return covariance_mm * scale[:, None] * scale


def quat_xyzw(R: Float[np.ndarray, "3 3"]) -> list[float]:
    """Unit quaternion in the order of ROS and TUM, w not negative."""
    return Rotation.from_matrix(R).as_quat(canonical=True).tolist()


def rpy_rad(R: Float[np.ndarray, "3 3"]) -> tuple[float, float, float]:
    """Roll, pitch, yaw of a URDF: R = Rz(yaw) Ry(pitch) Rx(roll). At a pitch of 90 degrees roll is 0.

    Not SciPy's, which warns there.
    """
    cos_pitch = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = float(np.arctan2(-R[2, 0], cos_pitch))
    if cos_pitch < 1e-9:
        return 0.0, pitch, float(np.arctan2(-R[0, 1], R[1, 1]))
    return float(np.arctan2(R[2, 1], R[2, 2])), pitch, float(np.arctan2(R[1, 0], R[0, 0]))


def numbers(values: np.ndarray | list[float]) -> str:
    """Numbers with all their digits, apart by blanks."""
    return " ".join(repr(float(value)) for value in values)


def about_frames(hand_eye: HandEye) -> list[str]:
    """Both directions, units and axes in words, a line each."""
    arm, camera = hand_eye.arm, hand_eye.camera
    return [
        f"{arm}_T_{camera}: maps coordinates in {camera} to coordinates in {arm} (parent {arm}, child {camera})",
        f"{camera}_T_{arm}: its inverse, maps coordinates in {arm} to coordinates in {camera}",
        f"camera axes: {AXES_IN_WORDS[hand_eye.axes]}; metres, quaternions x y z w",
    ]


def _skew(t: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    x, y, z = t
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
