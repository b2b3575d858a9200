"""Numbers in print, what a page says in words, and what importing loads."""

import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rmis_calib.geometry.rigid import RigidTransform, rigid_exp
from rmis_calib.report.words.answer import covariance_text, inverse_covariance
from rmis_calib.report.words.details import residual_tests, shaft_ends, unknowns, unknowns_summary
from rmis_calib.report.words.directions import observability
from rmis_calib.report.words.formatting import fixed, significant, with_sigma
from rmis_calib.report.words.verdict import verdict
from rmis_calib.results import EndCounts, ShaftEnds
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


@pytest.mark.parametrize(
    ("value", "sigma", "texts"),
    [
        (4.00312, 0.0045, ("4.0031", "0.0045")),
        (-1.4e-16, 0.2, ("0.00", "0.20")),
        (-1.4e-16, None, ("0", "unknown")),
        (-9.9904, 0.24, ("−9.99", "0.24")),
        (123.4, 17.0, ("123", "17")),
        (None, 0.2, ("unknown", "0.20")),
    ],
)
def test_a_value_has_no_more_digits_than_its_sigma_tells(
    value: float | None, sigma: float | None, texts: tuple[str, str]
) -> None:
    assert with_sigma(value, sigma) == texts


def test_unknowns_that_priors_hold_are_marked_and_counted(result_with) -> None:
    result = result_with(
        nuisances={
            "radius": {"value": 4.0, "sigma": 0.01, "unit": "mm", "held": False},
            "clock": {"value": -1.4e-16, "sigma": 2.0, "unit": "s", "held": True},
            "noise line": {"value": 0.5, "sigma": None, "unit": "x nominal"},
        }
    )
    rows = unknowns(result)
    assert [(row.name, row.value, row.held) for row in rows] == [
        ("radius", "4.000", False),
        ("clock", "0.0", True),
        ("noise line", "0.500", False),
    ]
    assert unknowns_summary(rows) == "2 unknowns, 1 of them held by its prior, 1 level without a sigma"


def test_every_measured_end_is_in_the_table_and_every_other_has_a_reason(rendered_run) -> None:
    """Against the detections: what was taken, whether its end was measured, and what the detector says it ends at."""
    taken = [c.candidate >= 0 for c in rendered_run.choices]
    measured, other = 0, 0
    for view, choice, is_taken in zip(rendered_run.views, rendered_run.choices, taken, strict=True):
        for frame in rendered_run.told.frames[is_taken.numpy()]:
            has_end = bool(view.detections.end_valid[frame, choice.candidate[rendered_run.told.frames == frame]])
            measured, other = measured + has_end, other + (not has_end)
    table = shaft_ends(rendered_run.result)
    assert table is not None and measured > 20
    assert sum(sum(counts) for _, counts in table.rows) == measured
    assert sum(count for _, count in table.not_measured) == other


def test_ends_at_two_places_are_told_apart_in_the_table(result_with) -> None:
    kinds = {"ring": EndCounts(30, 2, 1), "tube": EndCounts(0, 9, 4)}
    ends = ShaftEnds(by_kind=kinds, gap_mm=-9.03, gap_sigma_mm=0.06, not_measured={"border": 3, "hidden": 1})
    table = shaft_ends(result_with(ends=ends))
    assert table is not None
    assert table.rows == (("ring that closes it", (30, 2, 1)), ("end of the dark tube", (0, 9, 4)))
    assert table.gap == "9.030 ± 0.060 mm before"
    assert table.not_measured == (("the shaft leaves the picture", 3), ("something covers the end", 1))
    assert shaft_ends(result_with(ends=None)) is None


def test_directions_are_ordered_and_placed_on_a_log_scale() -> None:
    shown = observability(Observability(directions=[Direction(sigma, "turn") for sigma in (0.1, 10.0, None, 1.0)]))
    assert [item.sigma_mm for item in shown.directions] == ["not bounded", "10 mm", "1.0 mm", "0.10 mm"]
    # axis from 0.1 to 10 mm: 1 mm lies in its middle; the smallest keeps a visible sliver
    assert [item.bar_percent for item in shown.directions] == [100.0, 100.0, 50.0, 0.5]
    assert [label for _, label in shown.ticks] == ["0.1", "1", "10"]


