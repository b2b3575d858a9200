"""Batches that are killed at random moments and resumed: do they end in the summary of one that was not?"""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from rmis_calib.batches.summary import TIMES


def run(root: Path, out: Path, *flags: str) -> tuple[float, int]:
    """Seconds and exit code of a batch."""
    command = [sys.executable, "-m", "rmis_calib", "batch", str(root), "--out", str(out), *flags]
    start = time.perf_counter()
    code = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False).returncode
    return time.perf_counter() - start, code


def without_times(out: Path) -> dict:
    raw = json.loads((out / "summary.json").read_text())
    for row in raw["recordings"]:
        for key in TIMES:
            row.pop(key, None)
    return raw


def kills(root: Path, work: Path, count: int, flags: list[str]) -> None:
    """Batches killed up to three times each at random moments (parent, worker or both), then resumed to the end."""
    whole, out = work / "few_whole", work / "killed"
    took_s, _ = run(root, whole, *flags)
    moments = random.Random(0)
    same = killed = 0
    for done in range(1, count + 1):
        shutil.rmtree(out, ignore_errors=True)
        starts = 1
        while starts <= 3 and killed_at(root, out, flags, moments.uniform(0.2, 0.7) * took_s, moments):
            starts += 1
        if starts > 3:
            run(root, out, *flags)
        killed += starts - 1
        same += without_times(out) == without_times(whole)
        print(f"  {same} of {done} so far, {starts} starts for the last", flush=True)
    print(
        f"{same} of {count} batches, killed {killed} times in all, ended in the summary of the one that was not killed"
    )


def killed_at(root: Path, out: Path, flags: list[str], after_s: float, moments: random.Random) -> bool:
    """Whether a batch that is killed after some seconds had not ended before."""
    command = [sys.executable, "-m", "rmis_calib", "batch", str(root), "--out", str(out), *flags]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        process.wait(after_s)
        return False
    except subprocess.TimeoutExpired:
        whom = moments.choice(["parent", "worker", "both"])
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        if whom in ("worker", "both") and children:
            kill(int(moments.choice(children)))
        if whom in ("parent", "both"):
            kill(process.pid)
        process.wait()
        return True


def kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
