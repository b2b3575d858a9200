"""Frames of a calibration with the detected and the predicted instrument drawn in."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rmis_calib.geometry.cameras import Camera
from rmis_calib.pipeline.answer.predicted_shaft import PredictedShaft, in_picture, inside, predict_shaft
from rmis_calib.pipeline.answer.result import TOO_FEW
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.pipeline.scene import scene_of
from rmis_calib.report.drawing.marks import Mark
from rmis_calib.report.drawing.overlays import Overlay
from rmis_calib.results import CalibrationResult

_AT_ONCE = 16
"""Frames read in one call: opening and seeking a video for each takes longer than drawing, and all may not fit."""
_MOST_POINTS = 24
"""Points of a drawn edge: lenses bend it by little."""
_AXIS_MM = 10.0
_TIP_BEYOND_MM = 1.0
"""Distance of the arm's last frame beyond the head point from which it is drawn, too."""


def overlays(run: CalibrationRun, motions: np.ndarray, side: str | None = None) -> Iterator[Overlay]:
    """Pictures of these motions (increasing numbers) in each view, or in that of one side; each video is read once, a
    few frames at a time."""
    for view in run.views:
        if side not in (None, view.side):
            continue
        for start in range(0, len(motions), _AT_ONCE):
            part = motions[start : start + _AT_ONCE]
            predicted, tips = predict_shaft(run, view, part), _tips(run, view, part)
            images = view.source.frames(run.poses.frames[part].tolist())
            for index, (motion, image) in enumerate(zip(part.tolist(), images, strict=True)):
                marks = (*detected_marks(run, view, motion), *predicted_marks(run, view, predicted, index, tips))
                yield overlay_of(run, view, motion, image, marks)


def spread(total: int, count: int) -> np.ndarray:
    """Indices of `count` of `total` things, evenly spread from the first to the last; all for -1."""
    if count < 0 or count >= total:
        return np.arange(total)
    return np.unique(np.linspace(0, total - 1, count).round().astype(int)) if count else np.arange(0)


def overlay_of(
    run: CalibrationRun,
    view: View,
    motion: int,
    image: UInt8[Tensor, "3 h w"],
    marks: Sequence[Mark],
    caption: str = "",
) -> Overlay:
    """One frame; the caption is by default what became of the motion."""
    frame = int(run.poses.frames[motion])
    return Overlay(
        frame=frame,
        camera=view.side,
        image=np.ascontiguousarray(image.permute(1, 2, 0).cpu().numpy()),
        caption=caption or caption_of(run.result, view.side, frame),
        used=bool(run.result.motions.used[frame]),
        marks=tuple(marks),
    )


def caption_of(result: CalibrationResult, side: str, frame: int) -> str:
    """Why the motion was not used, or how far its contours are from the prediction."""
    reason = result.motions.reasons[frame]
    if reason == TOO_FEW:
        return "usable"
    px = result.residual(f"contour_{side}", frame)
    return reason or ("not measured here" if px is None else f"contours {px:.2f} px from the prediction")


def detected_marks(run: CalibrationRun, view: View, motion: int) -> list[Mark]:
    """What was found in one frame: the candidate that was taken, those that were not, and a labelled head point."""
    frame = int(run.poses.frames[motion])
    taken, used = int(run.choices[run.views.index(view)].candidate[motion]), bool(run.result.motions.used[frame])
    found, marks = view.detections, []
    contours = found.contour_uv[frame].double().cpu().numpy()
    candidates = np.flatnonzero(np.isfinite(contours).all((1, 2, 3))).tolist()
    for candidate in sorted(candidates, key=lambda number: number == taken):  # the one that was taken on top
        style = "detected" if candidate == taken and (used or _is_unsolved(run)) else "refused"
        label = f"confidence {float(found.confidence[frame, candidate]):.2f}" if style == "refused" else ""
        marks += [Mark(style, contours[candidate, 0]), Mark(style, contours[candidate, 1], label)]
    if taken >= 0 and bool(found.end_valid[frame, taken]) and view.camera is not None:
        # On the axis, as the prediction is: the rim that is seen lies in front of it, several px further along.
        end = torch.nn.functional.pad(found.end_xy[frame, taken].double().cpu(), (0, 1), value=1.0)
        marks.append(Mark("end", view.camera.project(end)[0].numpy()[None]))
    heads = run.recording.head_points
    if heads is not None:
        uv = heads.uv(view.side)
        row = np.flatnonzero(heads.frames == frame)
        if uv is not None and len(row):
            marks.append(Mark("head", np.asarray(uv[row[0]], dtype=float)[None]))
    return marks


