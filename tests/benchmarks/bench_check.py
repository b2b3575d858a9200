"""How long `rc.check` takes: python tests/benchmarks/bench_check.py [--presets demo davinci_720] [--no-real]

Rendered stereo recordings, and the real ones beside the checkout. Seconds of wall time and of processor time of a
process of its own, imports included, as at the command line. On a machine that does other work the wall time is that of
the other work.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import data_synth

MOTIONS = 60
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def seconds(folder: Path) -> str:
    """Wall and processor time in words."""
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "rmis_calib", "check", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done.stderr
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return f"wall {time.perf_counter() - start:5.1f} s, CPU {cpu:5.1f} s"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split(":")[0])
    parser.add_argument("--presets", nargs="+", default=["demo", "davinci_720"])
    parser.add_argument("--no-real", action="store_true", help="leave the real recordings out")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        for preset in arguments.presets:
            config = replace(data_synth.load_synth_config(preset), motions=MOTIONS)
            folder = data_synth.write_recording(Path(temporary) / preset, config)
            print(f"{preset:24} {MOTIONS:4} frames  {seconds(folder)}")
    for path in [] if arguments.no_real else sorted(SHARED.glob("*/recording.yaml")):
        print(f"{path.parent.name:24} {'':12} {seconds(path.parent)}")


if __name__ == "__main__":
    main()
