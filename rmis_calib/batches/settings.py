"""Settings of a batch. Importing this module imports neither torch nor anything heavy."""

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class BatchSettings:
    """How a tree of recordings is worked through; what is computed is the calibration's configuration."""

    workers: Annotated[int, Field(ge=1)] | None = None
    """Processes that work side by side. Default: one a core, and no more than there are recordings. The cores are
    shared out: each process computes with cores / workers threads."""
    cluster: str | None = None
    """Address of a dask scheduler (tcp://host:8786), or `local` to start one here, in place of own processes. The
    workers must see the recordings and the output folder under the same paths."""
    retries: Annotated[int, Field(ge=0)] = 2
    """How often a recording is tried again whose process died (a decoder that crashed, memory that ran out)."""
    timeout_min: Annotated[float, Field(gt=0.0)] | None = None
    """A recording that takes longer is stopped, and counts as failed."""
    memory_gb: Annotated[float, Field(gt=0.0)] | None = None
    """Memory that a process may take; a recording that needs more fails alone. Default: the machine's free memory,
    shared by the workers (Linux)."""
    fail_fast: bool = False
    """Stop at the first recording without a trustworthy result; those at work are finished."""
    device_batch: Annotated[int, Field(ge=0)] | None = None
    """Most frames that the process of a device searches at once, of all recordings whose camera and picture size are
    the same; the workers only decode and solve. 0: each worker searches its own. Default: 64 on a GPU, 0 on a CPU."""
    overlays: Annotated[int, Field(ge=-1)] = 12
    """Pictures drawn a recording with detected and predicted contours (-1: every frame)."""
    overlay_video: bool = False
    """Write a video of every recording with what was detected and predicted drawn in."""
    profile: bool = False
    """Write OUT/NAME/profile.txt: the functions in which the time of a recording went."""
    watch: bool = False
    """Keep looking for new recordings until interrupted (Ctrl-C). One counts as complete when it holds a file called
    `done`, or when nothing in it has changed for `settle_s`."""
    settle_s: Annotated[float, Field(gt=0.0)] = 30.0
    """With `watch`: seconds without change after which a recording without a `done` file counts as complete."""
    poll_s: Annotated[float, Field(gt=0.0)] = 5.0
    """With `watch`: seconds from one look to the next."""
