"""urdf-origin: a robot description with the arm's link and a fixed joint to each camera; its joints go into yours."""

from rmis_calib.exports.answer import Answer
from rmis_calib.exports.formats.markup import xml_comment
from rmis_calib.exports.hand_eye import HandEye, about_frames, numbers, rpy_rad


def content(answer: Answer) -> str:
    """A URDF of its own, so that any URDF reader takes the file as it is."""
    items = answer.hand_eyes()
    head = [*answer.about(), *(line for item in items for line in about_frames(item))]
    head.append("origin: xyz in m, rpy in rad about fixed axes, R = Rz(yaw) Ry(pitch) Rx(roll)")
    links = [f'  <link name="{name}"/>' for name in (items[0].arm, *(item.camera for item in items))]
    lines = ['<?xml version="1.0"?>', '<robot name="hand_eye">', xml_comment(head), *links]
    return "\n".join([*lines, *(joint(item) for item in items), "</robot>", ""])


def joint(item: HandEye) -> str:
    """The fixed joint from the arm to a camera."""
    pose = item.arm_T_camera
    return (
        f'  <joint name="{item.arm}_to_{item.camera}" type="fixed">\n'
        f'    <parent link="{item.arm}"/>\n    <child link="{item.camera}"/>\n'
        f'    <origin xyz="{numbers(pose[:3, 3])}" rpy="{numbers(list(rpy_rad(pose[:3, :3])))}"/>\n'
        "  </joint>"
    )
