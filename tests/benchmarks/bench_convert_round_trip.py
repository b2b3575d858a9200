"""A rendered recording written as others write theirs, converted back and calibrated: how far the answer is from that
of the recording itself, and whether a clock offset that was put in is found.

Run: python tests/benchmarks/bench_convert_round_trip.py [--kinds ros1 sqlite3 mcap session] [--motions 40]

Continuous video (`video`), stereo of 640x480 without loss, whose joints are 120 ms off as they are. Each kind is
calibrated twice: with the joints' stamps as they are, and 40 ms later. A minute or two a kind.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "convert"))
from bag_writing import write_bag
from test_sessions_and_sets import pictures, sidecar, write_joint_csv, write_video

import data_synth
import rmis_calib as rc
from rmis_calib.results import CalibrationResult

LATE_S = 0.04


def write(recording: Path, folder: Path, kind: str) -> Path:
    """The recording as another source."""
    if kind != "session":
        return write_bag(recording, folder / ("a.bag" if kind == "ros1" else "a"), kind)
    pairs = zip(pictures(recording, "right"), pictures(recording, "left"), strict=True)
    write_video(folder / "stereo.mp4", [np.concatenate(pair, axis=1) for pair in pairs], rate=30)
    (folder / "stereo.json").write_text(json.dumps(sidecar(recording, "2026", side_by_side="RL")))
    write_joint_csv(recording, folder, "PSM1", "instrument")
    write_joint_csv(recording, folder, "ECM", "laparoscope")
    return folder


def with_late_joints(recording: Path, out: Path) -> Path:
    """The recording with the joints' stamps later than they are."""
    lines = (recording / "joints.csv").read_text().splitlines()
    out.mkdir()
    for file in recording.iterdir():
        (out / file.name).symlink_to(file)
    (out / "joints.csv").unlink()
    rows = [line.split(",", 1) for line in lines[1:]]
    late = [f"{float(stamp) + LATE_S!r},{rest}" for stamp, rest in rows]
    (out / "joints.csv").write_text("\n".join([lines[0], *late]) + "\n")
    return out


def answer(folder: Path) -> CalibrationResult:
    return rc.calibrate(rc.load_recording(folder), throw=False)


def main() -> None:
    parser = argparse.ArgumentParser(description="Convert other layouts of a recording back and calibrate them.")
    parser.add_argument("--kinds", nargs="+", default=["ros1", "sqlite3", "mcap", "session"])
    parser.add_argument("--motions", type=int, default=40)
    arguments = parser.parse_args()
    config = data_synth.load_synth_config("video")
    config = replace(config, motions=arguments.motions, output=replace(config.output, pictures="images"))
    print(f"{'kind':<10}{'largest difference':>20}{'clock, as is':>16}{'clock, 40 ms late':>20}")
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        recording = data_synth.write_recording(root / "recording", config)
        original = answer(recording)
        late = with_late_joints(recording, root / "late")
        settings = rc.ConvertSettings(robot=str(recording / "robot.yaml"), stereo=str(recording / "stereo.yaml"))
        for kind in arguments.kinds:
            found = []
            for name, source in (("exact", recording), ("late", late)):
                place = root / f"{kind}-{name}"
                place.mkdir()
                rc.convert(write(source, place, kind), root / f"{kind}-{name}-recording", settings)
                found.append(answer(root / f"{kind}-{name}-recording"))
            apart = found[0].camera_right_T_arm.matrix - original.camera_right_T_arm.matrix
            clocks = [1e3 * result.kinematic_offsets.clock_s for result in found]
            print(f"{kind:<10}{float(apart.abs().max()):>20.1e}{clocks[0]:>13.1f} ms{clocks[1]:>17.1f} ms", flush=True)


if __name__ == "__main__":
    main()
