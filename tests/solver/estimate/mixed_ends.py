"""Shafts whose ends are measured at several places of them, simulated: the same scene and noise with wrists of other
lengths, from which each end is taken at random."""

from typing import Any

import numpy as np

from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig, SceneSettings

RING_MM, GAP_MM = 20.0, 9.0
"""Where the tube stops before the head point, and how far beyond that the metal's tip lies."""
ANYWHERE_MM = np.linspace(1.0, 39.0, 16)
"""Lengths of wrist at which what lies over the shaft ends it."""


def with_ends(tip: float, anywhere: float, seed: int = 0, together: bool = False, **fields: Any) -> dict[str, Any]:
    """Observations in the keys of an observations file, with `truth`, and `is_tip_right`, `is_tip_left` (trials, N).

    Args:
        tip: share of the ends that are the metal's tip, by chance.
        anywhere: share of the ends that are nowhere in particular.
        seed: of the noise, and of which end is which.
        together: whether both cameras take the same end of a motion.
        fields: of `LineStudyConfig`.
    """

    def scene(wrist_mm: float) -> dict[str, Any]:
        return simulate_lines(LineStudyConfig(scene=SceneSettings(wrist_length_mm=wrist_mm), seed=seed, **fields))

    arrays, generator = scene(RING_MM), np.random.default_rng(1000 + seed)
    shape = arrays["valid_right"].shape
    draw = generator.random(shape)
    for side in ("right", "left"):
        draw = draw if together else generator.random(shape)
        is_tip = draw < tip
        arrays[f"is_tip_{side}"] = is_tip
        end = arrays[f"end_{side}"]
        end[is_tip] = scene(RING_MM - GAP_MM)[f"end_{side}"][is_tip]
        which = generator.integers(len(ANYWHERE_MM), size=shape)
        for index, wrist_mm in enumerate(ANYWHERE_MM if anywhere else ()):
            here = (draw >= tip) & (draw < tip + anywhere) & (which == index)
            end[here] = scene(float(wrist_mm))[f"end_{side}"][here]
    return arrays
