"""The same code on a GPU: the answers of both devices agree."""

import numpy as np
import pytest
import torch

import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.errors import InputError

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device on this machine")


@needs_cuda
@pytest.mark.slow
def test_calibration_on_cuda_agrees_with_the_cpu(demo_output):
    on_cpu = rc.CalibrationResult.read(demo_output / "calibration" / "result.json")
    recording = rc.load_recording(demo_output / "recording")
    on_cuda = rc.calibrate(recording, parse_config({"device": "cuda"}))
    # Pictures are float32 and sums are ordered differently: agreement far inside one sigma, not to the last bit.
    difference = on_cuda.camera_right_T_arm.matrix.cpu() - on_cpu.camera_right_T_arm.matrix
    assert difference[:3, :3].abs().max() < 0.1 * np.deg2rad(on_cpu.rotation_sigma_deg)
    assert difference[:3, 3].norm() < 0.1 * on_cpu.translation_sigma_mm


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")
def test_absent_device_is_named(rendered_pairs):
    with pytest.raises(InputError, match="one of 0 CUDA devices"):
        rc.calibrate(rc.load_recording(rendered_pairs), parse_config({"device": "cuda"}))
