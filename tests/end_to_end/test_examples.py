"""The worked examples do what they say."""

import importlib.util
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def load(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_a_network_learns_edges_through_the_calibration():
    example = load("train_lines_through_calibration")
    network = example.train(steps=15)
    assert example.held_out_mm(network, 12) < 0.8 * example.held_out_mm(example.steepest, 12)


def test_a_marker_makes_a_weak_recording_strong():
    before, after = load("own_measurement").main()
    assert before.status != "ok" and after.status == "ok"
    assert after.translation_sigma_mm < 0.3 * before.translation_sigma_mm
    residual = after.residuals["tracked marker"]
    assert residual.unit == "mm" and 0.2 < residual.rms < 1.0
