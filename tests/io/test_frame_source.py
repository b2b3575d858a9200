"""Frame sources: exact counts and times, bounded background decoding, and every kind of broken file."""

import threading
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from recording_files import FPS, FRAMES, HEIGHT, WIDTH, frame_image, frame_number, truncate, write_images, write_video

from rmis_calib.errors import FileError, InputError, VideoError
from rmis_calib.io.video import open_source

CONTAINERS = [
    ("v.mp4", "libx264", {}),
    ("v.mp4", "mpeg4", {}),
    ("v.mp4", "libx264", {"movflags": "frag_keyframe+empty_moov"}),
    ("v.mkv", "libx264", {}),
    ("v.mkv", "libx264", {"live": "1"}),  # no index, and a segment of unknown size
    ("v.mov", "mjpeg", {}),
    ("v.avi", "mpeg4", {}),
    ("v.avi", "mjpeg", {}),
    ("v.ts", "libx264", {}),
    ("v.h264", "libx264", {}),
    ("v.webm", "libvpx", {}),
    ("v.webm", "libvpx-vp9", {}),
]


def decoder_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("rmis-decode")]


@pytest.mark.parametrize(("name", "codec", "options"), CONTAINERS)
def test_every_container_gives_every_frame_once_in_order(tmp_path: Path, name: str, codec: str, options: dict) -> None:
    source = open_source(write_video(tmp_path / name, codec=codec, container_options=options))
    assert (source.count, source.size) == (FRAMES, (HEIGHT, WIDTH))
    batches = list(source.batches(5))
    assert [len(batch.images) for batch in batches] == [5, 5, 2]
    assert torch.equal(torch.cat([batch.indices for batch in batches]), torch.arange(FRAMES))
    images = torch.cat([batch.images for batch in batches])
    assert images.shape == (FRAMES, 3, HEIGHT, WIDTH) and images.dtype == torch.uint8
    assert [frame_number(image.numpy()) for image in images] == list(range(FRAMES))
    assert source.times_s is not None
    # Raw H.264 has no time stamps and FFmpeg assumes 25 fps; Matroska rounds to 1 ms.
    np.testing.assert_allclose(source.times_s, np.arange(FRAMES) / FPS, atol=1e-3)


@pytest.mark.parametrize("kind", ["video", "images"])
def test_every_third_frame(tmp_path: Path, kind: str) -> None:
    path = write_video(tmp_path / "v.mp4") if kind == "video" else write_images(tmp_path / "images", FRAMES)
    source = open_source(path)
    batches = list(source.batches(3, every=3))
    assert [batch.indices.tolist() for batch in batches] == [[0, 3, 6], [9]]
    assert torch.equal(torch.cat([batch.images for batch in batches]), source.frames([0, 3, 6, 9]))
    with pytest.raises(InputError, match="every: expected at least 1, found 0"):
        source.batches(3, every=0)


@pytest.mark.parametrize(("name", "codec", "options"), CONTAINERS)
def test_random_access_equals_sequential(tmp_path: Path, name: str, codec: str, options: dict) -> None:
    source = open_source(write_video(tmp_path / name, codec=codec, container_options=options))
    everything = torch.cat([batch.images for batch in source.batches(4)])
    for order in ([11, 0, 5, 5, 3], [4], [0, 1, 2], [6, 10]):
        assert torch.equal(source.frames(order), everything[order])
    assert torch.equal(source.frame(7), everything[7])


def test_colours_are_rgb(tmp_path: Path) -> None:
    image = open_source(write_images(tmp_path / "images")).frame(3)
    assert torch.equal(image, torch.from_numpy(frame_image(3)).permute(2, 0, 1))
    red, _, blue = open_source(write_video(tmp_path / "v.mp4")).frame(0)[:, 4, 40].tolist()
    assert red > blue + 50


