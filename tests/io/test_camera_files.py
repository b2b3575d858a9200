"""stereo.yaml as people write it, and files of other programs in its place."""

import cv2
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


def test_an_opencv_file_is_named(folder: RecordingFolder) -> None:
    path = folder.path / "stereo.yaml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("M1", np.eye(3))
    storage.release()
    with pytest.raises(RecordingError, match="found an OpenCV FileStorage file: copy fx"):
        load_recording(folder.path)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (
            "image_width: 96\nimage_height: 64\ncamera_name: left\ncamera_matrix: {rows: 3, cols: 3, data: [1]}\n"
            "distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [0]}\n",
            "a ROS camera_info of one camera",
        ),
        (
            "cam0: {camera_model: pinhole, intrinsics: [1, 1, 1, 1], distortion_coeffs: [0, 0, 0, 0]}\n"
            "cam1: {T_cn_cnm1: [[1]]}\n",
            "a kalibr camchain",
        ),
    ],
)
def test_files_of_other_programs_are_named(folder: RecordingFolder, text: str, name: str) -> None:
    (folder.path / "stereo.yaml").write_text(text)
    with pytest.raises(RecordingError, match=f"expected a stereo.yaml of this program .*found {name}: "):
        load_recording(folder.path)
