"""Peak memory and speed of converting bags of growing size: memory must not grow with the bag.

Run: python tests/benchmarks/bench_convert_memory.py [--pairs 40 160] [--kinds ros1 mcap sqlite3]
As large as a long procedure: python tests/benchmarks/bench_convert_memory.py --gigabytes 20

Stereo pictures of 1920x1080 (6.2 MB each), joints at 100 Hz. By default pictures are noise, which no lossless coding
shrinks. With --gigabytes they are black, so that the bag takes its size in the file system (every byte of it is read)
but little of the disk: runs of zeros become holes as it is written, and the recording's PNG files are small.
"""

import argparse
import ctypes
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "convert"))
from bag_writing import BagWriter, to_ns

HEIGHT, WIDTH, RATE_HZ = 1080, 1920, 30.0
PAIR_GB = 2 * 3 * HEIGHT * WIDTH / 1e9
_PUNCH_HOLE = 0x02 | 0x01  # and keep the size
_BLOCK = 4096
# Not getrusage: a child's peak there begins with its parent's.
_CONVERT = """
import sys
from rmis_calib.cli import main
status = main(sys.argv[1:])
print(open("/proc/self/status").read())
sys.exit(status)
"""


@contextmanager
def large_pages(kind: str) -> Iterator[None]:
    """SQLite's pages of 64 kB instead of 4 kB, whose pointers would leave no room for holes."""
    import sqlite3

    whole = sqlite3.connect

    def connect(*args: object, **more: object) -> sqlite3.Connection:
        connection = whole(*args, **more)  # pyright: ignore[reportArgumentType, reportCallIssue]
        connection.execute("PRAGMA page_size = 65536")
        return connection

    if kind == "sqlite3":
        sqlite3.connect = connect  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        sqlite3.connect = whole


def write(path: Path, kind: str, pairs: int, is_black: bool) -> None:
    generator = np.random.default_rng(0)
    shape = (HEIGHT, WIDTH, 3)
    picture = np.zeros(shape, np.uint8) if is_black else generator.integers(0, 256, shape, dtype=np.uint8)
    done = 0
    with large_pages(kind if is_black else ""), BagWriter(path, kind) as writer:
        for i in range(pairs):
            for k in range(3):
                ns = to_ns((i + k / 3) / RATE_HZ)
                writer.joints("/PSM1/measured_js", ns, [], np.array([0.1, 0.2, 0.1 + 1e-4 * i, 0.0, 0.0, 0.0]))
            for side in ("right", "left"):
                writer.image(f"/rig/{side}/image_raw", to_ns(i / RATE_HZ), np.roll(picture, i, axis=1), "bgr8")
            if is_black and i % 50 == 49:
                done = dig_holes(path, done)
    if is_black:
        dig_holes(path, 0)


def dig_holes(path: Path, start: int) -> int:
    """Give the blocks of zeros of a file from `start` on back to the disk; returns how far it got."""
    fallocate = ctypes.CDLL(None, use_errno=True).fallocate
    file = path if path.is_file() else max(path.iterdir(), key=lambda each: each.stat().st_size)
    step = 64 << 20
    with file.open("r+b") as opened:
        size = opened.seek(0, os.SEEK_END)
        for place in range(start, size - step, step):
            opened.seek(place)
            blocks = np.frombuffer(opened.read(step), np.uint64).reshape(-1, _BLOCK // 8)
            edges = np.flatnonzero(np.diff(np.concatenate([[0], ~blocks.any(1), [0]]).astype(np.int8)))
            for first, last in edges.reshape(-1, 2).tolist():
                at, length = place + first * _BLOCK, (last - first) * _BLOCK
                if fallocate(opened.fileno(), _PUNCH_HOLE, ctypes.c_long(at), ctypes.c_long(length)) != 0:
                    raise OSError(ctypes.get_errno(), "this file system has no holes: run it with --pairs")
    return max(start, size // step * step - step)


def convert(bag: Path, out: Path, stereo: Path) -> tuple[float, float]:
    """Seconds, and peak memory of the process in GB."""
    command = ["convert", str(bag), "--out", str(out), "--robot", "dvrk-classic", "--stereo", str(stereo)]
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", _CONVERT, *command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    kilobytes = next(line.split()[1] for line in done.stdout.splitlines() if line.startswith("VmHWM"))
    return time.perf_counter() - start, float(kilobytes) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, nargs="+", default=[40, 160])
    parser.add_argument("--gigabytes", type=float, help="one bag of black pictures of this size, with holes")
    parser.add_argument("--kinds", nargs="+", default=["ros1", "mcap", "sqlite3"])
    arguments = parser.parse_args()
    is_black = arguments.gigabytes is not None
    counts = [round(arguments.gigabytes / PAIR_GB)] if is_black else sorted(arguments.pairs)
    camera = {"fx": 1100.0, "fy": 1100.0, "cx": 960.0, "cy": 540.0, "distortion": [0.0] * 5}
    extrinsics = np.eye(4)
    extrinsics[0, 3] = 5.0
    content = {"image_size": [WIDTH, HEIGHT], "right": camera, "left": camera}
    print(f"{'bag':<10}{'pairs':>7}{'GB':>8}{'on disk':>9}{'s':>8}{'peak GB':>10}")
    for kind in arguments.kinds:
        for pairs in counts:
            with tempfile.TemporaryDirectory() as folder:
                stereo = Path(folder, "stereo.yaml")
                stereo.write_text(yaml.safe_dump(content | {"camera_left_T_camera_right": extrinsics.tolist()}))
                bag = Path(folder, "a.bag" if kind == "ros1" else "a")
                write(bag, kind, pairs, is_black)
                files = [p.stat() for p in ([bag] if bag.is_file() else bag.iterdir())]
                size, disk = sum(f.st_size for f in files) / 1e9, sum(512 * f.st_blocks for f in files) / 1e9
                seconds, peak = convert(bag, Path(folder, "out"), stereo)
                print(f"{kind:<10}{pairs:>7}{size:>8.2f}{disk:>9.2f}{seconds:>8.1f}{peak:>10.2f}", flush=True)


if __name__ == "__main__":
    main()
