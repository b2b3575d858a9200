"""Peak memory and speed of converting bags of growing size: memory must not grow with the bag.

Run: python tests/benchmarks/bench_convert_memory.py [--pictures 200 800] [--kinds ros1 mcap sqlite3]

Pictures of 1920x1080 (6.2 MB each, of noise, which no lossless coding shrinks), two eyes, joints at 100 Hz.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "convert"))
from bag_writing import BagWriter, to_ns

HEIGHT, WIDTH, RATE_HZ = 1080, 1920, 30.0


def write(path: Path, kind: str, pairs: int) -> None:
    generator = np.random.default_rng(0)
    noise = generator.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    with BagWriter(path, kind) as writer:
        for i in range(pairs):
            for k in range(3):
                ns = to_ns((i + k / 3) / RATE_HZ)
                writer.joints("/PSM1/measured_js", ns, [], np.array([0.1, 0.2, 0.1 + 1e-4 * i, 0.0, 0.0, 0.0]))
            for side in ("right", "left"):
                writer.image(f"/rig/{side}/image_raw", to_ns(i / RATE_HZ), np.roll(noise, i, axis=1), "bgr8")


def convert(bag: Path, out: Path, stereo: Path) -> tuple[float, float]:
    """Seconds, and peak memory of the process in GB."""
    command = [sys.executable, "-m", "rmis_calib", "convert", str(bag), "--out", str(out), "--robot", "dvrk-classic"]
    start = time.perf_counter()
    subprocess.run([*command, "--stereo", str(stereo)], check=True, capture_output=True)
    seconds = time.perf_counter() - start
    return seconds, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pictures", type=int, nargs="+", default=[40, 160])
    parser.add_argument("--kinds", nargs="+", default=["ros1", "mcap", "sqlite3"])
    arguments = parser.parse_args()
    camera = {"fx": 1100.0, "fy": 1100.0, "cx": 960.0, "cy": 540.0, "distortion": [0.0] * 5}
    extrinsics = np.eye(4)
    extrinsics[0, 3] = 5.0
    content = {"image_size": [WIDTH, HEIGHT], "right": camera, "left": camera}
    print(f"{'bag':<10}{'pairs':>7}{'GB':>8}{'s':>8}{'peak GB':>10}")
    for kind in arguments.kinds:
        for pairs in sorted(arguments.pictures):
            with tempfile.TemporaryDirectory() as folder:
                stereo = Path(folder, "stereo.yaml")
                stereo.write_text(yaml.safe_dump(content | {"camera_left_T_camera_right": extrinsics.tolist()}))
                bag = Path(folder, "a.bag" if kind == "ros1" else "a")
                write(bag, kind, pairs)
                size = sum(p.stat().st_size for p in ([bag] if bag.is_file() else bag.iterdir())) / 1e9
                seconds, peak = convert(bag, Path(folder, "out"), stereo)
                print(f"{kind:<10}{pairs:>7}{size:>8.2f}{seconds:>8.1f}{peak:>10.2f}", flush=True)


if __name__ == "__main__":
    main()
