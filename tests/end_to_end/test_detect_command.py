"""`rmis-calib detect`: lines, overlays, videos, sheets of the stages; masks of one's own, for `calibrate` too."""

import csv
import shutil
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from rmis_calib.cli import main
from rmis_calib.io import load_recording, open_source
from rmis_calib.pipeline import detect

SIDES = ("right", "left")


@pytest.fixture(scope="session")
def true_masks(rendered_pairs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Masks of the shafts of that recording, drawn from its truth."""
    folder = tmp_path_factory.mktemp("masks")
    truth = np.load(rendered_pairs / "truth.npz")
    for side in SIDES:
        (folder / side).mkdir()
        for frame, uv in enumerate(truth[f"{side}_contour_uv"]):
            mask = np.zeros((480, 640), np.uint8)
            outline = np.concatenate([uv[0], uv[1, ::-1]])
            cv2.fillPoly(mask, [np.round(outline).astype(np.int32)], 255)
            cv2.imwrite(str(folder / side / f"{frame:04d}.png"), mask)
    return folder


def test_overlay_videos_show_every_frame(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["detect", str(recording), "--out", str(out), "--overlay-video", "--overlays", "1"]) == 0
    originals = load_recording(recording)
    for side, original in zip(SIDES, (originals.right, originals.left), strict=True):
        video = open_source(out / f"overlay_{side}.mp4")
        assert (video.count, video.size) == (4, (480, 640))
        np.testing.assert_allclose(np.diff(video.times_s), 0.5, atol=1e-3)  # stops of the recording are 0.5 s apart
        assert original is not None
        changed = (video.frame(3).int() - original.frame(3).int()).abs().amax(0) > 60
        assert 0.001 < changed.float().mean() < 0.1
    assert sorted(p.name for p in (out / "overlays").iterdir()) == ["left_000000.jpg", "right_000000.jpg"]
    assert not (out / "debug").exists()


def test_lines_say_what_every_shaft_ends_at(recording: Path, tmp_path: Path) -> None:
    """Rendered shafts end at a metal wrist, in view of both cameras."""
    assert main(["detect", str(recording), "--out", str(tmp_path / "out"), "--overlays", "0"]) == 0
    with (tmp_path / "out" / "lines.csv").open(newline="") as file:
        found = [row for row in csv.DictReader(file) if row["found"] == "1" and row["candidate"] == "0"]
    assert len(found) == 8
    assert {row["end_kind"] for row in found} == {"tube"}
    assert all(0.5 < float(row["end_sureness"]) <= 1.0 for row in found)


def test_sheets_of_stages(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    frames = load_recording(recording).right.frames(range(4)).permute(0, 2, 3, 1).numpy()
    frames[[1, 3]] = 120  # nothing to see
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{i}.png"), np.ascontiguousarray(frame[..., ::-1]))

    def drawn(*flags: str) -> list[str]:
        out = tmp_path / "out"
        assert main(["detect", str(folder), "--out", str(out), "--overwrite", "--debug", *flags]) == 0
        return sorted(p.name for p in (out / "debug").iterdir())

    assert drawn() == [f"right_00000{i}.jpg" for i in range(4)]
    assert drawn("--debug-frames", "3") == ["right_000001.jpg", "right_000003.jpg"]
    capsys.readouterr()
    assert drawn("--debug-frames", "1", "--batch-size", "1") == ["right_000001.jpg"]
    assert "1 sheets; 2 frames without a shaft; --debug-frames -1 draws every frame" in capsys.readouterr().out
    assert len(drawn("--debug-frames", "-1")) == 4
    sheet = cv2.imread(str(tmp_path / "out" / "debug" / "right_000001.jpg"))
    assert sheet.shape[1] == 12 + 5 * (480 + 12)
    amber = (np.abs(sheet.astype(int) - [0, 176, 255]) < 40).all(-1)
    assert amber.sum() > 1000  # the frame about the stage that failed


def test_a_failing_detection_leaves_nothing(recording: Path, tmp_path: Path) -> None:
    video = recording / "right.mp4"
    video.write_bytes(video.read_bytes()[:-2000])
    assert main(["detect", str(recording), "--out", str(tmp_path / "out"), "--overlay-video"]) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["recording"]


def test_masks_of_pictures_lead_to_the_same_lines(recording: Path, true_masks: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["detect", str(recording), "--out", str(out), "--masks", str(true_masks), "--overlays", "0"]) == 0
    with np.load(out / "lines.npz") as lines, np.load(recording / "truth.npz") as truth:
        for side in SIDES:
            assert lines[f"valid_{side}"][:, 0].all()
            middle = lines[f"axis_xy_{side}"][:, 0].mean(1)
            normal = truth[f"{side}_n_axis"] / np.linalg.norm(truth[f"{side}_n_axis"][:, :2], axis=1, keepdims=True)
            distance = (middle * normal[:, :2]).sum(-1) + normal[:, 2]
            assert np.abs(distance).max() * 700 < 0.3  # px


def test_masks_serve_a_calibration(recording: Path, true_masks: Path, tmp_path: Path) -> None:
    """Four motions are too few for an answer; the masks were read all the same, and black ones silence the pictures."""
    black = shutil.copytree(true_masks, tmp_path / "black")
    for path in black.glob("*/*.png"):
        cv2.imwrite(str(path), np.zeros((480, 640), np.uint8))
    for masks, usable in ((true_masks, 4), (black, 0)):
        out = tmp_path / f"out{usable}"
        assert main(["calibrate", str(recording), "--out", str(out), "--masks", str(masks), "--overlays", "0"]) == 1
        assert f"{usable} of 4 motions are usable" in (out / "result.json").read_text()


@pytest.mark.parametrize("kind", ["grey", "sixteen bits", "palette"])
def test_class_numbers_serve_as_masks(recording: Path, true_masks: Path, tmp_path: Path, kind: str) -> None:
    """Shaft 2, wrist 1 below it, 255 to be ignored: the same lines as from black and white masks."""
    folder = Path(shutil.copytree(true_masks, tmp_path / "classes"))
    for path in folder.glob("*/*.png"):
        numbers = np.where(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 127, 2, 0).astype(np.uint8)
        numbers[-40:, -40:], numbers[:20, :20] = 1, 255
        if kind == "palette":
            picture = Image.fromarray(numbers, "P")
            picture.putpalette([10, 200, 30, 250, 250, 250, 0, 0, 0] + [128] * 759)  # the shaft is black, as it happens
            picture.save(path)
        else:
            cv2.imwrite(str(path), numbers.astype(np.uint16 if kind == "sixteen bits" else np.uint8))
    out = {}
    for name, masks, labels in (("white", true_masks, []), ("classes", folder, ["--mask-labels", "2"])):
        argv = ["detect", str(recording), "--out", str(tmp_path / f"by_{name}"), "--masks", str(masks)]
        assert main([*argv, *labels, "--overlays", "0"]) == 0
        with np.load(tmp_path / f"by_{name}" / "lines.npz") as lines:
            out[name] = lines["contour_xy_right"]
    np.testing.assert_array_equal(out["white"], out["classes"])


class Dark(torch.nn.Module):
    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return (images.amax(1) < 0.28).float()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_model_masks_both_cameras(recording: Path, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.script(Dark()).save(str(tmp_path / "dark.pt"))
    out = tmp_path / "out"
    masks = str(tmp_path / "dark.pt")
    assert main(["detect", str(recording), "--out", str(out), "--masks", masks, "--overlays", "0"]) == 0
    with np.load(out / "lines.npz") as lines:
        assert lines["valid_right"].any(-1).all() and lines["valid_left"].any(-1).all()


def test_a_callable_masks_a_recording(recording: Path) -> None:
    table = detect(load_recording(recording), segment=lambda images: torch.zeros_like(images[:, 0]))
    assert not any(view.found.any() for view in table.views)


def _remove(folder: Path) -> None:
    (folder / "left" / "0003.png").unlink()


def _shrink(folder: Path) -> None:
    for path in (folder / "right").iterdir():
        cv2.imwrite(str(path), np.zeros((240, 320), np.uint8))


def _shrink_one(folder: Path) -> None:
    cv2.imwrite(str(folder / "right" / "0002.png"), np.zeros((240, 320), np.uint8))


def _label_values(folder: Path) -> None:
    for path in (folder / "right").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) // 255)


def _colours(folder: Path) -> None:
    for path in (folder / "right").iterdir():
        picture = np.zeros((480, 640, 3), np.uint8)
        picture[100:200, :, 2] = 200
        cv2.imwrite(str(path), picture)


def _truncate(folder: Path) -> None:
    path = folder / "right" / "0000.png"
    path.write_bytes(path.read_bytes()[:200])


DAMAGE = {
    "no folder": (shutil.rmtree, ["expected a folder of mask pictures, or a model file", "nothing there"]),
    "one camera only": (lambda f: shutil.rmtree(f / "left"), ["right and left", "no folder left"]),
    "one mask too few": (_remove, ["left", "expected 4 masks", "found 3"]),
    "another size": (_shrink, ["right", "640 x 480", "320 x 240"]),
    "one of another size": (_shrink_one, ["0002.png", "640 x 480", "320 x 240"]),
    "0 and 1": (_label_values, ["0 and 255", "the numbers 0, 1", "--mask-labels"]),
    "colours": (_colours, ["0 and 255", "colours", "--mask-labels"]),
    "a truncated mask": (_truncate, ["0000.png", "truncated"]),
    "a stranger": (lambda f: (f / "right" / "notes.txt").write_text("x"), ["images only", "notes.txt"]),
}


@pytest.mark.parametrize("command", ["detect", "calibrate"])
@pytest.mark.parametrize("case", DAMAGE)
def test_bad_masks_are_one_clear_line(
    case: str, command: str, recording: Path, true_masks: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    damage, words = DAMAGE[case]
    masks = shutil.copytree(true_masks, tmp_path / "masks")
    damage(masks)
    out = tmp_path / "out"
    assert main([command, str(recording), "--out", str(out), "--masks", str(masks), "--overlays", "0"]) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("rmis-calib: error:")]
    assert len(errors) == 1
    assert all(word in errors[0] for word in words), errors[0]
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("model.pt", b"no model", ["model.pt", "expected a TorchScript model"]),
        ("model.h5", b"no model", ["model.h5", "ending in .pt, .ts or .onnx"]),
    ],
)
def test_bad_models_are_one_clear_line(
    name: str, content: bytes, words: list[str], recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / name).write_bytes(content)
    out = tmp_path / "out"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        assert main(["detect", str(recording), "--out", str(out), "--masks", str(tmp_path / name)]) == 2
    error = capsys.readouterr().err
    assert all(word in error for word in words), error
    assert not out.exists()
