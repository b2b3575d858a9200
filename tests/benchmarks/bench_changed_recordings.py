"""Recordings, real and rendered, changed as users' recordings differ (changes/): one row each.

    python tests/benchmarks/bench_changed_recordings.py [--recordings NAME ...] [--changes NAME ...] [--data FOLDER]

Recordings are folders of `--data` with a reference, and the rendered `moving`, `still` and `video`, whose encoders have
offsets of the usual size, and whose files state nothing about it. Columns: motions used, distance from the reference in
sigmas of both (M; 4.49 is the bound of 3 sigma), verdict, and what is said first: the error, the likely cause, or the
note on what was done. At the end of a row: `!` ok and wrong, `?` a harmless change that changed the verdict or took
away a third of the motions, `-` a harmful one that is not named, though the answer is beyond 3 sigma or refused.
"""

import argparse
import re
import shutil
import sys
import tempfile
import traceback
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import RmisCalibError
from rmis_calib.geometry.cameras import Camera
from rmis_calib.io import load_recording
from rmis_calib.pipeline import run_calibration
from rmis_calib.pipeline.pictures.detection import Detectors
from rmis_calib.vision import DetectorSettings, ShaftDetections, ShaftDetector
from tests.benchmarks.bench_real_recordings import gap
from tests.benchmarks.broken_recordings import Yaml, write_rendered
from tests.benchmarks.changes.recordings import CHANGES, Change, fits

BOUND = 4.49
_IMAGES: Yaml = {"output": {"pictures": "images"}, "noise": {"joint_offset_deg": 0.1, "joint_offset_mm": 0.1}}
RENDERED: dict[str, Yaml] = {
    "moving": _IMAGES | {"motions": 30},
    "still": _IMAGES | {"motions": 30, "motion": {"laparoscope": "unlogged"}},
    "video": _IMAGES | {"motions": 50, "motion": {"kind": "smooth", "speed": 3.0, "joint_rate_hz": 100.0}},
}


_SEEN: dict[bytes, ShaftDetections] = {}
"""What was found in a batch of pictures with a camera: many changes leave both as they are."""


class RememberingDetector(ShaftDetector):
    """Looks at each batch of pictures once."""

    def __init__(self, settings: DetectorSettings, camera: Camera | None) -> None:
        super().__init__(settings, camera)
        self._camera = repr(camera)

    def detect(self, images: Tensor, masks: Tensor | None = None) -> ShaftDetections:
        key = blake2b(images.numpy(force=True).tobytes() + self._camera.encode())
        if key.digest() not in _SEEN:
            _SEEN[key.digest()] = super().detect(images, masks)
        return _SEEN[key.digest()]


@dataclass(frozen=True)
class Outcome:
    """What came of one recording."""

    verdict: str
    used: int
    total: int
    sigmas: float
    said: str
    """All that it said."""
    first: str
    """The error, the likely cause named first, or the first note."""


REMEMBERING = Detectors(RememberingDetector)


def outcome(folder: Path) -> Outcome:
    try:
        result = run_calibration(load_recording(folder), CalibrationConfig(), detectors=REMEMBERING).result
    except RmisCalibError as error:
        return Outcome("refused", 0, 0, float("nan"), str(error), str(error).replace(str(folder), "..."))
    except Exception:
        print(traceback.format_exc(), file=sys.stderr)
        return Outcome("CRASH", 0, 0, float("nan"), "", traceback.format_exc().splitlines()[-1])
    used, total = int(result.motions.used.sum()), len(result.motions.used)
    sigmas = float("nan") if result.camera_right_T_arm is None else gap(result, folder)[2]
    cause = re.search(r"Likely: (.*?)(; then: |$)", result.message)
    first = cause[1] if cause else (result.message if result.status != "ok" else "; ".join(result.notes[:1]))
    said = " ".join((result.message, *result.notes))
    return Outcome(result.status, used, total, sigmas, said, first)


def mark(change: Change, found: Outcome, before: Outcome | None) -> str:
    """What is wrong with a row; empty: nothing."""
    wrong = found.sigmas > BOUND
    if found.verdict == "CRASH" or (found.verdict == "ok" and wrong):
        return "!"
    if change.harmful:
        unnamed = not re.search(change.harmful, found.said)
        return "-" if unnamed and (wrong or found.verdict != "ok") else ""
    if before is None:
        return ""
    fewer = found.used < 2 / 3 * before.used * (found.total / before.total if before.total else 1)
    return "?" if fewer or wrong or (found.verdict != before.verdict and before.verdict == "ok") else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[3] / "shared/data")
    parser.add_argument("--recordings", nargs="*")
    parser.add_argument("--changes", nargs="*", choices=list(CHANGES), default=list(CHANGES))
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    real = [path.parent for path in sorted(arguments.data.glob("*/reference.yaml")) if "sigma_deg" in path.read_text()]
    print(f"{'recording':21} {'change':33} {'used':>7} {'M':>6}  verdict")
    with tempfile.TemporaryDirectory() as scratch:
        for name in arguments.recordings or [*RENDERED, *(folder.name for folder in real)]:
            source = {folder.name: folder for folder in real}.get(name)
            if source is None:
                source = write_rendered(Path(scratch) / name, RENDERED[name], arguments.seed)
            rows(name, source, arguments.changes, Path(scratch) / "changed")


def rows(name: str, source: Path, changes: list[str], copy: Path) -> None:
    """Print one recording's rows."""
    before = None
    for words in changes:
        change = CHANGES[words]
        if not fits(source, change):
            continue
        shutil.copytree(source, copy)
        change.apply(copy)
        found = outcome(copy)
        shutil.rmtree(copy)
        before = found if words == "as it is" else before
        used = f"{found.used}/{found.total}"
        print(
            f"{name:21} {words:33} {used:>7} {found.sigmas:6.2f}  {found.verdict:16} {mark(change, found, before):1} "
            f"{found.first[:260]}",
            flush=True,
        )


if __name__ == "__main__":
    main()
