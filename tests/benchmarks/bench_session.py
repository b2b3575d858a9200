"""How long `rc.Session.add` takes a frame: python tests/benchmarks/bench_session.py

Rendered stereo and single pictures of 640x480. Wall time and CPU time of a frame: median over frames between solves of
all motions, and the longest. The two eyes are searched side by side. On a machine that does other work the wall time is
that of the other work.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import data_synth
import rmis_calib as rc
from rmis_calib.geometry.cameras import StereoRig

MOTIONS = 60


def main() -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        config = replace(data_synth.load_synth_config("demo"), motions=MOTIONS)
        recording = rc.load_recording(data_synth.write_recording(Path(temporary) / "recording", config))
        readings = [recording.joints_at_frames(arm)[0] for arm in ("laparoscope", "instrument")]
        columns = [*recording.robot.columns("laparoscope"), *recording.robot.columns("instrument")]
        rows = np.concatenate(readings, axis=1)
        right = recording.right.frames(range(MOTIONS))
        left = None if recording.left is None else recording.left.frames(range(MOTIONS))
        for name, pictures in (("stereo", left), ("one camera", None)):
            stereo = recording.stereo if pictures is not None else StereoRig(recording.stereo.right)
            session, seconds = rc.Session(recording.robot, stereo), []
            for k in range(MOTIONS):
                start = time.perf_counter(), time.process_time()
                joints = dict(zip(columns, rows[k].tolist(), strict=True))
                session.add(joints, right[k], None if pictures is None else pictures[k])
                seconds.append((time.perf_counter() - start[0], time.process_time() - start[1]))
                session.advice()  # computed while the arms move to their next place
            wall, cpu = 1e3 * np.array(seconds[6:]).T
            print(f"{name:11} wall {np.median(wall):4.0f} ms (longest {wall.max():4.0f}), CPU {np.median(cpu):4.0f} ms")


if __name__ == "__main__":
    main()
