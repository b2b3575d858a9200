"""Videos and pictures as cameras and grabbers write them: turned, deep, with cover art, wrong stamps or headers."""

import shutil
import struct
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from recording_files import FPS, FRAMES, HEIGHT, WIDTH, frame_image, frame_number, write_images, write_video

from rmis_calib.errors import VideoError
from rmis_calib.io.readers import open_reader
from rmis_calib.io.video import open_source

TURNS = {  # of the display matrix (a, b; c, d): how many quarter turns anticlockwise a picture is shown turned
    90: ((0, 1), (-1, 0), 3),
    180: ((-1, 0), (0, -1), 2),
    270: ((0, -1), (1, 0), 1),
}


def with_display_matrix(path: Path, rows: tuple[tuple[int, int], tuple[int, int]]) -> Path:
    """The MP4 file with another matrix in its track header (ISO 14496-12, 8.3.2)."""
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 4 + 20 + 8 + 8
    (a, b), (c, d) = rows
    for i, value in enumerate((a, b, 0, c, d, 0)):
        struct.pack_into(">i", data, matrix + 4 * i, value << 16)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("angle", sorted(TURNS))
def test_a_display_matrix_turns_the_pictures(tmp_path: Path, angle: int) -> None:
    plain = open_source(write_video(tmp_path / "plain.mp4"))
    *rows, quarter = TURNS[angle]
    copy = Path(shutil.copy(tmp_path / "plain.mp4", tmp_path / "turned.mp4"))  # coding it again may differ
    source = open_source(with_display_matrix(copy, tuple(rows)))
    assert source.size == ((HEIGHT, WIDTH) if quarter == 2 else (WIDTH, HEIGHT))
    for index in (0, 7):
        expected = np.rot90(plain.frame(index).permute(1, 2, 0).numpy(), quarter)
        np.testing.assert_array_equal(source.frame(index).permute(1, 2, 0).numpy(), expected)
    assert len(list(source.batches(5))) == 3
    assert any(f"turned by {90 * quarter} deg" in note for note in open_reader(tmp_path / "turned.mp4").notes)


def test_a_mirrored_video_is_refused(tmp_path: Path) -> None:
    path = with_display_matrix(write_video(tmp_path / "mirrored.mp4"), ((-1, 0), (0, 1)))
    with pytest.raises(VideoError, match="mirrored"):
        open_source(path)


def test_cover_art_is_no_camera(tmp_path: Path) -> None:
    plain = write_video(tmp_path / "plain.mp4")
    path = tmp_path / "cover.mp4"
    with av.open(str(path), "w") as container, av.open(str(plain)) as source:
        video = container.add_stream_from_template(source.streams.video[0])
        cover = container.add_stream("png", rate=1)
        cover.width, cover.height, cover.pix_fmt = 32, 32, "rgb24"
        cover.disposition = av.stream.Disposition.attached_pic
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = video
                container.mux(packet)
        picture = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24")
        container.mux([*cover.encode(picture), *cover.encode()])
    with av.open(str(path)) as container:
        assert len(container.streams.video) == 2
    assert open_source(path).count == FRAMES


