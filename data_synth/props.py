"""What else is in the scene: instruments that nobody logs, and tissue in the foreground. float64 NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_synth.kinematics import Array, transform_points
from data_synth.settings_picture import LookSettings

RADIUS_MM = 4.0
WRIST_MM = 11.0
HEAD_BEYOND_MM = 3.0


@dataclass(frozen=True)
class OtherInstrument:
    """An instrument that swings about its own port on its own path; positions in base, mm."""

    kind: str
    base_p_rcm: Array
    base_p_head: Array
    swing_mm: Array
    frequency_hz: Array
    phase_rad: Array

    def head(self, times_s: Array) -> Array:
        """Head point (..., 3) in base at times (...)."""
        angle = 2.0 * np.pi * self.frequency_hz * times_s[..., None] + self.phase_rad
        return self.base_p_head + self.swing_mm * np.sin(angle)


@dataclass(frozen=True)
class TissueLoop:
    """Tissue in front of the instrument: a round-ended tube between two points in base, mm."""

    base_p_a: Array
    base_p_b: Array
    radius_mm: float


@dataclass(frozen=True)
class Props:
    """All of them."""

    others: tuple[OtherInstrument, ...]
    loops: tuple[TissueLoop, ...]


def place_props(look: LookSettings, base_T_camera_home: Array, generator: np.random.Generator) -> Props:
    """Other instruments from the left and from below, and a loop that reaches over the shaft, as the home camera sees
    them."""
    ports = np.array([[-85.0, -35.0, 25.0], [-20.0, 95.0, 30.0]])
    heads = np.array([[-30.0, 8.0, 104.0], [-2.0, 30.0, 112.0]])

    def in_base(point: Array, spread: float) -> Array:
        return transform_points(base_T_camera_home, point + spread * generator.uniform(-1.0, 1.0, 3))

    others = tuple(
        OtherInstrument(
            kind=kind,
            base_p_rcm=in_base(port, 5.0),
            base_p_head=in_base(head, 4.0),
            swing_mm=generator.uniform(2.0, 8.0, 3),
            frequency_hz=generator.uniform(0.05, 0.3, 3),
            phase_rad=generator.uniform(0.0, 2.0 * np.pi, 3),
        )
        for kind, port, head in zip(look.other_instruments, ports, heads, strict=False)
    )
    ends = (np.array([60.0, 42.0, 75.0]), np.array([23.0, -1.0, 70.0]))
    loops = (TissueLoop(in_base(ends[0], 3.0), in_base(ends[1], 2.0), 8.5),) if look.tissue_over_shaft else ()
    return Props(others, loops)


def hidden_by(loop: TissueLoop, camera_T_base: Array, camera_p: Array) -> Array:
    """Whether points (..., 3) in the camera are behind the loop: the ray to them passes nearer to its axis than its
    radius."""
    a = transform_points(camera_T_base, loop.base_p_a)
    e = transform_points(camera_T_base, loop.base_p_b) - a
    d = camera_p / np.linalg.norm(camera_p, axis=-1, keepdims=True)
    de, da, ea, ee = ((p * q).sum(-1) for p, q in ((d, e), (d, a), (e, a), (e, e)))
    h = np.clip((da * de - ea) / np.maximum(ee - de * de, 1e-9), 0.0, 1.0)
    nearest = a + h[..., None] * e
    gap = nearest - (d * nearest).sum(-1)[..., None] * d
    return np.linalg.norm(gap, axis=-1) < loop.radius_mm
