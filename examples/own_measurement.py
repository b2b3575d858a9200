"""Add a measurement of your own: it makes a weak recording strong.

With one still camera, a few small motions and half a pixel of noise, the width of the shaft gives poor distances, and
the result is `weak`. If a tracker also sees a marker on the instrument, even to half a millimetre only, a dozen lines
pass that to the solver. The measurement then counts in the estimate, the uncertainty, the outlier test and the report,
like everything built in.

    python examples/own_measurement.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from torch import Tensor

import rmis_calib as rc
from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig

TRACKER_SIGMA_MM = 0.5


def tracked_marker(R: Tensor, t: Tensor, arm_p: Tensor, camera_p: Tensor) -> Tensor:
    """Predicted minus tracked position of the marker in the camera's frame, mm."""
    return (R @ arm_p[..., None])[..., 0] + t - camera_p


def recording(seed: int = 0) -> tuple[rc.ShaftObservations, rc.Measurement, np.ndarray]:
    """Contours seen by one still camera, the marker as tracked, and the true `camera_right_T_arm`."""
    study = LineStudyConfig(
        trials=1, seed=seed, positions_laparoscope=1, positions_instrument=2, kinematics_noise_mm=0.2,
        kinematics_noise_deg=0.05,
    )  # fmt: skip
    arrays = simulate_lines(study)
    given = ("arm_T_rcm", "rcm_v_axis", "contour_right", "valid_right")
    observations = rc.ShaftObservations(
        **{key: arrays[key][0] for key in given},
        sigma_image=arrays["sigma_image"],
        shaft_radius_mm=arrays["shaft_radius_mm"],
    )
    truth, arm_T_rcm = arrays["truth"]["camera_right_T_arm"][0], arrays["arm_T_rcm"][0]
    arm_p = (arm_T_rcm[:, :3, :3] @ arrays["rcm_p_head"][0][..., None])[..., 0] + arm_T_rcm[:, :3, 3]
    camera_p = arm_p @ truth[:3, :3].T + truth[:3, 3]
    camera_p = camera_p + np.random.default_rng(seed).normal(scale=TRACKER_SIGMA_MM, size=camera_p.shape)
    marker = rc.Measurement(
        "tracked marker", tracked_marker, {"arm_p": arm_p, "camera_p": camera_p}, sigma=TRACKER_SIGMA_MM
    )
    return observations, marker, truth


def draw(results: dict[str, rc.CalibrationResult], truth: np.ndarray, picture: Path) -> None:
    """Translation error along each axis, with the 1 sigma that each result claims."""
    figure, ax = plt.subplots(figsize=(7, 4.4), layout="constrained")
    for shift, (words, result) in zip((-0.1, 0.1), results.items(), strict=True):
        assert result.camera_right_T_arm is not None and result.covariance is not None
        error_mm = result.camera_right_T_arm.matrix[:3, 3].numpy() - truth[:3, 3]
        sigma_mm = np.sqrt(np.diag(result.covariance)[3:])
        ax.errorbar(np.arange(3) + shift, error_mm, sigma_mm, fmt="o", capsize=5, label=f"{words}: {result.status}")
    ax.axhline(0.0, color="black", linewidth=0.8)
    ax.set(xticks=range(3), xticklabels=["x", "y", "z"], ylabel="translation error, mm (bars: 1 sigma)")
    ax.legend()
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def main(out: Path) -> tuple[rc.CalibrationResult, rc.CalibrationResult, Path]:
    observations, marker, truth = recording()
    before = rc.solve(observations, throw=False)
    after = rc.solve(observations, measurements=[marker], throw=False)
    results = {"contours alone": before, "with the marker": after}
    for words, result in results.items():
        assert result.camera_right_T_arm is not None
        error = np.linalg.norm(result.camera_right_T_arm.matrix[:3, 3].numpy() - truth[:3, 3])
        print(f"{words}: {result.status}, 1 sigma {result.translation_sigma_mm:.2f} mm, {error:.2f} mm off")
    print(f"residual of the marker: rms {after.residuals['tracked marker'].rms:.2f} mm")
    out.mkdir(parents=True, exist_ok=True)
    picture = out / "own_measurement.png"
    draw(results, truth, picture)
    print(f"drawn: {picture}")
    return before, after, picture


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_measurement"))
