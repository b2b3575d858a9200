"""What observations are made of, apart from detections."""

import contextlib

import pytest
from measured_from_truth import SMALL

import data_synth
import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.errors import ObservationsError
from rmis_calib.pipeline.arms.poses import motion_poses
from rmis_calib.pipeline.motions import observations
from rmis_calib.pipeline.pictures.detection import View


def test_the_model_error_of_each_camera_is_in_its_own_focal_lengths(tmp_path, monkeypatch):
    left = SMALL | {"fx_px": 350.0, "fy_px": 350.0}
    config = {"motions": 3, "seed": 1, "camera": {"width_px": 160, "height_px": 120, "right": SMALL, "left": left}}
    data_synth.write_recording(tmp_path / "recording", data_synth.load_synth_config(config))
    recording = rc.load_recording(tmp_path / "recording")
    sigma = {}

    def measured(side, detections, choice, model_sigma):
        sigma[side] = model_sigma
        return {}

    def view_of(side):
        view = object.__new__(View)
        object.__setattr__(view, "side", side)
        return view

    monkeypatch.setattr(observations, "_measured", measured)
    monkeypatch.setattr(View, "at", lambda view, frames: None)
    choices = tuple(object.__new__(observations.Choice) for _ in range(2))
    with contextlib.suppress(ObservationsError):  # nothing was measured
        observations.assemble(
            recording,
            motion_poses(recording),
            (view_of("right"), view_of("left")),
            choices,
            parse_config({"picture_errors": {"model_sigma_px": 0.7}}),
        )
    assert sigma["right"] == pytest.approx(0.7 / 175.0)
    assert sigma["left"] == pytest.approx(0.7 / 350.0)
