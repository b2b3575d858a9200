"""The frames of a session as a recording without files."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import InputError, VideoError
from rmis_calib.geometry.cameras import Camera, StereoRig
from rmis_calib.io import FrameSource, JointLog, Recording
from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.pipeline.pictures.detection import View, concatenate
from rmis_calib.robot import Robot
from rmis_calib.vision import ShaftDetections

WHERE = Path("session")
APART_S = 1.0
"""Between the still poses of a session on their own clock: a list of poses, in which nothing is interpolated."""


class SeenFrames(FrameSource):
    """Frames that were looked at and not kept."""

    def __init__(self, size: tuple[int, int], count: int) -> None:
        self.path, self.size, self.count, self.times_s = WHERE, size, count, None

    def frames(self, indices: object) -> Tensor:
        """Nothing.

        Raises:
            VideoError: always.
        """
        raise VideoError(where=str(self.path), expected="frames in files", found="a session, which keeps no pictures")


class Collected:
    """Joints, poses and detections of the frames so far; pictures are not kept.

    Attributes:
        columns: joints of the arms in use, `<arm>.<joint>_rad` or `_mm`, laparoscope first.
    """

    def __init__(
        self,
        robot: Robot,
        stereo: StereoRig,
        laparoscope_arm: str | None,
        instrument_arm: str,
        shaft_diameter_mm: float,
    ) -> None:
        self._robot, self._stereo, self._diameter_mm = robot, stereo, shaft_diameter_mm
        self._arms = (laparoscope_arm, instrument_arm)
        self.columns = tuple(robot.joints(*(arm for arm in self._arms if arm is not None)))
        self._readings: list[np.ndarray] = []
        self._poses: list[MotionPoses] = []
        self._found: dict[str, list[ShaftDetections]] = {"right": []} | ({"left": []} if stereo.left else {})

    def __len__(self) -> int:
        return len(self._readings)

    def cameras(self) -> dict[str, Camera]:
        """Cameras by their side, the right one first."""
        left = self._stereo.left
        return {"right": self._stereo.right} | ({} if left is None else {"left": left})

    def readings_of(self, joints: Mapping[str, float]) -> Float[np.ndarray, " j"]:
        """Readings in the order of `columns`.

        Raises:
            InputError: a joint is missing, unknown or not finite.
        """
        missing = [column for column in self.columns if column not in joints]
        unknown = [column for column in joints if column not in self.columns]
        if missing or unknown:
            found = f"no {', '.join(missing)}" if missing else f"{', '.join(unknown)}, of no arm in use"
            raise InputError(where="joints", expected=f"readings of {', '.join(self.columns)}", found=found)
        values = np.array([float(joints[column]) for column in self.columns])
        if not np.isfinite(values).all():
            raise InputError(where="joints", expected="finite readings", found=dict(joints))
        return values

    def add(self, readings: np.ndarray, poses: MotionPoses, found: dict[str, ShaftDetections]) -> None:
        """One frame more."""
        self._readings.append(readings)
        self._poses.append(poses)
        for side, detections in found.items():
            self._found[side].append(detections)

    def recording(self) -> Recording:
        """All frames, each with joints of its own time."""
        times_s = APART_S * np.arange(len(self))
        log = JointLog(times_s, self.columns, np.stack(self._readings))
        sources = {side: SeenFrames(camera.image_size, len(self)) for side, camera in self.cameras().items()}
        return Recording(
            WHERE, self._robot, self._stereo, sources["right"], sources.get("left"), log, times_s, *self._arms,
            self._diameter_mm, 0.0, None,
        )  # fmt: skip

    def poses(self) -> MotionPoses:
        """Kinematics of all frames."""
        first = self._poses[0]
        tensors = {name: torch.cat([getattr(part, name) for part in self._poses]) for name in first.by_motion()}
        return replace(first, frames=np.arange(len(self)), **tensors)

    def views(self) -> tuple[View, ...]:
        """Detections of all frames."""
        return tuple(self.view(side, found) for side, found in self._found.items())

    def view(self, side: str, found: list[ShaftDetections]) -> View:
        """Detections of some frames of a camera."""
        camera, count = self.cameras()[side], len(found)
        return View(
            side, SeenFrames(camera.image_size, count), camera, concatenate(found), torch.ones(count) * torch.inf
        )
