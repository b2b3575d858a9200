"""The verdict, why it is so, and what to do next: the first things to read."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from rmis_calib.pipeline.answer.result import JOINTS_UNKNOWN, TOO_FEW
from rmis_calib.pipeline.motions.observations import ANOTHER_INSTRUMENT, DIRECTION_UNKNOWN
from rmis_calib.report.words.formatting import finite, significant
from rmis_calib.results import STATUS_SENTENCES, CalibrationResult, ResidualTest
from rmis_calib.solver import MotionReason
from rmis_calib.vision import FrameReason

_SHOWN_FAILED = 3
"""Failed tests of residuals that stand among the checks; all are in the table."""
WORTH_MOVING = 0.95
"""An advised motion that leaves more than this part of the weakest sigma is not worth the effort."""


@dataclass(frozen=True)
class Headline:
    """The verdict, the first thing to read: `tone` is `ok`, `weak` or `bad`, and chooses colour and icon together."""

    tone: str
    word: str
    advice: str = ""
    sentence: str = ""


HEADLINES = {
    "solver_failed": Headline("bad", "No solution"),
    "unobservable": Headline("bad", "Not observable", "do not use"),
    "insufficient_data": Headline("bad", "Not enough data"),
    "weak": Headline("weak", "Weak", "do not rely on it"),
    "ok": Headline("ok", "Trustworthy"),
}
"""Of each status, what needs a look most first."""


@dataclass(frozen=True)
class Check:
    """Something that a result must hold to be trustworthy, whether it does, and the numbers."""

    passed: bool
    words: str


@dataclass(frozen=True)
class Verdict:
    """The first screen's words.

    Attributes:
        headline: the verdict.
        reason: why, a sentence.
        checks: what was looked at; each passes where the result is trustworthy, and one does not where it is not.
        steps: what to do next, the first thing first.
        more: further motions that are advised, and on what they count.
    """

    headline: Headline
    reason: str
    checks: tuple[Check, ...]
    steps: tuple[str, ...]
    more: tuple[str, ...]


def headline(result: CalibrationResult) -> Headline:
    """The verdict in words and a sentence."""
    return replace(HEADLINES[result.status], sentence=STATUS_SENTENCES[result.status])


def verdict(result: CalibrationResult) -> Verdict:
    """The verdict with its reason and what follows from it."""
    sentence, _, rest = result.message.partition(": ")
    reason = rest if sentence == STATUS_SENTENCES[result.status] and rest else result.message
    return Verdict(headline(result), _as_sentence(reason), checks(result, reason), *next_steps(result))


def checks(result: CalibrationResult, reason: str) -> tuple[Check, ...]:
    """What the verdict rests on. Where all of these hold and the result is still not trustworthy, the reason is one."""
    found = [*_error_checks(result), *_residual_checks(result), *_picture_checks(result)]
    if result.status in ("insufficient_data", "solver_failed") or not found:
        return ()
    if not result.trustworthy and all(check.passed for check in found):
        found.append(Check(False, _as_sentence(reason)))
    return tuple(found)


def _error_checks(result: CalibrationResult) -> list[Check]:
    """Predicted errors against the limits that the calibration was made with."""
    limits = result.config.get("solver", {})
    limits = limits.get("verdict", {}) if isinstance(limits, Mapping) else {}
    found = []
    for what, value, unit in (
        ("Predicted error at the working point", result.observability.working_point_sigma_mm, "mm"),
        ("Predicted error of rotation", result.rotation_sigma_deg, "deg"),
    ):
        size, limit = finite(value), finite(limits.get(f"trustworthy_{unit}") if isinstance(limits, Mapping) else None)
        if size is not None and limit is not None:
            words = f"{what}: {significant(size, 2)} {unit}, 1 σ (limit {limit:g})"
            found.append(Check(size < limit, words))
    return found


def _residual_checks(result: CalibrationResult) -> list[Check]:
    """Whether tests of residuals, and of parts of the data against each other, pass; the worst of those that do not."""
    tests = result.tests
    if tests is None or not tests.tests:
        return []
    failed, count = tests.failed, len(tests.tests)
    found = [
        Check(False, f"{test.words[:1].upper()}{test.words[1:]}: {_sigmas(test)}") for test in failed[:_SHOWN_FAILED]
    ]
    words = f"Tests of the residuals: {count - len(failed)} of {count} pass"
    return [*found, Check(not failed, words)]


def _sigmas(test: ResidualTest) -> str:
    return f"{significant(test.statistic, 2)} sigmas"


def _picture_checks(result: CalibrationResult) -> list[Check]:
    """Whether the pictures show the shaft where it is predicted."""
    picture = result.picture
    if picture is None or picture.passed is None:
        return []
    found = [
        f"an edge at {100.0 * view.edge_share:.0f} %, {significant(view.median_px, 2)} px off ({camera})"
        for camera, view in picture.views.items()
    ]
    return [Check(picture.passed, f"Pictures along the predicted contours: {'; '.join(found)}")]


def next_steps(result: CalibrationResult) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What to do next, and further motions that are advised."""
    advice = result.observability.advice
    if result.status == "ok":
        return _when_ok(result), advice[1:] if _is_worth_moving(result) else ()
    if result.status == "insufficient_data":
        return (*_remedies(result), _MORE), advice
    if result.status == "solver_failed":
        return (_CHECK, _MORE), advice
    if advice:
        return (advice[0], "Then calibrate again with those motions in the recording."), advice[1:]
    return (*_remedies(result), _CHECK, _MORE), ()


