"""Tasks for the worker tests: what a process imports must lie in a module."""

import os
import signal
import time
from pathlib import Path


def square(task, report):
    report("working", 0, 1)
    report("working", 1, 1)
    return task**2


def die_if_told(task, report):
    """("die", file): count the attempt in the file and be killed; ("once", file): only at the first attempt."""
    kind, path = task
    if kind in ("die", "once"):
        attempts = Path(path)
        with attempts.open("a") as file:
            file.write("x")
        if kind == "die" or len(attempts.read_text()) == 1:
            os.kill(os.getpid(), signal.SIGKILL)
    return kind


def sleep(task, report):
    report("sleeping", 0, 1)
    time.sleep(task)
    return os.getpid()


def threads(task, report):
    import torch

    return torch.get_num_threads()


def allocate(task, report):
    try:
        return len(bytearray(task))
    except MemoryError:
        return "memory error"
