"""Pictures of two eyes that belong together, written as they come."""

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from rmis_calib.convert.material import Job
from rmis_calib.convert.messages import is_cut_off, write_picture
from rmis_calib.convert.topics import Topic
from rmis_calib.errors import RecordingError

_WAITING = 32
"""Pictures of one eye that wait for the other's: a bag that interleaves worse loses pairs, and says so."""
_GAPS = 25
"""Intervals between pictures whose median counts: two stamps may lie together by chance."""
_PAIR_SLACK = 0.5
"""Share of a frame interval that the eyes of a pair may be apart."""


class EyePairs:
    """Pictures written as they come; of two eyes only those that belong together, both encoded at once."""

    def __init__(self, job: Job, right: Topic, left: Topic | None) -> None:
        self._job, self._right, self._left = job, right, left
        self._pool = ThreadPoolExecutor(max_workers=2, thread_name_prefix="rmis-encode")
        self._waiting: dict[str, deque[tuple[int, Any]]] = {
            right.name: deque(),
            **({left.name: deque()} if left else {}),
        }
        self._gaps_ns: deque[int] = deque(maxlen=_GAPS)
        self._previous: dict[str, int] = {}
        self._ns: list[int] = []
        self._apart: list[int] = []
        self._lost = self._damaged = 0
        self._sizes: dict[str, tuple[int, int]] = {}
        for side in ("right", *(("left",) if left is not None else ())):
            (job.folder / side).mkdir()

    @property
    def size(self) -> tuple[int, int] | None:
        """(height, width) of the right pictures, where that is known without decoding."""
        return self._sizes.get("right")

    def add(self, topic: str, ns: int, message: Any) -> None:
        """One picture.

        Raises:
            RecordingError: it is of another size than those before, or of an encoding that is not read.
        """
        if is_cut_off(message):
            self._damaged += 1
            return
        previous = self._previous.get(topic)
        if previous is not None and ns <= previous:
            self._lost += 1
            return
        if previous is not None and topic == self._right.name:
            self._gaps_ns.append(ns - previous)
        self._previous[topic] = ns
        if self._left is None:
            self._write(ns, message, None)
            return
        self._waiting[topic].append((ns, message))
        self._match()

    def finish(self) -> np.ndarray:
        """(N,) stamps of the frames that were written.

        Raises:
            RecordingError: there are none.
        """
        if self._left is not None:
            self._match(at_end=True)
            self._lost += sum(map(len, self._waiting.values()))
        self._pool.shutdown()
        where = self._right.name
        if not self._ns:
            expected = "pictures of both eyes with stamps that belong together" if self._left else "pictures"
            raise RecordingError(where=where, expected=expected, found="none")
        if self._damaged:
            self._job.note(f"{self._damaged} pictures that break off were left out")
        if self._lost:
            self._job.note(f"{self._lost} pictures without a partner, or with a repeated stamp, were left out")
        if self._apart:
            apart_ms = float(np.median(np.abs(self._apart))) / 1e6
            self._job.note(f"{len(self._ns)} pairs of pictures; the eyes are {apart_ms:.3g} ms apart (median)")
        return np.array(self._ns, dtype=np.int64)

    def _match(self, at_end: bool = False) -> None:
        """Write the pairs at the head of both queues; let go of what can have no partner any more."""
        assert self._left is not None
        right, left = self._waiting[self._right.name], self._waiting[self._left.name]
        while right and left:
            apart = left[0][0] - right[0][0]
            slack = _PAIR_SLACK * sorted(self._gaps_ns)[len(self._gaps_ns) // 2] if self._gaps_ns else None
            if slack is None and not at_end and len(right) < 2:
                break  # the interval is not known before the second picture
            if slack is None or abs(apart) <= slack:
                (ns, right_message), (_, left_message) = right.popleft(), left.popleft()
                self._apart.append(apart)
                self._write(ns, right_message, left_message)
            else:
                (right if apart > 0 else left).popleft()
                self._lost += 1
        for queue in (right, left):
            while len(queue) > _WAITING:
                queue.popleft()
                self._lost += 1

    def _write(self, ns: int, right: Any, left: Any) -> None:
        number = f"{len(self._ns):06d}"
        eyes = [("right", right, self._right), *([("left", left, self._left)] if self._left is not None else [])]
        written = [
            self._pool.submit(write_picture, message, self._job.folder / side / number, topic.name)
            for side, message, topic in eyes
        ]
        for (side, _, topic), future in zip(eyes, written, strict=True):
            size = future.result()[1]
            if size is not None and size != self._sizes.setdefault(side, size):
                (height, width), found = self._sizes[side], f"{size[1]} x {size[0]} in picture {len(self._ns)}"
                raise RecordingError(where=topic.name, expected=f"pictures of {width} x {height} px", found=found)
        self._ns.append(ns)
