"""How long `rc.check` takes: python tests/benchmarks/bench_check.py

Rendered stereo recordings, and the real ones beside the checkout. Seconds of wall time of a process of its own, imports
included, as at the command line.
"""

import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import data_synth

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def seconds(folder: Path) -> float:
    start = time.perf_counter()
    command = [sys.executable, "-m", "rmis_calib", "check", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    return time.perf_counter() - start


def main() -> None:
    with tempfile.TemporaryDirectory() as temporary:
        for preset, motions in (("demo", 60), ("davinci_720", 60)):
            config = replace(data_synth.load_synth_config(preset), motions=motions)
            folder = data_synth.write_recording(Path(temporary) / preset, config)
            print(f"{preset:24} {motions:4} frames  {seconds(folder):.1f} s")
    for path in sorted(SHARED.glob("*/recording.yaml")):
        print(f"{path.parent.name:24} {'':12} {seconds(path.parent):.1f} s")


if __name__ == "__main__":
    main()
