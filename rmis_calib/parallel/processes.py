"""Tasks on processes of this machine, each of which may die without the others: no lock and no queue is shared.

A process has one pipe to its parent, and works on one task at a time. It is started afresh (never forked), so that
libraries with threads of their own are safe, and it ends when its parent does, however that dies.
"""

import contextlib
import math
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

Report = Callable[[str, int, int], None]
"""(stage, done, total)."""
_REPORT_EVERY_S = 0.2
_WAIT_S = 0.5
_STARTING = threading.Lock()
"""One process at a time is started: each takes its number of threads from this one's environment."""
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Limits:
    """What a process may take.

    Attributes:
        threads: of each library that has threads.
        memory_bytes: of data; None: no limit.
        timeout_s: a task's; None: no limit.
        retries: of a task whose process died.
    """

    threads: int
    memory_bytes: int | None
    timeout_s: float | None
    retries: int


@dataclass(frozen=True)
class Event:
    """What happened to a task.

    Attributes:
        index: of the task.
        kind: `started`, `progress`, `finished`, or `died`: given up after the last attempt.
        value: (stage, done, total) of `progress`, what the function returned of `finished`, why of `died`.
        attempt: counted from 1.
        worker: number of the process.
    """

    index: int
    kind: str
    value: Any
    attempt: int
    worker: int


class _Worker:
    """A process with the task that it works on."""

    def __init__(self, number: int, function: Callable[[Any, Report], Any], limits: Limits) -> None:
        self.number, self._limits = number, limits
        self.connection, theirs = multiprocessing.Pipe()
        context = multiprocessing.get_context("spawn")
        arguments = (theirs, function, limits)
        self._process = context.Process(target=_work, args=arguments, name=f"rmis-calib-{number}", daemon=True)
        with environment_of_threads(limits.threads):
            self._process.start()
        theirs.close()
        self.task: int | None = None
        self.attempt = 0
        self.since_s = 0.0
        self.stopped_for: str | None = None

    def give(self, index: int, task: Any, attempt: int) -> None:
        self.task, self.attempt, self.since_s = index, attempt, math.inf
        self.connection.send((task,))

    def stop_if_late(self) -> None:
        limit_s = self._limits.timeout_s
        if self.task is not None and limit_s is not None and time.monotonic() - self.since_s > limit_s:
            self.stopped_for = f"it was stopped after {limit_s / 60:g} min"
            self._process.kill()

    def why_it_died(self) -> str:
        self._process.join(5.0)
        return self.stopped_for or _about_exit(self._process.exitcode)

    def end(self) -> None:
        """Let it finish what it does, or kill it where it does something."""
        if self.task is not None:
            self._process.kill()
        with contextlib.suppress(OSError):
            self.connection.send(None)
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self.connection.close()


