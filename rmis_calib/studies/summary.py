"""From trials to what figures show: medians and quartiles of every condition, with the bound."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pyarrow

KEYS = (
    "noise", "coefficient", "motions", "laparoscope_positions", "instrument_positions", "cameras", "method",
)  # fmt: skip
MEASURES = {"rotation": "deg", "translation": "mm", "working_point": "mm", "reprojection": "px"}
"""Quantities of an error, with their units; a study has some of them."""


@dataclass(frozen=True)
class Group:
    """Trials that differ by their noise alone.

    Attributes:
        keys: what they have in common.
        count: trials.
        unanswered: trials without an answer; they count as infinitely wrong.
        quartiles: of each measure, (25 %, 50 %, 75 %, 90 %); infinite where too many are unanswered.
        rms: of each measure, over the answered trials.
        bound_rms, bound_median: of each measure.
    """

    keys: Mapping[str, Any]
    count: int
    unanswered: int
    quartiles: Mapping[str, tuple[float, float, float, float]]
    rms: Mapping[str, float]
    bound_rms: Mapping[str, float]
    bound_median: Mapping[str, float]

    def row(self) -> dict[str, Any]:
        """Flat, for a table."""
        out = dict(self.keys) | {"trials": self.count, "unanswered": self.unanswered}
        for measure in self.quartiles:
            unit = MEASURES[measure]
            names = [f"{measure}_{what}_{unit}" for what in ("q25", "median", "q75", "q90")]
            out |= dict(zip(names, self.quartiles[measure], strict=True))
            out |= {
                f"{measure}_rms_{unit}": self.rms[measure],
                f"{measure}_bound_rms_{unit}": self.bound_rms[measure],
                f"{measure}_bound_median_{unit}": self.bound_median[measure],
            }
        return out


def summarise(table: "pyarrow.Table", keys: Sequence[str] = KEYS) -> list[Group]:
    """Groups of trials, in the order in which they come."""
    columns = {name: table.column(name).to_pylist() for name in keys}
    rows: dict[tuple[Any, ...], list[int]] = {}
    for index, key in enumerate(zip(*columns.values(), strict=True)):
        rows.setdefault(key, []).append(index)
    ends = tuple(f"_error_{unit}" for unit in MEASURES.values())
    named = [name for name in table.column_names if name.endswith(ends) or name.startswith("bound_")]
    values = {name: np.asarray(table.column(name)) for name in named}
    return [
        _group(dict(zip(keys, key, strict=True)), {name: value[index] for name, value in values.items()})
        for key, index in rows.items()
    ]


def _group(keys: dict[str, Any], values: Mapping[str, np.ndarray]) -> Group:
    units = {measure: unit for measure, unit in MEASURES.items() if f"{measure}_error_{unit}" in values}
    quartiles, rms, bound_rms, bound_median, count, unanswered = {}, {}, {}, {}, 0, 0
    for measure, unit in units.items():
        error = values[f"{measure}_error_{unit}"]
        answered = error[np.isfinite(error)]
        count, unanswered = len(error), max(unanswered, len(error) - len(answered))
        # A quantile between a finite error and an infinite one is infinite: no interpolation across.
        at = np.quantile(error, (0.25, 0.5, 0.75, 0.9), method="linear" if len(answered) == len(error) else "higher")
        quartiles[measure] = tuple(float(x) for x in at)
        rms[measure] = float(np.sqrt(np.mean(answered**2))) if len(answered) else float("inf")
        nothing = np.full(1, np.nan)
        bound_rms[measure] = float(values.get(f"bound_{measure}_rms_{unit}", nothing).mean())
        bound_median[measure] = float(values.get(f"bound_{measure}_median_{unit}", nothing).mean())
    return Group(keys, count, unanswered, quartiles, rms, bound_rms, bound_median)
