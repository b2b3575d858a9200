"""Candidates for the next motion as the picture shows it, for observations without joints.

The instrument swings about its RCM and slides along its shaft; the laparoscope swings about a pivot behind the camera
on the viewing axis, slides along that axis and rolls about it: what an arm with a remote centre can do to a 0 degree
endoscope, near enough to tell which motion is worth making.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rigid import rigid_from_rotation_translation, rigid_inverse
from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.pipeline.answer.advice.candidates import Candidates, at_found_setup
from rmis_calib.pipeline.words import joined
from rmis_calib.solver import Problem, Solution
from rmis_calib.solver.assess.next_motion import measured_alike
from rmis_calib.solver.settings import AdviceSettings

PIVOT_BEHIND_MM = 120.0
"""Assumed distance of the laparoscope's trocar behind the camera."""
WHERE = (
    "near the last motion (an observations file holds no joints, so motions are described as the right image shows "
    "them; a motion of the laparoscope counts only if its arm is logged)"
)
_LEAST_ACROSS = 0.5
"""Sine to the shaft below which a direction of the picture is none in which the tip could swing."""
_SIDES = {
    "to the right": (1.0, 0.0, 0.0),
    "to the left": (-1.0, 0.0, 0.0),
    "down": (0.0, 1.0, 0.0),
    "up": (0.0, -1.0, 0.0),
    "away from the camera": (0.0, 0.0, 1.0),
    "towards the camera": (0.0, 0.0, -1.0),
}
"""Directions in `camera_right`."""
_TURNS = {
    "to the right": (0.0, 1.0, 0.0),
    "to the left": (0.0, -1.0, 0.0),
    "up": (1.0, 0.0, 0.0),
    "down": (-1.0, 0.0, 0.0),
    "clockwise": (0.0, 0.0, 1.0),
    "anticlockwise": (0.0, 0.0, -1.0),
}
"""Axes in `camera_right` (y points down) about which the view turns that way."""
_PARTS = (0.5, 1.0)
"""Parts of the reach that are tried."""
Words = tuple[str, ...]


def pose_candidates(problem: Problem, solution: Solution, motion: int, settings: AdviceSettings) -> Candidates:
    """What the instrument, the laparoscope and both can do from one motion on.

    Args:
        problem: what was solved, with one trial axis of length 1.
        solution: its answer.
        motion: index of the motion to start from.
        settings: how far to go.
    """
    camera_right_T_arm, problem = solution.camera_right_T_arm.reshape(4, 4), at_found_setup(problem, solution)
    arm_T_rcm, v = problem.arm_T_rcm[0, motion], problem.rcm_v_axis[0, motion]
    swings = _swings(camera_right_T_arm[:3, :3] @ arm_T_rcm[:3, :3], v, math.radians(settings.reach_deg))
    slides = _slides(problem, settings.reach_mm)
    moves = _laparoscope_moves(camera_right_T_arm, settings)
    # The first of each is to do nothing; all three together are no motion.
    triples = [(i, j, k) for i in range(len(swings)) for j in range(len(slides)) for k in range(len(moves))][1:]
    words = [(*swings[i][0], *slides[j][0], *moves[k][0]) for i, j, k in triples]
    turn = torch.stack([swings[i][1] for i, _, _ in triples])
    slide_mm = torch.tensor([slides[j][1] for _, j, _ in triples], dtype=v.dtype, device=v.device)
    steps = torch.stack([moves[k][1] for _, _, k in triples])
    like = measured_alike(problem, len(triples), motion)
    turned_v = turn @ v
    poses = rigid_inverse(steps) @ arm_T_rcm  # seen from the arm where it is then
    at = replace(
        like,
        arm_T_rcm=poses[None],
        rcm_v_axis=turned_v[None],
        laparoscope_base_T_arm=None
        if problem.laparoscope_base_T_arm is None
        else (problem.laparoscope_base_T_arm[0, motion] @ steps)[None],
        clock_derivative=None if like.clock_derivative is None else torch.zeros_like(like.clock_derivative),
        rcm_s_end_mm=like.rcm_s_end_mm + slide_mm,
        rcm_p_head=(turn @ problem.rcm_p_head[0, motion] + slide_mm[:, None] * turned_v)[None],
    )
    return Candidates(at, torch.tensor([len(parts) for parts in words]), tuple(joined(list(parts)) for parts in words))


def _swings(
    camera_right_R_rcm: Float[Tensor, "3 3"], v: Float[Tensor, "3"], reach_rad: float
) -> list[tuple[Words, Float[Tensor, "3 3"]]]:
    """Turns of the shaft about its RCM, in `rcm`, by where its tip goes in the picture."""
    out: list[tuple[Words, Tensor]] = [((), torch.eye(3, dtype=v.dtype, device=v.device))]
    for side, direction in _SIDES.items():
        axis = torch.linalg.cross(v, camera_right_R_rcm.mT @ v.new_tensor(direction))
        if float(axis.norm()) < _LEAST_ACROSS:
            continue
        for part in _PARTS:
            words = f"swing the instrument's tip {math.degrees(part * reach_rad):.3g} deg {side}"
            out.append(((words,), rotvec_to_matrix(part * reach_rad * axis / axis.norm())))
    return out


def _slides(problem: Problem, reach_mm: float) -> list[tuple[Words, float]]:
    """Ways along the shaft, mm; none where nothing in the pictures would show them."""
    out: list[tuple[Words, float]] = [((), 0.0)]
    if bool(torch.isfinite(problem.end_xy).any()) or bool(torch.isfinite(problem.head_xy).any()):
        for part in _PARTS:
            out.append(((f"insert the instrument by {part * reach_mm:.3g} mm",), part * reach_mm))
            out.append(((f"withdraw the instrument by {part * reach_mm:.3g} mm",), -part * reach_mm))
    return out


def _laparoscope_moves(
    camera_right_T_arm: Float[Tensor, "4 4"], settings: AdviceSettings
) -> list[tuple[Words, Float[Tensor, "4 4"]]]:
    """Places of `arm` after moves of the laparoscope, in `arm` before them."""
    pivot = camera_right_T_arm.new_tensor((0.0, 0.0, -PIVOT_BEHIND_MM))
    eye = torch.eye(3, dtype=pivot.dtype, device=pivot.device)
    camera_right_T_moved: list[tuple[Words, Tensor]] = [((), torch.eye(4).to(pivot))]
    for part in _PARTS:
        for side, axis in _TURNS.items():
            R = rotvec_to_matrix(math.radians(part * settings.reach_deg) * pivot.new_tensor(axis))
            words = f"turn the laparoscope's view {part * settings.reach_deg:.3g} deg {side}"
            camera_right_T_moved.append(((words,), rigid_from_rotation_translation(R, pivot - R @ pivot)))
        for verb, sign in (("insert", 1.0), ("withdraw", -1.0)):
            shift = pivot.new_tensor((0.0, 0.0, sign * part * settings.reach_mm))
            words = f"{verb} the laparoscope by {part * settings.reach_mm:.3g} mm"
            camera_right_T_moved.append(((words,), rigid_from_rotation_translation(eye, shift)))
    arm_T_camera_right = rigid_inverse(camera_right_T_arm)
    return [(words, arm_T_camera_right @ moved @ camera_right_T_arm) for words, moved in camera_right_T_moved]
