"""ethz: the JSON of ethz-asl/hand_eye_calibration, its T_H_E: the eye in the hand's frame, metres, Hamilton quaternion.

Source: its extrinsic_calibration.py; time_alignment.py: the eye's times are the hand's plus `delay`.
"""

import json

from rmis_calib.exports.answer import Answer
from rmis_calib.exports.hand_eye import about_frames, quat_xyzw


def content(answer: Answer) -> str:
    """One camera; readers pass over the key `about`."""
    item = answer.hand_eyes()[0]
    pose = item.arm_T_camera
    value = {
        "about": [*answer.about(), *about_frames(item), "delay: camera time less joint time, s"],
        "delay": -answer.clock_s + 0.0,
        "rotation": dict(zip("ijkw", quat_xyzw(pose[:3, :3]), strict=True)),
        "translation": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
    }
    return json.dumps(value, indent=3, allow_nan=False) + "\n"
