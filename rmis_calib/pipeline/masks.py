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

_EXPECTED = "a folder of mask pictures, or a model file ending in .pt, .ts or .onnx"


def open_masks(
    masks: str | Path | Segmenter | None, sources: Mapping[str, FrameSource], device: str
) -> dict[str, MaskReader]:
    """Masks of every camera; none for None.

    Args:
        masks: any callable from pictures (b, 3, h, w) in [0, 1] to masks; or a model, which serves every camera; or a
            folder of pictures in the order of the frames, brighter than half on shafts. Of two cameras each has a
            folder of its own below it, `right` and `left`.
        sources: frames by side; there are as many masks as frames, and of their size.
        device: where models run.

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
        return {side: _by_pictures(path, source) for side, source in sources.items()}
    missing = [side for side in sources if not (path / side).is_dir()]
    if missing:
        expected = f"a folder of masks for each camera: {' and '.join(sources)}"
        raise FileError(where=str(path), expected=expected, found=f"no folder {missing[0]}")
    return {side: _by_pictures(path / side, source) for side, source in sources.items()}


def _by_model(segment: Segmenter) -> MaskReader:
    return lambda batch: segment(batch.images.to(torch.float32) / 255.0)


def _by_pictures(path: Path, source: FrameSource) -> MaskReader:
    """Masks from pictures, which `open_source` has put into their order."""
    masks = open_source(path)
    if masks.count != source.count:
        expected = f"{source.count} masks, one for each frame of {source.path.name}"
        raise VideoError(where=str(path), expected=expected, found=masks.count)
    if masks.size != source.size:
        expected = f"masks of {source.size[1]} x {source.size[0]} px, as the frames"
        raise VideoError(where=str(path), expected=expected, found=f"{masks.size[1]} x {masks.size[0]}")

    def read(batch: FrameBatch) -> Tensor:
        brightest = masks.frames(batch.indices.tolist()).amax(1)
        if int(brightest.max()) == 1:
            raise InputError(where=str(path), expected="masks of 0 and 255 (white on shafts)", found="0 and 1")
        return (brightest > 127).to(batch.images.device)

    return read
