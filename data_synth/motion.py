"""How the arms move: stops on a grid or at random, or smooth continuous paths; and the joint log of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from data_synth.kinematics import Array
from data_synth.scene import MOVING_JOINTS, Scene, half_range, moved_from
from data_synth.settings import MotionSettings

MOVING_FRACTION = 0.5
"""Part of a stop period that is spent moving; the rest is dwelt around the frame."""
START_S = 1.0
"""Time of the first frame: leaves room for the joint log, which starts earlier."""
TRIES = 200
"""Redraws of a stop that is not in view."""

InView = Callable[[Array, Array], Array]


def joint_grid(positions: int) -> Array:
    """Combinations (positions^3, 3) of evenly spaced values in [-1, 1] of three joints; zero for a single position."""
    values = np.linspace(-1.0, 1.0, positions) if positions > 1 else np.zeros(1)
    return np.stack(np.meshgrid(values, values, values, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class JointPath:
    """Readings of both arms as functions of time: stops with rests between, or sums of sines.

    Attributes:
        laparoscope_home, instrument_home: (J,) readings in the middle of the motion.
        half_range: (6,) of the laparoscope's moving joints, then of the instrument's.
        stop_times_s: (S,) middles of the rests, or empty for a smooth path.
        stops: (S, 6) in units of half_range.
        frequency_hz: (K, 6) of the sines.
        phase_rad: (K, 6).
        amplitude: (K, 6), columns sum to at most 1.
    """

    laparoscope_home: Array
    instrument_home: Array
    half_range: Array
    stop_times_s: Array
    stops: Array
    frequency_hz: Array
    phase_rad: Array
    amplitude: Array

    def at(self, times_s: Array) -> tuple[Array, Array]:
        """Readings of the laparoscope (..., J) and of the instrument (..., J) at times (...)."""
        return self.readings(self._stopping(times_s) if len(self.stop_times_s) else self._smooth(times_s))

    def readings(self, unit: Array) -> tuple[Array, Array]:
        """Readings of both arms (..., J) whose moving joints are off home by `unit` (..., 6) of half their range."""
        change = self.half_range * unit
        return (
            moved_from(self.laparoscope_home, change[..., :MOVING_JOINTS]),
            moved_from(self.instrument_home, change[..., MOVING_JOINTS:]),
        )

    def _stopping(self, times_s: Array) -> Array:
        if len(self.stop_times_s) == 1:
            return np.broadcast_to(self.stops[0], (*times_s.shape, 6))
        index = np.clip(np.searchsorted(self.stop_times_s, times_s) - 1, 0, len(self.stop_times_s) - 2)
        span = self.stop_times_s[index + 1] - self.stop_times_s[index]
        phase = (times_s - self.stop_times_s[index]) / span
        u = np.clip((phase - 0.5) / MOVING_FRACTION + 0.5, 0.0, 1.0)[..., None]
        blend = u * u * (3.0 - 2.0 * u)
        return self.stops[index] * (1.0 - blend) + self.stops[index + 1] * blend

    def _smooth(self, times_s: Array) -> Array:
        angle = 2.0 * np.pi * self.frequency_hz * times_s[..., None, None] + self.phase_rad
        return (self.amplitude * np.sin(angle)).sum(-2)


def plan_path(
    settings: MotionSettings, scene: Scene, frames: int, generator: np.random.Generator, in_view: InView
) -> tuple[JointPath, Array]:
    """Path of both arms and the times (frames,) of its frames, s.

    Args:
        settings: kind and ranges of the motion.
        scene: for the home positions.
        frames: number of frames.
        generator: source of randomness.
        in_view: whether the shaft's end is in view at readings (n, J) of each arm; used by `random` when
            `keep_end_in_view`.
    """
    ranges = settings.rotation_range_deg, settings.translation_range_mm
    laparoscope = half_range(scene.laparoscope, *ranges) * (settings.laparoscope == "moving")
    none = np.zeros((0, 6))
    still = JointPath(
        scene.laparoscope_home, scene.instrument_home,
        np.concatenate([laparoscope, half_range(scene.instrument, *ranges)]), np.zeros(0), none, none, none, none,
    )  # fmt: skip
    if settings.kind == "smooth":
        return _smooth(still, settings.speed, generator), START_S + np.arange(frames) / settings.frame_rate_hz

    def good(unit: Array) -> Array:
        return in_view(*still.readings(unit))

    make = _grid_stops if settings.kind == "grid" else _random_stops
    stops = make(settings, frames, generator, good)
    times = START_S + (np.arange(frames) + 0.5) * settings.stop_period_s
    return replace(still, stop_times_s=times, stops=stops), times


def _smooth(still: JointPath, speed: float, generator: np.random.Generator) -> JointPath:
    """Three incommensurable sines a joint, below 0.4 Hz: hand speeds of a few centimetres a second."""
    frequency = speed * generator.uniform(0.05, 0.4, (3, 6)) * np.array([1.0, 0.6, 0.35])[:, None]
    amplitude = generator.uniform(0.5, 1.0, (3, 6))
    amplitude /= amplitude.sum(0)
    phase = generator.uniform(0.0, 2.0 * np.pi, (3, 6))
    return replace(still, frequency_hz=frequency, phase_rad=phase, amplitude=amplitude)


def _grid_stops(
    settings: MotionSettings, frames: int, generator: np.random.Generator, good: Callable[[Array], Array]
) -> Array:
    laparoscope = joint_grid(settings.positions_laparoscope if settings.laparoscope == "moving" else 1)
    instrument = joint_grid(settings.positions_instrument)
    places = len(laparoscope) * len(instrument)
    if frames > places:
        raise ValueError(f"motions: expected at most {places} on this grid, found {frames}")
    unit = np.concatenate(
        [np.repeat(laparoscope, len(instrument), 0), np.tile(instrument, (len(laparoscope), 1))], axis=-1
    )
    order = generator.permutation(places)
    if settings.keep_end_in_view:
        order = order[np.argsort(~good(unit)[order], kind="stable")]
    return unit[np.sort(order[:frames])]


def _random_stops(
    settings: MotionSettings, frames: int, generator: np.random.Generator, good: Callable[[Array], Array]
) -> Array:
    stops = generator.uniform(-1.0, 1.0, (frames, 6))
    for _ in range(TRIES if settings.keep_end_in_view else 0):
        bad = ~good(stops)
        if not bad.any():
            break
        stops[bad] = generator.uniform(-1.0, 1.0, (int(bad.sum()), 6))
    return stops


def log_times(frame_times_s: Array, rate_hz: float) -> Array:
    """Times of a joint log that covers the frames with half a second to spare on both sides, in step with no frame."""
    first, last = frame_times_s.min() - 0.5, frame_times_s.max() + 0.5
    return first + np.arange(int(np.ceil((last - first) * rate_hz)) + 1) / rate_hz
