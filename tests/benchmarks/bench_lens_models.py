"""The same rendered recording seen through a pinhole, a fisheye and a rational lens, calibrated from its pictures.

Run: python tests/benchmarks/bench_lens_models.py [--motions 40]

Pictures are rendered without distortion and bent by OpenCV's own lens models, which the calibration knows nothing of.
"""

import argparse
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import yaml

import data_synth
import rmis_calib as rc

LENSES = {
    "plumb_bob": None,
    "equidistant": [0.06, -0.04, 0.02, -0.006],
    "rational_polynomial": [0.41, -0.12, 1e-3, -8e-4, 0.05, 0.72, 0.09, 0.11],
}
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)


def render(folder: Path, motions: int) -> Path:
    """The demo's scene through lenses without distortion."""
    config = data_synth.load_synth_config("demo")
    straight = (0.0, 0.0, 0.0, 0.0, 0.0)
    eyes = {side: replace(getattr(config.camera, side), distortion=straight) for side in ("right", "left")}
    output = replace(config.output, pictures="images")
    config = replace(config, motions=motions, output=output, camera=replace(config.camera, **eyes))
    return data_synth.write_recording(folder / "straight", config)


def bend(recording: Path, folder: Path, model: str, distortion: list[float]) -> Path:
    """A copy of the recording as another lens would have shown it."""
    out = Path(shutil.copytree(recording, folder / model))
    (out / "head_points.csv").unlink(missing_ok=True)  # they are of the straight pictures
    stereo = yaml.safe_load((out / "stereo.yaml").read_text())
    width, height = stereo["image_size"]
    v, u = np.mgrid[:height, :width].astype(np.float64)
    raw = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    undistort = cv2.fisheye.undistortPoints if model == "equidistant" else cv2.undistortPoints
    for side in ("right", "left"):
        camera = stereo[side]
        K = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]])
        places = undistort(raw, K, np.array(distortion), R=None, P=K, criteria=CRITERIA)
        maps = np.moveaxis(places.reshape(height, width, 2).astype(np.float32), -1, 0)
        for path in sorted((out / side).glob("*.png")):
            bent = cv2.remap(cv2.imread(str(path)), *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            cv2.imwrite(str(path), bent)
        camera |= {"distortion_model": model, "distortion": distortion}
    (out / "stereo.yaml").write_text(yaml.safe_dump(stereo))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motions", type=int, default=40)
    arguments = parser.parse_args()
    print(f"{'lens':<22}{'verdict':<10}{'error, deg':>12}{'mm':>8}{'1 sigma, deg':>14}{'mm':>8}")
    with tempfile.TemporaryDirectory() as name:
        straight = render(Path(name), arguments.motions)
        for model, distortion in LENSES.items():
            folder = straight if distortion is None else bend(straight, Path(name), model, distortion)
            result = rc.calibrate(rc.load_recording(folder), throw=False)
            rows = dict(rc.evaluate(result, folder).rows())
            errors = [rows[key].split()[0] for key in ("rotation error", "translation error")]
            sigma = (result.rotation_sigma_deg or np.nan, result.translation_sigma_mm or np.nan)
            print(
                f"{model:<22}{result.status:<10}{errors[0]:>12}{errors[1]:>8}{sigma[0]:>14.3f}{sigma[1]:>8.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