def run_tasks(
    tasks: Sequence[Any],
    function: Callable[[Any, Report], Any],
    workers: int,
    limits: Limits,
    stop: Callable[[], bool] = lambda: False,
) -> Generator[Event, None, None]:
    """Work through tasks in processes; events as they come, in any order of the tasks.

    A task whose process dies goes to the end of the line, until its retries are used up. Closing the iterator kills
    what is at work.

    Args:
        tasks: can be pickled.
        function: `function(task, report)`; must not raise, and can be pickled.
        workers: processes.
        limits: of each.
        stop: asked before each task is given out; True lets those at work finish, and gives out no more.
    """
    line = deque((index, 1) for index in range(len(tasks)))
    running: dict[Connection, _Worker] = {}
    try:
        while line or any(worker.task is not None for worker in running.values()):
            if stop():
                line.clear()
            idle = [worker for worker in running.values() if worker.task is None]
            while line and (idle or len(running) < workers):
                index, attempt = line.popleft()
                worker = idle.pop() if idle else _Worker(_free_number(running), function, limits)
                running[worker.connection] = worker
                with contextlib.suppress(OSError):  # it died while it was idle: noticed below
                    worker.give(index, tasks[index], attempt)
                yield Event(index, "started", None, attempt, worker.number)
            for connection in wait(list(running), timeout=_WAIT_S):
                worker = running[connection]  # type: ignore[index]
                try:
                    kind, value = worker.connection.recv()
                except (EOFError, OSError):
                    del running[worker.connection]
                    why = worker.why_it_died()
                    if worker.task is None:
                        continue
                    if worker.attempt <= limits.retries and worker.stopped_for is None:
                        line.append((worker.task, worker.attempt + 1))
                    else:
                        yield Event(worker.task, "died", why, worker.attempt, worker.number)
                    continue
                if kind == "begun":  # a new process has loaded its libraries before
                    worker.since_s = time.monotonic()
                    continue
                index, attempt = worker.task, worker.attempt
                assert index is not None
                if kind == "finished":
                    worker.task = None
                yield Event(index, kind, value, attempt, worker.number)
            for worker in running.values():
                worker.stop_if_late()
    finally:
        for worker in running.values():
            worker.end()


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def free_memory_bytes() -> int | None:
    """Memory that is free on this machine, or in the container that it is; None where nobody says."""
    free = []
    with contextlib.suppress(OSError, ValueError, StopIteration), open("/proc/meminfo", encoding="ascii") as file:
        free.append(1024 * int(next(line for line in file if line.startswith("MemAvailable")).split()[1]))
    with (
        contextlib.suppress(OSError, ValueError),
        open("/sys/fs/cgroup/memory.max", encoding="ascii") as most,
        open("/sys/fs/cgroup/memory.current", encoding="ascii") as now,
    ):
        free.append(int(most.read()) - int(now.read()))  # "max" is no number: no limit
    return min(free, default=None)


def _free_number(running: dict[Connection, _Worker]) -> int:
    taken = {worker.number for worker in running.values()}
    return next(number for number in range(len(running) + 1) if number not in taken)


def _about_exit(code: int | None) -> str:
    if code is None:
        return "its process does not answer"
    if code >= 0:
        return f"its process ended with exit code {code}"
    names = {signal.SIGSEGV: "crashed (a decoder, most likely)", signal.SIGABRT: "crashed (a decoder, most likely)"}
    names[signal.SIGKILL] = "was killed (memory may have run out)"
    number = signal.Signals(-code) if -code in set(signal.Signals) else -code
    return f"its process {names.get(number, 'was killed')}, signal {getattr(number, 'name', number)}"  # type: ignore[arg-type]


@contextlib.contextmanager
def environment_of_threads(threads: int) -> Iterator[None]:
    """Environment of new processes: libraries read their number of threads when they are loaded."""
    changes = dict.fromkeys(_THREAD_VARIABLES, str(threads)) | {"OMP_WAIT_POLICY": "PASSIVE"}
    with _STARTING:
        before = {name: os.environ.get(name) for name in changes}
        os.environ.update(changes)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _work(connection: Connection, function: Callable[[Any, Report], Any], limits: Limits) -> None:
    """What a process does: one task after the other, until it gets None or its parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    end_with_parent()
    prefer_to_kill()
    _bound_memory(limits.memory_bytes)
    import torch

    torch.set_num_threads(limits.threads)
    while True:
        try:
            given = connection.recv()
        except (EOFError, OSError):
            return
        if given is None:
            return
        connection.send(("begun", None))
        report = Throttled(lambda *progress: connection.send(("progress", progress)), _REPORT_EVERY_S)
        value = function(given[0], report)
        connection.send(("finished", value))


class Throttled:
    """A report that passes on the first and the last of a stage, and between them one every few moments."""

    def __init__(self, send: Report, every_s: float) -> None:
        self._send, self._every_s = send, every_s
        self._last: dict[str, float] = {}

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        if stage in self._last and done < total and now - self._last[stage] < self._every_s:
            return
        self._last[stage] = now
        self._send(stage, done, total)


def end_with_parent() -> None:
    """End this process when its parent does, however that dies."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="rmis-parent").start()


def prefer_to_kill() -> None:
    """Make the kernel prefer this process to its parent when memory runs out."""
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w", encoding="ascii") as file:
            file.write("900")


def _bound_memory(limit: int | None) -> None:
    """Make an allocation beyond the limit fail in this process."""
    if limit is not None and sys.platform.startswith("linux"):
        import resource

        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