def video_with_stamps(path: Path, stamps: list[int]) -> Path:
    """Intra-coded pictures with these time stamps, in units of 1 / FPS, written as they are."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuvj420p"
        packets = []
        for number in range(len(stamps)):
            packets += stream.encode(av.VideoFrame.from_ndarray(frame_image(number), format="rgb24"))
        packets += stream.encode()
        for number, (packet, stamp) in enumerate(zip(packets, stamps, strict=True)):
            packet.pts, packet.dts = stamp, number
            container.mux(packet)
    return path


def test_one_repeated_stamp_costs_one_frame_its_own_time(tmp_path: Path) -> None:
    stamps = [0, 1, 2, 5, 5, 7, 8, 9, 12, 13, 14, 15]  # frame 4 repeats frame 3
    path = video_with_stamps(tmp_path / "v.mkv", stamps)
    with av.open(str(path)) as container:  # the container keeps what was written
        assert len({packet.pts for packet in container.demux(video=0) if packet.size}) == len(stamps) - 1
    source = open_source(path)
    expected = np.array([0, 1, 2, 5, 6, 7, 8, 9, 12, 13, 14, 15]) / FPS
    np.testing.assert_allclose(source.times_s, expected, atol=2e-3)  # Matroska rounds to milliseconds
    assert any("frame 4: interpolated" in note for note in open_reader(path).notes)
    assert [frame_number(source.frame(index).numpy()) for index in (0, 3, 4, 11)] == [0, 3, 4, 11]


def test_a_header_that_promises_more_than_frame_times_list(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.avi", 20, "mjpeg")
    data = bytearray(path.read_bytes())
    for tag, offset in ((b"avih", 8 + 16), (b"strh", 8 + 32)):  # frames in the main and in the stream header
        struct.pack_into("<I", data, data.index(tag) + offset, 25)
    path.write_bytes(data)
    with av.open(str(path)) as container:
        if container.streams.video[0].frames != 25:
            pytest.skip("this FFmpeg counts by itself")
    with pytest.raises(VideoError, match="expected 25 frames, found 20"):
        open_reader(path)
    reader = open_reader(path, expected_count=20)
    assert reader.count == 20 and any("promises 25 frames" in note for note in reader.notes)


def ramp(bits: int) -> np.ndarray:
    return np.linspace(0, (1 << bits) - 1, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype(np.uint16)


@pytest.mark.parametrize("bits", [10, 12, 16])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_deep_grey_pictures_keep_their_range(tmp_path: Path, bits: int, suffix: str) -> None:
    folder = tmp_path / "deep"
    folder.mkdir()
    for number in range(3):
        assert cv2.imwrite(str(folder / f"{number}{suffix}"), ramp(bits))
    source = open_source(folder)
    image = source.frame(1).numpy()
    expected = (ramp(bits) >> (bits - 8)).astype(np.uint8)
    np.testing.assert_array_equal(image, np.stack([expected] * 3))
    assert any(f"read as {bits} bits" in note for note in open_reader(folder).notes) == (bits < 16)
    # Counter-literal: the usual conversion drops eight bits, and a picture of 10 bits is then black.
    assert image.max() == 255


def test_a_picture_deeper_than_the_others_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "deep"
    folder.mkdir()
    for number in range(40):
        values = ramp(16 if number == 21 else 12)
        assert cv2.imwrite(str(folder / f"{number:02d}.png"), values)
    with pytest.raises(VideoError, match=r"21\.png: expected values up to 4095 \(12 bits\)"):
        list(open_source(folder).batches(8))


def test_transparency_and_palettes(tmp_path: Path) -> None:
    folder = tmp_path / "rgba"
    folder.mkdir()
    opaque = np.dstack([frame_image(3)[..., ::-1], np.full((HEIGHT, WIDTH), 7, np.uint8)])
    assert cv2.imwrite(str(folder / "0.png"), opaque)
    np.testing.assert_array_equal(open_source(folder).frame(0).permute(1, 2, 0).numpy(), frame_image(3))
    matplotlib_image = pytest.importorskip("PIL.Image")
    picture = matplotlib_image.fromarray(frame_image(3)).quantize(64)
    picture.save(tmp_path / "palette.png")
    read = open_source(tmp_path / "palette.png").frame(0).permute(1, 2, 0).numpy()
    np.testing.assert_array_equal(read, np.asarray(picture.convert("RGB")))


@pytest.mark.parametrize(("codec", "pixels"), [("libx264", "yuv420p10le"), ("ffv1", "gray12le")])
def test_deep_videos_keep_their_range(tmp_path: Path, codec: str, pixels: str) -> None:
    path = tmp_path / "deep.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixels
        for number in range(4):
            frame = av.VideoFrame.from_ndarray(frame_image(number), format="rgb24").reformat(format=pixels)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    source = open_source(path)
    assert [frame_number(image.numpy()) for image in source.frames(range(4))] == [0, 1, 2, 3]


def test_sixteen_bit_video_of_twelve_bits(tmp_path: Path) -> None:
    path = tmp_path / "deep.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray16le"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(ramp(12), format="gray16le")))
        container.mux(stream.encode())
    reader = open_reader(path)
    assert any("read as 12 bits" in note for note in reader.notes)
    np.testing.assert_array_equal(next(reader.read_all())[..., 0], (ramp(12) >> 4).astype(np.uint8))


def test_plain_files_need_no_note(tmp_path: Path) -> None:
    assert open_reader(write_video(tmp_path / "v.mp4")).notes == ()
    assert open_reader(write_images(tmp_path / "images")).notes == ()
