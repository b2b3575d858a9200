"""Several results of one set-up: as good as one big solve, honest about what does not average out, and what changed."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.stats import chi2

import data_synth
import rmis_calib as rc
from rmis_calib.batches import JobRecord
from rmis_calib.batches.pooling import changes, drift, pool
from rmis_calib.batches.rows import setup_of
from rmis_calib.batches.setups import compare, setups_of, told_diameter_mm
from rmis_calib.errors import InputError
from rmis_calib.io import read_description
from rmis_calib.results import Information

_EYE = {"fx_px": 175.0, "fy_px": 175.0, "cx_px": 80.0, "cy_px": 60.0}
TINY = {"motions": 1, "camera": {"width_px": 160, "height_px": 120, "right": _EYE, "left": None}}


def tangent(result: rc.RigidTransform, other: np.ndarray) -> np.ndarray:
    """Displacement of a transform from another one, by hand: the rotation is small."""
    R = result.R.numpy() @ other[:3, :3].T
    turn = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2.0
    return np.concatenate([turn, result.t.numpy() - other[:3, 3]])


def distance2(gap: np.ndarray, covariance: np.ndarray) -> float:
    return float(gap @ np.linalg.solve(covariance, gap))


def test_pooling_parts_is_solving_all_at_once(observed, part_of, solved) -> None:
    seen, truth = observed(480, 5)
    whole = solved(seen)
    parts = [solved(part_of(seen, slice(start, None, 6))) for start in range(6)]
    pooled = pool(parts)
    gap = tangent(pooled.camera_right_T_arm, whole.camera_right_T_arm.matrix.numpy())
    sigma = np.sqrt(np.diag(whole.covariance))
    # Parts of 80 motions are linearised at their own estimates; the sixth part of a sigma is what that costs.
    assert np.abs(gap / sigma).max() < 0.15
    np.testing.assert_allclose(np.sqrt(np.diag(pooled.covariance)), sigma, rtol=0.05)
    assert distance2(tangent(pooled.camera_right_T_arm, truth), pooled.covariance) < chi2.ppf(0.999, 6)


def test_shared_unknowns_do_not_average_out(series) -> None:
    """By hand: n recordings measure x + s to 0.1 mm each, and s, which they share, is known to 2 mm beforehand. Then x
    has a variance of 2^2 + 0.1^2 / n, and not of (2^2 + 0.1^2) / n."""
    measures = np.zeros((1, 7))
    measures[0, [3, 6]] = 10.0  # x and s over 0.1 mm
    others = np.diag([1e8, 1e8, 1e8, 0.0, 100.0, 100.0, 0.0])
    told = Information(("radius",), np.array([2.0]), others + measures.T @ measures, np.zeros(7))
    own = replace(series[0][0], information=told, covariance=told.transform_covariance())
    assert own.covariance[3, 3] == pytest.approx(2.0**2 + 0.1**2)
    assert pool([own] * 100).covariance[3, 3] == pytest.approx(2.0**2 + 0.1**2 / 100)
    assert pool([own] * 100).covariance[4, 4] == pytest.approx(0.1**2 / 100)
    alone = replace(own, information=None)
    assert pool([alone] * 100).covariance[3, 3] == pytest.approx((2.0**2 + 0.1**2) / 100)


def test_offsets_and_clocks_are_of_one_recording(series) -> None:
    told = series[0][0].information
    assert told is not None
    assert {"radius", "end_offset", "stereo_rotation[0]"} <= set(told.shared_names)
    assert not any(name.startswith(("clock", "joint_offset", "rcm_offset")) for name in told.shared_names)


def test_what_a_covariance_allows_beyond_its_noise_is_kept(series) -> None:
    results, _ = series
    extra = np.diag([1e-4] * 3 + [4.0] * 3)
    doubtful = [replace(result, covariance=result.covariance + extra) for result in results]
    np.testing.assert_allclose(pool(doubtful).covariance, pool(results).covariance + extra, rtol=1e-3, atol=1e-6)


def test_another_diameter_is_another_set_up(series, tmp_path) -> None:
    """The radius's deviation from what was told is one unknown of all recordings that are pooled."""
    results, _ = series
    folder = data_synth.write_recording(tmp_path / "recording", data_synth.load_synth_config(TINY))
    records = []
    for name, diameter_mm in (("a", 8.0), ("b", 8.5), ("c", 8.0)):
        told = yaml.safe_load((folder / "recording.yaml").read_text())
        (folder / "recording.yaml").write_text(yaml.safe_dump(told | {"shaft_diameter_mm": diameter_mm}))
        row = {"setup": setup_of(read_description(folder)), "status": "ok"}
        (tmp_path / "out" / name).mkdir(parents=True)
        results[len(records)].write(tmp_path / "out" / name / "result.json")
        records.append(JobRecord(name, "", "calibrate", "", "finished", None, "", row))
    pooled = {setup.names: setup.setup for setup in setups_of(tmp_path / "out", records)}
    assert set(pooled) == {("a", "c"), ("b",)}
    assert "8 mm shaft" in pooled["a", "c"] and "8.5 mm shaft" in pooled["b",]


def test_results_of_one_set_up_agree_and_pool_to_the_truth(series) -> None:
    results, truth = series
    compared = compare(results, [f"case_{i}" for i in range(12)])
    pooled = compared.pooled
    assert pooled is not None and pooled.agreement is not None and pooled.agreement.holds
    assert 0.4 < pooled.agreement.chi2 / pooled.agreement.degrees_of_freedom < 1.6
    assert not compared.changes and not compared.outliers and not compared.drifts
    assert "agree within their sigmas" in compared.sentences()[0]
    assert distance2(tangent(pooled.camera_right_T_arm, truth), pooled.covariance) < chi2.ppf(0.999, 6)
    assert pooled.translation_sigma_mm < results[0].translation_sigma_mm


