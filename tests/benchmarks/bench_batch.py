"""A batch of 50 recordings that end in every way: outcomes, speed, memory, kills; and the page of 1,000 recordings.

    python tests/benchmarks/bench_batch.py [--kills 20] [--only-kills] [--small] [--keep FOLDER]

Prints one line a measurement. Each part makes its own outputs; nothing is read but what is rendered here.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np

import data_synth
from tests.benchmarks.batch_kills import kills, run
from tests.benchmarks.batch_page import page_of_many
from tests.benchmarks.batch_zoo import check_outcomes, render, zoo
from tests.benchmarks.bench_device_batch import small_scene


def overhead(out: Path) -> None:
    """Time of a recording beyond its own stages, but for the first of each worker, which loads the libraries."""
    beyond = []
    for path in sorted(out.glob("good/*/job.json"), key=lambda path: path.stat().st_mtime)[2:]:
        record = json.loads(path.read_text())
        seconds = dict(record["stages"])
        detecting = max(value for key, value in seconds.items() if key.startswith("detecting"))
        own = detecting + sum(value for key, value in seconds.items() if not key.startswith("detecting"))
        beyond.append(record["seconds"] - own)
    print(f"beyond its own stages, a recording: median {np.median(beyond):.2f} s, largest {max(beyond):.2f} s")


def throughput(bases: dict[str, Path], work: Path) -> None:
    root = work / "speed"
    for i in range(12):
        shutil.copytree(bases["good"], root / f"case_{i:02d}")
    took = {}
    for workers in (1, 2):
        out = work / f"speed_{workers}"
        took[workers], code = run(root, out, "--workers", str(workers))
        assert code == 0, code
    one_thread = work / "one_thread"
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "rmis_calib", "calibrate", str(root / "case_00"), "--out", str(one_thread)]
    start = time.perf_counter()
    subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
    single = time.perf_counter() - start
    print(
        f"12 recordings: 1 worker (all cores) {took[1]:.1f} s, 2 workers {took[2]:.1f} s, {took[1] / took[2]:.2f} x "
        f"as fast; `calibrate` of one {single:.1f} s"
    )


def few(work: Path, small: bool) -> Path:
    """A tree of three recordings that end well and one that fails; `small`: of 6 motions, 320 px wide, to detect in."""
    root = work / "few"
    for i in range(3):
        config = small_scene(320, 6, i) if small else data_synth.load_synth_config({"motions": 24, "seed": i})
        data_synth.write_recording(root / f"case_{i}", config)
    (root / "cut").mkdir()
    shutil.copy(root / "case_0" / "recording.yaml", root / "cut")
    return root


def whole_zoo(work: Path) -> None:
    """Speed, then 50 recordings of every outcome, and the page of 1,000."""
    bases = render(work / "bases")
    throughput(bases, work)
    expected = zoo(work / "zoo", bases)
    took, code = run(work / "zoo", work / "out", "--workers", "2", "--memory-gb", "2.5")
    print(f"50 recordings, 2 workers: {took:.0f} s, exit code {code}")
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(f"peak memory of a process: {peak:.2f} GB")
    check_outcomes(work / "out", expected)
    overhead(work / "out")
    page_of_many(work / "out", work)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--only-kills", action="store_true", help="nothing but the killed batches of four recordings")
    parser.add_argument("--small", action="store_true", help="kill batches of tiny recordings, with `--task detect`")
    parser.add_argument("--keep", type=Path)
    arguments = parser.parse_args()
    work = arguments.keep or Path(tempfile.mkdtemp(prefix="bench_batch_"))
    work.mkdir(parents=True, exist_ok=True)
    if not arguments.only_kills:
        whole_zoo(work)
    flags = ["--workers", "2"] + (["--task", "detect"] if arguments.small else [])
    kills(few(work, arguments.small), work, arguments.kills, flags)
    if arguments.keep is None:
        shutil.rmtree(work)


if __name__ == "__main__":
    main()
