"""Broken recording.yaml, robot.yaml and stereo.yaml: one clear line each, with file, key, expected and found."""

import pytest
from breaking import REMOVE, Case, check_one_clear_line, edit, remove, write
from recording_files import RecordingFolder, identity

from rmis_calib.errors import FileError, RecordingError, RobotError

ONE_ROTATION_OFF = [[1.0, 0.002, 0.0, 5.0], *identity()[1:]]
REFLECTION = [[-1.0, 0.0, 0.0, 5.0], *identity()[1:]]
LAST_ROW = [*identity(5.0)[:3], [0.0, 0.0, 0.001, 1.0]]
JOINT = "arms__instrument__joints"
CASES: dict[str, Case] = {
    # Files that are not there.
    "no recording.yaml": (
        remove("recording.yaml"),
        FileError,
        r"expected a recording: a folder with recording\.yaml, found a folder without it",
    ),
    "no robot": (remove("robot.yaml"), FileError, r"robot\.yaml: expected a readable file, found nothing there"),
    "no stereo": (remove("stereo.yaml"), FileError, r"stereo\.yaml: expected a readable file, found nothing there"),
    "no video": (remove("right.mp4"), FileError, r"right\.mp4: expected a video or a folder of images, found nothing"),
    "no left video": (
        remove("left.mp4"),
        FileError,
        r"left\.mp4: expected a video or a folder of images, found nothing",
    ),
    "no joints": (remove("joints.csv"), FileError, r"joints\.csv: expected a readable file, found nothing there"),
    "no frame times": (remove("frame_times.csv"), FileError, r"frame_times\.csv: expected a readable file"),
    # recording.yaml.
    "unknown key": (
        edit("recording.yaml", shaft_diametre_mm=8.0),
        RecordingError,
        r"recording\.yaml: shaft_diametre_mm: .*unknown one \(did you mean shaft_diameter_mm\?\)",
    ),
    "odd key": (
        edit("recording.yaml", zzz=1),
        RecordingError,
        r"zzz: expected a known key, .*\(known: clock_offset_s, ",
    ),
    "missing key": (edit("recording.yaml", joints=REMOVE), RecordingError, "joints: expected this key, found nothing"),
    "missing arm key": (
        edit("recording.yaml", laparoscope_arm=REMOVE),
        RecordingError,
        "laparoscope_arm: expected this",
    ),
    "other format": (edit("recording.yaml", format="rmis-calib/2"), RecordingError, "format: expected 'rmis-calib/1'"),
    "text for a number": (
        edit("recording.yaml", shaft_diameter_mm="8 mm"),
        RecordingError,
        "shaft_diameter_mm: expected a number, found '8 mm'",
    ),
    "infinite offset": (
        edit("recording.yaml", clock_offset_s=float("inf")),
        RecordingError,
        "clock_offset_s: .*finite",
    ),
    "text offset": (
        edit("recording.yaml", clock_offset_s="soon"),
        RecordingError,
        "clock_offset_s: .*number, found 'soon'",
    ),
    "null instrument": (edit("recording.yaml", instrument_arm=None), RecordingError, "instrument_arm: .*found null"),
    "diameter in metres": (
        edit("recording.yaml", shaft_diameter_mm=0.008),
        RecordingError,
        "shaft_diameter_mm: looks like metres; write millimetres; expected a diameter of 1 to 30 mm, found 0.008",
    ),
    "diameter too large": (edit("recording.yaml", shaft_diameter_mm=31.0), RecordingError, "1 to 30 mm, found 31"),
    "one arm twice": (edit("recording.yaml", laparoscope_arm="instrument"), RecordingError, "two different arms"),
    "one video twice": (edit("recording.yaml", left="right.mp4"), RecordingError, "two different videos"),
    "unknown arm": (
        edit("recording.yaml", instrument_arm="psm1"),
        RecordingError,
        r"recording\.yaml: instrument_arm: expected an arm of robot test \(laparoscope, instrument\), found psm1",
    ),
    "not a mapping": (write("recording.yaml", b"- 1\n"), RecordingError, "expected a mapping"),
    "key twice": (write("recording.yaml", b"format: a\nformat: b\n"), RecordingError, "line 2: .*key 'format' twice"),
    # The robot.
    "unknown preset": (
        edit("recording.yaml", robot="dvrk-clasic"),
        RobotError,
        r"robot preset: expected one of .*rcm-3x3.*, found 'dvrk-clasic' \(did you mean dvrk-classic\?\)",
    ),
    "unknown joint key": (
        edit("robot.yaml", **{f"{JOINT}__0__alpha": 0.0}),
        RobotError,
        r"robot\.yaml: arms\.instrument\.joints\.0\.alpha: .*did you mean alpha_rad",
    ),
    "unknown arm key": (edit("robot.yaml", arms__instrument__tool=1), RobotError, r"arms\.instrument\.tool: .*unknown"),
    "unknown robot key": (edit("robot.yaml", arm=1), RobotError, r"robot\.yaml: arm: .*did you mean arms"),
    "unknown head key": (
        edit("robot.yaml", arms__instrument__head_point__xyz=[0, 0, 0]),
        RobotError,
        r"head_point\.xyz: .*did you mean xyz_mm",
    ),
    "DH in metres": (
        edit("robot.yaml", **{f"{JOINT}__2__d_mm": -0.4, f"{JOINT}__2__max": 240.0}),
        RobotError,
        r"arms\.instrument: looks like metres; write millimetres; expected DH lengths in mm, found none above 0\.4",
    ),
    "limits in metres": (edit("robot.yaml", **{f"{JOINT}__2__max": 0.24}), RobotError, r"joints\.2: looks like metres"),
    "alpha in degrees": (edit("robot.yaml", **{f"{JOINT}__0__alpha_rad": 90.0}), RobotError, "looks like degrees"),
    "limits in degrees": (edit("robot.yaml", **{f"{JOINT}__0__max": 90.0}), RobotError, "looks like degrees"),
    "one limit": (edit("robot.yaml", **{f"{JOINT}__0__max": REMOVE}), RobotError, "both min and max or neither"),
    "limits swapped": (edit("robot.yaml", **{f"{JOINT}__0__max": -1.6}), RobotError, "expected min < max"),
    "joint type": (
        edit("robot.yaml", **{f"{JOINT}__0__type": "hinge"}),
        RobotError,
        "'revolute' or 'prismatic', found 'h",
    ),
    "joint name": (
        edit("robot.yaml", **{f"{JOINT}__0__name": "a.b"}),
        RobotError,
        r"joints\.0\.name: expected letters, digits",
    ),
    "joint name twice": (edit("robot.yaml", **{f"{JOINT}__0__name": "pitch"}), RobotError, "joint names that differ"),
    "arm without joints": (
        edit("robot.yaml", **{JOINT: []}),
        RobotError,
        r"instrument\.joints: expected 1 entry or more",
    ),
    "rcm frame": (edit("robot.yaml", arms__instrument__rcm_frame=4), RobotError, "rcm_frame from 0 to 3 .*found 4"),
    "shaft frame": (edit("robot.yaml", arms__instrument__shaft_frame=-1), RobotError, "shaft_frame: .*found -1"),
    "head before shaft": (edit("robot.yaml", arms__instrument__head_point__frame=2), RobotError, "shaft_frame at most"),
    "half an instrument": (edit("robot.yaml", arms__instrument__rcm_frame=REMOVE), RobotError, "found no rcm_frame"),
    "not an instrument": (
        edit("recording.yaml", laparoscope_arm="instrument", instrument_arm="laparoscope"),
        RobotError,
        r"arms\.laparoscope: expected rcm_frame, shaft_frame and head_point of an instrument arm, found none",
    ),
    "base not a rotation": (
        edit("robot.yaml", arms__instrument__base_T_arm_base=ONE_ROTATION_OFF),
        RobotError,
        r"arms\.instrument\.base_T_arm_base: expected an orthonormal rotation .*found a deviation of 0\.002",
    ),
    "tool a reflection": (
        edit("robot.yaml", arms__laparoscope__end_T_tool=REFLECTION),
        RobotError,
        r"arms\.laparoscope\.end_T_tool: expected a rotation \(determinant \+1\), found a reflection",
    ),
    "three rows": (
        edit("robot.yaml", arms__instrument__base_T_arm_base=identity()[:3]),
        RobotError,
        r"base_T_arm_base: expected 4 entries, found \[\[",
    ),
    "NaN in a matrix": (
        edit("robot.yaml", arms__instrument__base_T_arm_base__1__1=float("nan")),
        RobotError,
        r"base_T_arm_base\.1\.1: expected a finite number, found nan",
    ),
    # The cameras.
    "extrinsics last row": (
        edit("stereo.yaml", camera_left_T_camera_right=LAST_ROW),
        RecordingError,
        "a last row of 0, 0",
    ),
    "extrinsics reflect": (
        edit("stereo.yaml", camera_left_T_camera_right=REFLECTION),
        RecordingError,
        "found a reflection",
    ),
    "baseline in metres": (
        edit("stereo.yaml", camera_left_T_camera_right=identity(0.005)),
        RecordingError,
        r"stereo\.yaml: camera_left_T_camera_right: looks like metres; write millimetres; .*found 0\.005 mm",
    ),
    "baseline too large": (
        edit("stereo.yaml", camera_left_T_camera_right=identity(5000.0)),
        RecordingError,
        "expected a baseline of 0.1 to 200 mm, found 5000 mm",
    ),
    "no left camera": (
        edit("stereo.yaml", left=REMOVE, camera_left_T_camera_right=REMOVE),
        RecordingError,
        r"recording\.yaml: left: expected a left camera in stereo\.yaml, found none for left\.mp4",
    ),
    "no left video for it": (edit("recording.yaml", left=REMOVE), RecordingError, "left: .*found no left video"),
    "no extrinsics": (edit("stereo.yaml", camera_left_T_camera_right=REMOVE), RecordingError, "found only left"),
    "focal in widths": (
        edit("stereo.yaml", right__fx=0.9),
        RecordingError,
        r"stereo\.yaml: right\.fx: expected a focal",
    ),
    "negative focal": (edit("stereo.yaml", right__fy=-91.0), RecordingError, r"right\.fy: expected more than 0"),
    "no distortion": (
        edit("stereo.yaml", right__distortion=REMOVE),
        RecordingError,
        r"right: expected distortion: \[k1, k2, p1, p2, k3\] \(five zeros for undistorted images\), found none",
    ),
    "principal point": (edit("stereo.yaml", left__cx=900.0), RecordingError, r"left\.cx: expected a principal point"),
    "four distortions": (
        edit("stereo.yaml", right__distortion=[0.0] * 4),
        RecordingError,
        r"right: expected 5 entries of distortion for plumb_bob, found 4 \(distortion_model: equidistant\?\)",
    ),
    "unknown camera key": (edit("stereo.yaml", right__skew=0.0), RecordingError, r"right\.skew: .*unknown"),
    "fractional size": (
        edit("stereo.yaml", image_size=[96.5, 64]),
        RecordingError,
        r"image_size\.0: expected a whole number",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_one_clear_line(folder: RecordingFolder, name: str) -> None:
    check_one_clear_line(folder, CASES[name])
