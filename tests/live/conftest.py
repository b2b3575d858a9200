"""A rendered recording whose frames a session is fed with."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import data_synth
import rmis_calib as rc


@dataclass(frozen=True, eq=False)
class Frames:
    """Pictures and joints of stops of both arms, and the exact answer."""

    recording: rc.Recording
    right: torch.Tensor
    left: torch.Tensor
    joints: list[dict[str, float]]
    truth: np.ndarray
    """camera_right_T_arm, mm."""


@pytest.fixture(scope="session")
def frames(tmp_path_factory) -> Frames:
    config = replace(data_synth.load_synth_config("demo"), motions=18, seed=4)
    folder = Path(data_synth.write_recording(tmp_path_factory.mktemp("live") / "recording", config))
    recording = rc.load_recording(folder)
    readings = [recording.joints_at_frames(arm)[0] for arm in ("laparoscope", "instrument")]
    columns = [*recording.robot.columns("laparoscope"), *recording.robot.columns("instrument")]
    joints = [dict(zip(columns, row.tolist(), strict=True)) for row in np.concatenate(readings, axis=1)]
    count = list(range(recording.n_frames))
    left = recording.left
    assert left is not None
    truth = np.array(yaml.safe_load((folder / "ground_truth.yaml").read_text())["camera_right_T_arm"])
    return Frames(recording, recording.right.frames(count), left.frames(count), joints, truth)
