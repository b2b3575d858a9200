"""Residuals with their sign, in px, with what they may depend on: the place in the picture, the joints, the time.

A sign is what a pattern is told by: residuals that are all positive in one corner of the picture speak of the lens, and
ones that turn over with a joint of that joint; their sizes alone would look like noise.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.geometry.cameras import Camera, corrected_point
from rmis_calib.geometry.lines import contour_planes, point_line_distance
from rmis_calib.pipeline.answer.predicted_shaft import PredictedShaft, in_picture, predict_shaft
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.motions.association import reversed_direction
from rmis_calib.pipeline.motions.observations import labelled_heads
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.pipeline.scene import readings_of

KINDS = {
    "across": (
        "Shaft across",
        "Positive: the shaft lies to the right of its prediction, for someone looking towards the tip.",
    ),
    "width": ("Shaft width", "Positive: the shaft is wider in the picture than predicted, so nearer or thicker."),
    "end": ("Shaft end along", "Positive: the shaft ends farther towards the tip than predicted."),
    "head_across": ("Head point across", "Positive: the label lies to the right of its prediction."),
    "head_along": ("Head point along", "Positive: the label lies farther towards the tip than its prediction."),
}
"""Kinds of residuals: heading, and what a positive one means."""


@dataclass(frozen=True, eq=False)
class SignedResiduals:
    """One kind of residual, N of them over motions and cameras.

    Attributes:
        kind: key of `KINDS`.
        px: signed.
        motion: number of the motion, its frame.
        is_left: whether the left camera measured it.
        used: whether it entered the estimate, or, of head points that did not, whether its motion did.
        group: of neighbouring motions that it belongs to (`result.consistency`); -1 for none.
        uv: where in the picture, raw px.
        across_uv: direction in the picture in which it counts as positive, unit.
    """

    kind: str
    px: Float[np.ndarray, " n"]
    motion: Int[np.ndarray, " n"]
    is_left: Bool[np.ndarray, " n"]
    used: Bool[np.ndarray, " n"]
    group: Int[np.ndarray, " n"]
    uv: Float[np.ndarray, "n 2"]
    across_uv: Float[np.ndarray, "n 2"]

    def at(self, index: Int[np.ndarray, " k"]) -> "SignedResiduals":
        """Some of them."""
        arrays = {name: value[index] for name, value in vars(self).items() if name != "kind"}
        return SignedResiduals(self.kind, **arrays)


@dataclass(frozen=True, eq=False)
class ResidualEvidence:
    """All residuals of a calibration, and what they are drawn over.

    Attributes:
        kinds: one entry a kind that was measured.
        joints: readings by column, one a frame of the recording, those that moved.
        times_s: of each frame.
        picture_size: (height, width).
    """

    kinds: tuple[SignedResiduals, ...]
    joints: dict[str, Float[np.ndarray, " f"]]
    times_s: Float[np.ndarray, " f"]
    picture_size: tuple[int, int]


def residual_evidence(run: CalibrationRun) -> ResidualEvidence | None:
    """Signed residuals of every motion; None without an answer."""
    if run.result.camera_right_T_arm is None:
        return None
    by_kind: dict[str, list[dict[str, np.ndarray]]] = {}
    group = run.groups
    for view in run.views:
        motions = np.arange(len(run.poses.frames))
        predicted, camera = predict_shaft(run, view, motions), run.camera(view)
        if predicted is None or camera is None:
            continue
        for kind, (px, uv, across) in _measured(run, view, predicted, camera).items():
            known = np.isfinite(px)
            frames = run.poses.frames[known]
            by_kind.setdefault(kind, []).append(
                {
                    "px": px[known],
                    "motion": frames,
                    "is_left": np.full(len(frames), view.side == "left"),
                    "used": _counted(run, kind, view.side)[known],
                    "group": group[known],
                    "uv": uv[known],
                    "across_uv": across[known],
                }
            )
    measured = [kind for kind in KINDS if any(len(part["px"]) for part in by_kind.get(kind, []))]
    joined = tuple(_joined(kind, by_kind[kind]) for kind in measured)
    if not joined:
        return None
    times_s = np.asarray(run.recording.frame_times_s, dtype=float)
    return ResidualEvidence(joined, _moving_joints(run), times_s, run.views[0].source.size)


def _joined(kind: str, parts: list[dict[str, np.ndarray]]) -> SignedResiduals:
    """One kind of both cameras."""
    return SignedResiduals(kind, **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def _counted(run: CalibrationRun, kind: str, side: str) -> Bool[np.ndarray, " m"]:
    """Whether the motion was used, and with it this measurement: single ends are left out of motions that are used."""
    used = run.result.motions.used[run.poses.frames]
    entry = run.result.residuals.get(f"end_{side}") if kind == "end" else None
    return used if entry is None else used & np.isfinite(entry.by_motion[run.poses.frames])


def _moving_joints(run: CalibrationRun) -> dict[str, Float[np.ndarray, " f"]]:
    """Logged readings at the frames, deg and mm, of joints that moved by more than a hair; NaN where unknown."""
    columns, frames, readings = readings_of(run.recording, run.result.kinematic_offsets.clock)
    found = {}
    for column, values in zip(columns, readings.numpy().T, strict=True):
        name, _, unit = column.rpartition("_")
        values = np.degrees(values) if unit == "rad" else values
        if np.ptp(values) > 0.1:
            by_frame = np.full(run.recording.n_frames, np.nan)
            by_frame[frames] = values
            found[f"{name}, {'deg' if unit == 'rad' else unit}"] = by_frame
    return found


def _measured(
    run: CalibrationRun, view: View, predicted: PredictedShaft, camera: Camera
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """By kind: signed px, place and positive direction, one a motion; NaN where not measured."""
    focal = float(camera.focal)
    choice, found = run.choices[run.views.index(view)], view.at(run.poses.frames)
    rows = torch.arange(len(choice.candidate), device=choice.candidate.device)
    best = choice.candidate.clamp_min(0)
    contour = found.contour_xy[rows, best].double()
    contour = torch.where(choice.reversed[:, None, None, None], reversed_direction(contour), contour)
    contour = torch.where(choice.taken[:, None, None, None], contour, torch.nan).cpu()
    off = run.result.intrinsic_correction(view.side)
    contour = torch.stack(corrected_point(contour[..., 0], contour[..., 1], *off), dim=-1)
    v = torch.nn.functional.normalize(predicted.end - predicted.rcm, dim=-1)
    radius_mm = run.result.nuisance("radius", run.recording.shaft_diameter_mm / 2)
    planes = contour_planes(predicted.rcm, v, radius_mm)
    lines = planes / planes[..., :2].norm(dim=-1, keepdim=True)
    edge = point_line_distance(contour, lines[:, :, None, :]).mean(-1)  # (m, edge)
    right = torch.nn.functional.normalize(planes.sum(1)[:, :2], dim=-1)  # right of who looks towards the tip
    along = torch.stack([right[:, 1], -right[:, 0]], dim=-1)
    place = contour.mean((1, 2))
    kinds = {
        "across": (edge.mean(-1), place, right),
        "width": (edge[:, 1] - edge[:, 0], place, right),
    }
    has_end = choice.taken & found.end_valid[rows, best] & ~choice.reversed
    end = torch.where(has_end[:, None], found.end_xy[rows, best].double(), torch.nan).cpu()
    end = torch.stack(corrected_point(end[:, 0], end[:, 1], *off), dim=-1)
    if "end_offset" in run.result.nuisances:
        kinds["end"] = (((end - _flat(predicted.end)) * along).sum(-1), end, along)
    labelled = labelled_heads(run.recording, view.side, camera, view.head_step)
    if labelled is not None:
        heads = labelled[torch.as_tensor(run.poses.frames)]
        gap = heads - _flat(predicted.head)
        kinds["head_across"] = ((gap * right).sum(-1), heads, right)
        kinds["head_along"] = ((gap * along).sum(-1), heads, along)
    return {
        kind: (focal * value.numpy(), in_picture(camera, _deep(xy)), direction.numpy())
        for kind, (value, xy, direction) in kinds.items()
    }


def _flat(camera_p: Float[Tensor, "m 3"]) -> Float[Tensor, "m 2"]:
    return camera_p[:, :2] / camera_p[:, 2:]


def _deep(xy: Float[Tensor, "m 2"]) -> Float[Tensor, "m 3"]:
    """Points a millimetre-scale depth away that project there; NaN stays NaN."""
    return torch.nn.functional.pad(xy, (0, 1), value=1.0) * 100.0
