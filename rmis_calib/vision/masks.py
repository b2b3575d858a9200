"""Masks of one's own in place of the colour stage: TorchScript, ONNX, or any callable from pictures to masks."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from rmis_calib.errors import ConfigError, FileError, InputError, ShapeError

Segmenter = Callable[[Tensor], Tensor]

TORCHSCRIPT_SUFFIXES = (".pt", ".ts", ".torchscript")
MODEL_SUFFIXES = (*TORCHSCRIPT_SUFFIXES, ".onnx")


def checked_masks(masks: Any, images: Tensor) -> Bool[Tensor, "b h w"]:
    """Masks that fit a batch of pictures.

    Args:
        masks: (b, h, w) or (b, 1, h, w), boolean, or numbers above 0.5 on shafts (above 127 for uint8).
        images: (b, 3, h, w).

    Raises:
        ShapeError: they do not.
    """
    expected = (images.shape[0], images.shape[2], images.shape[3])
    if not isinstance(masks, Tensor):
        raise ShapeError(where="masks", expected=f"one tensor of shape {expected}", found=type(masks).__name__)
    flat = masks[:, 0] if masks.ndim == 4 and masks.shape[1] == 1 else masks
    if tuple(flat.shape) != expected:
        raise ShapeError(where="masks", expected=f"shape {expected}, as the pictures", found=tuple(masks.shape))
    if flat.dtype == torch.bool:
        return flat.to(images.device)
    return flat.to(images.device) > (127 if flat.dtype == torch.uint8 else 0.5)


def load_segmenter(path: str | Path, device: torch.device | str = "cpu") -> Segmenter:
    """A model from pictures (b, 3, h, w) in [0, 1] to masks: TorchScript (.pt, .ts) or, with onnxruntime, ONNX.

    Args:
        path: the file.
        device: where a TorchScript model runs; ONNX models run on the CPU.

    Raises:
        FileError: no such file, or not a model.
        ConfigError: another kind of file, or ONNX without onnxruntime.
    """
    file = Path(path)
    if not file.is_file():
        raise FileError(where=str(file), expected="a TorchScript or ONNX model", found="no such file")
    if file.suffix in TORCHSCRIPT_SUFFIXES:
        return _torchscript_segmenter(file, device)
    if file.suffix == ".onnx":
        return _onnx_segmenter(file)
    raise ConfigError(where=str(file), expected="a model file ending in .pt, .ts or .onnx", found=file.suffix)


def _torchscript_segmenter(file: Path, device: torch.device | str) -> Segmenter:
    try:
        model = torch.jit.load(str(file), map_location=device).eval()
    except RuntimeError as error:
        expected = "a TorchScript model (saved by torch.jit.save)"
        raise FileError(where=str(file), expected=expected, found=_first_sentence(error)) from error

    def segment(images: Tensor) -> Tensor:
        try:
            with torch.no_grad():
                return model(images)
        except RuntimeError as error:
            raise _refused(file, images, _last_line(error)) from error

    return segment


def _onnx_segmenter(file: Path) -> Segmenter:
    try:
        import onnxruntime  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        expected = "the package onnxruntime (install it with: pip install onnxruntime)"
        raise ConfigError(where=str(file), expected=expected, found="not installed") from error
    failures = _onnx_failures(onnxruntime)
    try:
        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    except failures as error:
        raise FileError(where=str(file), expected="an ONNX model", found=_first_sentence(error)) from error
    entry = session.get_inputs()[0]
    # A model exported for one picture at a time takes them one at a time.
    one_by_one = entry.shape[0] == 1

    def segment(images: Tensor) -> Tensor:
        pictures = images.cpu().numpy()
        parts = [pictures[i : i + 1] for i in range(len(pictures))] if one_by_one else [pictures]
        try:
            masks = [torch.from_numpy(session.run(None, {entry.name: part})[0]) for part in parts]
        except failures as error:
            raise _refused(file, images, _first_sentence(error)) from error
        return torch.cat(masks).to(images.device)

    return segment


def _onnx_failures(onnxruntime: Any) -> tuple[type[Exception], ...]:
    """What onnxruntime raises; its classes have no ancestor of their own."""
    kinds = vars(onnxruntime.capi.onnxruntime_pybind11_state).values()
    return tuple(kind for kind in kinds if isinstance(kind, type) and issubclass(kind, Exception))


def _refused(file: Path, images: Tensor, why: str) -> InputError:
    expected = f"a model that takes pictures of shape {tuple(images.shape)}"
    return InputError(where=str(file), expected=expected, found=f"an error of the model ({why})")


def _first_sentence(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0].partition(". ")[0]


def _last_line(error: Exception) -> str:
    """TorchScript puts its traceback before the message."""
    return (str(error).strip().splitlines() or [type(error).__name__])[-1]