def test_covariance_of_the_inverse_is_that_of_inverted_samples() -> None:
    """1 sigma of the inverse against 100,000 perturbed transforms, inverted with SciPy: 1 % of sampling error."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6)) * np.array([2e-3, 1e-3, 3e-3, 0.4, 0.6, 0.5])[:, None]
    covariance = root @ root.T
    pose = torch.tensor([0.4, -1.1, 0.3, -38.0, 7.0, -101.0], dtype=torch.float64)
    transform = RigidTransform("camera_right", "arm", rigid_exp(pose))
    draws = rng.multivariate_normal(np.zeros(6), covariance, size=100_000)
    matrix = transform.matrix.numpy()
    R = Rotation.from_rotvec(draws[:, :3]) * Rotation.from_matrix(matrix[:3, :3])
    back = R.inv()
    t_back = -back.apply(matrix[:3, 3] + draws[:, 3:])
    mean = Rotation.from_matrix(matrix[:3, :3].T)
    perturbed = np.concatenate([(back * mean.inv()).as_rotvec(), t_back - (-mean.apply(matrix[:3, 3]))], axis=1)
    sampled = np.cov(perturbed.T)
    found = inverse_covariance(transform, covariance)
    sigma = np.sqrt(np.diag(sampled))
    assert np.abs((found - sampled) / np.outer(sigma, sigma)).max() < 0.02


def test_a_motion_that_gains_nothing_is_not_advised(result_with) -> None:
    def advised(after_mm: float) -> tuple[str, ...]:
        motion = {"words": "move", "joints": None, "weakest_sigma_mm": after_mm, "working_point_sigma_mm": 1.0}
        seen = {
            "verdict": "trustworthy",
            "working_point_sigma_mm": 1.0,
            "directions": [{"sigma_at_working_point_mm": 0.94, "words": "translation"}],
            "advice": ["First move."],
            "next_motions": [motion],
        }
        return verdict(result_with(observability=seen)).steps

    assert any("gain little" in step and "0.93 mm of 0.94 mm" in step for step in advised(0.93))
    assert advised(0.5)[-1] == "For a smaller sigma: First move."


def test_every_check_holds_for_a_trustworthy_result_and_one_fails_for_another(result_with) -> None:
    limits = {"solver": {"verdict": {"trustworthy_mm": 2.5, "trustworthy_deg": 2.0}}}
    fine = verdict(result_with(config=limits))
    assert len(fine.checks) == 2 and all(check.passed for check in fine.checks)
    weak = verdict(result_with(config=limits, status="weak", message="the cameras were told wrong"))
    assert [check.passed for check in weak.checks] == [True, True, False]
    assert weak.checks[-1].words == "The cameras were told wrong."
    loose = {"verdict": "weak", "working_point_sigma_mm": 2.8}
    assert [c.passed for c in verdict(result_with(config=limits, status="weak", observability=loose)).checks] == [
        False,
        True,
    ]


def test_checks_name_the_tests_that_fail(result_with) -> None:
    entry = {"statistic": 9.04, "probability": 1e-9, "before_motion": 41, "words": "the clock jumps before motion 41"}
    failed = {"kind": "clock", "over": "time step", "failed": True} | entry
    passed = {"kind": "shift_right", "over": "u", "failed": False, "words": "the shaft's place changes"}
    tests = {"level": 0.005, "tests": [failed, entry | passed], "causes": ["frames were lost there"]}
    result = result_with(status="weak", message="the clock jumps", tests=tests)
    found = verdict(result).checks
    assert [check.passed for check in found] == [False, False]
    assert [check.words for check in found] == [
        "The clock jumps before motion 41: 9.0 sigmas",
        "Tests of the residuals: 1 of 2 pass",
    ]
    table = residual_tests(result)
    assert table.failed == (("The clock jumps before motion 41", "9.0"),) and table.count == 2
    assert dict(table.rows)["clock"] == (("9.0", True), ("", False)) and table.columns == ("step in time", "u")


def test_importing_the_package_loads_nothing_heavy_and_charts_do_not_load_pyplot() -> None:
    program = (
        "import sys, rmis_calib.report\n"
        "assert not {'torch', 'matplotlib', 'cv2', 'jinja2'} & set(sys.modules)\n"
        "import numpy as np; from rmis_calib.report.charts.panel import Scale\n"
        "assert [label for _, label in Scale(-1.0, 1.0, 0.0, 10.0).ticks(4)] == ['−1', '−0.5', '0', '0.5', '1']\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True)


def test_covariance_is_six_aligned_lines() -> None:
    lines = covariance_text(np.diag([1e-6, 1e-6, 1e-6, 0.01, 0.01, -0.01])).splitlines()
    assert len(lines) == 6 and len({len(line) for line in lines}) == 1
    assert covariance_text(None) == ""
    assert math.isfinite(float(lines[0].split()[0]))