def _is_unsolved(run: CalibrationRun) -> bool:
    """Whether there is no answer that a candidate could contradict."""
    return run.result.camera_right_T_arm is None


def predicted_marks(
    run: CalibrationRun, view: View, predicted: PredictedShaft | None, index: int, tips: Float[Tensor, "m 3"] | None
) -> list[Mark]:
    """Where the result puts the instrument in one frame, the `index`-th of the predicted ones."""
    camera = run.camera(view)
    if predicted is None or camera is None:
        return []
    size = view.source.size
    marks = [Mark("predicted", shortened(in_picture(camera, edge), size)) for edge in predicted.edges[index]]
    axis = in_picture(camera, predicted.edges[index].mean(0))
    marks += _towards_rcm(axis, in_picture(camera, predicted.rcm[index]), size)
    end, head = predicted.end[index], predicted.head[index]
    end_uv, head_uv = in_picture(camera, end), in_picture(camera, head)
    if "end_offset" in run.result.nuisances:
        marks.append(Mark("end_predicted", end_uv[None]))
    chain = [end_uv, head_uv]
    along = torch.nn.functional.normalize(end - predicted.rcm[index], dim=-1)
    if tips is not None and float((tips[index] - head) @ along) > _TIP_BEYOND_MM:
        chain.append(in_picture(camera, tips[index]))
        marks.append(Mark("tip", chain[-1][None]))
    marks += [Mark("wrist", np.stack(chain)), Mark("head_predicted", head_uv[None])]
    return [*marks, *_axes(camera, predicted.camera_R_arm, end)]


def _axes(camera: Camera, camera_R_arm: Float[Tensor, "3 3"], origin: Float[Tensor, "3"]) -> list[Mark]:
    """The axes of `arm`, moved to a point of the picture: how the answer is turned."""
    ends = origin + _AXIS_MM * camera_R_arm.mT
    start = in_picture(camera, origin)
    return [Mark(name, np.stack([start, in_picture(camera, end)])) for name, end in zip("xyz", ends, strict=True)]


def _towards_rcm(axis: Float[np.ndarray, "p 2"], rcm_uv: Float[np.ndarray, "2"], size: tuple[int, int]) -> list[Mark]:
    """An arrow along the shaft to the RCM, or to where the shaft comes in from it."""
    seen = axis[inside(axis, size)]
    if len(seen) < 2:
        return []
    first = rcm_uv if bool(inside(rcm_uv[None], size)[0]) else seen[0]
    length = 0.12 * size[1]
    away = np.linalg.norm(seen - first, axis=-1)
    back = seen[int(np.abs(away - length).argmin())]
    return [Mark("rcm", np.stack([back, first]))]


def shortened(uv: Float[np.ndarray, "p 2"], size: tuple[int, int]) -> Float[np.ndarray, "q 2"]:
    """The part of a line that lies in the picture or just outside of it, in few points."""
    seen = np.flatnonzero(inside(uv, size, margin=0.1)).tolist()
    if not seen:
        return np.empty((0, 2))
    part = uv[seen[0] : seen[-1] + 1]
    return part[spread(len(part), _MOST_POINTS)]


def _tips(run: CalibrationRun, view: View, motions: np.ndarray) -> Float[Tensor, "m 3"] | None:
    """The last frame of the instrument's arm, in one camera, mm."""
    camera_T_arm = run.camera_T_arm(view)
    if camera_T_arm is None or not len(motions):
        return None
    scene = scene_of(run.recording, run.result, run.poses.frames[motions])
    base_p_tip, base_T_arm = torch.as_tensor(scene.instrument_points[:, -1]), torch.as_tensor(scene.base_T_arm)
    arm_p_tip = torch.einsum("mji,mj->mi", base_T_arm[:, :3, :3], base_p_tip - base_T_arm[:, :3, 3])
    camera_T_arm = camera_T_arm.cpu()
    return arm_p_tip @ camera_T_arm[:3, :3].mT + camera_T_arm[:3, 3]
