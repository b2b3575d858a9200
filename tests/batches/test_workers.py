"""Processes that may die: what they take with them, and what not."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rmis_calib.parallel.processes import Limits, cores, run_tasks
from tests.batches import toy_tasks

LIMITS = Limits(threads=1, memory_bytes=None, timeout_s=None, retries=2)


def ends(events) -> dict[int, tuple[str, object]]:
    return {event.index: (event.kind, event.value) for event in events if event.kind in ("finished", "died")}


def test_every_task_is_done_once_and_tells_its_progress() -> None:
    events = list(run_tasks(range(5), toy_tasks.square, 2, LIMITS))
    assert ends(events) == {i: ("finished", i**2) for i in range(5)}
    assert sorted(e.index for e in events if e.kind == "started") == list(range(5))
    assert {e.value for e in events if e.kind == "progress"} == {("working", 0, 1), ("working", 1, 1)}
    assert {e.worker for e in events} <= {0, 1}


def test_a_task_that_kills_its_process_is_tried_again_and_then_given_up(tmp_path: Path) -> None:
    tasks = [("live", ""), ("die", str(tmp_path / "always")), ("once", str(tmp_path / "once")), ("live", "")]
    events = list(run_tasks(tasks, toy_tasks.die_if_told, 2, LIMITS))
    done = ends(events)
    assert done[0] == done[3] == ("finished", "live")
    assert done[2] == ("finished", "once")
    assert done[1][0] == "died"
    assert "SIGKILL" in str(done[1][1])
    assert (tmp_path / "always").read_text() == "xxx"  # once, and two retries
    assert (tmp_path / "once").read_text() == "xx"


def test_a_task_that_takes_too_long_is_stopped_and_not_tried_again() -> None:
    limits = Limits(threads=1, memory_bytes=None, timeout_s=2.0, retries=2)
    start = time.monotonic()
    done = ends(run_tasks([60.0, 0.0], toy_tasks.sleep, 2, limits))
    assert time.monotonic() - start < 30.0
    assert done[0][0] == "died"
    assert "was stopped" in str(done[0][1])
    assert done[1][0] == "finished"


def test_memory_and_threads_are_bounded() -> None:
    if not sys.platform.startswith("linux"):
        pytest.skip("memory is bounded on Linux only")
    limits = Limits(threads=1, memory_bytes=3 * 2**30, timeout_s=None, retries=0)
    done = ends(run_tasks([2**20, 4 * 2**30], toy_tasks.allocate, 1, limits))
    assert done == {0: ("finished", 2**20), 1: ("finished", "memory error")}
    assert ends(run_tasks([None], toy_tasks.threads, 1, LIMITS)) == {0: ("finished", 1)}


def test_stop_gives_out_no_more_tasks() -> None:
    seen: list[int] = []
    for event in run_tasks(range(100), toy_tasks.square, 1, LIMITS, stop=lambda: len(seen) >= 3):
        if event.kind == "finished":
            seen.append(event.index)
    assert 3 <= len(seen) <= 4


def test_workers_end_with_their_parent() -> None:
    """Killed so that it can say nothing to anyone, the parent must leave no process behind that goes on writing."""
    code = (
        "from tests.batches import toy_tasks\n"
        "from rmis_calib.parallel.processes import Limits, run_tasks\n"
        "if __name__ == '__main__':\n"
        "    for event in run_tasks([600.0], toy_tasks.sleep, 1, Limits(1, None, None, 0)):\n"
        "        print(event.kind, flush=True)\n"
    )
    root = Path(__file__).resolve().parents[2]
    with subprocess.Popen([sys.executable, "-c", code], cwd=root, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        while parent.stdout.readline().strip() != "progress":
            assert parent.poll() is None
        children = [int(pid) for pid in Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()]
        parent.send_signal(signal.SIGKILL)
    assert children
    deadline = time.monotonic() + 20.0
    while any(os.path.exists(f"/proc/{pid}") and not is_zombie(pid) for pid in children):
        assert time.monotonic() < deadline, "a worker outlives its parent"
        time.sleep(0.1)


def is_zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def test_cores_are_those_of_this_process() -> None:
    assert 1 <= cores() <= (os.cpu_count() or 1)
