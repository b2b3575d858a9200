"""The check of benchmarks against their baseline, on made-up numbers."""

from dataclasses import replace

import pytest

from tests.benchmarks import baseline
from tests.benchmarks.baseline import Metric, compare

ERROR = Metric("error", 1.0, "x bound", "lower", 0.05)
FOUND = Metric("found", 0.98, "of all", "higher", 0.02)
FALSE = Metric("false", 0.0, "a picture", "lower", 0.02)
ALL = [ERROR, FOUND, FALSE]


def test_the_same_and_better_numbers_pass() -> None:
    assert compare(ALL, ALL) == []
    assert compare([replace(ERROR, value=0.2), replace(FOUND, value=1.0), FALSE], ALL) == []


@pytest.mark.parametrize(
    ("metric", "good", "bad"), [(ERROR, 1.049, 1.051), (FOUND, 0.961, 0.960), (FALSE, 0.019, 0.021)]
)
def test_a_number_may_be_worse_by_its_tolerance_and_no_more(metric, good, bad) -> None:
    rest = [other for other in ALL if other is not metric]
    assert compare([*rest, replace(metric, value=good)], ALL) == []
    (fault,) = compare([*rest, replace(metric, value=bad)], ALL)
    assert fault.startswith(f"{metric.metric}: {bad:.4g} ")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("metric", ALL)
def test_a_number_that_is_none_never_passes(metric, value) -> None:
    assert len(compare([replace(metric, value=value)], [metric])) == 1


def test_a_number_that_vanished_or_that_nobody_knows_is_a_fault() -> None:
    assert compare(ALL[1:], ALL) == ["error: vanished (baseline 1 x bound)"]
    assert compare([], ALL)[2].startswith("false: vanished")
    assert compare(ALL, ALL[1:]) == ["error: not in the baseline (add it: --update)"]


def test_another_unit_or_direction_is_another_number() -> None:
    assert "now in px" in compare([replace(ERROR, unit="px"), FOUND, FALSE], ALL)[0]
    assert "higher is better" in compare([replace(ERROR, direction="higher"), FOUND, FALSE], ALL)[0]


def test_the_tolerance_is_the_committed_one(tmp_path) -> None:
    """A run cannot pass by being told a wider one."""
    assert compare([replace(ERROR, value=2.0, tolerance=9.0)], [ERROR])
    baseline.write(ALL, tmp_path / "baseline.json")
    assert baseline.read(tmp_path / "baseline.json") == ALL


def test_the_committed_baseline_can_be_read() -> None:
    names = [metric.metric for metric in baseline.read()]
    assert len(names) == len(set(names)) > 15
