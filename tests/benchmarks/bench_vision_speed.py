"""Time from a decoded uint8 picture to contour lines, beside OpenCV's full-frame chain in the same run.

    python tests/benchmarks/bench_vision_speed.py [--preset davinci_720] [--device cpu] [--batches 1 4 8 16]
        [--repeats 12]

The chain: colour conversion, 5x5 opening, Canny, probabilistic Hough transform, all at full size; it ends at segments.
`alone` is one call after the other; `side by side` is a batch on each core, as the pipeline detects. All are the least
of the repeats, interleaved, since a busy machine only ever adds; processor time also says what a busy machine hides.
"""

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from data_synth import load_synth_config, write_recording
from rmis_calib.io import load_recording
from rmis_calib.vision import ShaftDetector


def opencv_chain(image: np.ndarray) -> np.ndarray | None:
    """What is commonly done, on the whole picture."""
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    mask = cv2.inRange(hsv, (0, 0, 0), (180, 255, 90))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    edges = cv2.Canny(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 50, 150)
    return cv2.HoughLinesP(cv2.bitwise_and(edges, cv2.dilate(mask, np.ones((5, 5), np.uint8))), 1, np.pi / 360, 80)


def drawn_picture() -> np.ndarray:
    """1280x720, a dark bar over rough tissue, (H, W, 3) uint8."""
    rough = np.random.default_rng(0).normal(0.0, 25.0, (45, 80, 3)).astype(np.float32)
    picture = cv2.resize(rough, (1280, 720), interpolation=cv2.INTER_CUBIC) + np.array([170.0, 95.0, 80.0])
    cv2.line(picture, (1290, 120), (620, 430), (38.0, 36.0, 37.0), 74, cv2.LINE_AA)
    picture = cv2.GaussianBlur(picture, (0, 0), 1.2)
    return picture.clip(0, 255).astype(np.uint8)


def timed(action: Callable[[], object], device: torch.device) -> tuple[float, float]:
    """Wall and processor seconds of one call, with the device's queue drained."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    began, busy = time.perf_counter(), time.process_time()
    action()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - began, time.process_time() - busy


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--preset", default="davinci_720", help="of the pictures, which says their size: 1280x720")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 8, 16])
    parser.add_argument("--repeats", type=int, default=12)
    options = parser.parse_args()
    device, threads = torch.device(options.device), torch.get_num_threads()
    with tempfile.TemporaryDirectory() as folder:
        config = dataclasses.replace(load_synth_config(options.preset), motions=max(options.batches))
        recording = load_recording(write_recording(Path(folder) / "r", config))
        images = next(recording.right.batches(max(options.batches), device)).images
    picture = np.ascontiguousarray(images[0].permute(1, 2, 0).cpu().numpy())
    detector = ShaftDetector(camera=recording.stereo.right.to(device=device))
    print(f"{device}, {threads} torch threads, {cv2.getNumThreads()} OpenCV threads, {images.shape[2:]}")
    print("| batch | alone, ms a picture | side by side | processor ms | OpenCV chain, ms | processor ms | found |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    one_core = partial(torch.set_num_threads, 1)
    with ThreadPoolExecutor(threads, initializer=one_core) as executor:
        for batch in options.batches:
            part = images[:batch]

            def side_by_side(part: torch.Tensor = part) -> None:
                list(executor.map(detector.detect, [part] * (2 * threads)))

            found = detector.detect(part)
            alone, beside, theirs = [], [], []
            for _ in range(options.repeats):
                alone.append(timed(lambda part=part: detector.detect(part), device))
                beside.append(timed(side_by_side, device))
                theirs.append(timed(lambda: opencv_chain(picture), torch.device("cpu")))
            of_all = 2 * threads * batch
            numbers = [least(alone)[0] / batch, *(least(beside) / of_all), *least(theirs)]
            share = f"{int(found.valid.any(1).sum())}/{batch}"
            print(
                f"| {batch} | " + " | ".join(f"{1e3 * number:.1f}" for number in numbers) + f" | {share} |", flush=True
            )


def least(times: list[tuple[float, float]]) -> np.ndarray:
    """The least of the repeats, wall and processor seconds."""
    return np.array(times).min(0)


if __name__ == "__main__":
    main()
