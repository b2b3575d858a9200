"""Of strips measured where a shaft was expected, those that are one."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.geometry.lines import point_line_distance
from rmis_calib.vision.detections import EndKind, FrameReason, ShaftDetections

# Largest distance from the expected contours, as a share of the shaft's width, and how many times likelier a strip so
# near is a shaft. On 213 pictures of `brutal` with an expectation off by 2 px and 0.3 deg, 78 % of the shafts are
# measured so near, and 2 % of what is measured so near is wrong; with an expectation 5 deg or a width off, 3 of 2,160.
_NEAR = 0.08
_ODDS = 30.0


def where_expected(
    measured: ShaftDetections,
    contour_n: Float[Tensor, "b 2 3"],
    width: Float[Tensor, "b k"],
    broken: Bool[Tensor, " b"],
    least: float,
) -> ShaftDetections:
    """The surest of each frame's strips that lies near the expected contours, one candidate a frame.

    Args:
        measured: strips of the frames, whatever their confidence.
        contour_n: expected normals of both contours' planes.
        width: of the strips, normalised units.
        broken: frames that are none.
        least: confidence from which a candidate is valid.
    """
    line = (contour_n / contour_n[..., :2].norm(dim=-1, keepdim=True))[:, None, :, None]  # (b, 1, edge, 1, 3)
    forwards, backwards = (
        point_line_distance(points, line).abs().amax((-2, -1))
        for points in (measured.contour_xy, measured.contour_xy.flip(-3))
    )
    off = torch.where(measured.direction_known, forwards, torch.minimum(forwards, backwards))
    near = measured.valid & (off < _NEAR * width) & ~broken[:, None]
    odds = _ODDS * measured.confidence
    sure = torch.where(near, odds / (odds + 1 - measured.confidence), 0.0)
    valid = sure >= least
    best = torch.where(valid, sure, 0.0).argmax(1)
    rows = torch.arange(len(best), device=best.device)
    fields = {name: value[rows, best][:, None] for name, value in vars(measured).items() if value.ndim > 1}
    chosen = valid[rows, best][:, None]
    fields |= {"valid": chosen, "confidence": torch.where(chosen, sure[rows, best][:, None], torch.nan)}
    # Before a chessboard or under tissue the shaft's tone ends where it does not: only an end that the network knows
    # counts. With the others a real recording went from 13 px off at the head to 77, and without them to 12.
    known_end = (fields["end_kind"] == int(EndKind.TUBE)) | (fields["end_kind"] == int(EndKind.RING))
    fields["end_valid"] = fields["end_valid"] & chosen & known_end
    fields["direction_known"] = fields["direction_known"] & chosen
    reason = torch.where(chosen[:, 0], int(FrameReason.OK), int(FrameReason.EDGES_UNCLEAR))
    return ShaftDetections(reason=torch.where(broken, int(FrameReason.BAD_PIXELS), reason), **fields)
