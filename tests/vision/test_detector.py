"""The detector on pictures whose truth the tests draw themselves."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from drawn_bars import Bar, draw_bar, tissue

from rmis_calib.errors import ShapeError
from rmis_calib.geometry import Camera, axis_plane, contour_planes, plane_normal_from_points
from rmis_calib.vision import DetectorSettings, FrameReason, ShaftDetections, ShaftDetector


def contour_errors_px(found: ShaftDetections, bar: Bar, frame: int = 0) -> np.ndarray:
    """(edge, point) distance of the detected contour points beyond the true contour, px; positive is outwards."""
    points = found.contour_xy[frame, 0].double().numpy() - bar.centre
    lateral = points @ bar.left
    return np.stack([lateral[0] - bar.width_px / 2, -lateral[1] - bar.width_px / 2])


@pytest.fixture(scope="module")
def detector() -> ShaftDetector:
    return ShaftDetector()


@pytest.mark.parametrize("angle_deg", [7.0, 25.0, 61.0, 97.0, 152.0, 205.0, 245.0, 297.0, 349.0])
def test_contours_of_a_bar_at_any_angle(detector: ShaftDetector, angle_deg: float) -> None:
    bar = draw_bar(angle_deg, noise_levels=2.0)
    found = detector.detect(bar.batch)
    assert found.reason.tolist() == [FrameReason.OK]
    # Measured: 0.003 px rms; the tolerance leaves room for another platform's arithmetic.
    assert np.abs(contour_errors_px(found, bar)).max() < 0.03
    assert bool(found.direction_known[0, 0])
    assert bool(found.end_valid[0, 0])
    along = (found.end_uv[0, 0].double().numpy() - bar.centre) @ bar.along
    assert abs(along - bar.end_px) < 0.25


def test_points_run_towards_the_tip_and_edge_0_is_on_the_left(detector: ShaftDetector) -> None:
    bar = draw_bar(25.0)  # walks to the right: left is up, and up is smaller v
    points = detector.detect(bar.batch).contour_xy[0, 0]
    assert torch.all(points[:, 1, 0] > points[:, 0, 0])
    assert points[0, 0, 1] < points[1, 0, 1]


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_turning_the_picture_turns_the_contours(detector: ShaftDetector, quarter_turns: int) -> None:
    bar = draw_bar(33.0, size=(480, 480), noise_levels=1.0)
    upright = detector.detect(bar.batch).contour_xy[0, 0].numpy()
    turned = detector.detect(torch.rot90(bar.batch, quarter_turns, (2, 3))).contour_xy[0, 0].numpy()
    for _ in range(quarter_turns):
        upright = np.stack([upright[..., 1], 479 - upright[..., 0]], -1)  # rot90 moves (u, v) to (v, w - 1 - u)
    direction = turned[:, 1] - turned[:, 0]
    normal = np.stack([direction[:, 1], -direction[:, 0]], -1) / np.linalg.norm(direction, axis=-1, keepdims=True)
    distance = np.einsum("epi,ei->ep", upright - turned[:, :1], normal)
    assert np.abs(distance).max() < 0.05


def test_a_bright_bar_is_not_a_shaft(detector: ShaftDetector) -> None:
    bar = draw_bar(25.0, inside=(230.0, 225.0, 220.0), outside=(120.0, 70.0, 60.0))
    assert not detector.detect(bar.batch).valid.any()


@pytest.mark.parametrize(
    ("inside", "outside"),
    [
        ((25, 25, 25), (107, 93, 57)),  # black on an olive bench
        ((66, 52, 60), (56, 21, 28)),  # slate grey on dark liver: the shaft is brighter than what lies beside it
        ((80, 79, 88), (230, 172, 158)),  # dark grey on a pink phantom
        ((20, 26, 60), (150, 60, 55)),  # dark blue on red tissue
        ((25, 25, 25), (60, 90, 130)),  # black on blue: channels in the wrong order
    ],
)
def test_no_scene_colour_is_hard_wired(detector: ShaftDetector, inside: tuple, outside: tuple) -> None:
    bar = draw_bar(205.0, inside=inside, outside=outside, noise_levels=1.5, blur_px=0.9)
    found = detector.detect(bar.batch)
    assert bool(found.valid[0, 0])
    assert np.abs(contour_errors_px(found, bar)).max() < 0.06


def test_the_wrist_is_not_the_shaft(detector: ShaftDetector) -> None:
    bar = draw_bar(25.0, wrist=(150.0, 148.0, 152.0), end_px=60.0, noise_levels=1.5)
    found = detector.detect(bar.batch)
    along = (found.end_uv[0, 0].double().numpy() - bar.centre) @ bar.along
    assert abs(along - 60.0) < 0.3


def test_uncertainty_covers_the_error(detector: ShaftDetector) -> None:
    bars = [draw_bar(20.0 + 7 * i, noise_levels=4.0, offset_px=0.13 * i, seed=i) for i in range(12)]
    found = detector.detect(torch.cat([bar.batch for bar in bars]))
    ratios = [
        contour_errors_px(found, bar, i) / found.contour_sigma[i, 0].double().numpy()[:, None]
        for i, bar in enumerate(bars)
    ]
    assert np.abs(ratios).max() < 4.0


def test_a_batch_gives_what_single_frames_give(detector: ShaftDetector) -> None:
    bars = [draw_bar(angle, noise_levels=2.0) for angle in (20.0, 110.0, 300.0)]
    together = detector.detect(torch.cat([bar.batch for bar in bars]))
    for i, bar in enumerate(bars):
        alone = detector.detect(bar.batch)
        torch.testing.assert_close(together.contour_xy[i], alone.contour_xy[0], equal_nan=True, rtol=0, atol=2e-3)
        assert torch.equal(together.valid[i], alone.valid[0])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_a_gpu_gives_what_the_cpu_gives(detector: ShaftDetector) -> None:
    images = torch.cat([draw_bar(angle, noise_levels=2.0).batch for angle in (20.0, 110.0)])
    on_cpu, on_gpu = detector.detect(images), detector.detect(images.cuda())
    assert on_gpu.contour_xy.is_cuda
    torch.testing.assert_close(on_cpu.contour_xy, on_gpu.contour_xy.cpu(), equal_nan=True, rtol=0, atol=5e-3)


def test_float_and_uint8_agree(detector: ShaftDetector) -> None:
    bar = draw_bar(25.0, noise_levels=2.0)
    ints = detector.detect(bar.batch)
    floats = detector.detect(bar.batch.to(torch.float64) / 255)
    torch.testing.assert_close(ints.contour_xy, floats.contour_xy, equal_nan=True, rtol=0, atol=1e-2)


@pytest.mark.parametrize("level", [0, 255, 128])
def test_a_picture_of_one_tone_has_nothing_in_it(detector: ShaftDetector, level: int) -> None:
    found = detector.detect(torch.full((2, 3, 240, 320), level, dtype=torch.uint8))
    assert not found.valid.any()
    assert set(found.reason.tolist()) == {FrameReason.NO_PICTURE}
    assert torch.isnan(found.contour_xy).all()


def test_tissue_without_a_shaft_gives_none(detector: ShaftDetector) -> None:
    images = np.stack([tissue(seed=seed) for seed in range(6)])
    found = detector.detect(torch.from_numpy(images).permute(0, 3, 1, 2))
    assert not found.valid.any()
    assert all(FrameReason(reason) is not FrameReason.OK for reason in found.reason.tolist())


def test_a_black_border_and_a_round_field_are_not_shafts(detector: ShaftDetector) -> None:
    picture = tissue()
    v, u = np.mgrid[:480, :640]
    round_field = np.where((np.hypot(u - 320, v - 240) < 260)[..., None], picture, 0).astype(np.uint8)
    bordered = picture.copy()
    bordered[:, :30] = bordered[:, -24:] = bordered[:12] = 0
    found = detector.detect(torch.from_numpy(np.stack([round_field, bordered])).permute(0, 3, 1, 2))
    assert not found.valid.any()


def test_pixels_that_are_not_numbers_are_a_reason_and_spare_the_rest(detector: ShaftDetector) -> None:
    images = draw_bar(25.0).batch.repeat(2, 1, 1, 1).to(torch.float32) / 255
    images[0, 1, 10, 10] = torch.nan
    found = detector.detect(images)
    assert found.reason.tolist() == [FrameReason.BAD_PIXELS, FrameReason.OK]
    assert not found.valid[0].any()
    assert bool(found.valid[1, 0])


@pytest.mark.parametrize(
    "images",
    [
        torch.zeros(3, 100, 100, dtype=torch.uint8),
        torch.zeros(1, 1, 100, 100, dtype=torch.uint8),
        torch.zeros(1, 3, 100, 100, dtype=torch.int32),
        torch.zeros(0, 3, 100, 100, dtype=torch.uint8),
        torch.zeros(1, 3, 20, 100, dtype=torch.uint8),
    ],
)
def test_wrong_images_are_refused(detector: ShaftDetector, images: torch.Tensor) -> None:
    with pytest.raises(ShapeError, match="expected"):
        detector.detect(images)


def test_pictures_of_another_size_than_the_camera_are_refused() -> None:
    camera = Camera.from_values(700.0, 700.0, 320.0, 240.0, image_size=(480, 640))
    with pytest.raises(ShapeError, match="camera"):
        ShaftDetector(camera=camera).detect(torch.zeros(1, 3, 240, 320, dtype=torch.uint8))


def test_confidence_ranks_and_is_limited(detector: ShaftDetector) -> None:
    found = detector.detect(draw_bar(25.0, noise_levels=2.0).batch)
    assert 0.8 < float(found.confidence[0, 0]) <= 1.0
    strict = ShaftDetector(DetectorSettings(min_confidence=1.0)).detect(draw_bar(25.0).batch)
    assert strict.reason.tolist() == [FrameReason.AMBIGUOUS]


def cylinder_picture(
    camera: Camera, p: torch.Tensor, v: torch.Tensor, radius_mm: float, s_end_mm: float
) -> torch.Tensor:
    """A dark cylinder seen by a distorting camera, by ray casting with 4 x 4 samples a pixel; ends at `s_end_mm`."""
    height, width = camera.image_size
    fine = 4
    at = (torch.arange(width * fine, dtype=torch.float64) + 0.5) / fine - 0.5
    down = (torch.arange(height * fine, dtype=torch.float64) + 0.5) / fine - 0.5
    uv = torch.stack(torch.meshgrid(at, down, indexing="xy"), -1)
    xy, _ = camera.undistort_points(uv)
    ray = torch.nn.functional.normalize(torch.cat([xy, torch.ones_like(xy[..., :1])], -1), dim=-1)
    across_ray, across_p = ray - (ray @ v)[..., None] * v, p - (p @ v) * v
    a, b = across_ray.square().sum(-1), across_ray @ across_p
    root = b.square() - a * (across_p.square().sum() - radius_mm**2)
    depth = (b - root.clamp(min=0).sqrt()) / a
    s = (ray * depth[..., None] - p) @ v
    dark = (root > 0) & (s < s_end_mm)
    colour = torch.where(dark[..., None], torch.tensor([40.0, 42.0, 46.0]), torch.tensor([175.0, 112.0, 100.0]))
    return torch.nn.functional.avg_pool2d(colour.permute(2, 0, 1)[None], fine).round().to(torch.uint8)


def test_a_cylinder_seen_by_a_distorting_camera() -> None:
    camera = Camera.from_values(700.0, 698.0, 322.0, 236.0, (-0.3, 0.08, 5e-4, -4e-4, 0.0), image_size=(480, 640))
    p = torch.tensor([60.0, -25.0, 70.0], dtype=torch.float64)
    v = torch.nn.functional.normalize(torch.tensor([-0.8, 0.35, 0.45], dtype=torch.float64), dim=-1)
    found = ShaftDetector(camera=camera).detect(cylinder_picture(camera, p, v, 4.0, 70.0))
    contour = found.contour_xy[0, 0].double()
    focal = float(camera.focal)
    normals = plane_normal_from_points(contour[:, 0], contour[:, 1])
    # Signs and order as in geometry: exchanged edges or a reversed direction would give 2 and not 0.
    assert (normals - contour_planes(p, v, 4.0)).norm(dim=-1).max() * focal < 0.15
    axis = found.axis_xy[0, 0].double()
    assert (plane_normal_from_points(axis[0], axis[1]) - axis_plane(p, v)).norm() * focal < 0.1
    end = p + 70.0 * v
    # The rim that is seen lies 4 mm nearer than the axis, tens of pixels away: the correction is what is tested here.
    assert (found.end_xy[0, 0].double() - end[:2] / end[2]).norm() * focal < 0.6
    assert (found.end_uv[0, 0].double() - camera.project(end)[0]).norm() > 3.0


def test_the_real_recording(shared_data: Path) -> None:
    """Every fourth frame: the shaft first or second, mostly with an end."""
    files = sorted((shared_data / "recode_recording/right").glob("*.jpg"))[::4]
    images = np.stack([cv2.imread(str(file))[..., ::-1] for file in files])
    found = ShaftDetector().detect(torch.from_numpy(images).permute(0, 3, 1, 2).contiguous())
    # The instrument's shaft is the only long strip that runs from the top left to the lower right.
    direction = found.contour_xy[:, :2, :, 1] - found.contour_xy[:, :2, :, 0]
    steep = (direction[..., 0] > 0.3 * direction[..., 1]).all(-1) & (direction[..., 1] > 50).all(-1)
    shaft = found.valid[:, :2] & steep
    # Measured: 13 of 13, and 47 of all 50.
    assert int(shaft.any(1).sum()) >= 11
    rank = shaft.int().argmax(1)
    rows = torch.arange(len(files))
    # Measured: 9. Balls on the shaft look like its end, and where the network wavers between them it gives none.
    assert int((found.end_valid[rows, rank] & shaft.any(1)).sum()) >= 8


FISHEYE = Camera.from_values(
    560.0, 565.0, 322.0, 238.0, [0.06, -0.04, 0.02, -0.006], image_size=(480, 640), model="equidistant"
)
RATIONAL = Camera.from_values(
    560.0, 565.0, 322.0, 238.0, [0.41, -0.12, 1e-3, -8e-4, 0.05, 0.72, 0.09, 0.11], image_size=(480, 640),
    model="rational_polynomial",
)  # fmt: skip


@pytest.mark.parametrize("camera", [FISHEYE, RATIONAL], ids=["fisheye", "rational"])
def test_contours_through_a_bent_lens_are_straight_and_in_place(camera: Camera) -> None:
    bar = draw_bar(205.0, width_px=60.0, noise_levels=0.0)
    K = np.array([[560.0, 0, 322.0], [0, 565.0, 238.0], [0, 0, 1]])
    v, u = np.mgrid[:480, :640].astype(np.float64)
    raw = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    undistort = (
        cv2.fisheye.undistortPoints if camera is FISHEYE else getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
    )
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    # OpenCV finds where each raw pixel comes from in the straight picture: the truth is the drawn bar itself.
    straight = undistort(raw, K, camera.distortion.numpy(), R=None, P=K, criteria=criteria).reshape(480, 640, 2)
    bent = cv2.remap(bar.image, *np.moveaxis(straight.astype(np.float32), -1, 0), cv2.INTER_CUBIC)
    found = ShaftDetector(camera=camera).detect(torch.from_numpy(bent).permute(2, 0, 1)[None])
    assert bool(found.valid[0, 0])
    # Contour points are normalised; back to the straight picture's pixels.
    points = found.contour_xy[0, 0].double().numpy() * [560.0, 565.0] + [322.0, 238.0] - bar.centre
    error = np.stack([points[0] @ bar.left - bar.width_px / 2, -points[1] @ bar.left - bar.width_px / 2])
    # The lens moves these contours by several pixels; what remains is the interpolation's.
    assert np.abs(error).max() < 0.15
