"""How fast pictures are made, in processor time, so that other work on the machine does not count."""

import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from data_synth import load_synth_config
from data_synth.render import Renderer
from data_synth.settings import OutputSettings
from data_synth.world import build_world
from data_synth.write import VideoWriter

PAIRS_PER_SECOND = 10.0
CORES = 2
PAIRS = 8


@pytest.mark.slow
def test_ten_stereo_pairs_a_second_on_two_cores(tmp_path: Path) -> None:
    renderer = Renderer(build_world(load_synth_config("demo")))
    best = np.inf
    for attempt in range(3):
        writers = [
            VideoWriter(tmp_path / f"{side}{attempt}", OutputSettings(), renderer.size, Fraction(2)) for side in "rl"
        ]
        start = time.process_time()
        for frame in range(PAIRS):
            for side, writer in zip(("right", "left"), writers, strict=True):
                writer.add(renderer.render(side, np.array([frame]))[0].numpy())
        for writer in writers:
            writer.close()
        best = min(best, (time.process_time() - start) / PAIRS)
    # Measured: 0.10 to 0.12 s of processor time a pair.
    assert best < CORES / PAIRS_PER_SECOND