def test_variable_frame_rate_keeps_its_time_stamps(tmp_path: Path) -> None:
    pts = [3, 4, 5, 9, 10, 14, 15, 16, 17, 30, 31, 40]
    source = open_source(write_video(tmp_path / "v.mp4", pts=pts))
    np.testing.assert_allclose(source.times_s, (np.array(pts) - 3) / FPS, atol=1e-9)
    assert frame_number(source.frame(9).numpy()) == 9


def test_image_kinds_and_orientation(tmp_path: Path) -> None:
    for suffix in (".png", ".jpg", ".bmp", ".tif"):
        source = open_source(write_images(tmp_path / suffix[1:], suffix=suffix))
        assert source.count == FRAMES and source.times_s is None
        assert [frame_number(image.numpy()) for image in source.frames(range(FRAMES))] == list(range(FRAMES))
    single = open_source(tmp_path / "png" / "0004.png")
    assert single.count == 1 and frame_number(single.frame(0).numpy()) == 4


def test_stopping_early_ends_the_thread(tmp_path: Path) -> None:
    source = open_source(write_video(tmp_path / "v.mp4"))
    batches = iter(source.batches(2))
    next(batches)
    assert decoder_threads()
    batches.close()
    assert not decoder_threads()
    for _ in source.batches(1):
        break
    assert not decoder_threads()


def test_decoding_stays_three_batches_ahead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_source(write_images(tmp_path / "images"))
    reader, read = source._reader, []
    decode = reader._decode
    monkeypatch.setattr(reader, "_decode", lambda path: read.append(path) or decode(path))
    batches = iter(source.batches(2))
    for consumed in range(1, 4):
        next(batches)
        # The executor's own queue runs dry before the count is taken.
        reader_idle = threading.Event()
        reader_idle.wait(0.2)
        assert len(read) <= 2 * (consumed + 2)
    batches.close()


def test_errors_reach_the_consumer_in_their_place(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "images", suffix=".jpg")
    truncate(folder / "0007.jpg", 0.7)
    batches = iter(open_source(folder).batches(2))
    assert [next(batches).indices[0].item() for _ in range(3)] == [0, 2, 4]
    with pytest.raises(VideoError, match=r"0007\.jpg.*truncated"):
        next(batches)
    assert not decoder_threads()


