"""stereo.yaml as people write it."""

import numpy as np
import pytest
from breaking import edit
from recording_files import RecordingFolder

from rmis_calib.errors import RecordingError
from rmis_calib.io.recording import load_recording


def turn(degrees: float) -> np.ndarray:
    a = np.deg2rad(degrees)
    return np.array([[np.cos(a), 0.0, np.sin(a)], [0.0, 1.0, 0.0], [-np.sin(a), 0.0, np.cos(a)]])


@pytest.mark.parametrize("decimals", [4, 5, 6])
def test_a_printed_rotation_is_made_orthonormal_with_a_note(folder: RecordingFolder, decimals: int) -> None:
    R = turn(1.7) @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    printed = np.eye(4)
    printed[:3, :3] = np.round(R, decimals)
    printed[0, 3] = 5.0
    edit("stereo.yaml", camera_left_T_camera_right=printed.tolist())(folder)
    recording = load_recording(folder.path)
    read = recording.stereo.camera_left_T_camera_right
    assert read is not None
    found = read.R.numpy()
    assert np.abs(found.T @ found - np.eye(3)).max() < 1e-12
    np.testing.assert_allclose(found, R, atol=10.0**-decimals)
    noted = any("camera_left_T_camera_right: the rotation was printed with few digits" in n for n in recording.notes)
    assert noted == (decimals == 4)  # five digits leave it 3e-7 short, as single precision does


def test_a_rotation_that_is_none_is_refused(folder: RecordingFolder) -> None:
    wrong = [[1.0, 0.002, 0.0, 5.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    edit("stereo.yaml", camera_left_T_camera_right=wrong)(folder)
    with pytest.raises(RecordingError, match="expected an orthonormal rotation"):
        load_recording(folder.path)
