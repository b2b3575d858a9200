"""Whether parts of the data agree: groups of neighbouring motions, halves, before and after, and the clock."""

import numpy as np
import torch

from rmis_calib.pipeline.answer.motion_names import NUMBERED, MotionNames
from rmis_calib.results import Change, ClockJump, Consistency, GroupShift, Shift
from rmis_calib.solver import Solution

WORTH_SAYING = 1.25
"""Growth of sigma by disagreeing groups from which it is said."""


def consistency_of(solution: Solution) -> Consistency | None:
    """Groups of neighbouring motions and halves against each other; None without groups."""
    groups, jump = solution.groups, solution.clock_jump
    if groups is None or groups.count == 0 or bool((groups.group < 0).all()):
        return None
    numbers = groups.group.reshape(-1).cpu().numpy()
    sizes = np.bincount(numbers[numbers >= 0], minlength=groups.count).tolist()
    without = [
        GroupShift(*size_of(shift), sigmas, motions=motions)
        for shift, sigmas, motions in zip(groups.shift[0], groups.sigmas[0].tolist(), sizes, strict=True)
    ]
    return Consistency(
        inflation=float(groups.inflation),
        group_by_motion=numbers,
        groups=tuple(without),
        halves=Shift(*size_of(groups.halves[0]), float(groups.halves_sigmas)),
        change=Change(*size_of(groups.change[0]), float(groups.change_sigmas), before_motion=int(groups.change_at)),
        clock_jump=None if jump is None else ClockJump(float(jump.jump_s), float(jump.sigmas), int(jump.at)),
    )


def size_of(shift: torch.Tensor) -> tuple[float, float]:
    """Angle in degrees and distance in mm of a (6,) difference of two transforms."""
    return float(torch.rad2deg(shift[:3].norm())), float(shift[3:].norm())


def about_groups(consistency: Consistency | None, names: MotionNames = NUMBERED) -> tuple[str, ...]:
    """Whether parts of the data disagree by more than noise, in words."""
    if consistency is None or (consistency.inflation or 1.0) < WORTH_SAYING:
        return ()
    worst = int(np.argmax([group.sigmas or 0.0 for group in consistency.groups]))
    group = consistency.groups[worst]
    number = consistency.group_by_motion
    return (
        "Groups of neighbouring motions disagree by more than noise explains, so all sigmas were multiplied by "
        f"{consistency.inflation:.1f}. The {names.some(number == worst, number >= 0)} disagree most: without them the "
        f"answer moves by {group.rotation_deg:.2g} deg, {group.translation_mm:.2g} mm.",
    )
