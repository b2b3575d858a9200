"""Where along the instrument its shaft ends were measured, in a result and in words."""

from collections import Counter
from dataclasses import replace

import torch

from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.pipeline.motions.association import Choice
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.results import EndCounts, ShaftEnds
from rmis_calib.solver import Solution
from rmis_calib.vision import EndKind

KINDS = ("unknown", "tube", "ring")
"""Kinds of end in the order of `Solution.ends`."""
OTHER_TOOL_MM = 25.0
"""Distance of the shaft's end from its nominal place that no wrist explains: the metal of one is 5 to 20 mm long."""


def ends_of(solution: Solution) -> ShaftEnds | None:
    """Number of ends of each kind at each place; None where none was measured."""
    if solution.ends is None or not int(solution.ends.sum()):
        return None
    counts = solution.ends.reshape(len(KINDS), 3).tolist()
    gap = solution.nuisances.get("end_gap")
    return ShaftEnds(
        by_kind={kind: EndCounts(*each) for kind, each in zip(KINDS, counts, strict=True) if sum(each)},
        gap_mm=None if gap is None else float(gap.value),
        gap_sigma_mm=None if gap is None else float(gap.sigma),
    )


def with_unmeasured(
    ends: ShaftEnds | None, views: tuple[View, ...], poses: MotionPoses, choices: tuple[Choice, ...]
) -> ShaftEnds | None:
    """The record with the ends of the chosen shafts that no picture shows, by why not."""
    if ends is None:
        return None
    counts: Counter[str] = Counter()
    names = {int(EndKind.BORDER): "border", int(EndKind.HIDDEN): "hidden"}
    for view, choice in zip(views, choices, strict=True):
        found = view.at(poses.frames)
        rows = torch.nonzero(choice.taken)[:, 0]
        best = choice.candidate[rows]
        kinds = found.end_kind[rows, best][~found.end_valid[rows, best]]
        counts.update(names.get(kind, "unclear") for kind in kinds.tolist())
    return replace(ends, not_measured=dict(sorted(counts.items())))


def about_ends(solution: Solution) -> tuple[str, ...]:
    """Whether the ends are those of two places, and how many were left out, in words."""
    ends = ends_of(solution)
    if ends is None:
        return ()
    said = []
    if ends.gap_mm is not None:
        where = "beyond" if ends.gap_mm > 0 else "before"
        said.append(
            f"The ends of the shaft were measured at two places of the instrument: {ends.first_place} at one, and "
            f"{ends.second_place} at another {abs(ends.gap_mm):.1f} mm {where} it (the ring of the tube and the tip of "
            "the metal?). Both were used, each with a place of its own."
        )
    if ends.left_out and not ends.used:
        said.append(
            f"The {ends.left_out} measured shaft ends do not agree on one place along the shaft, and none was used."
        )
    elif ends.left_out:
        said.append(
            f"{ends.left_out} of {ends.left_out + ends.used} measured ends of the shaft are at another place along it "
            "than most, and were left out (the metal's tip, or what lies over the shaft?)."
        )
    return tuple(said)


def about_tool(solution: Solution) -> tuple[str, ...]:
    """Whether the shaft ends so far from where the tool's table says that it is another tool's."""
    end = solution.nuisances.get("end_offset")
    if end is None:
        return ()
    offset, sigma = float(end.value.reshape(-1)[0]), float(end.sigma.reshape(-1)[0])
    if abs(offset) - 3.0 * sigma < OTHER_TOOL_MM:
        return ()
    where = "beyond" if offset > 0 else "before"
    return (
        f"The shaft ends {abs(offset):.0f} mm {where} the place given by the tool's table: does the table belong "
        "to another tool (the wrists of S/Si and Classic instruments are 50 mm apart), or is the length of a wrist "
        "missing?",
    )
