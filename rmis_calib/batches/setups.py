"""Recordings of one robot and one pair of cameras side by side: one transform for all, and what changed in between."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np

from rmis_calib.batches.job_record import JobRecord
from rmis_calib.batches.pooling import (
    SIGNIFICANT,
    Agreement,
    Change,
    Pooled,
    can_be_pooled,
    changes,
    drift,
    own_covariances,
    pool,
)
from rmis_calib.errors import InputError
from rmis_calib.results import JOINT_OFFSET, CalibrationResult

LEAST_FOR_DRIFT = 4
"""Recordings from which a trend is told."""


@dataclass(frozen=True)
class Drift:
    """An offset that grows from recording to recording.

    Attributes:
        name: the unknown.
        slope: a recording.
        unit: of the slope.
        probability: of as much by chance, for any of the unknowns.
    """

    name: str
    slope: float
    unit: str
    probability: float


@dataclass(frozen=True, eq=False)
class SetupComparison:
    """What the recordings of one set-up say of each other, in the order given.

    Attributes:
        setup: name of the set-up.
        names: of the recordings with a transform.
        results: of these.
        pooled: one transform of all, results that do not fit left out; None without a result.
        changes: where another transform begins; the pooled one is then of no one state.
        segments: pooled transforms between the changes; one where there are none.
        drifts: offsets of joints, and of the clock, that grow.
        copies: names of results that repeat another one to the last bit, and of that one; they do not count.
    """

    setup: str
    names: tuple[str, ...]
    results: tuple[CalibrationResult, ...]
    pooled: Pooled | None
    changes: tuple[Change, ...]
    segments: tuple[Pooled, ...]
    drifts: tuple[Drift, ...]
    copies: tuple[tuple[str, str], ...] = ()

    @property
    def answer(self) -> Pooled | None:
        """The pooled transform, where there is one for all of them."""
        return None if self.changes else self.pooled

    @property
    def agrees(self) -> bool:
        """Whether there is one transform, and the results that count agree on it."""
        return self.answer is not None and (self.answer.agreement is None or self.answer.agreement.holds)

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of the recordings that do not fit the others."""
        if self.answer is None:
            return ()
        return tuple(name for name, keep in zip(self.names, self.answer.kept, strict=True) if not keep)

    def sentences(self) -> list[str]:
        """What there is to say, most important first."""
        if self.pooled is None:
            return ["No recording of this set-up has a transform that can be compared."]
        copied = [
            f"{name} repeats {first} to the last digit: the same data, counted once." for name, first in self.copies
        ]
        return copied + self._about_results()

    def _about_results(self) -> list[str]:
        assert self.pooled is not None
        if len(self.names) == 1:
            return ["One recording: nothing to compare it with."]
        said = [
            f"The transform changes before {self.names[change.index]}: by {change.rotation_deg:.2g} deg and "
            f"{change.translation_mm:.2g} mm (probability by chance {_probability(change.probability)})."
            for change in self.changes
        ]
        if said:
            return said + self._drift_sentences()
        assert self.pooled.agreement is not None
        for name in self.outliers:
            said.append(f"{name} does not fit the others, and is left out of the pooled transform.")
        said.append(_about(self.pooled.agreement, int(self.pooled.kept.sum())))
        return said + self._drift_sentences()

    def _drift_sentences(self) -> list[str]:
        return [
            f"{item.name} drifts by {item.slope:.2g} {item.unit} a recording "
            f"(probability by chance {_probability(item.probability)})."
            for item in self.drifts
        ]


def compare(results: Sequence[CalibrationResult], names: Sequence[str], setup: str = "") -> SetupComparison:
    """Compare results of one set-up: pooled, with outliers named; changes of the transform; drifting offsets.

    Args:
        results: in the order of their time; those without transform and covariance do not count, nor do copies: the
            same data twice would halve the covariance of the pooled transform.
        names: of each.
        setup: what to call the set-up.

    Raises:
        InputError: recordings were told different diameters of the shaft, whose deviation is pooled too.
    """
    firsts: dict[bytes, tuple[str, CalibrationResult]] = {}
    copies = []
    for name, result in zip(names, results, strict=True):
        if can_be_pooled(result):
            first, _ = firsts.setdefault(_digits(result), (name, result))
            copies += [(name, first)] if first != name else []
    pairs = list(firsts.values())
    kept_names, kept = tuple(name for name, _ in pairs), tuple(result for _, result in pairs)
    if not kept:
        return SetupComparison(setup, (), (), None, (), (), ())
    _check_one_diameter(kept_names, kept)
    whole = pool(kept, drop_outliers=False)
    found: list[Change] = []
    pooled = whole
    if whole.agreement is not None and not whole.agreement.holds:
        pooled = pool(kept)
        if pooled.agreement is not None and not (pooled.agreement.holds and not pooled.kept.all()):
            found = changes(whole.deviation, own_covariances(kept))
    edges = [0, *(change.index for change in found), len(kept)]
    segments = tuple(pool(kept[a:b]) for a, b in pairwise(edges)) if found else (pooled,)
    return SetupComparison(setup, kept_names, kept, pooled, tuple(found), segments, _drifts(kept), tuple(copies))


