"""Backgrounds of a laboratory bench: cloth, paper, chessboards, rulers, cases, cables, letters, cast shadows. Colours
are encoded values, 0 to 1. OpenCV draws."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from data_synth.kinematics import Array
from data_synth.textures import filtered_noise

_LETTERS = "ABCDEFGHKLMNPRSTUVXYZ0123456789"


def draw_clutter(generator: np.random.Generator, height: int, width: int) -> Array:
    """A bench as a camera sees it, (H, W, 3) float32: a surface, some things on it, light that falls off."""
    picture = _surface(generator, height, width)
    chance: tuple[tuple[Callable[[np.random.Generator, Array], None], float], ...] = (
        (_chessboard, 0.6),
        (_case, 0.35),
        (_case, 0.2),
        (_ruler, 0.2),
        (_cable, 0.3),
        (_cable, 0.15),
        (_strip, 0.25),
        (_letters, 0.25),
        (_glove, 0.15),
    )
    for draw, share in chance:
        if generator.random() < share:
            draw(generator, picture)
    picture = cv2.GaussianBlur(picture, (0, 0), generator.uniform(0.4, 2.5))
    return np.clip(picture * _light(generator, height, width)[..., None], 0.0, 1.0).astype(np.float32)


def _tone(generator: np.random.Generator, low: float, high: float, colourful: float) -> Array:
    """A colour of about this brightness."""
    return np.clip(generator.uniform(low, high) + colourful * generator.uniform(-1.0, 1.0, 3), 0.01, 0.99)


def _surface(generator: np.random.Generator, height: int, width: int) -> Array:
    """Paper, cloth with a weave, or a stained plate."""
    colour = _tone(generator, 0.15, 0.9, generator.choice([0.02, 0.25]))
    picture = np.broadcast_to(colour, (height, width, 3)).astype(np.float32).copy()
    size = 512
    grain = filtered_noise(generator, size, *np.sort(generator.uniform([2.0, 22.0], [200.0, 220.0])))
    if generator.random() < 0.35:
        period, angle = generator.uniform(3.0, 9.0), generator.uniform(0.0, np.pi)
        v, u = np.mgrid[:size, :size]
        along, across = (u * np.cos(angle) + v * np.sin(angle)), (v * np.cos(angle) - u * np.sin(angle))
        grain = grain + 1.5 * np.sin(2 * np.pi * along / period) * np.sin(2 * np.pi * across / period)
    grain = cv2.resize(grain.astype(np.float32), (max(width, height),) * 2)[:height, :width]
    return picture * (1.0 + generator.uniform(0.005, 0.06) * grain[..., None])


def _light(generator: np.random.Generator, height: int, width: int) -> Array:
    """Brightness factor (H, W): a spot that falls off, and a soft shadow."""
    v, u = np.mgrid[:height, :width].astype(np.float32)
    centre = generator.uniform(0.2, 0.8, 2) * [width, height]
    off = np.hypot(u - centre[0], v - centre[1]) / width
    light = 1.0 / (1.0 + generator.uniform(0.0, 3.0) * off**2)
    if generator.random() < 0.3:
        angle, level = generator.uniform(0.0, 2 * np.pi), generator.uniform(0.2, 0.7)
        side = (u - centre[0]) * np.cos(angle) + (v - centre[1]) * np.sin(angle)
        light = light * (1.0 - level / (1.0 + np.exp(-side / generator.uniform(3.0, 60.0))))
    return light


def _fill(picture: Array, corners: Array, colour: Array) -> None:
    shift = 4  # sixteenths of a pixel
    points = np.round(corners * 2**shift).astype(np.int32)
    cv2.fillPoly(picture, [points], [float(c) for c in colour], cv2.LINE_AA, shift)


def _place(
    generator: np.random.Generator, picture: Array, length: float, breadth: float, within: float = -0.1
) -> Callable[[Array], Array]:
    """A map from [-1, 1]^2 to a rectangle somewhere in the picture, turned, in perspective; its middle is `within`
    (share of the picture's size) the border."""
    height, width = picture.shape[:2]
    angle = generator.uniform(0.0, 2 * np.pi)
    centre = generator.uniform(within, 1 - within, 2) * [width, height]
    tilt = generator.uniform(-0.25, 0.25, 2)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def at(xy: Array) -> Array:
        return centre + (xy * [length / 2, breadth / 2]) @ turn.T / (1.0 + xy @ tilt)[..., None]

    return at


def _quad(at: Callable[[Array], Array], x0: float, x1: float, y0: float, y1: float) -> Array:
    return at(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))


def _chessboard(generator: np.random.Generator, picture: Array) -> None:
    """Dark squares on a bright sheet; their rows are as straight as a shaft."""
    columns, rows = generator.integers(4, 11, 2)
    square = generator.uniform(0.03, 0.16) * picture.shape[1]
    at = _place(generator, picture, columns * square, rows * square, within=generator.choice([-0.1, 0.35]))
    bright, dark = _tone(generator, 0.6, 0.98, 0.03), _tone(generator, 0.03, 0.35, 0.02)
    _fill(picture, _quad(at, -1.08, 1.08, -1.08, 1.08), bright)
    x, y = np.linspace(-1.0, 1.0, columns + 1), np.linspace(-1.0, 1.0, rows + 1)
    for i in range(columns):
        for j in range(i % 2, rows, 2):
            _fill(picture, _quad(at, x[i], x[i + 1], y[j], y[j + 1]), dark)


