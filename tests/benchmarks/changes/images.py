"""What users' cameras, recorders and programs do to a picture: functions of a picture (BGR) and a generator."""

from collections.abc import Callable

import cv2
import numpy as np

from tests.benchmarks.broken_recordings import Yaml

Picture = np.ndarray
PictureChange = Callable[[Picture, np.random.Generator], Picture]


def resized(scale: float) -> PictureChange:
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return lambda picture, _: cv2.resize(picture, None, fx=scale, fy=scale, interpolation=how)


def cut(picture: Picture) -> tuple[slice, slice]:
    """The part of a picture that is left without 8 % at the left and at the top, 4 % at the right and below."""
    height, width = picture.shape[:2]
    return slice(height * 8 // 100, height * 96 // 100), slice(width * 8 // 100, width * 96 // 100)


def recoded(quality: int) -> PictureChange:
    def change(picture: Picture, _: np.random.Generator) -> Picture:
        return np.asarray(cv2.imdecode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 1))

    return change


def grey(picture: Picture, _: np.random.Generator) -> Picture:
    return cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)


def gamma(exponent: float) -> PictureChange:
    return lambda picture, _: (255 * (picture / 255.0) ** exponent).round().astype(np.uint8)


def tinted(picture: Picture, _: np.random.Generator) -> Picture:
    return (picture * np.array([0.7, 0.95, 1.15])).clip(0, 255).round().astype(np.uint8)


def noisy(picture: Picture, generator: np.random.Generator) -> Picture:
    return (picture + generator.normal(0, 8.0, picture.shape)).clip(0, 255).round().astype(np.uint8)


def blurred(picture: Picture, _: np.random.Generator) -> Picture:
    return cv2.GaussianBlur(picture, (0, 0), 0.003 * picture.shape[1])


def with_lens(picture: Picture, camera: Yaml, distortion: tuple[float, ...], undo: bool) -> Picture:
    """The picture as a lens of this distortion would show it, or (`undo`) without the lens that it was taken by."""
    K = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1.0]])
    height, width = picture.shape[:2]
    uv = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2).astype(float)
    if undo:
        rays = np.concatenate([(uv - K[:2, 2]) / np.diag(K)[:2], np.ones_like(uv[..., :1])], -1)
        source, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(distortion))
    else:
        source = cv2.undistortPoints(uv, K, np.array(distortion), P=K)
    source = np.asarray(source).reshape(height, width, 2).astype(np.float32)
    return cv2.remap(picture, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def with_text(picture: Picture, _: np.random.Generator) -> Picture:
    """Date and case, as recorders burn them in, and a dark bar with a name."""
    shown, (height, width) = picture.copy(), picture.shape[:2]
    size = height / 480
    cv2.rectangle(shown, (0, height - int(36 * size)), (int(0.45 * width), height), (20, 20, 20), -1)
    for text, y in (("2023-11-05 10:41:07  PSM1 LND", height - int(12 * size)), ("REC", int(30 * size))):
        cv2.putText(shown, text, (10, y), cv2.FONT_HERSHEY_SIMPLEX, 0.6 * size, (240, 240, 240), max(1, int(2 * size)))
    return shown


def with_logo(picture: Picture, _: np.random.Generator) -> Picture:
    """Black bars that cross in the lower right corner: as like a shaft as a logo can be."""
    shown, (height, width) = picture.copy(), picture.shape[:2]
    thick = max(8, width // 24)
    cv2.line(shown, (int(0.8 * width), height), (width, int(0.7 * height)), (15, 15, 15), thick)
    cv2.circle(shown, (int(0.9 * width), int(0.88 * height)), thick, (200, 160, 40), -1)
    return shown


def vignetted(picture: Picture, _: np.random.Generator) -> Picture:
    """A round field that is bright in the middle and black in the corners, as a laparoscope shows it."""
    height, width = picture.shape[:2]
    v, u = np.mgrid[:height, :width]
    radius = np.hypot(u - width / 2, v - height / 2) / (0.56 * width)
    light = np.clip(1.0 - 0.4 * radius**2, 0, 1) * (radius < 1)
    return (picture * light[..., None]).round().astype(np.uint8)


def bordered(picture: Picture, _: np.random.Generator) -> Picture:
    side = picture.shape[1] // 8
    return cv2.copyMakeBorder(picture, 0, 0, side, side, cv2.BORDER_CONSTANT)


def combed(picture: Picture, generator: np.random.Generator) -> Picture:
    """Interlaced while the scene moved: odd rows are up to 4 px beside the even ones."""
    shown = picture.copy()
    shown[1::2] = np.roll(picture, generator.integers(-4, 5), axis=1)[1::2]
    return shown


def line_doubled(picture: Picture, _: np.random.Generator) -> Picture:
    """One field of an interlaced picture, shown in every second row too."""
    return np.repeat(picture[::2], 2, axis=0)[: picture.shape[0]]
