"""`hand_eye`: one interface to all methods, over one trial or a batch of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.baselines.adjoint import ata
from rmis_calib.baselines.closed_form import andreff, daniilidis, horaud, park, tsai
from rmis_calib.baselines.degeneracy import MotionAssessment, assess_motion, assess_solution
from rmis_calib.baselines.inputs import read_remote_centre, read_samples
from rmis_calib.baselines.motions import Motions, Samples, relative_motions
from rmis_calib.baselines.noise import noise_levels, propagate, residuals
from rmis_calib.baselines.refinement import refine
from rmis_calib.baselines.remote_centre import rcm
from rmis_calib.baselines.result import CARRIERS, HandEye
from rmis_calib.baselines.robot_world import Transforms, li, shah
from rmis_calib.baselines.status import HandEyeStatus
from rmis_calib.errors import InputError
from rmis_calib.geometry import (
    chordal_mean,
    matrix_to_rotvec,
    rigid_from_rotation_translation,
    rotvec_to_matrix,
)

_MOTIONS_AT_ONCE = 1 << 18
"""Relative motions in memory at once, about 1 kB each with derivatives."""


@dataclass(frozen=True, eq=False)
class _Problem:
    """What methods work on; every tensor has one leading axis of trials."""

    samples: Samples
    motions: Motions
    anchor_p_rcm: Tensor | None
    board_p_rcm: Tensor | None


_Solved = tuple[Transforms, Bool[Tensor, "*batch"] | None]
Method = Callable[[_Problem], _Solved]


def _closed_form(solve: Callable[[Motions], Tensor]) -> Method:
    return lambda problem: (_with_board(problem.samples, solve(problem.motions)), None)


def _ata(problem: _Problem) -> _Solved:
    X, settled = ata(problem.motions)
    return _with_board(problem.samples, X), settled


def _rcm(problem: _Problem) -> _Solved:
    assert problem.anchor_p_rcm is not None and problem.board_p_rcm is not None
    X, settled = rcm(problem.samples, problem.motions, problem.anchor_p_rcm, problem.board_p_rcm)
    return _with_board(problem.samples, X), settled


METHODS: dict[str, Method] = {
    "tsai": _closed_form(tsai),
    "park": _closed_form(park),
    "horaud": _closed_form(horaud),
    "andreff": _closed_form(andreff),
    "daniilidis": _closed_form(daniilidis),
    "ata": _ata,
    "rcm": _rcm,
    "shah": lambda problem: (shah(problem.samples), None),
    "li": lambda problem: (li(problem.samples), None),
    "refine": lambda problem: refine(problem.samples),
}
"""Every method by name; `rcm` also needs the remote centre of motion."""


def hand_eye(
    base_T_flange: Tensor | np.ndarray,
    camera_T_board: Tensor | np.ndarray,
    method: str = "park",
    *,
    setup: str = "eye_in_hand",
    camera_left_T_board: Tensor | np.ndarray | None = None,
    camera_left_T_camera: Tensor | np.ndarray | None = None,
    base_p_rcm: Tensor | np.ndarray | Sequence[float] | None = None,
    board_p_rcm: Tensor | np.ndarray | Sequence[float] | None = None,
    covariance: bool = True,
) -> HandEye:
    """Hand-eye calibration from poses of the robot and of a board that the camera sees.

    Works in float64 on the device of the input. The transforms carry derivatives to tensors that require them (the
    covariance does not). The order of the samples does not matter, nor does the unit of length.

    Args:
        base_T_flange: robot's poses, (N, 4, 4) or (..., N, 4, 4) for trials of N samples each, mm.
        camera_T_board: board's poses in the camera at the same samples, of the same shape, mm.
        method: a name of `METHODS`.
        setup: eye_in_hand (the camera rides on the flange) or eye_to_hand (the board does).
        camera_left_T_board: the board's poses in a second camera, for stereo (Pachtrachai et al. 2018): motions within
            and between both cameras count.
        camera_left_T_camera: pose of the first camera in the second, (4, 4) or one a trial, mm.
        base_p_rcm: remote centre of motion in the base, (3,) or one a trial, mm; `rcm` only.
        board_p_rcm: the same point in the board, mm; `rcm` only.
        covariance: whether to compute it; it takes about four times as long as the rest.

    Returns:
        A result whose tensors have the leading shape of the input. A trial that the data cannot answer has a status
        that names why, and NaN for its transforms.

    Raises:
        InputError: an unknown method or set-up; poses that are not rigid transforms; inputs that do not go together.
        InsufficientDataError: fewer than 3 samples.
    """
    if method not in METHODS:
        raise InputError(where="method", expected=f"one of {', '.join(METHODS)}", found=repr(method))
    if setup not in CARRIERS:
        raise InputError(where="setup", expected=f"one of {', '.join(CARRIERS)}", found=repr(setup))
    samples, batch = read_samples(base_T_flange, camera_T_board, camera_left_T_board, camera_left_T_camera, setup)
    centres = read_remote_centre(method, setup, base_p_rcm, board_p_rcm, samples.anchor_T_mount)
    trials, n = samples.anchor_T_mount.shape[:2]
    chunk = max(1, _MOTIONS_AT_ONCE // (n * n))
    parts = [
        _solve_chunk(
            Samples(samples.anchor_T_mount[k : k + chunk], samples.camera_T_board[k : k + chunk], samples.cameras),
            method,
            [None if centre is None else centre[k : k + chunk] for centre in centres],
            covariance,
        )
        for k in range(0, max(trials, 1), chunk)
    ]
    fields = {
        name: torch.cat([part[name] for part in parts]).reshape((*batch, *parts[0][name].shape[1:]))
        for name in parts[0]
    }
    return HandEye(method=method, setup=setup, covariance=fields.pop("covariance", None), **fields)


def _solve_chunk(samples: Samples, method: str, centres: list[Tensor | None], covariance: bool) -> dict[str, Tensor]:
    """Fields of the result for some trials."""
    with torch.no_grad():
        motion = assess_motion(samples, relative_motions(samples))
    good = (motion.status == HandEyeStatus.OK).nonzero()[:, 0]
    if not len(good):
        return _unanswered(samples, motion.status, covariance)
    chosen = Samples(samples.anchor_T_mount[good], samples.camera_T_board[good], samples.cameras)
    anchor_p_rcm, board_p_rcm = (None if centre is None else centre[good] for centre in centres)
    (X, Z), settled = METHODS[method](_Problem(chosen, relative_motions(chosen), anchor_p_rcm, board_p_rcm))
    answered = _judged(chosen, motion[good], X.detach(), Z.detach(), settled)
    if covariance:
        slopes = _slopes(chosen, method, anchor_p_rcm, board_p_rcm)
        found = residuals(chosen, X.detach(), Z.detach())
        answered["covariance"] = propagate(slopes, noise_levels(found), found.lever, chosen.cameras)
    answered |= {"mount_T_camera": X, "anchor_T_board": Z}
    refused = (answered["status"] != HandEyeStatus.OK) & (answered["status"] != HandEyeStatus.NOT_CONVERGED)
    fields = _unanswered(samples, motion.status, covariance)
    for name, values in answered.items():
        if name in ("mount_T_camera", "anchor_T_board", "covariance"):
            values = torch.where(refused[:, None, None], torch.nan, values)
        fields[name] = fields[name].index_copy(0, good, values)
    return fields


def _unanswered(samples: Samples, status: Tensor, covariance: bool) -> dict[str, Tensor]:
    """Fields of trials without an answer."""
    n = samples.anchor_T_mount.shape[-3]
    shapes: dict[str, tuple[int, ...]] = {
        **{"mount_T_camera": (4, 4), "anchor_T_board": (4, 4), "residual_deg": (n,), "residual_mm": (n,)},
        **{name: () for name in ("rotation_noise_deg", "translation_noise_mm", "robot_rotation_share")},
        **({"covariance": (6, 6)} if covariance else {}),
    }
    nan = {name: samples.camera_T_board.new_full((len(status), *shape), torch.nan) for name, shape in shapes.items()}
    return nan | {"status": status}


@torch.no_grad()
def _judged(
    samples: Samples, motion: MotionAssessment, X: Tensor, Z: Tensor, settled: Tensor | None
) -> dict[str, Tensor]:
    """Status, residuals and noise levels of solutions."""
    found = residuals(samples, X, Z)
    status = assess_solution(samples, motion, found)
    if settled is not None:
        status = torch.where((status == HandEyeStatus.OK) & ~settled, int(HandEyeStatus.NOT_CONVERGED), status)
    noise = noise_levels(found)
    rotation = noise.camera_rotation + noise.robot_rotation
    return {
        "status": status,
        "residual_deg": torch.rad2deg(found.turn.norm(dim=-1)),
        "residual_mm": found.shift.norm(dim=-1),
        "rotation_noise_deg": torch.rad2deg(rotation.sqrt()),
        "translation_noise_mm": noise.translation.sqrt(),
        "robot_rotation_share": noise.robot_rotation / rotation.clamp_min(1e-300),
    }


def _slopes(
    samples: Samples, method: str, anchor_p_rcm: Tensor | None, board_p_rcm: Tensor | None
) -> Float[Tensor, "*batch 6 n 6"]:
    """Derivatives of X (rotation, translation) to turns and shifts of camera_T_board of every sample."""
    anchor_T_mount, camera_T_board = samples.anchor_T_mount.detach(), samples.camera_T_board.detach()
    with torch.inference_mode(False), torch.enable_grad():
        change = torch.zeros_like(camera_T_board[..., 0]).repeat(1, 1, 2)[..., :6].requires_grad_()
        moved = rigid_from_rotation_translation(
            rotvec_to_matrix(change[..., :3]) @ camera_T_board[..., :3, :3],
            camera_T_board[..., :3, 3] + change[..., 3:],
        )
        disturbed = Samples(anchor_T_mount, moved, samples.cameras)
        motions = relative_motions(disturbed)
        (X, _), _ = METHODS[method](_Problem(disturbed, motions, anchor_p_rcm, board_p_rcm))
        turn = matrix_to_rotvec(X[..., :3, :3] @ X[..., :3, :3].detach().mT)
        outputs = [*turn.unbind(-1), *X[..., :3, 3].unbind(-1)]
        rows = [torch.autograd.grad(output.sum(), change, retain_graph=True)[0] for output in outputs]
    return torch.stack(rows, dim=-3)


def _with_board(samples: Samples, X: Float[Tensor, "*batch 4 4"]) -> Transforms:
    """X with the board's pose that it gives on average."""
    anchor_T_board = samples.anchor_T_mount @ X[..., None, :, :] @ samples.camera_T_board
    mean = chordal_mean(anchor_T_board[..., :3, :3])
    return X, rigid_from_rotation_translation(mean, anchor_T_board[..., :3, 3].mean(-2))
