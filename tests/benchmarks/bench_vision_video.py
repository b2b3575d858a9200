"""Whole stereo video to lines, beside decoding alone: frames a second, their ratio, and peak memory over the length.

    python tests/benchmarks/bench_vision_video.py [--frames 1000 10000] [--preset mild] [--every 1 4]
        [--search-every 8 1]

A rendered smooth stereo video is repeated packet by packet to the length asked for (so there is a cut every 240 pairs).
Each row is a process of its own; a frame is one picture, so a stereo pair counts twice. Decoding alone reads both
videos side by side, each in its own thread, to RGB tensors, as detection does. `--search-every 1` searches every frame
from the start, 8 every eighth or so (rmis_calib/pipeline/pictures/memory.py). Shares of decoding alone: of its pictures
a second, and of its processor time, which other programs on the machine do not change.
"""

import argparse
import csv
import dataclasses
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import av
import torch

from data_synth import load_synth_config, write_recording
from data_synth.settings import MotionSettings
from rmis_calib.config import CalibrationConfig
from rmis_calib.io import load_recording
from rmis_calib.pipeline import detect

PAIRS = 240


def repeat_video(path: Path, times: int) -> None:
    """The same packets again and again, each run later than the last."""
    longer = path.with_name(f"long_{path.name}")
    with av.open(str(path)) as source, av.open(str(longer), "w") as target:
        stream = source.streams.video[0]
        copy = target.add_stream_from_template(stream)
        packets = [packet for packet in source.demux(stream) if packet.size]
        contents = [(bytes(packet), packet.pts, packet.dts, packet.is_keyframe) for packet in packets]
        step = (max(pts for _, pts, _, _ in contents) // (len(contents) - 1)) * len(contents)
        for turn in range(times):
            for content, pts, dts, is_keyframe in contents:
                packet = av.Packet(content)
                packet.stream, packet.time_base, packet.is_keyframe = copy, stream.time_base, is_keyframe
                packet.pts, packet.dts = pts + turn * step, dts + turn * step
                target.mux(packet)
    longer.replace(path)


def make_recording(folder: Path, preset: str, pairs: int) -> Path:
    """A recording with `pairs` frames a camera; its joints cover the first of them, which detection does not mind."""
    config = dataclasses.replace(
        load_synth_config(preset), motions=PAIRS, motion=dataclasses.replace(MotionSettings(), kind="smooth")
    )
    path = write_recording(folder / f"{preset}_{pairs}", config)
    for side in ("right", "left"):
        repeat_video(path / f"{side}.mp4", -(-pairs // PAIRS))
    with (path / "frame_times.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["frame", "timestamp_s"])
        rows.writerows([n, f"{n / 30:.6f}"] for n in range(-(-pairs // PAIRS) * PAIRS))
    return path


def decode(path: Path) -> int:
    """Both videos to the last frame; how many pictures."""
    recording = load_recording(path)
    sources = [source for source in (recording.right, recording.left) if source is not None]

    def read(source: object) -> int:
        return sum(len(batch.indices) for batch in source.batches(8))  # pyright: ignore[reportAttributeAccessIssue]

    with ThreadPoolExecutor(len(sources)) as executor:
        return sum(executor.map(read, sources))


def run_one(task: str, path: Path) -> None:
    """One row's measurement, in this process."""
    began, cpu = time.perf_counter(), time.process_time()
    if task == "decode":
        count = decode(path)
    else:
        every, search_every = map(int, task.split("/"))
        table = detect(path, CalibrationConfig(every=every, search_every=search_every))
        count = sum(len(view.found) for view in table.views)
    spent, busy = time.perf_counter() - began, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{count},{spent},{busy},{peak}")


def measure(task: str, path: Path) -> list[float]:
    command = [sys.executable, __file__, "--task", task, "--path", str(path)]
    return [float(x) for x in subprocess.run(command, check=True, capture_output=True, text=True).stdout.split(",")]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, nargs="+", default=[1000, 10000], help="pictures, both cameras together")
    parser.add_argument("--preset", default="mild")
    parser.add_argument("--every", type=int, nargs="+", default=[1, 4], help="search every n-th frame")
    parser.add_argument("--search-every", type=int, nargs="+", default=[8, 1], help="from the start")
    parser.add_argument("--task", help="decode, or both numbers; for this script's own processes")
    parser.add_argument("--path", type=Path)
    options = parser.parse_args()
    if options.task:
        run_one(options.task, options.path)
        return
    print(f"{options.preset}, {torch.get_num_threads()} threads, torch {torch.__version__}")
    names = (
        "pictures",
        "task",
        "pictures / s",
        "of decoding",
        "processor ms a picture",
        "of decoding",
        "peak memory, MB",
    )
    print("| " + " | ".join(names) + " |\n|" + " --- |" * len(names))
    with tempfile.TemporaryDirectory() as folder:
        for frames in options.frames:
            path = make_recording(Path(folder), options.preset, frames // 2)
            alone = alone_busy = 0.0
            for task in ("decode", *(f"{n}/{m}" for n in options.every for m in options.search_every)):
                count, spent, busy, peak = measure(task, path)
                alone, alone_busy = alone or spent, alone_busy or busy
                every, _, search_every = task.partition("/")
                name = "decoding alone" if task == "decode" else f"lines, every {every}, searched every {search_every}"
                share, share_busy = (f"{100 * a / b:.0f} %" for a, b in ((alone, spent), (alone_busy, busy)))
                cells = (f"{count:.0f}", name, f"{count / spent:.0f}", share, f"{1e3 * busy / count:.2f}", share_busy)
                print("| " + " | ".join(cells) + f" | {peak:.0f} |", flush=True)


if __name__ == "__main__":
    main()