def _digits(result: CalibrationResult) -> bytes:
    """Transform and covariance, bit for bit."""
    assert result.camera_right_T_arm is not None and result.covariance is not None
    return result.camera_right_T_arm.matrix.cpu().numpy().tobytes() + result.covariance.tobytes()


def setups_of(out: Path, records: Sequence[JobRecord]) -> tuple[SetupComparison, ...]:
    """Comparisons of the recordings of each set-up."""
    by_setup: dict[str, list[JobRecord]] = {}
    for record in records:
        if record.outcome == "finished" and "setup" in record.row:
            by_setup.setdefault(record.row["setup"], []).append(record)
    comparisons = []
    for setup, members in sorted(by_setup.items()):
        results = [CalibrationResult.read(out / PurePosixPath(member.name) / "result.json") for member in members]
        comparisons.append(compare(results, [member.name for member in members], setup))
    return tuple(comparisons)


def told_diameter_mm(result: CalibrationResult) -> float | None:
    """Diameter of the shaft that the recording was told, from the prior of its radius; None where it was no unknown."""
    shared, unknowns = result.information, result.config.get("solver", {}).get("unknowns", {})
    relative = unknowns.get("radius_sigma_relative")
    if shared is None or "radius" not in shared.shared_names or not relative:
        return None
    return 2.0 * float(shared.shared_prior_sigma[shared.shared_names.index("radius")]) / relative


def _check_one_diameter(names: Sequence[str], results: Sequence[CalibrationResult]) -> None:
    """Refuse results of shafts of different diameters.

    Raises:
        InputError: names one result of each diameter.
    """
    told: dict[float, str] = {}
    for name, result in zip(names, results, strict=True):
        diameter_mm = told_diameter_mm(result)
        if diameter_mm is not None:
            told.setdefault(round(diameter_mm, 6), name)
    if len(told) > 1:
        found = ", ".join(f"{diameter_mm:g} mm ({name})" for diameter_mm, name in told.items())
        expected = "results of one shaft_diameter_mm (compare those of each diameter by themselves)"
        raise InputError(where="compare", expected=expected, found=found)


def _drifts(results: Sequence[CalibrationResult]) -> tuple[Drift, ...]:
    """Clock and joint offsets with a significant trend, among those that were estimated in every recording."""
    names = [
        name
        for name in results[0].nuisances
        if (name == "clock" or name.startswith(JOINT_OFFSET)) and all(_is_estimated(result, name) for result in results)
    ]
    if len(results) < LEAST_FOR_DRIFT or not names:
        return ()
    found = []
    for name in names:
        entries = [result.nuisances[name] for result in results]
        values, sigmas = (np.array([getattr(entry, key) for entry in entries]) for key in ("value", "sigma"))
        slope, probability = drift(values, sigmas)
        probability = min(1.0, probability * len(names))
        if probability < SIGNIFICANT:
            found.append(Drift(name, slope, entries[0].unit, probability))
    return tuple(found)


def _is_estimated(result: CalibrationResult, name: str) -> bool:
    entry = result.nuisances.get(name)
    return entry is not None and bool(entry.sigma) and not entry.held


def _about(agreement: Agreement, count: int) -> str:
    if agreement.holds:
        return (
            f"The {count} results agree within their sigmas: chi-square {agreement.chi2:.0f} for "
            f"{agreement.degrees_of_freedom} degrees of freedom."
        )
    ratio = (agreement.chi2 / agreement.degrees_of_freedom) ** 0.5
    return (
        f"The {count} results do not agree within their sigmas: chi-square {agreement.chi2:.0f} for "
        f"{agreement.degrees_of_freedom} degrees of freedom, as if every sigma were {ratio:.1f} times too small."
    )


def _probability(value: float) -> str:
    return "below 1e-6" if value < 1e-6 else f"{value:.1g}"
