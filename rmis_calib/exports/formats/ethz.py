"""ethz: the JSON of ethz-asl/hand_eye_calibration, its T_H_E: the eye in the hand's frame, metres, Hamilton quaternion.

Source: its extrinsic_calibration.py; time_alignment.py: the eye's times are the hand's plus `delay`. That is one
number: clocks that run at different rates are that far apart in the middle of the recording only, and `about` says so.
"""

import json

from rmis_calib.exports.answer import Answer
from rmis_calib.exports.hand_eye import about_frames, quat_xyzw


def content(answer: Answer) -> str:
    """One camera; readers pass over the key `about`."""
    item = answer.hand_eyes()[0]
    pose = item.arm_T_camera
    value = {
        "about": [*answer.about(), *about_frames(item), *_about_delay(answer)],
        "delay": -answer.clock_s + 0.0,
        "rotation": dict(zip("ijkw", quat_xyzw(pose[:3, :3]), strict=True)),
        "translation": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
    }
    return json.dumps(value, indent=3, allow_nan=False) + "\n"


def _about_delay(answer: Answer) -> list[str]:
    """What `delay` is, and where it does not hold."""
    meaning = "delay: camera time less joint time, s"
    if not answer.clock_rate:
        return [meaning]
    warning = f"DELAY IS NOT CONSTANT: it changes by {-answer.clock_rate:+.6g} s a second, as the clocks differ in rate"
    return [f"{meaning}, in the middle of the recording only", warning]
