"""Which topic is what: by type first, then by the words in its name."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from rmis_calib.convert.material import Placing
from rmis_calib.convert.messages import CAMERA_INFO, COMPRESSED, IMAGE, JOINT_STATE, POSES
from rmis_calib.convert.settings import ConvertSettings
from rmis_calib.errors import RecordingError
from rmis_calib.io._checks import Note

# Old (state_joint_current, position_cartesian_current) and new names; setpoints and goals are not measurements.
_MEASURED_JOINTS = ("measured_js", "state_joint_current", "joint_states")
_MEASURED_POSE = ("measured_cp", "position_cartesian_current", "position_cartesian_local_current")
_NOT_MEASURED = re.compile(
    r"setpoint|goal|servo|move|desired|command|cmd|reference|target|jaw|gripper|SUJ", re.IGNORECASE
)
"""Words of topics that do not say where an arm is."""
_NOT_PICTURES = ("depth", "disparity", "mask", "side", "overlay", "debug", "theora")
_ARM = re.compile(r"^(PSM|ECM|MTM|SUJ|arm|robot)\w*$", re.IGNORECASE)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag."""

    name: str
    type: str
    count: int

    @property
    def words(self) -> list[str]:
        return [word for word in self.name.split("/") if word]


@dataclass(frozen=True)
class Choice:
    """Topics that a recording needs."""

    right: Topic | None
    left: Topic | None
    infos: dict[str, Topic]
    """By side."""
    joints: dict[str, Topic]
    """By arm."""
    poses: dict[str, Topic]
    """By arm."""
    placings: dict[Placing, Topic]
    """What may tell where the arms' bases are."""


def choose_topics(topics: Sequence[Topic], settings: ConvertSettings, note: Note, where: str) -> Choice:
    """The topics that matter.

    Raises:
        RecordingError: a topic that was asked for is not there, or two fit equally well.
    """
    right, left = _pictures(topics, settings, note, where)
    infos = {}
    for side, picture in (("right", right), ("left", left)):
        info = None if picture is None else _info_of(picture, topics)
        if info is not None:
            infos[side] = info
    joints = _by_arm(topics, (JOINT_STATE,), _MEASURED_JOINTS) or _by_arm(topics, (JOINT_STATE,), None)
    poses = _by_arm(topics, POSES, _MEASURED_POSE)
    if not joints and not poses:
        poses = _by_arm(topics, POSES, None)
    for arm, topic in {**poses, **joints}.items():
        if topic.words[-1] not in (*_MEASURED_JOINTS, *_MEASURED_POSE):
            note(f"{arm}: {topic.name}, by its type ({topic.type.rpartition('/')[2]})")
    return Choice(right, left, infos, joints, poses, _placings(topics))


def _placings(topics: Sequence[Topic]) -> dict[Placing, Topic]:
    """`[SUJ/]ARM/[local/]measured_cp`: of an arm's base (SUJ) and of its tip."""
    found = {}
    for topic in topics:
        words = [word for word in topic.words if word != "dvrk"]
        if topic.type not in POSES or not topic.count or not words or words[-1] not in _MEASURED_POSE:
            continue
        is_base, is_local = words[0] == "SUJ", "local" in words[-1] or "local" in words[:-1]
        arm = [word for word in words[is_base:-1] if word != "local"]
        if len(arm) == 1 and _ARM.match(arm[0]):
            found[Placing(arm[0], "base" if is_base else "tip", is_local)] = topic
    return found


def describe(topics: Sequence[Topic]) -> str:
    """What a bag holds, in one line."""
    return ", ".join(f"{topic.name} ({topic.type.rpartition('/')[2]})" for topic in topics[:12]) or "nothing"


def _by_arm(topics: Sequence[Topic], types: Sequence[str], names: Sequence[str] | None) -> dict[str, Topic]:
    """Topics `.../ARM/[local/]name` by their arm; local ones win. Without names: all that measure."""
    found: dict[str, Topic] = {}
    for topic in topics:
        words = topic.words
        if topic.type not in types or not words or not topic.count or "SUJ" in words or "jaw" in words:
            continue
        if _NOT_MEASURED.search(topic.name) if names is None else words[-1] not in names:
            continue
        path = [word for word in words[:-1] if word not in ("local", "dvrk", "body", "spatial")]
        arm = next((word for word in path if _ARM.match(word)), path[-1] if path else words[-1])
        if arm not in found or "local" in topic.name:
            found[arm] = topic
    return found


def _pictures(
    topics: Sequence[Topic], settings: ConvertSettings, note: Note, where: str
) -> tuple[Topic | None, Topic | None]:
    pictures = [
        topic for topic in topics
        if topic.type in (IMAGE, COMPRESSED) and topic.count and not any(word in topic.name for word in _NOT_PICTURES)
    ]  # fmt: skip
    if settings.right_topic is not None or settings.left_topic is not None:
        named = {topic.name: topic for topic in topics if topic.type in (IMAGE, COMPRESSED)}
        chosen = []
        for name in (settings.right_topic, settings.left_topic):
            if name is not None and name not in named:
                raise RecordingError(where=where, expected=f"pictures on topic {name}", found=describe(topics))
            chosen.append(None if name is None else named[name])
        return (chosen[0], chosen[1]) if chosen[0] is not None else (chosen[1], None)
    by_side = {side: [t for t in pictures if side in t.name.lower()] for side in ("right", "left")}
    pairs = [
        (right, left) for right in by_side["right"] for left in by_side["left"]
        if re.sub("right", "left", right.name, flags=re.IGNORECASE) == left.name
    ]  # fmt: skip
    if pairs:
        best = sorted(pairs, key=lambda pair: _rank(pair[0]))
        if len(best) > 1 and _rank(best[0][0]) == _rank(best[1][0]):
            names = ", ".join(pair[0].name for pair in best)
            raise RecordingError(where=where, expected="--right-topic and --left-topic, since several fit", found=names)
        right, left = best[0]
        note(f"pictures: {right.name} and {left.name}, by their names" + _others(best))
        return right, left
    if not pictures:
        return None, None
    ranked = sorted(pictures, key=_rank)
    if len({topic.name.rsplit("/", 1)[0] for topic in ranked}) > 1 and _rank(ranked[0]) == _rank(ranked[1]):
        names = ", ".join(topic.name for topic in ranked)
        raise RecordingError(where=where, expected="--right-topic (and --left-topic)", found=names)
    note(f"pictures: {ranked[0].name}, the only camera (called right)")
    return ranked[0], None


def _others(pairs: Sequence[tuple[Topic, Topic]]) -> str:
    rest = [right.name for right, _ in pairs[1:]]
    return f" (rather than {', '.join(rest)})" if rest else ""


def _rank(topic: Topic) -> tuple[bool, bool, bool]:
    """Raw before rectified, colour before grey, lossless before compressed."""
    return ("rect" in topic.name, "mono" in topic.name, topic.type == COMPRESSED)


def _info_of(picture: Topic, topics: Sequence[Topic]) -> Topic | None:
    """The camera_info beside a picture: in the nearest folder of its name."""
    infos = [topic for topic in topics if topic.type == CAMERA_INFO and topic.count]
    words = picture.words
    for length in range(len(words) - 1, 0, -1):
        for info in infos:
            if info.words[:-1] == words[:length]:
                return info
    return None
