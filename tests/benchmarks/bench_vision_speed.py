"""Time from a decoded uint8 picture to contour lines at 1280x720, beside OpenCV's full-frame chain in the same run.

    python tests/benchmarks/bench_vision_speed.py [--device cpu] [--batches 1 4 8] [--repeats 12]

The chain: colour conversion, 5x5 opening, Canny, probabilistic Hough transform, all at full size; it ends at segments.
Both take the median over the repeats, interleaved, so that a busy machine slows both alike.
"""

import argparse
import dataclasses
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from bench_vision_render import read_recording

from data_synth import load_synth_config, write_recording
from rmis_calib.vision import ShaftDetector


def opencv_chain(image: np.ndarray) -> np.ndarray | None:
    """What is commonly done, on the whole picture."""
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    mask = cv2.inRange(hsv, (0, 0, 0), (180, 255, 90))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    edges = cv2.Canny(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 50, 150)
    return cv2.HoughLinesP(cv2.bitwise_and(edges, cv2.dilate(mask, np.ones((5, 5), np.uint8))), 1, np.pi / 360, 80)


def timed(action: object, device: torch.device) -> float:
    """Seconds of one call, with the device's queue drained."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    began = time.perf_counter()
    action()  # pyright: ignore[reportCallIssue]
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 8])
    parser.add_argument("--repeats", type=int, default=12)
    options = parser.parse_args()
    device = torch.device(options.device)
    with tempfile.TemporaryDirectory() as folder:
        config = dataclasses.replace(load_synth_config("davinci_720"), motions=max(options.batches))
        pictures, camera, _ = read_recording(write_recording(Path(folder) / "r", config))
    images = torch.from_numpy(pictures).to(device).permute(0, 3, 1, 2)  # channels last in memory, as decoded
    detector = ShaftDetector(camera=camera.to(device=device))
    print(
        f"{device}, {torch.get_num_threads()} torch threads, {cv2.getNumThreads()} OpenCV threads, {images.shape[2:]}"
    )
    print("| batch | ours, ms a picture | OpenCV chain, ms a picture | found |")
    print("| --- | --- | --- | --- |")
    for batch in options.batches:
        part = images[:batch]
        found = detector.detect(part)
        ours, theirs = [], []
        for _ in range(options.repeats):
            ours.append(timed(lambda part=part: detector.detect(part), device) / batch)
            theirs.append(timed(lambda: opencv_chain(pictures[0]), torch.device("cpu")))
        share = f"{int(found.valid.any(1).sum())}/{batch}"
        print(f"| {batch} | {1e3 * np.median(ours):.1f} | {1e3 * np.median(theirs):.1f} | {share} |", flush=True)


if __name__ == "__main__":
    main()
