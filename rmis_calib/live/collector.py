"""Still poses out of streams of joint states and pictures: one each time the arms rest at a new place."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rmis_calib.convert.joints import joint_order
from rmis_calib.io._checks import no_note
from rmis_calib.robot import Arm, Robot

_MM = 1000.0
_KEPT_S = 5.0
"""Joint samples older than this are forgotten."""


@dataclass(frozen=True)
class CollectorSettings:
    """When a pose counts as still, and as new."""

    still_s: float = 0.5
    """Time for which no joint may have moved before a picture is taken."""
    still_rad: float = 0.002
    """Range of a revolute joint that rests."""
    still_mm: float = 0.2
    """Range of a prismatic joint that rests."""
    new_rad: float = 0.02
    """A pose is new where some revolute joint is this far from the pose before..."""
    new_mm: float = 3.0
    """...or some prismatic joint this far."""
    apart_s: float = 0.02
    """Stamps of the two pictures of a pair differ by less."""


@dataclass(frozen=True, eq=False)
class StillPose:
    """Joints and pictures of one still pose.

    Attributes:
        time_s: stamp of the right picture.
        joints: mean readings while the arms rested, by column, rad and mm.
        pictures: by side, as they came.
    """

    time_s: float
    joints: dict[str, float]
    pictures: dict[str, np.ndarray]


class StillPoses:
    """Collects still poses; stamps of joints and pictures are on one clock.

    Args:
        robot: with the arms.
        arms: names of the arms in use.
        sides: cameras that a pose needs pictures of.
        settings: when a pose is still, and new.
    """

    def __init__(
        self, robot: Robot, arms: Sequence[str], sides: Sequence[str], settings: CollectorSettings | None = None
    ) -> None:
        self._settings = settings or CollectorSettings()
        self._arms: dict[str, Arm] = {name: robot.arms[name] for name in arms}
        self._columns = {name: robot.columns(name) for name in arms}
        self._samples: dict[str, deque[tuple[float, np.ndarray]]] = {name: deque() for name in arms}
        self._sides = tuple(sides)
        self._pictures: dict[str, tuple[float, np.ndarray]] = {}
        self._last: np.ndarray | None = None
        units = [joint.unit for arm in self._arms.values() for joint in arm.joints]
        is_mm = np.array([unit == "mm" for unit in units])
        self._still = np.where(is_mm, self._settings.still_mm, self._settings.still_rad)
        self._new = np.where(is_mm, self._settings.new_mm, self._settings.new_rad)

    def add_joints(self, arm: str, time_s: float, names: Sequence[str], positions: Sequence[float]) -> StillPose | None:
        """A joint state of an arm, rad and m; the pose that it completes.

        Raises:
            RecordingError: another number of joints than the arm has.
        """
        table, values = self._arms[arm], np.asarray(positions, dtype=np.float64)
        order = joint_order(names, len(values), table, f"joint states of {arm}", no_note)
        scale = np.array([_MM if joint.unit == "mm" else 1.0 for joint in table.joints])
        samples = self._samples[arm]
        samples.append((time_s, values[order] * scale))
        while samples and samples[0][0] < time_s - _KEPT_S:
            samples.popleft()
        return self._complete()

    def add_picture(self, side: str, time_s: float, picture: np.ndarray) -> StillPose | None:
        """A picture of a camera; the pose that it completes. The newest of each camera counts."""
        self._pictures[side] = (time_s, picture)
        return self._complete()

    def _complete(self) -> StillPose | None:
        if set(self._pictures) != set(self._sides):
            return None
        times = [self._pictures[side][0] for side in self._sides]
        if max(times) - min(times) >= self._settings.apart_s or not self._known_until(max(times)):
            return None
        rested = self._rested(min(times) - self._settings.still_s, max(times))
        if rested is None or (self._last is not None and bool((np.abs(rested - self._last) < self._new).all())):
            return None
        self._last = rested
        columns = [column for name in self._arms for column in self._columns[name]]
        pictures = {side: self._pictures[side][1] for side in self._sides}
        self._pictures = {}
        return StillPose(times[0], dict(zip(columns, rested.tolist(), strict=True)), pictures)

    def _known_until(self, time_s: float) -> bool:
        """Whether the joints of every arm are known beyond this time: what comes later may still tell of motion."""
        return all(samples and samples[-1][0] >= time_s for samples in self._samples.values())

    def _rested(self, start_s: float, end_s: float) -> np.ndarray | None:
        """Mean readings between two times, all arms one after the other; None where they moved or are not known."""
        means = []
        for samples in self._samples.values():
            inside = np.array([values for time_s, values in samples if start_s <= time_s <= end_s])
            # Known from before the start on, and often enough in between that a motion and back would show.
            if len(inside) < 3 or samples[0][0] > start_s:
                return None
            means.append((inside.mean(0), np.ptp(inside, axis=0)))
        ranges = np.concatenate([spread for _, spread in means])
        return None if bool((ranges > self._still).any()) else np.concatenate([mean for mean, _ in means])
