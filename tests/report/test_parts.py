"""Numbers in print, lazy import, and plots that neither leak into the page nor touch pyplot."""

import subprocess
import sys

import numpy as np
import pytest

from rmis_calib.report.content import covariance_text, observability
from rmis_calib.report.formatting import fixed, significant
from rmis_calib.report.plots import plot_residuals
from rmis_calib.solver.observability import Direction, Observability


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (0.04567, 2, "0.046"),
        (-12.345, 3, "−12.3"),
        (100.0, 2, "100"),
        (0.0, 3, "0"),
        (2.5e-7, 2, "2.5e−07"),
        (None, 2, "unknown"),
        (float("nan"), 2, "unknown"),
        (float("inf"), 2, "unknown"),
        ("text", 2, "unknown"),
    ],
)
def test_significant(value: object, digits: int, text: str) -> None:
    assert significant(value, digits) == text


def test_fixed_has_no_negative_zero_and_an_ascii_minus() -> None:
    assert fixed(-1e-9, 3) == "0.000"
    assert fixed(-1.5, 2) == "-1.50"


def test_directions_are_ordered_and_placed_on_a_log_scale() -> None:
    shown = observability(Observability(directions=[Direction(sigma, "turn") for sigma in (0.1, 10.0, None, 1.0)]))
    assert [item.sigma_mm for item in shown.directions] == ["not bounded", "10 mm", "1.0 mm", "0.10 mm"]
    # axis from 0.1 to 10 mm: 1 mm lies in its middle; the smallest keeps a visible sliver
    assert [item.bar_percent for item in shown.directions] == [100.0, 100.0, 50.0, 0.5]
    assert [label for _, label in shown.ticks] == ["0.1", "1", "10"]


def test_observability_that_was_not_assessed_is_open() -> None:
    shown = observability(Observability())
    assert (shown.verdict, shown.tone) == ("not assessed", "open")


def test_robust_scale_is_of_used_motions() -> None:
    values = np.array([1.0, 2.0, 3.0, 100.0, np.nan])
    plots = plot_residuals(values, np.array([True, True, True, False, True]), "px", "right", "Contours")
    assert plots.robust_scale == pytest.approx(1.4826 * 2.0)
    assert plots.beyond == 1


@pytest.mark.parametrize("values", [[0.0], [0.0, 0.0], [-1.0], [np.nan, 3.0], [0.0, 0.0, 5.0]])
def test_small_and_flat_residuals_are_drawn(values: list[float]) -> None:
    plots = plot_residuals(np.array(values), np.zeros(len(values), dtype=bool), "mm", "other", "Flat")
    for drawing in (plots.by_motion, plots.histogram):
        assert (
            drawing.startswith("<svg")
            and "<style" not in drawing
            and "DejaVu" not in drawing
            and "#0102" not in drawing
        )


def test_importing_the_package_loads_nothing_heavy_and_drawing_does_not_load_pyplot() -> None:
    program = (
        "import sys, rmis_calib.report\n"
        "assert not {'torch', 'matplotlib', 'cv2', 'jinja2'} & set(sys.modules)\n"
        "import numpy as np; from rmis_calib.report.plots import plot_residuals\n"
        "plot_residuals(np.ones(3), np.ones(3, bool), 'px', 'left', 'x')\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True)


def test_covariance_is_six_aligned_lines() -> None:
    lines = covariance_text(np.diag([1e-6, 1e-6, 1e-6, 0.01, 0.01, -0.01])).splitlines()
    assert len(lines) == 6 and len({len(line) for line in lines}) == 1
    assert covariance_text(None) == ""