def _case(generator: np.random.Generator, picture: Array) -> None:
    """A dark or bright box with a lid of another tone."""
    size = generator.uniform(0.1, 0.8, 2) * picture.shape[1]
    at = _place(generator, picture, *size)
    colour = _tone(generator, *((0.02, 0.2) if generator.random() < 0.7 else (0.3, 0.9)), 0.06)
    _fill(picture, _quad(at, -1.0, 1.0, -1.0, 1.0), colour)
    if generator.random() < 0.6:
        _fill(picture, _quad(at, -0.8, 0.8, -0.8, generator.uniform(-0.6, 0.8)), colour * generator.uniform(0.6, 1.6))


def _ruler(generator: np.random.Generator, picture: Array) -> None:
    """A scale with ticks and numbers."""
    length, breadth = generator.uniform(0.4, 1.2) * picture.shape[1], generator.uniform(0.04, 0.12) * picture.shape[1]
    at = _place(generator, picture, length, breadth)
    bright, dark = _tone(generator, 0.5, 0.95, 0.05), _tone(generator, 0.02, 0.3, 0.02)
    if generator.random() < 0.3:
        bright, dark = dark, bright
    _fill(picture, _quad(at, -1.0, 1.0, -1.0, 1.0), bright)
    ticks = generator.integers(10, 60)
    for i, x in enumerate(np.linspace(-0.97, 0.97, ticks)):
        reach = -0.2 if i % 5 == 0 else -0.6
        _fill(picture, _quad(at, x, x + 0.3 / ticks, -1.0, reach), dark)


def _cable(generator: np.random.Generator, picture: Array) -> None:
    """A dark hose along a curve, with a lighter line where the lamp is mirrored."""
    height, width = picture.shape[:2]
    knots = generator.uniform(-0.2, 1.2, (4, 2)) * [width, height]
    t = np.linspace(0.0, 1.0, 80)[:, None]
    curve = (1 - t) ** 3 * knots[0] + 3 * (1 - t) ** 2 * t * knots[1] + 3 * (1 - t) * t**2 * knots[2] + t**3 * knots[3]
    thick = int(generator.uniform(0.015, 0.09) * width)
    colour = _tone(generator, 0.03, 0.3, 0.08)
    points = [np.round(curve).astype(np.int32)]
    cv2.polylines(picture, points, False, [float(c) for c in colour], max(2, thick), cv2.LINE_AA)
    shine = np.clip(colour + generator.uniform(0.0, 0.25), 0.0, 1.0)
    cv2.polylines(picture, points, False, [float(c) for c in shine], max(1, thick // 5), cv2.LINE_AA)


def _strip(generator: np.random.Generator, picture: Array) -> None:
    """A flat dark strip on the bench, such as tape or a slit. It ends within the picture: one that does not is what a
    shaft without light on it looks like."""
    length, breadth = generator.uniform(0.1, 0.4) * picture.shape[1], generator.uniform(0.02, 0.15) * picture.shape[1]
    at = _place(generator, picture, length, breadth, within=0.3)
    _fill(picture, _quad(at, -1.0, 1.0, -1.0, 1.0), _tone(generator, 0.02, 0.3, 0.05))


def _letters(generator: np.random.Generator, picture: Array) -> None:
    """Print."""
    height, width = picture.shape[:2]
    colour = _tone(generator, 0.02, 0.4, 0.1)
    for _ in range(generator.integers(1, 4)):
        text = "".join(generator.choice(list(_LETTERS), generator.integers(2, 9)))
        place = (int(generator.uniform(-0.2, 0.9) * width), int(generator.uniform(0.0, 1.1) * height))
        scale = float(generator.uniform(0.8, 7.0))
        thick = max(1, int(2.5 * scale))
        mask = cv2.putText(np.zeros((height, width), np.uint8), text, place, 0, scale, [255.0], thick, cv2.LINE_AA)
        share = (mask / np.float32(255.0))[..., None]
        picture += share * (colour.astype(np.float32) - picture)


def _glove(generator: np.random.Generator, picture: Array) -> None:
    """Fingers: bright or dark rods with round ends, wider towards the hand."""
    height, width = picture.shape[:2]
    root = generator.uniform(0.0, 1.0, 2) * [width, height]
    angle = generator.uniform(0.0, 2 * np.pi)
    colour = _tone(generator, 0.1, 0.9, 0.15)
    for turn in np.linspace(-0.5, 0.5, 4):
        reach = generator.uniform(0.15, 0.35) * width
        tip = root + reach * np.array([np.cos(angle + turn), np.sin(angle + turn)])
        start, end = ([int(c) for c in np.round(p)] for p in (root, tip))
        thick = int(0.07 * width)
        cv2.line(
            picture, start, end, [float(c) for c in np.clip(colour * generator.uniform(0.85, 1.1), 0, 1)], thick, 16
        )