def test_results_of_other_shafts_are_not_compared(observed, solved) -> None:
    """Their radii deviate from different ones; a result of before the radius was told does not matter."""
    seen, _ = observed(30, 0)
    assert seen.shaft_radius_mm is not None
    wider = solved(replace(seen, shaft_radius_mm=seen.shaft_radius_mm + 0.25))
    first = solved(seen)
    assert told_diameter_mm(first) == pytest.approx(2.0 * seen.shaft_radius_mm)
    assert told_diameter_mm(wider) == pytest.approx(2.0 * seen.shaft_radius_mm + 0.5)
    with pytest.raises(InputError, match=r"one shaft_diameter_mm .*mm \(a\), .*mm \(b\)"):
        compare([first, wider], ["a", "b"])
    assert told_diameter_mm(replace(wider, information=None)) is None
    compare([first, replace(wider, information=None)], ["a", "b"])


def test_one_that_does_not_fit_is_named_and_left_out(series, moved) -> None:
    results, truth = series
    wrong = list(results)
    wrong[4] = moved(wrong[4], (0.0, 1.0, 0.0), (0.0, 0.0, 3.0))
    names = [f"case_{i}" for i in range(12)]
    compared = compare(wrong, names)
    assert compared.outliers == ("case_4",)
    assert "case_4 does not fit" in compared.sentences()[0]
    others = pool([result for i, result in enumerate(wrong) if i != 4])
    np.testing.assert_allclose(compared.pooled.camera_right_T_arm.matrix, others.camera_right_T_arm.matrix, atol=1e-9)
    assert distance2(tangent(compared.pooled.camera_right_T_arm, truth), compared.pooled.covariance) < 22.5


def test_a_laparoscope_that_was_knocked_is_told_where(series, moved) -> None:
    results, truth = series
    knocked = [result if i < 7 else moved(result, (0.0, 0.0, 0.8), (2.0, 0.0, 0.0)) for i, result in enumerate(results)]
    compared = compare(knocked, [f"case_{i}" for i in range(12)])
    assert [change.index for change in compared.changes] == [7]
    assert compared.changes[0].rotation_deg == pytest.approx(0.8, abs=0.25)
    assert compared.changes[0].translation_mm == pytest.approx(2.0, abs=0.7)
    assert "changes before case_7" in compared.sentences()[0]
    before, after = compared.segments
    assert distance2(tangent(before.camera_right_T_arm, truth), before.covariance) < chi2.ppf(0.999, 6)
    assert before.agreement is not None and before.agreement.holds
    assert after.agreement is not None and after.agreement.holds


def test_changes_are_found_by_chance_as_rarely_as_said() -> None:
    generator = np.random.default_rng(0)
    covariances = np.repeat(np.diag([1e-4, 2e-4, 1e-4, 0.04, 0.09, 0.2])[None], 15, axis=0)
    noise = generator.standard_normal((400, 15, 6)) * np.sqrt(np.diagonal(covariances[0]))
    found = sum(bool(changes(series, covariances)) for series in noise)
    assert found <= 10  # 1 % of 400, Bonferroni's bound; 10 has a probability of 0.3 %


def test_a_drift_is_told_from_chance() -> None:
    generator = np.random.default_rng(1)
    sigma = np.full(30, 0.02)
    slope, probability = drift(0.01 * np.arange(30) + generator.normal(0.0, 0.02, 30), sigma)
    assert slope == pytest.approx(0.01, abs=0.002)
    assert probability < 1e-6
    assert drift(generator.normal(0.0, 0.02, 30), sigma)[1] > 0.01


def test_drifting_clocks_are_named(series) -> None:
    results, _ = series
    clocks = [
        replace(result, nuisances=result.nuisances | {"clock": {"value": 0.1 * i, "sigma": 0.01, "unit": "s"}})
        for i, result in enumerate(results)
    ]
    assert "clock drifts by 0.1 s a recording" in " ".join(compare(clocks, [str(i) for i in range(12)]).sentences())


def test_information_is_kept_in_the_result_file(series, tmp_path) -> None:
    results, _ = series
    results[0].write(tmp_path / "result.json")
    again = rc.CalibrationResult.read(tmp_path / "result.json")
    np.testing.assert_array_equal(again.information.matrix, results[0].information.matrix)
    assert again.information.shared_names == results[0].information.shared_names
    np.testing.assert_allclose(again.information.transform_covariance(), results[0].covariance, rtol=1e-6, atol=1e-12)
    old = json.loads((tmp_path / "result.json").read_text())
    del old["information"]  # files of earlier versions
    assert rc.CalibrationResult.from_dict(old).information is None


def test_a_copy_of_a_result_does_not_count_again(series) -> None:
    results, _ = series
    once = compare(results[:3], ["a", "b", "c"])
    twice = compare([results[0], *results[:3], results[1]], ["a", "b", "c", "d", "e"])
    assert twice.copies == (("b", "a"), ("e", "c"))
    assert twice.names == ("a", "c", "d")
    assert once.pooled is not None and twice.pooled is not None
    assert np.array_equal(once.pooled.covariance, twice.pooled.covariance)
    assert twice.sentences()[0] == "b repeats a to the last digit: the same data, counted once."


def test_what_cannot_be_pooled_is_refused(series) -> None:
    results, _ = series
    with pytest.raises(InputError, match="found none"):
        pool([])
    with pytest.raises(InputError, match="found unobservable"):
        pool([results[0], replace(results[1], status="unobservable")])
    compared = compare([replace(results[0], status="unobservable")], ["a"])
    assert compared.pooled is None
    assert "No recording" in compared.sentences()[0]
