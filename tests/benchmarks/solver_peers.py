"""SciPy's least_squares on the problem of `joint`, as three users would write it.

All have the same measurements (both contours, ends, both cameras), the same shared unknowns with the same priors
(hand-eye 6, stereo 6, end offset), the same start (the answer of `global`) and SciPy's default tolerances.

`marginalised`: NumPy residuals, whitened with S = D + J Sigma J^T of the noise at the start; Jacobian by SciPy's
2-point differences, its default. One least_squares; `joint` evaluates S at its estimate, which takes a second one.
`analytic`: the same with the residuals and the analytic Jacobian of this package.
`latent`: a pose error of each motion is an unknown with its prior (6 N more), as the noise model is stated; sparse
2-point Jacobian.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, cast

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation

from rmis_calib.geometry.rotations import matrix_to_rotvec, skew
from rmis_calib.solver import Problem, SolverSettings
from rmis_calib.solver.estimate.noise_levels import assumed_noise
from rmis_calib.solver.model.jacobian import columns
from rmis_calib.solver.model.motion_covariance import covariance, image_variance
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.parameters import NuisancePriors, initial_state, make_layout
from rmis_calib.solver.model.residuals import linearise, residual_rows
from rmis_calib.solver.model.state import State

Rows = Callable[[np.ndarray, np.ndarray], np.ndarray]


class NumpyPeer:
    """Residuals of one trial in plain NumPy."""

    def __init__(self, problem: Problem) -> None:
        tensors = {field.name: getattr(problem, field.name) for field in fields(problem)}
        self.data = {name: x[0].numpy() for name, x in tensors.items() if isinstance(x, torch.Tensor) and x.ndim > 1}
        self.radius = float(problem.radius_mm[0])
        self.noise = {name: float(value[0]) for name, value in vars(problem.noise).items()}
        self.poses, self.axis = self.data["arm_T_rcm"], self.data["rcm_v_axis"]
        self.prior = np.repeat([self.noise["stereo_rad"], self.noise["stereo_mm"]], 3)
        pose = np.repeat([self.noise["kinematics_rad"], self.noise["kinematics_mm"]], 3)
        self.pose_sigma = np.tile(pose, (len(self.poses), 1))

    def start(self, camera_right_T_arm: np.ndarray, end_offset: float) -> np.ndarray:
        """(13,) rotation vector, translation, stereo perturbation, end offset."""
        turn = Rotation.from_matrix(camera_right_T_arm[:3, :3]).as_rotvec()
        return np.concatenate((turn, camera_right_T_arm[:3, 3], np.zeros(6), [end_offset]))

    def rows(self, x: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """(n, 10) residuals in normalised units; zero where not measured."""
        R, t = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:6]
        Z0 = self.data["camera_T_camera_right"][1]
        Z = np.eye(4)
        Z[:3, :3], Z[:3, 3] = Rotation.from_rotvec(x[6:9]).as_matrix() @ Z0[:3, :3], Z0[:3, 3] + x[9:12]
        p0, d0 = poses[:, :3, 3] @ R.T + t, np.einsum("nij,nj->ni", poses[:, :3, :3], self.axis) @ R.T
        out = []
        for c, T in enumerate((np.eye(4), Z)):
            p, d = p0 @ T[:3, :3].T + T[:3, 3], d0 @ T[:3, :3].T
            M = np.cross(p, d)
            D = np.linalg.norm(M, axis=1)
            m = M / D[:, None]
            u = np.cross(d, m)
            sine = self.radius / D
            for edge, sign in enumerate((1.0, -1.0)):
                n = np.sqrt(1.0 - sine**2)[:, None] * m + sign * sine[:, None] * u
                scale = np.hypot(n[:, 0], n[:, 1])
                for point in range(2):
                    xy = self.data["contour_xy"][c, :, edge, point]
                    out.append((n[:, 0] * xy[:, 0] + n[:, 1] * xy[:, 1] + n[:, 2]) / scale)
            q = p + (self.data["rcm_s_end_mm"] + x[12])[:, None] * d
            along = np.stack((-m[:, 1], m[:, 0]), 1) / np.hypot(m[:, 0], m[:, 1])[:, None]
            out.append(((self.data["end_xy"][c] - q[:, :2] / q[:, 2:]) * along).sum(1))
        return np.nan_to_num(np.stack(out, 1))

    def moved(self, perturbation: np.ndarray) -> np.ndarray:
        """Poses perturbed on the right by (rotation vector, translation)."""
        E = np.tile(np.eye(4), (len(self.poses), 1, 1))
        E[:, :3, :3], E[:, :3, 3] = Rotation.from_rotvec(perturbation[:, :3]).as_matrix(), perturbation[:, 3:]
        return self.poses @ E

    def whitening(self, x: np.ndarray) -> np.ndarray:
        """(n, 10, 10) inverse Cholesky factors of S."""
        S = np.tile(self.noise["image"] ** 2 * np.eye(10), (len(self.poses), 1, 1))
        base = self.rows(x, self.poses)
        for axis in range(6):
            step = np.zeros_like(self.pose_sigma)
            step[:, axis] = 1e-5 if axis < 3 else 1e-4
            J = (self.rows(x, self.moved(step)) - base) / step[0, axis] * self.pose_sigma[0, axis]
            S += J[:, :, None] * J[:, None]
        return np.linalg.inv(np.linalg.cholesky(S))

    def marginalised(self, x: np.ndarray, rounds: int) -> np.ndarray:
        """Estimate with S held at the start of each round."""
        for _ in range(rounds):
            whiten = self.whitening(x)

            def residuals(x: np.ndarray, whiten: np.ndarray = whiten) -> np.ndarray:
                white = np.matmul(whiten, self.rows(x, self.poses)[..., None])
                return np.concatenate((white.ravel(), x[6:12] / self.prior))

            x = least_squares(residuals, x, x_scale="jac").x
        return x

    def latent(self, x: np.ndarray) -> np.ndarray:
        """Estimate with the error of every motion's pose among the unknowns, in sigmas."""
        n = len(self.poses)

        def residuals(y: np.ndarray) -> np.ndarray:
            xi = y[13:].reshape(n, 6)
            image = self.rows(y[:13], self.moved(xi * self.pose_sigma)) / self.noise["image"]
            return np.concatenate((image.ravel(), y[6:12] / self.prior, y[13:]))

        pattern = lil_matrix((10 * n + 6 + 6 * n, 13 + 6 * n), dtype=int)
        pattern[: 10 * n + 6, :13] = 1
        for i in range(n):
            pattern[10 * i : 10 * i + 10, 13 + 6 * i : 19 + 6 * i] = 1
        pattern[10 * n + 6 :, 13:] = np.eye(6 * n, dtype=int)
        start = np.concatenate((x, np.zeros(6 * n)))
        return least_squares(residuals, start, x_scale="jac", jac_sparsity=pattern, tr_solver="lsmr").x[:13]


