"""A problem packed into measurement rows."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.errors import ShapeError
from rmis_calib.geometry.rotations import skew
from rmis_calib.solver.model.batched_linalg import batch_last, rotate
from rmis_calib.solver.model.compliance import coordinates
from rmis_calib.solver.model.measurement_rows import MeasurementRows, OwnRows
from rmis_calib.solver.observation_arrays import CAMERAS
from rmis_calib.solver.own_measurement import Measurement
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import NoiseSettings

MIN_SIGMA = 1e-6
"""Least image noise, normalised units (a thousandth of a pixel): exact data are not a division by zero."""


def pack(problem: Problem, noise: NoiseSettings) -> MeasurementRows:
    """The packed form of a problem with exactly one trial axis."""
    image = torch.nan_to_num(problem.noise.image, nan=noise.image).clamp_min(MIN_SIGMA)[:, None, None]
    arm_R_rcm = batch_last(problem.arm_T_rcm[..., :3, :3], 2)
    head_rcm = torch.nan_to_num(batch_last(problem.rcm_p_head, 1))
    line = _lines(problem, image)
    heads_known = torch.isfinite(problem.rcm_p_head).all(-1)
    end_xy, end_var, end_ok = _points(problem.end_xy, problem.end_sigma, problem.end_measured, image)
    head_xy, head_var, head_ok = _points(
        problem.head_xy, problem.head_sigma, problem.valid & heads_known[:, None], image
    )
    joint, clock = (
        None if derivative is None else _to_arm(arm_R_rcm[:, :, None], batch_last(derivative, 2))
        for derivative in (problem.joint_derivative, problem.clock_derivative)
    )
    camera = problem.camera_T_camera_right.permute(2, 3, 1, 0).contiguous()
    return MeasurementRows(
        p=batch_last(problem.arm_T_rcm[..., :3, 3], 1),
        v=rotate(arm_R_rcm, batch_last(problem.rcm_v_axis, 1)),
        R=arm_R_rcm,
        head=rotate(arm_R_rcm, head_rcm),
        s_end=torch.nan_to_num(problem.rcm_s_end_mm),
        line_xy=line[0],
        line_rho=line[1],
        line_var=line[2],
        line_ok=line[3],
        end_xy=end_xy,
        end_var=end_var,
        end_ok=end_ok,
        end_kind=problem.end_kind.transpose(0, 1)[: len(end_ok)].contiguous(),
        end_sureness=problem.end_sureness.transpose(0, 1)[: len(end_ok)].contiguous(),
        end_second=torch.zeros_like(end_var),
        head_xy=head_xy,
        head_var=head_var,
        head_ok=head_ok,
        camera_R=camera[:3, :3],
        camera_t=camera[:3, 3],
        pose=coordinates(problem),
        joint=joint,
        clock=clock,
        setup=None if problem.laparoscope_base_T_arm is None else _setup_effects(problem),
        own=tuple(_own(problem, item) for item in problem.own),
    )


def _own(problem: Problem, item: Measurement) -> OwnRows:
    """A measurement of the user's own, packed; its residual at the identity tells how many components it has.

    Raises:
        ShapeError: the residual does not keep the motions apart.
    """
    measured = torch.isfinite(item.sigma)
    for value in item.values.values():
        measured = (
            measured & torch.isfinite(value).flatten(2).all(-1) if value.ndim > 2 else measured & value.isfinite()
        )
    values = {key: torch.nan_to_num(value) for key, value in item.values.items()}
    like, shape = problem.arm_T_rcm, tuple(item.sigma.shape)
    eye = torch.eye(3, dtype=like.dtype, device=like.device).expand(*shape, 3, 3)
    probe = item.residual(eye, like.new_ones((*shape, 3)), **values)
    if probe.ndim != 3 or probe.shape[:2] != shape:
        raise ShapeError(
            where=f"measurement {item.name!r}", expected=f"residuals {(*shape, 'm')}", found=tuple(probe.shape)
        )
    m = probe.shape[-1]
    packed = {key: value.movedim((0, 1), (-2, -1)) for key, value in values.items()}
    variance = torch.where(measured, item.sigma, 1.0).square()
    rows = [x.expand(m, *shape) for x in (variance, measured, torch.zeros_like(variance))]
    still = like.new_zeros((3, *shape))
    return OwnRows(item.name, item.residual, CAMERAS.index(item.camera), packed, *rows, turn=still, moved=still)


def line_points(problem: Problem) -> int:
    """Line rows a camera has in the packed form: the points of both contours where any motion has them, else of the
    axis."""
    return 4 if bool(_contour_ok(problem).any()) else 2


def _contour_ok(problem: Problem) -> Bool[Tensor, "b c n"]:
    known = torch.isfinite(problem.contour_xy).all(-1).all(-1).all(-1) & problem.valid
    return known & torch.isfinite(problem.radius_mm)[:, None, None]


def _setup_effects(problem: Problem) -> Float[Tensor, "6 6 b n"]:
    """[displacement, component]: with S <- S (exp(omega), tau), the shaft turns by Q omega and its RCM moves by
    Q (tau + omega x p), Q = `arm_R_instrument_base` and p the RCM in `instrument_base`."""
    laparoscope, setup = problem.chains
    Q = laparoscope[..., :3, :3].mT @ setup[:, None, :3, :3]
    p = problem.instrument_base_T_rcm[..., :3, 3]
    turned = torch.cat((Q, -Q @ skew(p)), dim=-2)
    shifted = torch.cat((torch.zeros_like(Q), Q), dim=-2)
    return batch_last(torch.cat((turned, shifted), dim=-1), 2)


def _to_arm(arm_R_rcm: Tensor, displacement: Tensor) -> Tensor:
    """Rotation and translation parts of displacements, turned from `rcm` into `arm`."""
    return torch.cat((rotate(arm_R_rcm, displacement[:3]), rotate(arm_R_rcm, displacement[3:])))


def _lines(problem: Problem, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Contour points where both contours were measured, else axis points; (2, l, c, b, n), rho, variance, measured."""
    axis_ok = torch.isfinite(problem.axis_xy).all(-1).all(-1) & problem.valid  # (b, c, n)
    contour_ok = _contour_ok(problem)
    axis = problem.axis_xy.permute(4, 3, 1, 0, 2)  # (xy, point, c, b, n)
    axis_var = torch.where(torch.isfinite(problem.axis_sigma), problem.axis_sigma, image).square().transpose(0, 1)
    axis_ok = axis_ok.transpose(0, 1)
    if not bool(contour_ok.any()):
        xy = torch.nan_to_num(axis).contiguous()
        return (
            xy,
            torch.zeros_like(xy[0]),
            axis_var.expand_as(xy[0]).contiguous(),
            axis_ok.expand_as(xy[0]).contiguous(),
        )
    contour = problem.contour_xy.permute(5, 3, 4, 1, 0, 2)  # (xy, edge, point, c, b, n)
    contour_sigma = torch.where(torch.isfinite(problem.contour_sigma), problem.contour_sigma, image[..., None])
    contour_var = contour_sigma.square().permute(3, 1, 0, 2)[:, None].expand(contour.shape[1:])
    contour_ok = contour_ok.transpose(0, 1)
    rho = (
        contour_ok.to(axis.dtype)
        * torch.tensor([1.0, -1.0], dtype=axis.dtype, device=axis.device)[:, None, None, None, None]
    )
    first = torch.tensor([True, False], device=axis.device)[
        :, None, None, None, None
    ]  # an axis line takes the rows of edge 0
    xy = torch.where(contour_ok, contour, axis[:, None])
    ok = contour_ok | (axis_ok & first)
    var = torch.where(contour_ok, contour_var, axis_var.expand(contour.shape[1:]))
    shape = (4, *contour.shape[3:])
    return (
        torch.nan_to_num(xy).reshape(2, *shape).contiguous(),
        rho.expand(contour.shape[1:]).reshape(shape).contiguous(),
        var.reshape(shape).contiguous(),
        ok.expand(contour.shape[1:]).reshape(shape).contiguous(),
    )


def _points(xy: Tensor, sigma: Tensor, known: Tensor, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(2, c, b, n) coordinates, (c, b, n) variances and where measured; no cameras when nothing was measured at all."""
    ok = torch.isfinite(xy).all(-1) & known
    cameras = ok.shape[1] if bool(ok.any()) else 0
    var = torch.where(torch.isfinite(sigma), sigma, image).square()
    points = torch.nan_to_num(xy).permute(3, 1, 0, 2)[:, :cameras]
    return points.contiguous(), var.transpose(0, 1)[:cameras].contiguous(), ok.transpose(0, 1)[:cameras].contiguous()
