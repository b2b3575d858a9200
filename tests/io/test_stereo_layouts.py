"""Both eyes in one file, cropped pictures, and pictures of another size than the calibration's."""

from pathlib import Path

import av
import numpy as np
import pytest
from breaking import REMOVE, edit
from recording_files import FPS, FRAMES, HEIGHT, WIDTH, RecordingFolder, frame_image

from rmis_calib.errors import RecordingError, VideoError
from rmis_calib.io.recording import load_recording


def eyes(number: int) -> dict[str, np.ndarray]:
    """Two eyes that differ: the left one is the right one turned by half a turn."""
    right = frame_image(number)
    return {"right": right, "left": np.ascontiguousarray(right[::-1, ::-1])}


def write_pictures(folder: Path, compose) -> None:
    """A lossless video `both.mkv` of composed eyes."""
    with av.open(str(folder / "both.mkv"), "w") as container:
        first = compose(**eyes(0))
        stream = container.add_stream("ffv1", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = first.shape[1], first.shape[0], "bgr0"
        for number in range(FRAMES):
            frame = av.VideoFrame.from_ndarray(compose(**eyes(number)), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


LAYOUTS = {
    ("side_by_side", False): lambda left, right: np.hstack([left, right]),
    ("side_by_side", True): lambda left, right: np.hstack([right, left]),
    ("top_bottom", False): lambda left, right: np.vstack([left, right]),
    ("top_bottom", True): lambda left, right: np.vstack([right, left]),
}


@pytest.mark.parametrize("layout", sorted(LAYOUTS))
def test_two_eyes_in_one_file(folder: RecordingFolder, layout: tuple[str, bool]) -> None:
    write_pictures(folder.path, LAYOUTS[layout])
    edit("recording.yaml", right="both.mkv", left=REMOVE, stereo_layout=layout[0], swapped=layout[1])(folder)
    recording = load_recording(folder.path)
    assert recording.left is not None and recording.n_frames == FRAMES
    for number in (0, 9):
        for side, source in (("right", recording.right), ("left", recording.left)):
            np.testing.assert_array_equal(source.frame(number).permute(1, 2, 0).numpy(), eyes(number)[side])
    batch = next(recording.left.batches(4))
    assert batch.images.shape == (4, 3, HEIGHT, WIDTH)


@pytest.mark.parametrize("layout", ["side_by_side", "top_bottom"])
def test_a_double_picture_is_recognised(folder: RecordingFolder, layout: str) -> None:
    write_pictures(folder.path, LAYOUTS[layout, False])
    edit("recording.yaml", right="both.mkv", left="both.mkv")(folder)
    with pytest.raises(RecordingError, match="stereo_layout: side_by_side or top_bottom"):
        load_recording(folder.path)
    (folder.path / "copy.mkv").write_bytes((folder.path / "both.mkv").read_bytes())
    edit("recording.yaml", left="copy.mkv")(folder)
    with pytest.raises(VideoError, match=f"then write stereo_layout: {layout} in recording.yaml, and no left"):
        load_recording(folder.path)


def test_keys_that_do_not_go_together(folder: RecordingFolder) -> None:
    edit("recording.yaml", stereo_layout="side_by_side")(folder)
    with pytest.raises(RecordingError, match="expected no left beside stereo_layout"):
        load_recording(folder.path)
    edit("recording.yaml", stereo_layout=REMOVE, swapped=True)(folder)
    with pytest.raises(RecordingError, match="expected stereo_layout beside swapped"):
        load_recording(folder.path)


def test_a_crop_moves_the_principal_point(folder: RecordingFolder) -> None:
    plain = load_recording(folder.path).stereo
    edit("stereo.yaml", image_size=[WIDTH + 40, HEIGHT + 30])(folder)
    with pytest.raises(VideoError, match=rf"a part of it\? then write crop_right: \[u, v, {WIDTH}, {HEIGHT}\]"):
        load_recording(folder.path)
    edit("recording.yaml", crop_right=[12, 7, WIDTH, HEIGHT], crop_left=[20, 0, WIDTH, HEIGHT])(folder)
    rig = load_recording(folder.path).stereo
    assert rig.left is not None and plain.left is not None
    # A point that the whole picture shows at (u, v) is at (u - 12, v - 7) in the cropped one.
    assert (float(plain.right.cx - rig.right.cx), float(plain.right.cy - rig.right.cy)) == (12.0, 7.0)
    assert (float(plain.left.cx - rig.left.cx), float(plain.left.cy - rig.left.cy)) == (20.0, 0.0)
    assert float(rig.right.fx) == float(plain.right.fx) and rig.right.image_size == (HEIGHT, WIDTH)


def test_a_crop_beyond_the_calibrated_picture_is_refused(folder: RecordingFolder) -> None:
    edit("recording.yaml", crop_right=[1, 0, WIDTH, HEIGHT])(folder)
    with pytest.raises(RecordingError, match=r"crop_right: expected a part of the calibrated picture \(96 x 64 px\)"):
        load_recording(folder.path)


@pytest.mark.parametrize(("factor", "named"), [(2, "0.5"), (3, "0.333333")])
def test_a_calibration_of_a_larger_picture_is_offered_scaled(folder: RecordingFolder, factor: int, named: str) -> None:
    cx = (47.5 + 0.5) * factor - 0.5
    edit("stereo.yaml", image_size=[factor * WIDTH, factor * HEIGHT])(folder)
    edit("stereo.yaml", right__fx=90.0 * factor, right__fy=91.0 * factor, right__cx=cx)(folder)
    with pytest.raises(VideoError) as caught:
        load_recording(folder.path)
    text = str(caught.value)
    assert f"the same shape at {named} times the size" in text
    assert f"image_size: [{WIDTH}, {HEIGHT}] and, for right, fx: 90, fy: 91, cx: 47.5" in text
