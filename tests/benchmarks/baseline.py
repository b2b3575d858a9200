"""Numbers that must not get worse: how they are written down, and how a run is held against them."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

BASELINE = Path(__file__).with_name("baseline.json")
FORMAT = "rmis-calib-baseline/1"


@dataclass(frozen=True)
class Metric:
    """One number.

    Attributes:
        metric: its name.
        value: finite.
        unit: of the value; ratios within one run hold on any machine.
        direction: which way is better.
        tolerance: how much worse than the baseline it may be, as a part of the baseline's value; for a baseline of 0,
            in the unit.
    """

    metric: str
    value: float
    unit: str
    direction: Literal["lower", "higher"]
    tolerance: float

    @property
    def limit(self) -> float:
        """The worst value that still passes."""
        allowed = self.tolerance * (abs(self.value) or 1.0)
        return self.value + allowed if self.direction == "lower" else self.value - allowed

    def passes(self, value: float) -> bool:
        """Whether a new value is as good as this one, to the tolerance; one that is not finite never is."""
        if not math.isfinite(value):
            return False
        return value <= self.limit if self.direction == "lower" else value >= self.limit


def compare(measured: Sequence[Metric], baseline: Sequence[Metric]) -> list[str]:
    """What is wrong with a run, a line each; empty if nothing is.

    A metric that got worse or vanished, and one that the baseline does not know: nothing would notice if it vanished.
    """
    new = {metric.metric: metric for metric in measured}
    known = {metric.metric for metric in baseline}
    faults = []
    for old in baseline:
        now = new.get(old.metric)
        if now is None:
            faults.append(f"{old.metric}: vanished (baseline {old.value:.4g} {old.unit})")
        elif (now.unit, now.direction) != (old.unit, old.direction):
            faults.append(
                f"{old.metric}: now in {now.unit}, {now.direction} is better; baseline {old.unit}, {old.direction}"
            )
        elif not old.passes(now.value):
            faults.append(
                f"{old.metric}: {now.value:.4g} {old.unit}, baseline {old.value:.4g}, "
                f"{'at most' if old.direction == 'lower' else 'at least'} {old.limit:.4g}"
            )
    faults += [f"{name}: not in the baseline (add it: --update)" for name in new if name not in known]
    return faults


def read(path: Path = BASELINE) -> list[Metric]:
    """The metrics of a baseline file."""
    raw = json.loads(path.read_text())
    if raw["format"] != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT}, found {raw['format']}")
    return [Metric(**entry) for entry in raw["metrics"]]


def write(metrics: Sequence[Metric], path: Path = BASELINE) -> None:
    """Write a baseline, values to four digits."""
    entries = [asdict(metric) | {"value": float(f"{metric.value:.4g}")} for metric in metrics]
    path.write_text(json.dumps({"format": FORMAT, "metrics": entries}, indent=2) + "\n")
