"""A written video is whole, plays at its rate, and shows the pictures that went in."""

from pathlib import Path

import av
import numpy as np
import pytest

from rmis_calib.errors import OutputError, ShapeError
from rmis_calib.io import open_source
from rmis_calib.io.video_writing import OverlayVideo


def ramp(size: tuple[int, int], level: int) -> np.ndarray:
    """A smooth coloured picture: chroma at half resolution loses nothing of it."""
    v, u = np.mgrid[: size[0], : size[1]]
    return np.stack([u * 255 // size[1], v * 255 // size[0], np.full(size, level)], -1).astype(np.uint8)


@pytest.mark.parametrize("size", [(96, 128), (95, 127)])
def test_pictures_come_back(tmp_path: Path, size: tuple[int, int]) -> None:
    pictures = [ramp(size, level) for level in (40, 120, 200)]
    path = tmp_path / "out.mp4"
    with OverlayVideo(path, size, 25.0) as video:
        for picture in pictures:
            video.add(picture)
    source = open_source(path)
    assert source.count == 3
    assert source.size == (96, 128)
    assert source.times_s is not None
    np.testing.assert_allclose(source.times_s, [0.0, 0.04, 0.08], atol=1e-6)
    for read, picture in zip(source.frames(range(3)), pictures, strict=True):
        shown = read.permute(1, 2, 0).numpy()[: size[0], : size[1]]
        assert np.abs(shown.astype(int) - picture).mean() < 3.0
    with av.open(str(path)) as container:
        context = container.streams.video[0].codec_context
        assert (context.name, context.pix_fmt, context.colorspace) == ("h264", "yuv420p", 1)


def test_another_size_is_refused(tmp_path: Path) -> None:
    with OverlayVideo(tmp_path / "out.mp4", (96, 128), 25.0) as video:
        video.add(ramp((96, 128), 0))
        with pytest.raises(ShapeError, match=r"\(96, 128, 3\)"):
            video.add(ramp((64, 64), 0))


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(OutputError, match="out.mp4: expected a place"),
        OverlayVideo(tmp_path / "file" / "out.mp4", (96, 128), 25.0) as video,
    ):
        video.add(ramp((96, 128), 0))