def transform(x: np.ndarray) -> torch.Tensor:
    """`camera_right_T_arm` of an estimate, (1, 4, 4)."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:6]
    return torch.as_tensor(out)[None]


class AnalyticPeer:
    """`marginalised` with this package's residuals and Jacobian; unknowns are increments of the start."""

    def __init__(self, problem: Problem, settings: SolverSettings, start: torch.Tensor, end_offset: float) -> None:
        self.measured = pack(problem, settings.noise)
        nominal = NuisancePriors.of(problem)
        zero = initial_state(nominal, start[None, :3, :3], start[None, :3, 3])
        self.layout = make_layout(nominal, self.measured, zero, settings.unknowns, settings.noise)
        self.origin = replace(zero, end_offset=torch.full((1,), end_offset, dtype=torch.float64))
        self.noise, _ = assumed_noise(problem, settings.noise)

    def _state(self, x: np.ndarray) -> State:
        return self.origin.moved(self.layout.step(torch.as_tensor(x)[None]))

    def _jacobian(self, x: np.ndarray) -> torch.Tensor:
        """(n, k, p) in the increments from the start: the columns hold for increments from the current state."""
        state, delta = self._state(x), torch.as_tensor(x)
        rows, shaft = linearise(self.measured, state)
        J = columns(self.layout, rows, shaft, self.measured, state)[:, :, 0].permute(2, 0, 1).clone()
        for name, sign in (("rotation", 1.0), ("stereo_rotation", -1.0)):
            part = self.layout.blocks[name]
            K = sign * skew(delta[part])
            J[..., part] = J[..., part] @ (torch.eye(3, dtype=K.dtype) + K / 2 + K @ K / 6 + K @ K @ K / 24)
        part = self.layout.blocks["stereo_translation"]
        J[..., part] = J[..., part] @ (state.stereo_R[0].mT @ self.origin.stereo_R[0])
        return J

    def solve(self, rounds: int) -> torch.Tensor:
        """`camera_right_T_arm` (1, 4, 4)."""
        x = np.zeros(self.layout.size)
        bounded = torch.isfinite(self.layout.sigma[0])
        sigma = self.layout.sigma[0, bounded].numpy()
        prior_J = np.eye(self.layout.size)[bounded.numpy()] / sigma[:, None]
        for _ in range(rounds):
            rows, _ = linearise(self.measured, self._state(x))
            k, _, n = rows.r.shape
            S = torch.empty(k, k, 1, n, dtype=torch.float64)
            covariance(rows.w, rows.a, image_variance(self.measured, self.noise), self.measured.cameras, self.noise, S)
            whiten = torch.linalg.inv(torch.linalg.cholesky(S[:, :, 0].permute(2, 0, 1)))

            def residuals(x: np.ndarray, whiten: torch.Tensor = whiten) -> np.ndarray:
                state = self._state(x)
                white = (whiten @ residual_rows(self.measured, state)[:, 0].T[..., None]).ravel()
                deviation = self.layout.prior(state)[0][0, bounded].numpy()
                return np.concatenate((white.numpy(), deviation / sigma))

            def jacobian(x: np.ndarray, whiten: torch.Tensor = whiten) -> np.ndarray:
                return np.concatenate(((whiten @ self._jacobian(x)).flatten(0, 1).numpy(), prior_J))

            x = least_squares(residuals, x, jac=cast(Any, jacobian), x_scale="jac").x
        state = self._state(x)
        pose = np.concatenate((matrix_to_rotvec(state.R[0]).numpy(), state.t[0].numpy()))
        return transform(pose)
