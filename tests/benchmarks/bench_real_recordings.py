"""Every real recording that has a reference, calibrated as a user does: what is said, and how far it is from the truth;
and rendered ones whose files say something wrong (broken_recordings.py).

    python tests/benchmarks/bench_real_recordings.py [--data FOLDER] [--recordings NAME ...] [KEY=VALUE ...]
    python tests/benchmarks/bench_real_recordings.py --recordings --broken [CASE ...] [--seed 1]

KEY=VALUE are settings of `calibrate`, such as `measurements=contours`. Columns: verdict; own sigma; distance from the
reference (the nearest, where a recording has several that differ), in deg, mm, and in the sigmas of both together (M;
4.49 is the bound of 3 sigma for 6 unknowns); median residuals of contours and ends; how many times the sigmas count as
groups of motions disagree; and M of two halves of the motions, far from each other in joint space. Below: the message;
edges of the pictures off the predicted contours (median, spread, share of places), and what they say against it.
"""

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
import yaml

from rmis_calib.config import CalibrationConfig, parse_config
from rmis_calib.errors import RmisCalibError
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.io import load_recording
from rmis_calib.pipeline import run_calibration
from rmis_calib.results import CalibrationResult
from tests.benchmarks.broken_recordings import BROKEN, write_broken


def references(folder: Path) -> tuple[list[torch.Tensor], float, float]:
    """Transforms that the recording's reference file holds, and their sigma an axis, rad and mm."""
    entries = yaml.safe_load((folder / "reference.yaml").read_text())
    found = [torch.tensor(value).double() for value in entries.values() if np.shape(value) == (4, 4)]
    return found, float(np.deg2rad(entries["sigma_deg"])), float(entries["sigma_mm"])


def gap(result: CalibrationResult, folder: Path) -> tuple[float, float, float]:
    """Distance from the nearest reference: deg, mm, and sigmas of both."""
    assert result.camera_right_T_arm is not None
    transforms, rad, mm = references(folder)
    T = result.camera_right_T_arm.matrix.double()
    own = torch.as_tensor(np.full((6, 6), np.inf) if result.covariance is None else result.covariance)
    both = own + torch.diag(torch.tensor([rad**2] * 3 + [mm**2] * 3).double())
    best = (np.inf, np.inf, np.inf)
    for X in transforms:
        off = torch.cat((matrix_to_rotvec(X[:3, :3] @ T[:3, :3].mT), X[:3, 3] - T[:3, 3]))
        M = float((off @ torch.linalg.solve(both, off)).sqrt())
        found = (float(torch.rad2deg(off[:3].norm())), float(off[3:].norm()), M)
        best = min(best, found, key=lambda item: item[2])
    return best


def residual(result: CalibrationResult, kind: str) -> str:
    """Median of a kind, right / left, px."""
    return " / ".join(
        f"{result.residuals[f'{kind}_{side}'].median:.2f}"
        for side in ("right", "left")
        if f"{kind}_{side}" in result.residuals
    )


def edges(result: CalibrationResult) -> str:
    """Edges of the pictures off the predicted contours: median and spread, px, and share of places, right / left."""
    views = {} if result.picture is None else result.picture.views
    return " / ".join(
        f"{view.median_px or 0:+.2f} +- {view.spread_px or 0:.2f}, {100 * view.edge_share:.0f} %"
        for view in views.values()
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[3] / "shared/data")
    parser.add_argument("--recordings", nargs="*")
    parser.add_argument("--broken", nargs="*", choices=list(BROKEN))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("settings", nargs="*")
    arguments = parser.parse_args()
    values = {key: yaml.safe_load(value) for key, value in (item.split("=", 1) for item in arguments.settings)}
    config = parse_config(values)
    folders = [
        path.parent for path in sorted(arguments.data.glob("*/reference.yaml")) if "sigma_deg" in path.read_text()
    ]
    print(
        f"{'recording':32} {'status':17} {'used':>7}  sigma             from the reference  M      "
        "contours, px   ends, px   grown halves"
    )
    for folder in folders:
        if arguments.recordings is None or folder.name in arguments.recordings:
            row(folder, config)
    if arguments.broken is not None:
        for name in arguments.broken or BROKEN:
            with tempfile.TemporaryDirectory() as parent:
                row(write_broken(name, Path(parent), arguments.seed), config)


def row(folder: Path, config: CalibrationConfig) -> None:
    """Print the lines of one recording."""
    try:
        result = run_calibration(load_recording(folder), config).result
    except RmisCalibError as error:
        print(f"{folder.name:32} {error}", flush=True)
        return
    used = f"{int(result.motions.used.sum())}/{len(result.motions.used)}"
    if result.camera_right_T_arm is None:
        print(f"{folder.name:32} {result.status:17} {used:>7}  {result.message}", flush=True)
        return
    degrees, mm, M = gap(result, folder)
    groups = result.consistency
    grown, halves = (groups.inflation, groups.halves.sigmas) if groups else (1.0, float("nan"))
    print(
        f"{folder.name:32} {result.status:17} {used:>7}  "
        f"{result.rotation_sigma_deg or 0:5.2f} deg {result.translation_sigma_mm or 0:4.1f} mm  "
        f"{degrees:5.2f} deg {mm:5.1f} mm {M:5.2f}  {residual(result, 'contour'):14} {residual(result, 'end'):10} "
        f"{grown or 1.0:4.1f}  {halves or 0.0:5.1f}"
    )
    print(f"{'':32} {result.message}")
    said = () if result.picture is None else result.picture.sentences
    print("\n".join(f"{'':32} {line}" for line in (f"pictures: {edges(result)}", *said)), flush=True)


if __name__ == "__main__":
    main()
