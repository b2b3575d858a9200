"""Masks of one's own in place of the colour stage: a folder of pictures, a TorchScript or ONNX model, any callable."""

from collections.abc import Callable
from pathlib import Path

import cv2
import torch
from jaxtyping import Bool
from torch import Tensor

from rmis_calib.errors import ConfigError, FileError, ShapeError

Segmenter = Callable[[Tensor], Tensor]


def checked_masks(masks: Tensor, images: Tensor) -> Bool[Tensor, "b h w"]:
    """Masks that fit a batch of pictures.

    Args:
        masks: (b, h, w) or (b, 1, h, w), boolean, or numbers above 0.5 on shafts (above 127 for uint8).
        images: (b, 3, h, w).

    Raises:
        ShapeError: they do not.
    """
    expected = (images.shape[0], images.shape[2], images.shape[3])
    flat = masks[:, 0] if masks.ndim == 4 and masks.shape[1] == 1 else masks
    if tuple(flat.shape) != expected:
        raise ShapeError(where="masks", expected=f"shape {expected}, as the pictures", found=tuple(masks.shape))
    if flat.dtype == torch.bool:
        return flat.to(images.device)
    return flat.to(images.device) > (127 if flat.dtype == torch.uint8 else 0.5)


class FolderMasks:
    """Masks in a folder, one picture a frame, in the order of their names; brighter than half is shaft."""

    def __init__(self, folder: str | Path) -> None:
        """List the folder.

        Raises:
            FileError: there is no such folder, or no picture in it.
        """
        path = Path(folder)
        kinds = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"}
        self.files = sorted(p for p in path.iterdir() if p.suffix.lower() in kinds) if path.is_dir() else []
        if not self.files:
            raise FileError(where=str(path), expected="a folder of mask pictures", found="none")

    def read(self, indices: Tensor) -> Bool[Tensor, "b h w"]:
        """Masks of these frames.

        Args:
            indices: (b,) frame numbers.

        Raises:
            FileError: a frame has no mask, or the file is no picture.
        """
        masks = []
        for index in indices.tolist():
            if not 0 <= index < len(self.files):
                raise FileError(where="masks", expected=f"one for frame {index}", found=f"{len(self.files)} files")
            picture = cv2.imread(str(self.files[index]), cv2.IMREAD_GRAYSCALE)
            if picture is None:
                raise FileError(where=str(self.files[index]), expected="a picture", found="something else")
            masks.append(torch.from_numpy(picture) > 127)
        return torch.stack(masks)


def load_segmenter(path: str | Path) -> Segmenter:
    """A model from pictures (b, 3, h, w) in [0, 1] to masks: TorchScript (.pt, .ts) or, with onnxruntime, ONNX.

    Raises:
        FileError: no such file.
        ConfigError: another kind of file, or ONNX without onnxruntime.
    """
    file = Path(path)
    if not file.is_file():
        raise FileError(where=str(file), expected="a TorchScript or ONNX model", found="no such file")
    if file.suffix in {".pt", ".ts", ".torchscript"}:
        return torch.jit.load(str(file), map_location="cpu").eval()
    if file.suffix == ".onnx":
        return _onnx_segmenter(file)
    raise ConfigError(where=str(file), expected="a model file ending in .pt, .ts or .onnx", found=file.suffix)


def _onnx_segmenter(file: Path) -> Segmenter:
    try:
        import onnxruntime  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError(where=str(file), expected="the package onnxruntime", found="not installed") from error
    session = onnxruntime.InferenceSession(str(file))
    name = session.get_inputs()[0].name

    def segment(images: Tensor) -> Tensor:
        return torch.from_numpy(session.run(None, {name: images.cpu().numpy()})[0]).to(images.device)

    return segment