def inside_a_box(path: Path, fraction: float) -> float:
    """A fraction near the given one at which an MP4 file is cut inside one of its boxes.

    Where the encoder puts the fragments depends on the processor. A cut between two of them leaves a whole, shorter
    file: no container of this kind says how many fragments there were.
    """
    data, position = path.read_bytes(), 0
    while position < len(data):
        size = int.from_bytes(data[position : position + 4])
        if position + size > fraction * len(data):
            return (position + max(size // 2, 1)) / len(data)
        position += size
    raise AssertionError("no box there")


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [
        ("v.mp4", "libx264", {}),
        ("v.mp4", "libx264", {"movflags": "faststart"}),
        ("v.mp4", "libx264", {"movflags": "frag_keyframe+empty_moov"}),
        ("v.mkv", "libx264", {}),
        ("v.avi", "mjpeg", {}),
        ("v.avi", "mpeg4", {}),
        ("v.webm", "libvpx", {}),
    ],
)
@pytest.mark.parametrize("fraction", [0.95, 0.9, 0.75, 0.6, 0.3, 0.01])
def test_truncated_video(tmp_path: Path, name: str, codec: str, options: dict, fraction: float) -> None:
    path = write_video(tmp_path / name, 25, codec, container_options=options)
    truncate(path, inside_a_box(path, fraction) if "frag_keyframe" in options.get("movflags", "") else fraction)
    with pytest.raises(VideoError) as caught:
        list(open_source(path).batches(4))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_truncation_names_both_counts(tmp_path: Path) -> None:
    path = truncate(write_video(tmp_path / "v.mp4", 25, container_options={"movflags": "faststart"}), 0.8)
    with pytest.raises(VideoError, match=r"expected 25 frames, found \d+ frames"):
        open_source(path)


def test_fewer_decoded_than_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_source(write_video(tmp_path / "v.mp4"))
    monkeypatch.setattr(source._reader, "count", FRAMES + 1)
    with pytest.raises(VideoError, match=r"expected 13 frames, found 12 frames"):
        list(source.batches(4))


def test_damage_inside_a_video(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", 25, "mpeg4")
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 200
    data[start : start + 3000] = b"\x00" * 3000
    path.write_bytes(bytes(data))
    with pytest.raises(VideoError):
        list(open_source(path).batches(4))


@pytest.mark.parametrize("content", [b"", b"not a video at all " * 100, b"\x00" * 5000])
@pytest.mark.parametrize("name", ["v.mp4", "v.mkv", "v.png", "v.jpg"])
def test_zero_bytes_and_rubbish(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(VideoError, match="0 bytes" if not content else "expected"):
        open_source(path)


def test_audio_only(tmp_path: Path) -> None:
    path = tmp_path / "a.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    with pytest.raises(VideoError, match="expected one video stream, found 0"):
        open_source(path)


def test_missing_file_and_wrong_frame_number(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"nope\.mp4: expected a video or a folder of images, found nothing"):
        open_source(tmp_path / "nope.mp4")
    source = open_source(write_images(tmp_path / "images", 3))
    with pytest.raises(InputError, match="expected a frame of 0 to 2, found 3"):
        source.frame(3)
    with pytest.raises(InputError, match="batch_size: expected at least 1, found 0"):
        source.batches(0)
    assert source.frames([]).shape == (0, 3, HEIGHT, WIDTH)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".tif"])
@pytest.mark.parametrize("fraction", [0.999, 0.7, 0.3])
def test_truncated_images(tmp_path: Path, suffix: str, fraction: float) -> None:
    folder = write_images(tmp_path / "images", 2, suffix)
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    assert cv2.imwrite(str(folder / f"0001{suffix}"), noise)
    truncate(folder / f"0001{suffix}", fraction)
    with pytest.raises(VideoError, match=rf"0001\{suffix}"):
        open_source(folder).frame(1)


def test_jpeg_thumbnail_does_not_hide_a_truncation(tmp_path: Path) -> None:
    path = write_images(tmp_path / "images", 1, ".jpg") / "0000.jpg"
    data = path.read_bytes()
    thumbnail = b"\xff\xd8 a small picture \xff\xd9"
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2) + thumbnail
    path.write_bytes(data[:2] + segment + data[2:])
    assert open_source(path).count == 1
    path.write_bytes(data[:2] + segment + data[2:-40])
    with pytest.raises(VideoError, match="truncated"):
        open_source(path)


def test_image_folders_that_are_refused(tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(VideoError, match="expected a folder of images, found an empty one"):
        open_source(empty)
    folder = write_images(tmp_path / "images", 3)
    (folder / ".hidden").write_text("ignored")
    (folder / "notes.txt").write_text("x")
    with pytest.raises(VideoError, match=r"found notes\.txt"):
        open_source(folder)
    (folder / "notes.txt").unlink()
    assert cv2.imwrite(str(folder / "0002.png"), np.zeros((HEIGHT, WIDTH + 2, 3), np.uint8))
    with pytest.raises(VideoError, match=r"0002\.png: expected 96 x 64 px as in 0000\.png, found 98 x 64"):
        open_source(folder).frame(2)


def test_names_that_sort_in_two_ways(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for number in (1, 2, 10):
        assert cv2.imwrite(str(folder / f"f{number}.png"), frame_image(number))
    with pytest.raises(VideoError, match="pad the numbers with zeros"):
        open_source(folder)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_batches_on_cuda(tmp_path: Path) -> None:
    source = open_source(write_video(tmp_path / "v.mp4"))
    for batch in source.batches(5, "cuda"):
        assert batch.images.is_cuda
        assert torch.equal(batch.images.cpu(), source.frames(batch.indices.tolist()))
