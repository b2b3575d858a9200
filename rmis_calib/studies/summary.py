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
MEASURES = {"rotation": "deg", "translation": "mm", "working_point": "mm"}
"""Quantities of an error, with their units."""


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
        for measure, unit in MEASURES.items():
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
    values = {
        name: np.asarray(table.column(name)) for name in table.column_names if name.startswith(tuple(_value_names()))
    }
    return [
        _group(dict(zip(keys, key, strict=True)), {name: value[index] for name, value in values.items()})
        for key, index in rows.items()
    ]


def _value_names() -> list[str]:
    errors = [f"{measure}_error_{unit}" for measure, unit in MEASURES.items()]
    return errors + [f"bound_{measure}_" for measure in MEASURES]


def _group(keys: dict[str, Any], values: Mapping[str, np.ndarray]) -> Group:
    quartiles, rms, bound_rms, bound_median = {}, {}, {}, {}
    errors = {measure: values[f"{measure}_error_{unit}"] for measure, unit in MEASURES.items()}
    for measure, unit in MEASURES.items():
        error = errors[measure]
        answered = error[np.isfinite(error)]
        # A quantile between a finite error and an infinite one is infinite: no interpolation across.
        at = np.quantile(error, (0.25, 0.5, 0.75, 0.9), method="linear" if len(answered) == len(error) else "higher")
        quartiles[measure] = tuple(float(x) for x in at)
        rms[measure] = float(np.sqrt(np.mean(answered**2))) if len(answered) else float("inf")
        bound_rms[measure] = float(values[f"bound_{measure}_rms_{unit}"].mean())
        bound_median[measure] = float(values[f"bound_{measure}_median_{unit}"].mean())
    count = len(errors["rotation"])
    unanswered = int((~np.isfinite(errors["rotation"])).sum())
    return Group(keys, count, unanswered, quartiles, rms, bound_rms, bound_median)
