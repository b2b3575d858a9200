"""How fast recordings are rendered: stereo pairs a second on two cores, from processor time, H.264 included.

Run: python tests/benchmarks/bench_synth_speed.py
"""

import tempfile
import time
from fractions import Fraction
from pathlib import Path

import numpy as np

from data_synth import load_synth_config
from data_synth.render import Renderer
from data_synth.settings import OutputSettings
from data_synth.world import build_world
from data_synth.write import VideoWriter

CORES, PAIRS, REPEATS = 2, 8, 3
PRESETS = ("demo", "mild", "smoke", "two_instruments", "davinci_720", "hard", "brutal")


def pairs_per_second(preset: str, folder: Path) -> float:
    """Best of the repeats."""
    renderer = Renderer(build_world(load_synth_config(preset)))
    best = np.inf
    for attempt in range(REPEATS):
        writers = [
            VideoWriter(folder / f"{preset}{side}{attempt}", OutputSettings(), renderer.size, Fraction(2))
            for side in "rl"
        ]
        start = time.process_time()
        for frame in range(PAIRS):
            for side, writer in zip(("right", "left"), writers, strict=True):
                writer.add(renderer.render(side, np.array([frame]))[0].numpy())
        for writer in writers:
            writer.close()
        best = min(best, (time.process_time() - start) / PAIRS)
    return CORES / best


def main() -> None:
    print("| preset | stereo pairs / s |\n| --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for preset in PRESETS:
            print(f"| {preset} | {pairs_per_second(preset, Path(folder)):.1f} |", flush=True)


if __name__ == "__main__":
    main()
