"""Candidates that stand still while the instrument moves: furniture, and the squares of a chessboard."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rmis_calib.geometry.rigid import rotate_vectors
from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.vision import FrameReason, ShaftDetections

# Lines of one thing that stands still agree to a pixel; cells of four, normalised units and rad.
_CELL_OFFSET, _CELL_ANGLE = 0.006, 0.01
_LEAST_FRAMES = 4
# A shaft that turns in the plane through the optical centre keeps its line: only an instrument that has turned in two
# directions, and by more than its kinematics err (1 sigma, rad), must have moved in the picture.
_TURNED = 0.02


def background_candidates(detections: ShaftDetections, poses: MotionPoses) -> Bool[Tensor, "m k"]:
    """Which candidates lie where others of frames lie in which the joints point the instrument elsewhere.

    Args:
        detections: of the motions, in one camera.
        poses: of the same motions.
    """
    arm_v_axis = rotate_vectors(poses.arm_T_rcm, poses.rcm_v_axis)
    line = _line(detections)
    still = torch.zeros_like(detections.valid)
    # Cells have borders: four grids, half a cell apart, each of which may hold a thing as a whole.
    for shift in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5)):
        still |= _stands_still(_cells(line, detections.valid, shift), arm_v_axis)
    return still & detections.valid


def without_background(detections: ShaftDetections, poses: MotionPoses) -> tuple[ShaftDetections, int]:
    """Detections of all frames without the candidates that stand still, and in how many frames there were such."""
    frames = torch.as_tensor(poses.frames, device=detections.valid.device)
    still = background_candidates(detections.of_frames(frames), poses)
    valid, reason = detections.valid.clone(), detections.reason.clone()
    valid[frames] &= ~still
    emptied = frames[still.any(-1) & ~valid[frames].any(-1)]
    reason[emptied] = int(FrameReason.BACKGROUND)
    return replace(detections, valid=valid, reason=reason), int(still.any(-1).sum())


def about_background(side: str, frames: int) -> str:
    """The note that a result carries."""
    return (
        f"camera_{side}: in {frames} frames something shaft-like stood still while the instrument moved; it is left out"
    )


def _line(detections: ShaftDetections) -> Float[Tensor, "m k 2"]:
    """Angle of the axis, 0 to pi, and its signed distance from the centre; 0 for none."""
    axis = torch.nan_to_num(detections.axis_xy.double())
    along = axis[:, :, 1] - axis[:, :, 0]
    angle = torch.atan2(along[..., 1], along[..., 0]) % torch.pi
    middle = axis.mean(2)
    return torch.stack([angle, middle[..., 0] * angle.sin() - middle[..., 1] * angle.cos()], -1)


def _cells(
    line: Float[Tensor, "m k 2"], valid: Bool[Tensor, "m k"], shift: tuple[float, float]
) -> Int64[Tensor, "m k"]:
    """Number of the cell that each line lies in; lines that are none have cells of their own, one for all."""
    place = torch.stack([line[..., 0] / _CELL_ANGLE + shift[0], line[..., 1] / _CELL_OFFSET + shift[1]], -1).floor()
    place = torch.where(valid[..., None], place, torch.inf)
    _, cell = place.flatten(0, 1).unique(dim=0, return_inverse=True)
    return cell.reshape(valid.shape)


def _stands_still(cell: Int64[Tensor, "m k"], arm_v_axis: Float[Tensor, "m 3"]) -> Bool[Tensor, "m k"]:
    """Whether the instrument's directions over the frames that share a candidate's cell spread in two dimensions."""
    count = int(cell.max()) + 1
    v = arm_v_axis.double()[:, None].expand(-1, cell.shape[1], -1).flatten(0, 1)
    moments = torch.cat([torch.ones_like(v[:, :1]), v, (v[:, :, None] * v[:, None]).flatten(1)], 1)
    total = moments.new_zeros(count, moments.shape[1]).index_add_(0, cell.flatten(), moments)
    size = total[:, :1].clamp(min=1)
    mean, square = total[:, 1:4] / size, (total[:, 4:] / size).unflatten(1, (3, 3))
    spread = torch.linalg.eigvalsh(square - mean[:, :, None] * mean[:, None])[:, 1].clamp(min=0).sqrt()
    return ((size[:, 0] >= _LEAST_FRAMES) & (spread > _TURNED))[cell]
