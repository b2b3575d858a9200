"""Tasks on a dask cluster: the same function as on processes of this machine, on workers that come and go.

Needs the extra `cluster` (dask.distributed). Workers must see inputs and outputs under the same paths as the client.
"""

import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from rmis_calib.batches.workers import Event, Limits, Report
from rmis_calib.errors import InputError

TOPIC = "rmis-calib-progress"
_REPORT_EVERY_S = 1.0
_WAIT_S = 0.5


def run_tasks(
    tasks: Sequence[Any],
    function: Callable[[Any, Report], Any],
    address: str,
    workers: int,
    limits: Limits,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[Event]:
    """Work through tasks on a cluster; events as they come (see `workers.run_tasks`).

    The scheduler gives a task to another worker when its own dies, as often as its `allowed-failures` says (3; with
    `local` it is `limits.retries`); after that the task counts as died. Workers that join are used.

    Args:
        tasks: can be pickled.
        function: `function(task, report)`; must not raise.
        address: of the scheduler; `local` starts one here, with as many workers as asked for.
        workers: of a local cluster.
        limits: of a local cluster's workers, and how many threads a task may use.
        stop: asked before the results are waited for; True cancels what has not begun.

    Raises:
        InputError: dask.distributed is not installed, or no scheduler answers.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
        from distributed.client import Future
        from distributed.scheduler import KilledWorker
    except ImportError as error:
        expected = "dask.distributed (pip install 'rmis-calib[cluster]')"
        raise InputError(where="--cluster", expected=expected, found="not installed") from error
    with dask.config.set({"distributed.scheduler.allowed-failures": limits.retries}):
        cluster = None
        if address == "local":
            cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0", silence_logs=50)
        try:
            client = Client(cluster if cluster is not None else address, timeout="20s", set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            if cluster is not None:
                cluster.close()
            expected = "a dask scheduler that answers (tcp://host:8786), or local"
            raise InputError(where=f"--cluster {address}", expected=expected, found="none") from error
    messages: deque[tuple[int, tuple[str, int, int]]] = deque()
    futures: dict[Future, int] = {}
    seen: set[int] = set()
    try:
        client.subscribe_topic(TOPIC, lambda event: messages.append((event[1]["index"], tuple(event[1]["value"]))))
        for index, task in enumerate(tasks):
            # Keys of their own: a task that was done for another client must be done again for this one.
            key = f"rmis-calib-{socket.gethostname()}-{time.time_ns()}-{index}"
            future = client.submit(_on_worker, function, index, task, limits.threads, key=key, pure=False)
            futures[future] = index
        while futures:
            if stop():
                waiting = [future for future, index in futures.items() if index not in seen]
                client.cancel(waiting)
                futures = {future: index for future, index in futures.items() if index in seen}
            time.sleep(0.05 if any(future.done() for future in futures) else _WAIT_S)
            while messages:
                index, value = messages.popleft()
                if index not in seen:
                    seen.add(index)
                    yield Event(index, "started", None, 1, 0)
                yield Event(index, "progress", value, 1, 0)
            for future in [future for future in futures if future.done()]:
                index = futures.pop(future)
                if future.status == "finished":
                    yield Event(index, "finished", future.result(), 1, 0)
                else:
                    error = future.exception() if future.status == "error" else None
                    is_dead = isinstance(error, KilledWorker)
                    why = "every worker that took it died" if is_dead else f"the cluster gave it up: {error!r}"
                    yield Event(index, "died", why, limits.retries + 1, 0)
    finally:
        client.cancel(list(futures))
        client.close()
        if cluster is not None:
            cluster.close()


def _on_worker(function: Callable[[Any, Report], Any], index: int, task: Any, threads: int) -> Any:
    """The task, on a worker, with its progress as events of the cluster."""
    import torch
    from distributed import get_worker

    torch.set_num_threads(threads)
    worker = get_worker()
    last: dict[str, float] = {}

    def report(stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        if stage in last and done < total and now - last[stage] < _REPORT_EVERY_S:
            return
        last[stage] = now
        worker.log_event(TOPIC, {"index": index, "value": (stage, done, total)})

    return function(task, report)
