"""A batch on a dask cluster: a real scheduler and workers as processes of their own, one of which dies."""

import json
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

import rmis_calib as rc
from rmis_calib.batches import JobRecord, work
from rmis_calib.batches.summary import TIMES
from rmis_calib.errors import InputError
from rmis_calib.parallel.processes import Event

pytest.importorskip("distributed", reason="dask.distributed is absent (the extra `cluster`)")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def cluster() -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """Address of a scheduler, and its two workers."""
    address = f"tcp://127.0.0.1:{free_port()}"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    python = [sys.executable, "-m"]
    with ExitStack() as stack:

        def start(*command: str) -> subprocess.Popen:
            process = subprocess.Popen([*python, *command], **quiet)
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        start("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", address.rpartition(":")[2],
              "--no-dashboard")  # fmt: skip
        workers = [
            start("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
            for _ in range(2)
        ]
        yield address, workers


def rows(out: Path) -> list[dict]:
    raw = json.loads((out / "summary.json").read_text())["recordings"]
    return [{key: value for key, value in row.items() if key not in TIMES} for row in raw]


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_comes_to_the_same_summary(cluster, rendered_pairs, tmp_path) -> None:
    address, workers = cluster
    root = tmp_path / "root"
    for i in range(4):
        shutil.copytree(rendered_pairs, root / f"case_{i}")

    def watch(progress) -> None:
        if progress.event.kind == "progress" and workers[0].poll() is None:
            workers[0].send_signal(signal.SIGKILL)

    settings = rc.BatchSettings(workers=2, overlays=0, cluster=address)
    summary = rc.batch(root, tmp_path / "there", settings=settings, progress=watch)
    assert workers[0].poll() is not None
    assert summary.counts == {"insufficient_data": 4}
    rc.batch(root, tmp_path / "here", settings=rc.BatchSettings(workers=2, overlays=0))
    assert rows(tmp_path / "there") == rows(tmp_path / "here")
    for name in ("case_0", "case_3"):
        texts = [(tmp_path / where / name / "result.json").read_text() for where in ("there", "here")]
        there, here = (json.loads(text) | {"created": ""} for text in texts)
        assert there == here


@pytest.mark.slow
def test_outputs_that_are_not_seen_from_here_are_a_clear_failure(rendered_pairs, tmp_path, monkeypatch) -> None:
    """As with workers whose disks are their own: what a worker says it wrote is looked for."""

    def elsewhere(orders, *_):
        record = JobRecord("recording", "", "calibrate", "", "finished", None, "fine", {"status": "ok"}, host="node7")
        yield Event(0, "finished", record, 1, 0)

    monkeypatch.setattr(work.cluster, "run_tasks", elsewhere)

    summary = rc.batch(rendered_pairs, tmp_path / "out", settings=rc.BatchSettings(cluster="tcp://host:1"))
    assert summary.records[0].failure == "output"
    assert "written on node7, is not seen from here" in summary.records[0].message


def test_a_scheduler_that_is_not_there_is_told(rendered_pairs, tmp_path, monkeypatch) -> None:
    import distributed

    def refuse(*_, **__):
        raise OSError("timed out")

    monkeypatch.setattr(distributed, "Client", refuse)
    with pytest.raises(InputError, match="a dask scheduler that answers"):
        rc.batch(rendered_pairs, tmp_path / "out", settings=rc.BatchSettings(cluster="tcp://host:1"))
