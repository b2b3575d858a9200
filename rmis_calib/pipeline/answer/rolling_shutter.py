"""Pictures whose rows are read one after the other: every measured point is put to the instant of the middle row.

A point in row v of H is read `rolling_shutter_s` (v / (H - 1) - 1/2) after the middle row. Meanwhile the shaft moves by
what an answer that is right to a degree predicts: the points are moved back by that, and the answer is sought again.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.lines import point_line_distance
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.arms.found_offsets import poses_at_motions
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.arms.poses import row_delay_s
from rmis_calib.pipeline.motions.association import Choice
from rmis_calib.pipeline.pictures.detection import View

ROUNDS = 6
"""Solves at most; each brings an answer that the rows spoiled ten times nearer."""
SETTLED_PX = 0.01
_POINTS = ("contour_xy", "axis_xy", "end_xy")
_HEAD = "head_xy"


def with_rows_at_one_instant(
    run: CalibrationRun, solve_again: Callable[[tuple[View, ...]], CalibrationRun]
) -> tuple[CalibrationRun, str]:
    """The run solved with the points of its views where they would be had all rows been read with the middle one, and a
    sentence on it; empty, and the run as it is, where nothing is known of the rows or of the joints' velocity.

    A first answer may be weak just because of the rows; it is sought until the points stay.

    Args:
        run: solved from the points as they were measured.
        solve_again: the same from other views.
    """
    rolling_s, as_measured = run.recording.rolling_shutter_s, run.views
    if not rolling_s:
        return run, ""
    largest_px, before = 0.0, [torch.zeros(1, 1, 1)] * len(as_measured)
    for _ in range(ROUNDS):
        steps = _all_steps(run, as_measured)
        if steps is None:
            break
        change_px = [
            _largest_px(step["contour_xy"] - old, view, choice)
            for step, old, view, choice in zip(steps, before, as_measured, run.choices, strict=True)
        ]
        before = [step["contour_xy"] for step in steps]
        largest_px = max(map(_largest_px, before, as_measured, run.choices))
        if max(change_px) < SETTLED_PX:
            break
        run = solve_again(
            tuple(_moved(view, run.poses.frames, step) for view, step in zip(as_measured, steps, strict=True))
        )
    if not largest_px:
        return run, ""
    return run, (
        f"Rows are read within {1e3 * rolling_s:.3g} ms: measured points were moved by up to {largest_px:.2g} px, to "
        "the instant of the middle row."
    )


def _all_steps(run: CalibrationRun, views: tuple[View, ...]) -> list[dict[str, Tensor]] | None:
    """How far each view's points are to be moved; None without an answer that predicts it."""
    if run.result.camera_right_T_arm is None:
        return None
    unknowns = KinematicUnknowns(run.recording, run.poses.frames, str(run.poses.arm_T_rcm.device))
    if not unknowns.has_clock:
        return None
    half_s = 0.5 * run.recording.rolling_shutter_s
    first, last = (
        replace(run, poses=poses_at_motions(unknowns, run.poses, run.result.kinematic_offsets, later_s))
        for later_s in (-half_s, half_s)
    )
    steps = [_steps(view, choice, first, last) for view, choice in zip(views, run.choices, strict=True)]
    return None if any(step is None for step in steps) else [step for step in steps if step is not None]


def _largest_px(step: Tensor, view: View, choice: Choice) -> float:
    """Largest length of the steps of what is taken for the shaft, px."""
    rows = torch.arange(len(choice.candidate), device=step.device)[choice.taken]
    taken = step[rows, choice.candidate[rows]]
    focal = 1.0 if view.camera is None else float(view.camera.focal)
    return focal * float(torch.linalg.vector_norm(taken, dim=-1).amax()) if taken.numel() else 0.0


def _steps(view: View, choice: Choice, first: CalibrationRun, last: CalibrationRun) -> dict[str, Tensor] | None:
    """How far each point of the motions' detections is to be moved, normalised units; None without a prediction.

    Args:
        view: what was measured, in which candidate of `choice`.
        first, last: predict the shaft when the first and when the last row is read.
    """
    lines, ends, heads = [], [], []
    for run in (first, last):
        planes, end, head = run.predicted_contours(view), run.predicted_ends(view), run.predicted_heads(view)
        if planes is None or end is None or head is None:
            return None
        lines.append(torch.where(choice.reversed[:, None, None], planes.flip(1), planes))  # (m, 2, 3)
        ends.append(end[:, None, :2] / end[:, None, 2:])
        heads.append(head[:, :2] / head[:, 2:])
    if view.camera is None:
        return None
    found, camera = view.at(first.poses.frames), view.camera.to(torch.float64, ends[0].device)

    def share(xy: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 1"]:
        """Part of the motion between first and last row that a point's row sees after the middle one."""
        return row_delay_s(camera, camera.pixels(xy)[..., 1], 1.0)[..., None]

    def across(xy: Float[Tensor, "*b 2"], before: Float[Tensor, "*#b 3"], after: Float[Tensor, "*#b 3"]) -> Tensor:
        """Across a line that moves from one to another: to as far from it then as the point is at its own instant."""
        farther = point_line_distance(xy, after) - point_line_distance(xy, before)
        return torch.nan_to_num(share(xy) * after[..., :2] * farther[..., None])

    edges = [_lines(each)[:, None, :, None] for each in lines]
    axes = [_lines(each.sum(1))[:, None, None] for each in lines]
    contour_xy, axis_xy, end_xy = (getattr(found, name).double() for name in _POINTS)
    along = torch.nan_to_num(share(end_xy) * (ends[0] - ends[1]))
    steps = across(contour_xy, *edges), across(axis_xy, *axes), along
    labelled = row_delay_s(camera, _labelled_rows(view, first).to(heads[0]), 1.0)[:, None]
    return dict(zip(_POINTS, steps, strict=True)) | {_HEAD: torch.nan_to_num(labelled * (heads[0] - heads[1]))}


def _labelled_rows(view: View, run: CalibrationRun) -> Float[Tensor, " m"]:
    """Row of each motion's labelled head point, px; NaN where there is none."""
    rows, points = np.full(run.recording.n_frames, np.nan), run.recording.head_points
    uv = None if points is None else points.uv(view.side)
    if points is not None and uv is not None:
        rows[points.frames] = uv[:, 1]
    return torch.from_numpy(rows[run.poses.frames])


def _lines(planes: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Where planes through the optical centre meet the picture, scaled for `point_line_distance`."""
    return planes / torch.linalg.vector_norm(planes[..., :2], dim=-1, keepdim=True)


def _moved(view: View, frames: np.ndarray, steps: dict[str, Tensor]) -> View:
    """The view with the detections of some frames moved, and how far to move their labelled head points."""
    index, values = torch.as_tensor(frames, device=view.detections.valid.device), {}
    for name in _POINTS:
        value = getattr(view.detections, name)
        values[name] = value.index_add(0, index, steps[name].to(value.dtype))
    head = steps[_HEAD]
    head_step = head.new_zeros(len(view.detections.valid), 2).index_add(0, index.to(head.device), head)
    return replace(view, detections=replace(view.detections, **values), head_step=head_step)
