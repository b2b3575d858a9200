"""One small rendered recording for all tests of conversions."""

from dataclasses import replace
from pathlib import Path

import pytest

import data_synth


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six stereo frames as PNG, with the logs of both arms."""
    config = data_synth.load_synth_config("demo")
    eyes = {
        side: replace(eye, fx_px=eye.fx_px / 4, fy_px=eye.fy_px / 4, cx_px=eye.cx_px / 4, cy_px=eye.cy_px / 4)
        for side, eye in (("right", config.camera.right), ("left", config.camera.left))
    }
    camera = replace(config.camera, width_px=160, height_px=120, **eyes)
    config = replace(config, motions=6, output=replace(config.output, pictures="images"), camera=camera)
    return data_synth.write_recording(tmp_path_factory.mktemp("rendered") / "recording", config)
