"""Bring your own segmentation: any function from images to masks takes the place of the colour detection.

Here it is a threshold on brightness and colour, a stand-in for your network. The contours are still found at sub-pixel
precision inside the masks, so a rough mask is enough.

    python examples/own_masks.py [FOLDER]

On the command line, `--masks` takes a folder of mask images, a TorchScript or an ONNX model.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from torch import Tensor

import data_synth
import rmis_calib as rc
from rmis_calib.pipeline import DetectionTable


def segment(images: Tensor) -> Tensor:
    """Dark and grey pixels: (b, 3, h, w) in [0, 1] to (b, h, w) bool. Your network goes here."""
    brightness, spread = images.mean(1), images.amax(1) - images.amin(1)
    return (brightness < 0.5) & (spread < 0.08)


def draw(recording: rc.Recording, table: DetectionTable, picture: Path) -> None:
    """A frame, its mask, and the contours that were found in it."""
    view = table.views[0]
    frame = int(view.found.nonzero()[0])
    image = recording.right.frames([frame])[0]
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained")
    axes[0].imshow(segment(image[None] / 255.0)[0].numpy(), cmap="gray")
    axes[0].set_title("mask")
    axes[1].imshow(image.permute(1, 2, 0).numpy())
    for contour in view.detections.contour_uv[frame, 0]:
        axes[1].plot(*contour.numpy().T, color="orange", linewidth=2)
    axes[1].set_title("contours found inside it")
    for ax in axes:
        ax.set(xlim=(0, image.shape[2] - 1), ylim=(image.shape[1] - 1, 0), xticks=[], yticks=[])
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def main(out: Path) -> tuple[rc.CalibrationResult, Path]:
    data_synth.write_recording(out / "recording", data_synth.load_synth_config({"motions": 16, "seed": 4}))

    recording = rc.load_recording(out / "recording")
    result = rc.calibrate(recording, segment=segment)
    print(result.status, result.message)
    picture = out / "masks.png"
    draw(recording, rc.detect(recording, segment=segment), picture)
    print(f"drawn: {picture}")
    return result, picture


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_masks"))
