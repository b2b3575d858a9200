"""The colour stage with kornia's colour spaces, filters and morphology in the place of what it has: one row each.

    python tests/benchmarks/bench_vision_colour.py [--frames N]

Everything else of the detector stays as it is. Each colour space gives its two opponent colours over brightness, times
one constant, so that the mean tint of the real frames is that of the first row: the detector's thresholds then mean the
same. Shafts found and false detections are those of bench_vision_real_frames.py on the labelled real frames and of
bench_vision_render.py on two presets; the time is that of the colour stage alone, for a picture of 1280x720, one
thread, median. The network that rates strips, and the thresholds, were fitted with the first row.
"""

import argparse
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
from bench_vision_real_frames import COUNTS, DATA, pictures, read_labels, score
from bench_vision_render import run_preset
from bench_vision_speed import drawn_picture
from kornia.color import rgb_to_lab, rgb_to_luv, rgb_to_ycbcr, rgb_to_yuv
from kornia.filters import bilateral_blur, median_blur
from kornia.morphology import closing, opening
from torch import Tensor

from data_synth import load_synth_config
from rmis_calib.vision import DetectorSettings, ShaftDetector
from rmis_calib.vision.coarse import appearance
from rmis_calib.vision.image.canvas import shrink

PRESETS = ("mild", "hard")
SMALL_WIDTH = DetectorSettings().small_width_px
REPEATS = 30
FLOOR = 0.06
"""Brightness below which ratios drown in noise, as in the stage itself."""
Colours = Callable[[Tensor], tuple[Tensor, Tensor]]
Smoothing = Callable[[Tensor], Tensor]


def ycbcr(rgb: Tensor) -> tuple[Tensor, Tensor]:
    _, cb, cr = rgb_to_ycbcr(rgb).unbind(1)
    return _over_brightness(cr - 0.5, 0.5 - cb, rgb.amax(1))


def yuv(rgb: Tensor) -> tuple[Tensor, Tensor]:
    _, u, v = rgb_to_yuv(rgb).unbind(1)
    return _over_brightness(v, -u, rgb.amax(1))


def lab(rgb: Tensor) -> tuple[Tensor, Tensor]:
    lightness, a, b = rgb_to_lab(rgb).unbind(1)
    return _over_brightness(a / 100, b / 100, lightness / 100)


def luv(rgb: Tensor) -> tuple[Tensor, Tensor]:
    lightness, u, v = rgb_to_luv(rgb).unbind(1)
    return _over_brightness(u / 100, v / 100, lightness / 100)


def _over_brightness(warm: Tensor, yellow: Tensor, brightness: Tensor) -> tuple[Tensor, Tensor]:
    return warm / (brightness + FLOOR), yellow / (brightness + FLOOR)


GAUSSIAN, OPPONENTS = appearance.smooth, appearance.opponent_colours


def median(picture: Tensor) -> Tensor:
    return GAUSSIAN(median_blur(picture[:, None], 3)[:, 0])


def bilateral(picture: Tensor) -> Tensor:
    return bilateral_blur(picture[:, None], 5, 0.1, (1.4, 1.4), border_type="replicate")[:, 0]


def opened(picture: Tensor) -> Tensor:
    """Specks of glare, then of dark, smaller than 3 px, taken out before the blur."""
    kernel = picture.new_ones(3, 3)
    return GAUSSIAN(closing(opening(picture[:, None], kernel), kernel)[:, 0])


@dataclass(frozen=True)
class Variant:
    """A row of the table."""

    name: str
    colours: Colours = OPPONENTS
    smoothing: Smoothing = GAUSSIAN


VARIANTS = (
    Variant("red-green, yellow-blue; kornia's Gaussian (the detector's)"),
    Variant("kornia YCbCr", ycbcr),
    Variant("kornia YUV", yuv),
    Variant("kornia Lab", lab),
    Variant("kornia Luv", luv),
    Variant("kornia median 3x3 before the Gaussian", smoothing=median),
    Variant("kornia bilateral in place of the Gaussian", smoothing=bilateral),
    Variant("kornia opening and closing 3x3 before the Gaussian", smoothing=opened),
)


@contextmanager
def in_place(variant: Variant, scale: float) -> Iterator[None]:
    """The detector with a variant's colour stage."""

    def scaled(rgb: Tensor) -> tuple[Tensor, Tensor]:
        warm, yellow = variant.colours(rgb)
        return scale * warm, scale * yellow

    appearance.opponent_colours = variant.colours if scale == 1.0 else scaled
    appearance.smooth = variant.smoothing
    try:
        yield
    finally:
        appearance.opponent_colours, appearance.smooth = OPPONENTS, GAUSSIAN


def small(image: np.ndarray) -> Tensor:
    picture = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None]
    return shrink(picture, max(1, round(image.shape[1] / SMALL_WIDTH)))


def mean_tint(images: list[np.ndarray]) -> float:
    """Mean tint of the pictures under the colour stage as it is now."""
    tints = []
    for image in images:
        rgb = small(image)
        tints.append(float(appearance.scene_tint(rgb, torch.ones_like(rgb[:, 0], dtype=torch.bool)).mean()))
    return float(np.mean(tints))


def stage_ms() -> float:
    """Of both views of one picture; processor time."""
    rgb = small(drawn_picture())
    seen, times = torch.ones_like(rgb[:, 0], dtype=torch.bool), []
    for _ in range(REPEATS):
        began = time.process_time()
        appearance.shaft_contrast(rgb, seen)
        times.append(time.process_time() - began)
    return 1e3 * float(np.median(times))


def on_real_frames(images: dict[tuple[str, str], np.ndarray]) -> str:
    labels, detector = read_labels(), ShaftDetector()
    row: dict = defaultdict(list, dict.fromkeys(COUNTS, 0))
    for key, image in images.items():
        found = detector.detect(torch.from_numpy(image).permute(2, 0, 1)[None])
        score(key, found, labels.get(key, []), row, image.shape[1])
    return f"{row['shaft found']} of {row['shaft']} | {row['false']} | {row['sure false']}"


def on_preset(name: str, frames: int, folder: Path) -> str:
    tally = run_preset(replace(load_synth_config(name), motions=frames), folder / name, with_peers=False)["ours"]
    return f"{100 * tally.found:.0f} % | {tally.stray / tally.frames:.2f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=16)
    options = parser.parse_args()
    if not DATA.is_dir():
        raise SystemExit("real frames are absent (../shared/data beside the checkout)")
    torch.set_num_threads(1)
    images = pictures()
    usual = mean_tint(list(images.values()))
    presets = " | ".join(f"{name}: found | stray a picture" for name in PRESETS)
    print(f"| colour stage | ms | real shafts found | false | sure false | {presets} |")
    print("|" + " --- |" * (5 + 2 * len(PRESETS)))
    with tempfile.TemporaryDirectory() as folder:
        for variant in VARIANTS:
            scale = 1.0
            if variant.colours is not OPPONENTS:
                with in_place(variant, 1.0):
                    scale = usual / mean_tint(list(images.values()))
            with in_place(variant, scale):
                ms = stage_ms()
                rendered = " | ".join(on_preset(name, options.frames, Path(folder)) for name in PRESETS)
                print(f"| {variant.name} | {ms:.1f} | {on_real_frames(images)} | {rendered} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
