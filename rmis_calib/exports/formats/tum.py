"""tum: one line `timestamp x y z qx qy qz qw`, the pose of the camera in the arm's frame."""

from rmis_calib.exports.answer import Answer
from rmis_calib.exports.hand_eye import about_frames, numbers, quat_xyzw


def content(answer: Answer) -> str:
    """One camera, at time 0: the pose does not change."""
    item = answer.hand_eyes()[0]
    pose = item.arm_T_camera
    head = [f"# {line}" for line in (*answer.about(), *about_frames(item), "timestamp x y z qx qy qz qw")]
    return "\n".join([*head, f"0.0 {numbers(pose[:3, 3])} {numbers(quat_xyzw(pose[:3, :3]))}", ""])
