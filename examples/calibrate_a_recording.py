"""Calibrate a recording, compare with the truth, and draw what the answer predicts.

A small recording is rendered first, so that the truth is known; with a recording of your own, start at
`rc.load_recording`. The picture shows the shaft's axis where the transform and the joints put it: it must lie on the
shaft in every frame.

    python examples/calibrate_a_recording.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

import data_synth
import rmis_calib as rc
from rmis_calib.pipeline import CalibrationRun


def predicted_px(run: CalibrationRun, motion: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the shaft's axis, (n, 2) px of the right image, and the head point at the hinge of the jaws, (2,)."""
    assert run.result.camera_right_T_arm is not None
    camera_T_rcm = run.result.camera_right_T_arm.matrix @ run.poses.arm_T_rcm[motion]
    distance_mm = run.poses.rcm_s_end_mm[motion] - torch.linspace(60.0, 0.0, 30, dtype=torch.float64)
    rcm_p_axis = distance_mm[:, None] * run.poses.rcm_v_axis[motion]
    rcm_p = torch.cat([rcm_p_axis, run.poses.rcm_p_head[motion][None]])
    camera_p = rcm_p @ camera_T_rcm[:3, :3].mT + camera_T_rcm[:3, 3]
    uv, _ = run.recording.stereo.right.project(camera_p)
    return uv[:-1].numpy(), uv[-1].numpy()


def draw(run: CalibrationRun, picture: Path) -> None:
    """Four motions, spread over the recording."""
    motions = torch.linspace(0, len(run.poses.frames) - 1, 4).round().long().tolist()
    figure, axes = plt.subplots(2, 2, figsize=(10, 7.6), layout="constrained")
    for ax, motion in zip(axes.flat, motions, strict=True):
        frame = int(run.poses.frames[motion])
        image = run.recording.right.frames([frame])[0].numpy()  # (3, h, w)
        axis, head = predicted_px(run, motion)
        ax.imshow(image.transpose(1, 2, 0))
        ax.plot(*axis.T, color="white", linewidth=2.5)
        ax.plot(*head, "o", color="magenta", markersize=9, markeredgecolor="white")
        ax.set(xlim=(0, image.shape[2] - 1), ylim=(image.shape[1] - 1, 0), xticks=[], yticks=[], title=f"frame {frame}")
    result = run.result
    figure.suptitle(
        f"{result.status}: {result.rotation_sigma_deg:.2f} deg, {result.translation_sigma_mm:.2f} mm (1 sigma)"
    )
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def main(out: Path) -> tuple[rc.CalibrationResult, Path]:
    data_synth.write_recording(out / "recording", data_synth.load_synth_config({"motions": 16, "seed": 3}))

    recording = rc.load_recording(out / "recording")
    run = rc.run_calibration(recording)  # `rc.calibrate` is the same, and returns the result alone
    result = run.result
    print(result.status, result.message)
    assert result.camera_right_T_arm is not None  # a failed calibration has no transform; `rc.calibrate` raises instead
    print(result.camera_right_T_arm.matrix)  # (4, 4), mm

    error = rc.evaluate(result, recording)  # against ground_truth.yaml, which the calibration never reads
    print(f"off by {error.rotation_error_deg:.3f} deg, {error.translation_error_mm:.3f} mm")
    picture = out / "predicted_axis.png"
    draw(run, picture)
    print(f"drawn: {picture}")
    return result, picture


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_calibrate"))
