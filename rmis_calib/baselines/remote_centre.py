"""Hand-eye calibration that uses the remote centre of motion (RCM), the point that the laparoscope pivots about."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.baselines.closed_form import park, translation_system
from rmis_calib.baselines.fixed_point import fixed_point
from rmis_calib.baselines.linalg import solve_symmetric
from rmis_calib.baselines.motions import Motions, Samples, rotate_by_quat
from rmis_calib.geometry import (
    matrix_to_rotvec,
    quat_conjugate,
    quat_to_matrix,
    rigid_from_rotation_translation,
    rigid_inverse,
    rotvec_to_matrix,
    skew,
    transform_points,
)

_STEPS, _TOLERANCE = 500, 1e-8
_SMOOTHING = 1e-6
"""Norms are sqrt(r^2 + this^2), in sizes of the motions' translations: 0.1 um where they are 100 mm."""


def rcm(
    samples: Samples,
    motions: Motions,
    anchor_p_rcm: Float[Tensor, "*batch 3"],
    board_p_rcm: Float[Tensor, "*batch 3"],
) -> tuple[Float[Tensor, "*batch 4 4"], Bool[Tensor, "*batch"]]:
    """X, and whether both iterations settled.

    Let p_i be the RCM in the camera, r_i the RCM in the mount, and X = camera_T_mount. First the rotation minimises
    |mean(p - R r) - t(R)| + sum_i |(p_i - mean p) - R (r_i - mean r)|, where t(R) is the least-squares translation of
    the motions. Then the translation minimises sum_i |t - (p_i - R r_i)| + sum_j |(R_A - I) t - (R t_B - t_A)|.

    Differences from the authors' program. It pairs each sample with the next, so that order matters; here all pairs
    count, with the total weight of one motion a sample. It starts from the identity; here the start is `park`. It keeps
    the camera's axis within 4 degrees of the flange's z axis; that holds only for its robot's frames and is left out.
    In stereo, both cameras see the RCM here.

    Source: Pachtrachai et al. (2019), IEEE Robotics and Automation Letters, in the form of the authors' program
    (github.com/surgical-vision/hand-eye-rcm, HandEye_RCM.m); the article's own text was not at hand.
    """
    mount_T_camera = park(motions)
    motions = motions.swapped()
    length = motions.length()
    mount_p_rcm = transform_points(rigid_inverse(samples.anchor_T_mount), anchor_p_rcm[..., None, :])
    camera_p_rcm = transform_points(samples.camera_T_board, board_p_rcm[..., None, :])
    p, r = camera_p_rcm / length[..., None, None], mount_p_rcm / length[..., None, None]
    motions = Motions(
        motions.qa, motions.ta / length[..., None, None], motions.qb, motions.tb / length[..., None, None]
    )
    start = mount_T_camera[..., :3, :3].mT.detach()
    data = (start, p, r, *_asked_translation(motions))
    rotvec, turned = fixed_point(_turn, torch.zeros_like(start[..., 0]), data, steps=_STEPS, tolerance=_TOLERANCE)
    R = rotvec_to_matrix(rotvec) @ start
    equations = _translation_equations(motions, p - r @ R.mT, R)
    t, shifted = fixed_point(_shift, (p - r @ R.mT).mean(-2), equations, steps=_STEPS, tolerance=_TOLERANCE)
    return rigid_inverse(rigid_from_rotation_translation(R, t * length[..., None])), turned & shifted


def _asked_translation(motions: Motions) -> tuple[Float[Tensor, "*batch 3 9"], Float[Tensor, "*batch 3"]]:
    """t(R) = linear vec(R) + constant, the least-squares translation of the motions, which is linear in R."""
    basis = torch.eye(9, dtype=motions.qa.dtype, device=motions.qa.device).unflatten(-1, (3, 3))
    zero = torch.zeros_like(basis[0]).expand(*motions.qa.shape[:-2], 3, 3)
    normal, constant = translation_system(motions, zero)
    columns = [translation_system(motions, matrix.expand_as(zero))[1] - constant for matrix in basis]
    solved = torch.linalg.solve_ex(normal, torch.stack([*columns, constant], -1)).result
    return solved[..., :9], solved[..., 9]


def _turn(rotvec: Tensor, start: Tensor, p: Tensor, r: Tensor, linear: Tensor, constant: Tensor) -> Tensor:
    """The next rotation vector from the start: a Gauss-Newton step, reweighted for the sum of norms."""
    turn = rotvec_to_matrix(rotvec)
    R = turn @ start
    p_mean, r_mean = p.mean(-2), r.mean(-2)
    turned = (r - r_mean[..., None, :]) @ R.mT
    axes = skew(torch.eye(3, dtype=p.dtype, device=p.device))

    def moved(rotation: Tensor) -> Tensor:  # R mean(r) + the part of t(R) that is linear
        return (rotation @ r_mean[..., None] + linear @ rotation.flatten(-2)[..., None])[..., 0]

    # Derivatives to a left perturbation of R: skew(turned) of `away`, and of `apart` because it is linear in R.
    slope = torch.stack([-moved(axis @ R) for axis in axes], dim=-1)
    slopes = torch.cat([skew(turned), slope[..., None, :, :]], dim=-3)
    away, apart = p - p_mean[..., None, :] - turned, p_mean - moved(R) - constant
    values = torch.cat([away, apart[..., None, :]], dim=-2)
    step = -_reweighted(slopes, values, torch.ones_like(values[..., 0]))
    return matrix_to_rotvec(rotvec_to_matrix(step) @ turn)


def _translation_equations(
    motions: Motions, points: Float[Tensor, "*batch n 3"], R: Float[Tensor, "*batch 3 3"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Slopes, right-hand sides and counts of t = points and (R_A - I) t = R t_B - t_A, both senses of every motion."""
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    RA = quat_to_matrix(motions.qa)
    back_ta = -rotate_by_quat(quat_conjugate(motions.qa), motions.ta)
    back_tb = -rotate_by_quat(quat_conjugate(motions.qb), motions.tb)
    slopes = torch.cat([eye.expand(*points.shape, 3), RA - eye, RA.mT - eye], dim=-3)
    rhs = torch.cat([points, motions.tb @ R.mT - motions.ta, back_tb @ R.mT - back_ta], dim=-2)
    n, pairs = points.shape[-2], RA.shape[-3]
    counts = torch.cat([points.new_ones(n), points.new_full((2 * pairs,), n / (2 * pairs))])
    return slopes, rhs, counts.expand(rhs.shape[:-1])


def _shift(t: Tensor, slopes: Tensor, rhs: Tensor, counts: Tensor) -> Tensor:
    """The next translation: least squares, reweighted for the sum of norms."""
    return t - _reweighted(slopes, (slopes @ t[..., None, :, None])[..., 0] - rhs, counts)


def _reweighted(
    slopes: Float[Tensor, "*batch m 3 3"], values: Float[Tensor, "*batch m 3"], counts: Float[Tensor, "*batch m"]
) -> Float[Tensor, "*batch 3"]:
    """Least-squares solution of slopes x = values with every term over its norm."""
    weights = counts * (values.square().sum(-1) + _SMOOTHING**2).rsqrt() * _SMOOTHING
    weighted = weights[..., None, None] * slopes
    normal = torch.einsum("...mij,...mik->...jk", weighted, slopes)
    size = normal.diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(1e-300)
    rhs = torch.einsum("...mij,...mi->...j", weighted, values)
    return solve_symmetric(normal / size[..., None, None], rhs / size[..., None])
