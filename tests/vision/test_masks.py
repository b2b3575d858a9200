"""Masks of one's own in place of the colour stage."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from drawn_bars import draw_bar, tissue

from rmis_calib.errors import ConfigError, FileError, ShapeError
from rmis_calib.vision import FolderMasks, ShaftDetector, load_segmenter


def true_mask() -> torch.Tensor:
    """Mask of the bar of `draw_bar(25.0)`."""
    return draw_bar(25.0, inside=(255.0, 255.0, 255.0), outside=(0.0, 0.0, 0.0)).batch[:, 0] > 127


def test_a_mask_finds_what_colour_cannot() -> None:
    pale = draw_bar(25.0, inside=(235.0, 232.0, 228.0), outside=(105.0, 62.0, 52.0), noise_levels=1.0)
    assert not ShaftDetector().detect(pale.batch).valid.any()
    found = ShaftDetector().detect(pale.batch, true_mask())
    assert bool(found.valid[0, 0])
    lateral = (found.contour_xy[0, 0].double().numpy() - pale.centre) @ pale.left
    # The mask only says where; the contours come from the picture, to a hundredth of a pixel.
    assert np.abs(np.abs(lateral) - pale.width_px / 2).max() < 0.03


def test_a_callable_replaces_the_colour_stage() -> None:
    seen = []

    def segment(images: torch.Tensor) -> torch.Tensor:
        seen.append((tuple(images.shape), float(images.max())))
        return true_mask()[:, None].float()

    found = ShaftDetector(segment=segment).detect(draw_bar(25.0).batch)
    assert bool(found.valid[0, 0])
    assert seen == [((1, 3, 480, 640), pytest.approx(170 / 255))]


def test_an_empty_mask_silences_the_frame() -> None:
    found = ShaftDetector().detect(draw_bar(25.0).batch, torch.zeros(1, 480, 640, dtype=torch.bool))
    assert not found.valid.any()


def test_masks_of_another_shape_are_refused() -> None:
    with pytest.raises(ShapeError, match="masks"):
        ShaftDetector().detect(draw_bar(25.0).batch, torch.zeros(1, 240, 320))


def test_a_folder_of_masks_is_read_by_frame(tmp_path: Path) -> None:
    for index, level in enumerate((0, 255)):
        cv2.imwrite(str(tmp_path / f"{index:03d}.png"), np.full((4, 6), level, np.uint8))
    masks = FolderMasks(tmp_path).read(torch.tensor([1, 0]))
    assert masks.flatten(1).all(1).tolist() == [True, False]
    with pytest.raises(FileError, match="frame 2"):
        FolderMasks(tmp_path).read(torch.tensor([2]))
    with pytest.raises(FileError, match="mask pictures"):
        FolderMasks(tmp_path / "nothing")


@pytest.mark.filterwarnings(
    "ignore::DeprecationWarning"
)  # torch.jit.script, which the models that people have were made by
def test_a_torchscript_model_is_a_segmenter(tmp_path: Path) -> None:
    class Dark(torch.nn.Module):
        def forward(self, images: torch.Tensor) -> torch.Tensor:
            return (images.mean(1) < 0.3).float()

    torch.jit.script(Dark()).save(str(tmp_path / "dark.pt"))
    found = ShaftDetector(segment=load_segmenter(tmp_path / "dark.pt")).detect(draw_bar(25.0).batch)
    assert bool(found.valid[0, 0])


def test_other_files_are_no_segmenters(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no such file"):
        load_segmenter(tmp_path / "absent.pt")
    (tmp_path / "model.h5").write_bytes(b"")
    with pytest.raises(ConfigError, match="model file"):
        load_segmenter(tmp_path / "model.h5")


def test_tissue_alone_stays_silent_with_its_own_mask() -> None:
    images = torch.from_numpy(tissue()).permute(2, 0, 1)[None]
    blob = torch.zeros(1, 480, 640, dtype=torch.bool)
    blob[0, 200:280, 280:360] = True
    assert not ShaftDetector().detect(images, blob).valid.any()
