"""Tasks on a dask cluster: the same function as on processes of this machine, on workers that come and go.

Needs the extra `cluster` (dask.distributed). Workers must see inputs and outputs under the same paths as the client.
"""

import socket
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from rmis_calib.errors import InputError
from rmis_calib.parallel.processes import Event, Limits, Report, Throttled

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
) -> Generator[Event, None, None]:
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
    with _connected(address, workers, limits.retries) as client:
        messages: deque[tuple[int, tuple[str, int, int]]] = deque()
        client.subscribe_topic(TOPIC, lambda event: messages.append((event[1]["index"], tuple(event[1]["value"]))))
        futures: dict[Any, int] = {}
        for index, task in enumerate(tasks):
            # Keys of their own: a task that was done for another client must be done again for this one.
            key = f"rmis-calib-{socket.gethostname()}-{time.time_ns()}-{index}"
            future = client.submit(_on_worker, function, index, task, limits.threads, key=key, pure=False)
            futures[future] = index
        try:
            yield from _events(client, futures, messages, limits.retries, stop)
        finally:
            client.cancel(list(futures))


@contextmanager
def _connected(address: str, workers: int, retries: int) -> Iterator[Any]:
    """A client of the scheduler, and where it is `local` the cluster itself."""
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        expected = "dask.distributed (pip install 'rmis-calib[cluster]')"
        raise InputError(where="--cluster", expected=expected, found="not installed") from error
    with ExitStack() as stack:
        at: Any = address
        if address == "local":
            with dask.config.set({"distributed.scheduler.allowed-failures": retries}):
                at = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0", silence_logs=50)
            stack.callback(at.close)
        try:
            client = Client(at, timeout="20s", set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            expected = "a dask scheduler that answers (tcp://host:8786), or local"
            raise InputError(where=f"--cluster {address}", expected=expected, found="none") from error
        stack.callback(client.close)
        yield client


def _events(
    client: Any,
    futures: dict[Any, int],
    messages: deque[tuple[int, tuple[str, int, int]]],
    retries: int,
    stop: Callable[[], bool],
) -> Iterator[Event]:
    """What happens to the futures, until none is left in the mapping; each with the index of its task."""
    from distributed.scheduler import KilledWorker

    seen: set[int] = set()
    while futures:
        if stop():
            waiting = [future for future, index in futures.items() if index not in seen]
            client.cancel(waiting)
            for future in waiting:
                del futures[future]
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
                continue
            error = future.exception() if future.status == "error" else None
            is_dead = isinstance(error, KilledWorker)
            why = "every worker that took it died" if is_dead else f"the cluster gave it up: {error!r}"
            yield Event(index, "died", why, retries + 1, 0)


def _on_worker(function: Callable[[Any, Report], Any], index: int, task: Any, threads: int) -> Any:
    """The task, on a worker, with its progress as events of the cluster."""
    import torch
    from distributed import get_worker

    torch.set_num_threads(threads)
    worker = get_worker()

    def send(*progress: Any) -> None:
        worker.log_event(TOPIC, {"index": index, "value": progress})

    return function(task, Throttled(send, _REPORT_EVERY_S))
