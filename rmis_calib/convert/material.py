"""What a source holds, whatever it is: logs of arms in SI units, cameras, and pictures that are written already."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from rmis_calib.io._checks import Note
from rmis_calib.io.intrinsics import StereoFile

ProgressCallback = Callable[[str, int, int], None]

NS = 1_000_000_000
NEEDS_STEREO = "--stereo FILE, the cameras' calibration (any format of `rmis-calib cameras show`)"


@dataclass
class ArmLog:
    """What a source logs of one arm; SI units, stamps in ns."""

    name: str
    joint_ns: list[int] = field(default_factory=list)
    joints: list[np.ndarray] = field(default_factory=list)
    """rad and m."""
    joint_names: tuple[str, ...] = ()
    pose_ns: list[int] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    """x, y, z (m), qx, qy, qz, qw of the tip."""
    is_local: bool = False
    """Poses are relative to the arm's own base (the RCM), not to another frame."""
    pose_frame: str = ""

    @property
    def has_joints(self) -> bool:
        return bool(self.joints)


@dataclass
class PoseLog:
    """Poses of one frame in another; m, stamps in ns."""

    frame: str = ""
    """Name of the other frame."""
    ns: list[int] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    """x, y, z (m), qx, qy, qz, qw."""

    def add(self, ns: int, pose: np.ndarray, frame: str) -> None:
        self.ns.append(ns)
        self.poses.append(pose)
        self.frame = frame.strip("/")


@dataclass(frozen=True)
class Placing:
    """Which pose of an arm it is: of its base, as the set-up joints tell, or of its tip; and in which frame."""

    arm: str
    what: Literal["base", "tip"]
    is_local: bool
    """In the frame of the cart (base) or in the arm's own base (tip); else in the frame that the messages name."""


@dataclass
class Logs:
    """All that a source logs of the arms."""

    arms: dict[str, ArmLog]
    placings: dict[Placing, PoseLog] = field(default_factory=dict)
    """What may tell where the arms' bases are."""

    def with_content(self) -> "Logs":
        """Without arms of which nothing was logged."""
        arms = {name: log for name, log in self.arms.items() if log.has_joints or log.poses}
        return Logs(arms, {key: log for key, log in self.placings.items() if log.poses})


@dataclass
class Material:
    """All that a recording is made of."""

    logs: Logs
    cameras: StereoFile | None
    frame_ns: np.ndarray
    """(N,) int64, on the clock of the arms' stamps."""
    right: str
    """File or folder of the right pictures, in the recording."""
    left: str | None = None
    stereo_layout: Literal["side_by_side", "top_bottom"] | None = None
    swapped: bool = False
    robot: str | None = None
    """Robot that the source itself implies."""


@dataclass(frozen=True)
class Job:
    """Where a source reads from and writes to."""

    source: Path
    folder: Path
    """The recording in the making."""
    note: Note
    progress: ProgressCallback


Poses = Float[np.ndarray, "n 7"]
