"""Time and memory that a long joint log takes.

    python tests/benchmarks/bench_joint_log.py [--rows 3000000]

Writes a log of two arms at 1 kHz to a temporary folder, reads it, and interpolates it at 10,000 frame times.
"""

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

from rmis_calib.io.joints import load_joints
from rmis_calib.io.robot import load_robot

ARMS = ("laparoscope", "instrument")
BLOCK = 100_000


def write_log(path: Path, columns: tuple[str, ...], rows: int) -> None:
    """Slow sines of every joint; in blocks, so that writing does not count as the peak."""
    with path.open("w") as file:
        file.write(",".join(("timestamp_s", *columns)) + "\n")
        for start in range(0, rows, BLOCK):
            t = np.arange(start, min(start + BLOCK, rows)) / 1000.0
            values = [0.1 * np.sin(t / (2 + i)) + (100.0 if c.endswith("_mm") else 0.0) for i, c in enumerate(columns)]
            np.savetxt(file, np.stack([t, *values], axis=1), fmt="%.9f", delimiter=",")


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", type=int, default=3_000_000)
    rows = parser.parse_args().rows
    robot = load_robot("rcm-3x3")
    columns = tuple(column for arm in ARMS for column in robot.columns(arm))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "joints.csv"
        write_log(path, columns, rows)
        before, start = peak_mb(), time.perf_counter()
        log = load_joints(path, robot, ARMS)
        read_s = time.perf_counter() - start
        log.at(np.linspace(0.0, rows / 1000.0, 10_000))
        size = path.stat().st_size / 2**20
    print("| rows | file, MB | read, s | peak memory, MB (before: MB) |\n| --- | --- | --- | --- |")
    print(f"| {rows} | {size:.0f} | {read_s:.1f} | {peak_mb():.0f} ({before:.0f}) |")


if __name__ == "__main__":
    main()
