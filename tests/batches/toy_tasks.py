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


def run_job_with_a_decoder_that_aborts(order, report):
    """A job of a batch, in a process that the decoder takes down at the second picture of any video below `crash`."""
    import resource

    from rmis_calib.batches.task import run_job
    from rmis_calib.io._video_file import VideoReader

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pixels = VideoReader._pixels

    def abort_at_the_second(self, frame, number):
        if "crash" in self.path.parts and number == 1:
            os.abort()
        return pixels(self, frame, number)

    VideoReader._pixels = abort_at_the_second
    return run_job(order, report)


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
