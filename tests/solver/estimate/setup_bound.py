"""The Cramer-Rao bound of both transforms together, from the independent simulation's geometry alone. float64 NumPy.

Every image point of a contour tells its distance across the line, an end its place along the axis; the noise of the
kinematics (six numbers a motion) is eliminated motion by motion, S = sigma^2 I + G Sigma G^T. Derivatives are central
differences of the exact prediction.
"""

import numpy as np

from data_synth.contours import to_image, view_cylinder
from data_synth.kinematics import rigid_inverse, rotation_from_rotvec

STEP = 1e-6
"""Of central differences: rad, mm and relative ones alike; their error is below 1e-8 of the derivative."""


def moved(step):
    """[exp(rotvec), translation] of a step (rotation vector first)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_rotvec(step[:3]), step[3:]
    return T


def left_moved(T, step):
    """R = exp(dphi) R^, t = t^ + dt."""
    out = T.copy()
    out[:3, :3], out[:3, 3] = rotation_from_rotvec(step[:3]) @ T[:3, :3], T[:3, 3] + step[3:]
    return out


class Scene:
    """Truth of one trial, and what its exact pictures show."""

    def __init__(self, exact, sigma_image, sigma_mm, sigma_rad, sigma_stereo):
        truth = exact["truth"]
        self.X, self.Z = truth["camera_right_T_arm"][0], truth["camera_left_T_camera_right"][0]
        self.L, self.S = exact["laparoscope_base_T_arm"][0], exact["laparoscope_base_T_instrument_base"][0]
        self.instrument = rigid_inverse(self.S) @ self.L @ truth["arm_T_rcm"][0]
        self.v, self.s = exact["rcm_v_axis"][0], exact["rcm_s_end_mm"][0]
        self.radius, self.end = float(np.max(exact["shaft_radius_mm"])), truth["shaft_end_offset_mm"]
        self.points = {side: exact[f"contour_{side}"][0] for side in ("right", "left")}
        self.ends = {side: exact[f"end_{side}"][0] for side in ("right", "left")}
        self.sigma = sigma_image, sigma_mm, sigma_rad, sigma_stereo

    def rows(self, X, S, Z, radius, end, noise):
        """Residuals (N, rows): both contours' points and the end, of both cameras; NaN where not in the picture.
        `noise` is that of the kinematics, the same in every motion."""
        out = []
        camera_T_rcm = X @ rigid_inverse(self.L) @ S @ self.instrument @ moved(noise)
        for side, camera in (("right", np.eye(4)), ("left", Z)):
            T = camera @ camera_T_rcm
            p, v = T[:, :3, 3], (T[:, :3, :3] @ self.v[..., None])[..., 0]
            view = view_cylinder(p, v, radius)
            n = view.n_contour / np.linalg.norm(view.n_contour[..., :2], axis=-1, keepdims=True)  # (N, edge, 3)
            xy = self.points[side]
            out.append(((n[:, :, None, :2] * xy).sum(-1) + n[:, :, None, 2]).reshape(len(xy), 4))
            tip = p + (self.s + end)[:, None] * v
            along = to_image(tip) - to_image(p + 0.999 * (self.s + end)[:, None] * v)
            along /= np.linalg.norm(along, axis=-1, keepdims=True)
            out.append(((self.ends[side] - to_image(tip)) * along).sum(-1, keepdims=True))
        return np.concatenate(out, axis=1)

    def at(self, theta, noise):
        """Residuals at a step of all unknowns: X, S, stereo (6 each), radius, end."""
        X, S = left_moved(self.X, theta[:6]), left_moved(self.S, theta[6:12])
        return self.rows(X, S, self.Z @ moved(theta[12:18]), self.radius + theta[18], self.end + theta[19], noise)


def bound(scene, setup_known=False):
    """(12, 12) covariance of camera_right_T_arm and laparoscope_base_T_instrument_base; (6, 6) of the first where the
    set-up is known."""
    count = 20
    still, at = np.zeros(6), np.zeros(count)

    def slope(change):
        return (change(STEP) - change(-STEP)) / (2.0 * STEP)

    def of_unknown(i):
        return slope(lambda h: scene.at(np.eye(count)[i] * h, still))

    def of_noise(i):
        return slope(lambda h: scene.at(at, np.eye(6)[i] * h))

    J = np.stack([of_unknown(i) for i in range(count)], axis=-1)  # (N, rows, unknowns)
    G = np.stack([of_noise(i) for i in range(6)], axis=-1)
    ok = np.isfinite(scene.at(at, still))
    J, G = (np.where(ok[..., None], x, 0.0) for x in (J, G))
    sigma_image, sigma_mm, sigma_rad, sigma_stereo = scene.sigma
    spread = np.diag(np.repeat([sigma_rad**2, sigma_mm**2], 3))
    S = G @ spread @ G.transpose(0, 2, 1) + sigma_image**2 * np.eye(J.shape[1])
    H = np.einsum("nki,nkl,nlj->ij", J, np.linalg.inv(S), J)
    H[range(12, 18), range(12, 18)] += np.repeat([sigma_stereo[1] ** -2.0, sigma_stereo[0] ** -2.0], 3)
    H[18, 18] += (0.03 * scene.radius) ** -2.0
    kept = np.r_[:6, 12:count] if setup_known else np.arange(count)
    H = H[np.ix_(kept, kept)]
    scale = np.diag(H) ** -0.5
    C = np.linalg.inv(H * scale[:, None] * scale) * scale[:, None] * scale
    return C[:6, :6] if setup_known else C[:12, :12]