_CHECK = "Run rmis-calib check on the recording: units, clocks, cameras and joints."
_MORE = (
    "Record again: 20 or more stops in different places, several degrees and centimetres apart, with the end of the "
    "shaft in view."
)


def _when_ok(result: CalibrationResult) -> tuple[str, ...]:
    steps = ["Write it for your program: rmis-calib export (dvrk, ros-static-tf, urdf-origin, ...)."]
    if not result.head_point_error_px:
        steps.append(
            "Test it on what it has not seen: label some head points (head_points.csv) and run rmis-calib evaluate."
        )
    else:
        steps.append("Compare it with a second recording of the same set-up: rmis-calib compare.")
    advised = result.observability.next_motions
    if _is_worth_moving(result):
        steps.append(f"For a smaller sigma: {result.observability.advice[0]}")
    elif advised and _weakest(result) is not None:
        after = significant(advised[0].weakest_sigma_mm, 2)
        steps.append(
            "More motions of this kind would gain little: the best one leaves the weakest direction at "
            f"{after} mm of {significant(_weakest(result), 2)} mm."
        )
    return tuple(steps)


def _weakest(result: CalibrationResult) -> float | None:
    sigmas = [finite(direction.sigma_at_working_point_mm) for direction in result.observability.directions]
    return None if not sigmas or None in sigmas else max(sigma for sigma in sigmas if sigma is not None)


def _is_worth_moving(result: CalibrationResult) -> bool:
    advised, now = result.observability.next_motions, _weakest(result)
    if not result.observability.advice:
        return False
    after = finite(advised[0].weakest_sigma_mm) if advised else None
    return now is None or after is None or after < WORTH_MOVING * now


_REMEDIES = {
    FrameReason.NO_PICTURE.sentence: "Check the video: some pictures are black, white or of one tone.",
    FrameReason.NO_STRAIGHT_EDGES.sentence: "Bring the shaft into view, or give your own masks (--masks).",
    FrameReason.NOT_A_CYLINDER.sentence: "Bring more of the dark shaft into view, or give your own masks (--masks).",
    FrameReason.TOO_SHORT.sentence: "Let the shaft come in from the picture's border, and show more of its length.",
    FrameReason.EDGES_UNCLEAR.sentence: "Stop for each picture, or light the scene better: edges are blurred.",
    FrameReason.AMBIGUOUS.sentence: "Give your own masks (--masks), or lower detector.min_confidence after a look.",
    FrameReason.BACKGROUND.sentence: (
        "Take shaft-like things out of the view (rulers, boards, cables), or give your own masks (--masks)."
    ),
    FrameReason.REPEATED.sentence: "Mend the recording: pictures repeat (a grabber that hangs).",
    DIRECTION_UNKNOWN: "Let the tip stay in the picture, so that it is seen which way the instrument points.",
    ANOTHER_INSTRUMENT: "Point at the right instrument once: --instrument-at FRAME U V.",
    MotionReason.OUTLIER.sentence: "Run rmis-calib check: clocks, joints and cameras; then look at what contradicts.",
    JOINTS_UNKNOWN: "Log the joints over the whole video, or set clock_offset_s in recording.yaml.",
}
"""What to do about each reason of rejection."""


def _remedies(result: CalibrationResult) -> tuple[str, ...]:
    """What to do about the most frequent reasons."""
    counts = result.motions.rejected_by_reason
    ranked = sorted((reason for reason in counts if reason in _REMEDIES), key=lambda reason: -counts[reason])
    return tuple(f"{_REMEDIES[reason]} ({counts[reason]} motions)" for reason in ranked[:2])


def _as_sentence(text: str) -> str:
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "?", "!", ")")) else ".")


def is_usable(reason: str) -> bool:
    """Whether a motion that did not enter could have: there were too few for an estimate."""
    return reason == TOO_FEW
