"""Masks of one's own in place of the colour stage."""

import base64
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from drawn_bars import draw_bar, tissue

from rmis_calib.errors import ConfigError, FileError, InputError, ShapeError
from rmis_calib.vision import ShaftDetector, load_segmenter


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


DARK_ONNX = base64.b64decode(
    "CAg6wgEKNAoGaW1hZ2VzEgFtIglSZWR1Y2VNYXgqCwoEYXhlc0ABoAEHKg8KCGtlZXBkaW1zGAGgAQIKDwoBbQoBdBIBYiIETGVzcwobCgFiEgVt"
    "YXNrcyIEQ2FzdCoJCgJ0bxgBoAECEgRkYXJrKg0IARABIgSamZk+QgF0WiMKBmltYWdlcxIZChcIARITCgMSAWIKAggDCgMSAWgKAxIBd2IiCgVt"
    "YXNrcxIZChcIARITCgMSAWIKAggBCgMSAWgKAxIBd0IECgAQDQ=="
)
"""images (b, 3, h, w) -> masks (b, 1, h, w): 1 where the largest colour is below 0.3."""
DARK_ONNX_ONE_BY_ONE = base64.b64decode(
    "CAg6wAEKNAoGaW1hZ2VzEgFtIglSZWR1Y2VNYXgqCwoEYXhlc0ABoAEHKg8KCGtlZXBkaW1zGAGgAQIKDwoBbQoBdBIBYiIETGVzcwobCgFiEgVt"
    "YXNrcyIEQ2FzdCoJCgJ0bxgBoAECEgRkYXJrKg0IARABIgSamZk+QgF0WiIKBmltYWdlcxIYChYIARISCgIIAQoCCAMKAxIBaAoDEgF3YiEKBW1h"
    "c2tzEhgKFggBEhIKAggBCgIIAQoDEgFoCgMSAXdCBAoAEA0="
)
"""The same for a batch of exactly one."""


class Dark(torch.nn.Module):
    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return (images.mean(1) < 0.3).float()


class Halved(torch.nn.Module):
    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images[:, 0, ::2, ::2]


class OneChannel(torch.nn.Module):
    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.view(images.shape[0], 1, images.shape[2], images.shape[3])


def save_model(model: torch.nn.Module, path: Path) -> Path:
    with warnings.catch_warnings():  # torch.jit.script is deprecated; the models that people have were made by it
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.script(model).save(str(path))
    return path


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_torchscript_model_is_a_segmenter(tmp_path: Path) -> None:
    segment = load_segmenter(save_model(Dark(), tmp_path / "dark.pt"))
    found = ShaftDetector(segment=segment).detect(draw_bar(25.0).batch)
    assert bool(found.valid[0, 0])


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_model_that_does_not_fit_is_named(tmp_path: Path) -> None:
    images = draw_bar(25.0).batch
    with pytest.raises(ShapeError, match=r"masks: expected shape \(1, 480, 640\).*found \(1, 240, 320\)"):
        ShaftDetector(segment=load_segmenter(save_model(Halved(), tmp_path / "half.pt"))).detect(images)
    with pytest.raises(InputError, match=r"one.pt: expected a model that takes pictures of shape \(1, 3, 480, 640\)"):
        ShaftDetector(segment=load_segmenter(save_model(OneChannel(), tmp_path / "one.pt"))).detect(images)
    with pytest.raises(ShapeError, match="expected one tensor .* found tuple"):
        ShaftDetector(segment=lambda images: (images, images)).detect(images)  # pyright: ignore[reportArgumentType]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_other_files_are_no_segmenters(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no such file"):
        load_segmenter(tmp_path / "absent.pt")
    (tmp_path / "model.h5").write_bytes(b"")
    with pytest.raises(ConfigError, match="model file"):
        load_segmenter(tmp_path / "model.h5")
    torch.save(Dark(), tmp_path / "pickled.pt")
    with pytest.raises(FileError, match=r"pickled.pt: expected a TorchScript model"):
        load_segmenter(tmp_path / "pickled.pt")


def test_onnx_needs_its_runtime_and_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dark.onnx").write_bytes(DARK_ONNX)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigError, match="pip install onnxruntime"):
        load_segmenter(tmp_path / "dark.onnx")


@pytest.mark.parametrize("content", [DARK_ONNX, DARK_ONNX_ONE_BY_ONE])
def test_an_onnx_model_is_a_segmenter(content: bytes, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="onnxruntime, an optional package, is absent")
    (tmp_path / "dark.onnx").write_bytes(content)
    segment = load_segmenter(tmp_path / "dark.onnx")
    images = torch.cat([draw_bar(25.0).batch, draw_bar(-40.0).batch])
    assert ShaftDetector(segment=segment).detect(images).valid.any(-1).all()
    with pytest.raises(InputError, match=r"takes pictures of shape \(1, 1, 480, 640\)"):
        segment(torch.zeros(1, 1, 480, 640))
    (tmp_path / "cut.onnx").write_bytes(content[:100])
    with pytest.raises(FileError, match="cut.onnx: expected an ONNX model"):
        load_segmenter(tmp_path / "cut.onnx")


def test_tissue_alone_stays_silent_with_its_own_mask() -> None:
    images = torch.from_numpy(tissue()).permute(2, 0, 1)[None]
    blob = torch.zeros(1, 480, 640, dtype=torch.bool)
    blob[0, 200:280, 280:360] = True
    assert not ShaftDetector().detect(images, blob).valid.any()
