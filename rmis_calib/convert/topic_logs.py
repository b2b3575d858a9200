"""Messages of a bag's topics collected as logs of the arms."""

from typing import Any

import numpy as np

from rmis_calib.convert.material import ArmLog, Logs, PoseLog
from rmis_calib.convert.messages import pose_of, stamp_ns
from rmis_calib.convert.topics import Choice


class TopicLogs:
    """Logs that grow message by message."""

    def __init__(self, choice: Choice) -> None:
        self.logs = Logs({arm: ArmLog(arm) for arm in {**choice.joints, **choice.poses}})
        self._joints = {topic.name: self.logs.arms[arm] for arm, topic in choice.joints.items()}
        self._poses = {topic.name: self.logs.arms[arm] for arm, topic in choice.poses.items()}
        for arm, topic in choice.poses.items():
            self.logs.arms[arm].is_local = "local" in topic.name
        self._placings = {topic.name: PoseLog() for topic in choice.placings.values()}
        self.logs.placings = {key: self._placings[topic.name] for key, topic in choice.placings.items()}

    @property
    def topics(self) -> set[str]:
        """Names of the topics that are collected."""
        return {*self._joints, *self._poses, *self._placings}

    def add(self, topic: str, received_ns: int, message: Any) -> None:
        """One message."""
        ns = stamp_ns(message, received_ns)
        if topic in self._joints:
            log = self._joints[topic]
            if _has_all_joints(message, log):
                log.joint_ns.append(ns)
                log.joints.append(np.array(message.position, dtype=np.float64))
                log.joint_names = tuple(message.name)
            return
        pose, frame = pose_of(message), str(message.header.frame_id)
        if topic in self._poses:
            log = self._poses[topic]
            log.pose_ns.append(ns)
            log.poses.append(pose)
            log.pose_frame = frame
            # Where a console gives an arm no other frame, poses are in its own base, and say so.
            log.is_local = log.is_local or frame.strip("/") == f"{log.name}_base"
        if topic in self._placings:
            self._placings[topic].add(ns, pose, frame)


def _has_all_joints(message: Any, log: ArmLog) -> bool:
    """Whether a JointState has as many positions as the log's first, or, itself the first, as it has names."""
    count = len(message.position)
    return count == len(log.joints[0]) if log.joints else count >= max(1, len(message.name))
