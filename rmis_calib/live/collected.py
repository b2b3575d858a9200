"""The frames of a session as a recording without files."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rmis_calib.errors import InputError, VideoError
from rmis_calib.geometry.cameras import Camera, StereoRig
from rmis_calib.io import FrameSource, JointLog, Recording
from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.pipeline.pictures.frozen import ChangeMeter
from rmis_calib.robot import Robot
from rmis_calib.vision import ShaftDetections

WHERE = Path("session")
APART_S = 1.0
"""Between the still poses of a session on their own clock: a list of poses, in which nothing is interpolated."""


Picture = UInt8[Tensor, "3 h w"]


class SeenFrames(FrameSource):
    """Frames of a session, of which some pictures are kept."""

    def __init__(self, size: tuple[int, int], count: int, kept: Mapping[int, Picture]) -> None:
        self.path, self.size, self.count, self.times_s = WHERE, size, count, None
        self._kept = kept

    def has(self, index: int) -> bool:
        """Whether the picture is kept."""
        return index in self._kept

    def frames(self, indices: Sequence[int]) -> UInt8[Tensor, "n 3 h w"]:
        """Pictures by number.

        Raises:
            VideoError: one is not kept.
        """
        gone = [index for index in indices if index not in self._kept]
        if gone:
            raise VideoError(where=str(self.path), expected="a picture that is kept", found=f"frame {gone[0]}")
        return torch.stack([self._kept[index] for index in indices])


class Collected:
    """Joints, poses and detections of the frames so far, and the latest pictures, as many as there is room for.

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
        picture_memory_mb: float,
    ) -> None:
        self._robot, self._stereo, self._diameter_mm = robot, stereo, shaft_diameter_mm
        self._arms = (laparoscope_arm, instrument_arm)
        self.columns = tuple(robot.joints(*(arm for arm in self._arms if arm is not None)))
        self._readings: list[np.ndarray] = []
        self._poses: list[MotionPoses] = []
        sides = list(self.cameras())
        self._found: dict[str, list[ShaftDetections]] = {side: [] for side in sides}
        self._changes: dict[str, list[Tensor]] = {side: [] for side in sides}
        self._meters = {side: ChangeMeter() for side in sides}
        self._pictures: dict[str, dict[int, Picture]] = {side: {} for side in sides}
        self._room = 1e6 * picture_memory_mb

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

    def add(
        self,
        readings: np.ndarray,
        poses: MotionPoses,
        found: Mapping[str, ShaftDetections],
        pictures: Mapping[str, Picture],
    ) -> None:
        """One frame more."""
        number = len(self)
        self._readings.append(readings)
        self._poses.append(poses)
        for side, detections in found.items():
            self._found[side].append(detections)
            self._changes[side].append(self._meters[side](pictures[side][None]).cpu())
            self._pictures[side][number] = pictures[side].detach().cpu().clone()  # the caller may use its own again
        self._forget()

    def _forget(self) -> None:
        """The oldest pictures, where there is no room for all."""
        each = sum(next(iter(kept.values())).nbytes for kept in self._pictures.values())
        for kept in self._pictures.values():
            while kept and each * len(kept) > self._room:
                del kept[next(iter(kept))]

    def recording(self) -> Recording:
        """All frames, each with joints of its own time."""
        times_s = APART_S * np.arange(len(self))
        log = JointLog(times_s, self.columns, np.stack(self._readings))
        sources = {view.side: view.source for view in self.views()}
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
        views = []
        for side, camera in self.cameras().items():
            source = SeenFrames(camera.image_size, len(self), self._pictures[side])
            views.append(
                View(side, source, camera, ShaftDetections.joined(self._found[side]), torch.cat(self._changes[side]))
            )
        return tuple(views)
