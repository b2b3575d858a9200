"""Masks of one's own for a recording: which pictures or which model serves which camera, and the masks of a batch."""

from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from rmis_calib.errors import FileError, InputError, VideoError
from rmis_calib.io import FrameBatch, FrameSource, open_source
from rmis_calib.io._images import SUFFIXES as IMAGE_SUFFIXES
from rmis_calib.vision.masks import MODEL_SUFFIXES, Segmenter, load_segmenter

MaskReader = Callable[[FrameBatch], Tensor]
"""Masks (b, h, w) of a batch of frames."""

_COLOURED = 30
"""Levels between a pixel's colours from which a picture is one of colours; compression leaves less."""
_MOST_CLASSES, _LARGEST_CLASS = 32, 64
"""Few and small numbers are classes; a mask with soft edges has many grey levels."""
_EXPECTED = "a folder of mask pictures, or a model file ending in .pt, .ts or .onnx"


def open_masks(
    masks: str | Path | Segmenter | None,
    sources: Mapping[str, FrameSource],
    device: str,
    labels: tuple[int, ...] | None = None,
) -> dict[str, MaskReader]:
    """Masks of every camera; none for None.

    Args:
        masks: any callable from pictures (b, 3, h, w) in [0, 1] to masks; or a model, which serves every camera; or a
            folder of pictures in the order of the frames, brighter than half on shafts. Of two cameras each has a
            folder of its own below it, `right` and `left`.
        sources: frames by side; there are as many masks as frames, and of their size.
        device: where models run.
        labels: class numbers of the shaft in pictures of masks; None: bright is shaft.

    Raises:
        FileError: there is nothing, or neither masks nor a model.
        VideoError: not as many pictures as frames, or of another size.
        ConfigError: a model that cannot be run here.
    """
    if masks is None:
        return {}
    if not isinstance(masks, str | Path):
        return dict.fromkeys(sources, _by_model(masks))
    path = Path(masks)
    if not path.exists():
        raise FileError(where=str(path), expected=_EXPECTED, found="nothing there")
    if path.suffix.lower() in MODEL_SUFFIXES and path.is_file():
        return dict.fromkeys(sources, _by_model(load_segmenter(path, device)))
    if path.is_file() and not (len(sources) == 1 and path.suffix.lower() in IMAGE_SUFFIXES):
        raise FileError(where=str(path), expected=_EXPECTED, found="another kind of file")
    if len(sources) == 1 and not (path / "right").is_dir():
        return {side: _by_pictures(path, source, labels) for side, source in sources.items()}
    missing = [side for side in sources if not (path / side).is_dir()]
    if missing:
        expected = f"a folder of masks for each camera: {' and '.join(sources)}"
        raise FileError(where=str(path), expected=expected, found=f"no folder {missing[0]}")
    return {side: _by_pictures(path / side, source, labels) for side, source in sources.items()}


def _by_model(segment: Segmenter) -> MaskReader:
    return lambda batch: segment(batch.images.to(torch.float32) / 255.0)


def _by_pictures(path: Path, source: FrameSource, labels: tuple[int, ...] | None) -> MaskReader:
    """Masks from pictures, which `open_source` has put into their order."""
    masks = open_source(path)
    if masks.count != source.count:
        expected = f"{source.count} masks, one for each frame of {source.path.name}"
        raise VideoError(where=str(path), expected=expected, found=masks.count)
    if masks.size != source.size:
        expected = f"masks of {source.size[1]} x {source.size[0]} px, as the frames"
        raise VideoError(where=str(path), expected=expected, found=f"{masks.size[1]} x {masks.size[0]}")

    def by_label(batch: FrameBatch) -> Tensor:
        numbers = masks.labels(batch.indices.tolist())
        return torch.isin(numbers, torch.tensor(labels)).to(batch.images.device)

    def by_brightness(batch: FrameBatch) -> Tensor:
        images = masks.frames(batch.indices.tolist())
        _refuse_classes(path, images)
        return (images[:, 0] > 127).to(batch.images.device)

    return by_brightness if labels is None else by_label


def _refuse_classes(path: Path, images: Tensor) -> None:
    """Refuse pictures of masks that hold class numbers or colours: what is bright in them means nothing.

    Raises:
        InputError: names the numbers that were found, and the option that says which are the shaft.
    """
    expected = "masks of 0 and 255 (white on shafts)"
    if int((images.amax(1).int() - images.amin(1).int()).max()) > _COLOURED:
        found = (
            "colours: write one grey or palette picture of class numbers a frame, and name the shaft's by --mask-labels"
        )
        raise InputError(where=str(path), expected=expected, found=found)
    values = images[:, 0].unique().tolist()
    numbers = [value for value in values if 0 < value < 255]
    if numbers and len(numbers) <= _MOST_CLASSES and max(numbers) <= _LARGEST_CLASS:
        named = ", ".join(map(str, values))
        found = f'the numbers {named}: classes? then name those of the shaft by --mask-labels (255 is often "ignore")'
        raise InputError(where=str(path), expected=expected, found=found)
