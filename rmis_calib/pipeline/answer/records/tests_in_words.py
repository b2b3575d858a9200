"""The tests of a solve as the result tells them: what is left in the residuals, and what it is likely to come from."""

import math

from rmis_calib.pipeline.answer.motion_names import NUMBERED, MotionNames
from rmis_calib.results import ResidualTest, Tests
from rmis_calib.solver import Solution
from rmis_calib.solver.assess.tested_residuals import AXIS, CONTOURS
from rmis_calib.solver.observation_arrays import CAMERAS
from rmis_calib.solver.test_list import (
    ANSWER,
    CLOCK,
    HALVES,
    LEVEL,
    MEAN,
    NEAR_IN_JOINTS,
    NEAR_IN_TIME,
    PICTURE,
    TIME,
    TIME_STEP,
    TestName,
)

_KINDS = {
    "shift": "the shaft's place across itself",
    "turn": "the shaft's angle",
    "width": "the shaft's width",
    "taper": "the angle between the shaft's edges",
    "end": "the shaft's end",
    "head_u": "the head point's column",
    "head_v": "the head point's row",
}
_OVER = {
    MEAN: "is off on average",
    TIME: "drifts with time",
    "u": "changes from left to right in the picture",
    "v": "changes from top to bottom in the picture",
    "r2": "changes with the distance from the picture's centre",
    NEAR_IN_TIME: "is off alike in motions that follow each other",
    NEAR_IN_JOINTS: "is off alike in motions that are near to each other in joint space",
}
_CAUSES = {
    "clock": "the frame rate, or the clock of the joints",
    "clock jump": "frames or samples were lost there",
    "camera moved": "the camera, a trocar or an arm's base moved before {at}",
    "intrinsics": "the focal length, or the file of the cameras belongs to another picture size or crop",
    "lens": "the lens model",
    "stereo": "the cameras' pose to each other (camera_left_T_camera_right), or swapped cameras",
    "setup": "the base of an arm (base_T_arm_base)",
    "tool": "the tool: a bent shaft, or an axis that misses the remote centre",
    "joint_offset": "offsets of joints",
}
_OTHERWISE = "a joint's sign, unit or order, or an arm that gives way"
_NAMED = 3
"""Causes named at most."""
assert {*CONTOURS, *AXIS} <= {*_KINDS} and {*PICTURE} <= {*_OVER}


def told_tests(solution: Solution, columns: tuple[str, ...] = (), names: MotionNames = NUMBERED) -> Tests | None:
    """The tests of one solve (no trial batch), those that fail first; `columns` name the joints, `names` the
    motions."""
    found = solution.tests
    if found is None:
        return None
    rows = zip(
        found.names, *(x[0].tolist() for x in (found.statistic, found.corrected, found.against, found.at)), strict=True
    )
    tests = []
    for name, statistic, probability, failed, at in rows:
        if math.isnan(statistic):
            continue
        over = _column(name.over, columns)
        halves = name == TestName(ANSWER, HALVES)
        words = _words(TestName(name.kind, over), _half(solution, names) if halves else names.one(max(at, 0)))
        before = at if at >= 0 else None
        tests.append(ResidualTest(name.kind, over, statistic, probability, failed, before, words))
    tests.sort(key=lambda test: (not test.failed, test.probability, -abs(test.statistic or 0.0)))
    causes = tuple(causes_in_words(solution, names)) if bool(found.against.any()) else ()
    return Tests(LEVEL, tuple(tests), causes)


def about_neighbours(tests: Tests | None) -> tuple[str, ...]:
    """The clearest test of neighbours that fails, in words: their common errors are in the sigmas."""
    if tests is None:
        return ()
    for test in tests.tests:
        if test.over in (NEAR_IN_TIME, NEAR_IN_JOINTS) and (test.probability or 0.0) < LEVEL:
            words = f"{test.words[:1].upper()}{test.words[1:]} ({test.statistic:+.1f} sigmas)"
            return (f"{words}: sigmas count such motions together.",)
    return ()


def causes_in_words(solution: Solution, names: MotionNames = NUMBERED) -> list[str]:
    """What failed tests are likely to come from, the most likely first."""
    at = names.one(0 if solution.groups is None else int(solution.groups.change_at))
    return [_CAUSES[cause].format(at=at) for cause in ranked_causes(solution)[:_NAMED]] or [_OTHERWISE]


def ranked_causes(solution: Solution) -> list[str]:
    """Likely causes, of `solver.assess.causes`. A comparison of before and after that fails speaks for a change first,
    unless a clock that runs at another rate explains more."""
    gains = {name: float(gain[0]) for name, gain in solution.causes.items()}
    likely = sorted((name for name, gain in gains.items() if gain > 0.0), key=lambda name: -gains[name])
    tests = solution.tests
    told = [
        name
        for name, kind in (("clock jump", CLOCK), ("camera moved", ANSWER))
        if tests is not None and bool(tests.fails(kind, TIME_STEP))
    ]
    if told and "clock" in likely and gains["clock"] > max(gains.get(name, 0.0) for name in told):
        told.insert(0, "clock")
    return [*told, *(name for name in likely if name not in told)]


def _column(over: str, columns: tuple[str, ...]) -> str:
    """A joint by its column."""
    number = over.removeprefix("joint ")
    return columns[int(number)] if number != over and columns else over


def _half(solution: Solution, names: MotionNames) -> str:
    """What sets the first of the two halves of the motions apart."""
    groups = solution.groups
    if groups is None or groups.count == 0:
        return ""
    number, first = groups.group[0].cpu().numpy(), groups.first_half[0].cpu().numpy()
    return names.some((number >= 0) & first[number], number >= 0)


def _words(name: TestName, which: str) -> str:
    """What is left; `which` motions: the first one after a step in time, else those of one half."""
    if name == TestName(ANSWER, HALVES):
        return f"the {which} give another answer than the rest"
    if name == TestName(ANSWER, TIME_STEP):
        return f"the motions before and after {which} give different answers"
    if name == TestName(CLOCK, TIME_STEP):
        return f"the clock between pictures and joints jumps before {which}"
    kind, _, camera = name.kind.rpartition("_")
    what = f"{_KINDS[kind]} in the {camera} camera" if camera in CAMERAS and kind in _KINDS else name.kind
    if name.over == TIME_STEP:
        return f"{what} jumps before {which}"
    return f"{what} {_OVER.get(name.over, f'changes with {name.over}')}"
