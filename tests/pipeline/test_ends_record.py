"""What a result says of the places at which shaft ends are measured."""

import numpy as np
import pytest

import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.io import ShaftObservations
from tests.solver.estimate.mixed_ends import GAP_MM, with_ends

NOISE = {"pixel_noise_px": 0.3, "kinematics_noise_mm": 0.3, "kinematics_noise_deg": 0.1}


def observed(tip, anywhere):
    """One trial, with the kinds that a detector told: rings for what is the tip."""
    arrays = with_ends(tip, anywhere, seed=3, trials=1, positions_laparoscope=1, positions_instrument=4, **NOISE)
    del arrays["truth"], arrays["sigma_image"]
    for side in ("right", "left"):
        seen = np.isfinite(arrays[f"end_{side}"]).all(-1)
        arrays[f"end_kind_{side}"] = np.where(seen, arrays.pop(f"is_tip_{side}"), np.nan)
        arrays[f"end_sureness_{side}"] = np.where(seen, 0.9, np.nan)
    one = {name: value[0] if np.ndim(value) > 1 else value for name, value in arrays.items()}
    del one["laparoscope_base_T_arm"], one["laparoscope_base_T_instrument_base"]
    return ShaftObservations.from_arrays({name: value for name, value in one.items() if "setup" not in name})


def test_two_places_are_in_the_result_and_in_words(tmp_path):
    observations = observed(0.3, 0.0)
    result = rc.solve(observations, throw=False)
    assert result.ends is not None and result.ends.gap_mm is not None
    kinds = np.concatenate([observations.end_kind_right, observations.end_kind_left])
    assert result.ends.by_kind.keys() == {"tube", "ring"}
    assert result.ends.by_kind["tube"].first_place == result.ends.first_place == int((kinds == 0).sum())
    assert result.ends.by_kind["ring"].second_place == result.ends.second_place == int((kinds == 1).sum())
    assert result.ends.left_out == 0
    assert result.ends.gap_mm == pytest.approx(GAP_MM, abs=4.0 * result.ends.gap_sigma_mm)
    said = [sentence for sentence in result.observability.sentences if "two places" in sentence]
    assert len(said) == 1 and f"{result.ends.second_place} at another 9" in said[0]
    result.write(tmp_path / "result.json")
    assert rc.CalibrationResult.read(tmp_path / "result.json").ends == result.ends


def test_one_place_needs_no_words():
    result = rc.solve(observed(0.0, 0.0), throw=False)
    assert result.ends is not None and result.ends.gap_mm is None
    assert result.ends.second_place == result.ends.left_out == 0
    assert not any("place" in sentence for sentence in result.observability.sentences if "ends" in sentence)
    contours = parse_config({"measurements": ["contours"]})
    assert "ends" not in rc.solve(observed(0.0, 0.0), contours, throw=False).to_dict()


def test_ends_nowhere_are_counted():
    result = rc.solve(observed(0.0, 0.2), throw=False)
    assert result.ends is not None and result.ends.left_out > 0
    said = [sentence for sentence in result.observability.sentences if "were left out" in sentence]
    assert len(said) == 1 and said[0].startswith(
        f"{result.ends.left_out} of {result.ends.left_out + result.ends.used} "
    )
