"""What the camera's electronics do to an encoded picture: drift, sharpening, Bayer pattern, noise, compression. torch,
float32."""

from __future__ import annotations

import cv2
import numpy as np
import torch
import torch.nn.functional as nnf
from torch import Tensor

from data_synth.kinematics import Array
from data_synth.settings_picture import CameraSettings

NOISE_POOL = 1 << 23
"""Values of white noise drawn once; every picture takes a run of them from a random place."""
DRIFT_FRAMES = 25.0
"""Frames over which brightness and colour drift."""


class Sensor:
    """Turns encoded pictures (B, H, W, 3), 0 to 1, into uint8, the same for the same seed, side and frame."""

    def __init__(self, settings: CameraSettings, seed: int, frames: int, device: torch.device) -> None:
        self.settings = settings
        self.seed = seed
        self._pool = torch.randn(NOISE_POOL, generator=torch.Generator().manual_seed(seed)).to(device)
        self._gains = torch.as_tensor(self._drift(frames), dtype=torch.float32, device=device)

    def _drift(self, frames: int) -> Array:
        """Colour gains (frames, 3): smooth random walks with the settings' spread."""
        generator = np.random.default_rng([self.seed, 4])
        knots = int(frames / DRIFT_FRAMES) + 2
        values = generator.standard_normal((knots, 3))
        at = np.arange(frames) / DRIFT_FRAMES
        smooth = np.stack([np.interp(at, np.arange(knots), column) for column in values.T], axis=-1)
        gain = 1.0 + self.settings.gain_variation * smooth[:, :1]
        balance = 1.0 + self.settings.white_balance_variation * smooth[:, 1:]
        return gain * np.stack([balance[:, 0], np.ones(frames), balance[:, 1]], axis=-1)

    def expose(self, picture: Tensor, frames: Array, side: str) -> Tensor:
        """Pictures (B, H, W, 3) uint8 of encoded ones, which are used up."""
        s = self.settings
        if s.gain_variation or s.white_balance_variation:
            picture = picture * self._gains[torch.as_tensor(frames, device=picture.device)][:, None, None]
        if s.sharpening:
            picture = _sharpen(picture, s.sharpening)
        levels = picture.clamp_(0.0, 1.0).mul_(255.0)
        generators = [np.random.default_rng([self.seed, 2, int(frame), side == "left"]) for frame in frames]
        if s.bayer:
            levels = _mosaic(levels + self._noise(levels.shape, generators, s.noise_levels))
        elif s.noise_levels:
            levels.add_(self._noise(levels.shape, generators, s.noise_levels))
        if s.colour_noise_levels:
            levels.add_(self._colour_noise(levels.shape, generators))
        out = levels.add_(0.5).clamp_(0.0, 255.0).to(torch.uint8)
        return out if s.jpeg_quality is None else _jpeg(out, s.jpeg_quality)

    def _noise(self, shape: torch.Size, generators: list[np.random.Generator], sigma: float) -> Tensor:
        """White noise of a batch of pictures, each a run of the pool."""
        count = shape[1:].numel()
        starts = [int(g.integers(0, len(self._pool) - count)) for g in generators]
        return sigma * torch.stack([self._pool[i : i + count].view(shape[1:]) for i in starts])

    def _colour_noise(self, shape: torch.Size, generators: list[np.random.Generator]) -> Tensor:
        """Noise of red and blue with a coarse grain; green takes the opposite, so that the brightness stays."""
        small = torch.Size((shape[0], shape[1] // 4 + 1, shape[2] // 4 + 1, 2))
        red, blue = self._noise(small, generators, self.settings.colour_noise_levels).unbind(-1)
        colour = torch.stack([red, -(0.30 * red + 0.11 * blue) / 0.59, blue], dim=-1)
        return _enlarged(colour, shape[1:3])


def _enlarged(pictures: Tensor, size: torch.Size) -> Tensor:
    """Pictures (B, h, w, C) bilinearly at another size; on the CPU by OpenCV, which needs a tenth of torch's time."""
    if pictures.is_cuda:
        planes = pictures.movedim(-1, 1)
        return nnf.interpolate(planes, size=tuple(size), mode="bilinear", align_corners=False).movedim(1, -1)
    large = [cv2.resize(p.numpy(), (size[1], size[0]), interpolation=cv2.INTER_LINEAR) for p in pictures]
    return torch.from_numpy(np.stack(large))


def _sharpen(picture: Tensor, strength: float) -> Tensor:
    """Unsharp mask: symmetric, so a straight edge keeps its place."""
    line = np.array([1.0, 4.0, 6.0, 4.0, 1.0], dtype=np.float32) / 16.0
    return torch.lerp(_filtered(picture, np.outer(line, line)), picture, 1.0 + strength)


CROSS = np.array([[0.25, 0.5, 0.25], [0.5, 1.0, 0.5], [0.25, 0.5, 0.25]], dtype=np.float32)
"""Interpolates a colour that every fourth pixel has."""
PLUS = np.array([[0.0, 0.25, 0.0], [0.25, 1.0, 0.25], [0.0, 0.25, 0.0]], dtype=np.float32)
"""Interpolates a colour that every second pixel has."""


def _mosaic(picture: Tensor) -> Tensor:
    """Keep one colour a pixel (RGGB) and interpolate the others bilinearly."""
    kept = torch.zeros_like(picture)
    for row, column, colour in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        kept[:, row::2, column::2, colour] = picture[:, row::2, column::2, colour]
    # Mirrored about the border pixel, the pattern keeps its colours.
    out = _filtered(kept, CROSS)
    out[..., 1:2] = _filtered(kept[..., 1:2].contiguous(), PLUS)
    return out


def _filtered(pictures: Tensor, kernel: Array) -> Tensor:
    """Pictures (B, H, W, C) filtered by a symmetric kernel, mirrored about the border pixels.

    On the CPU by OpenCV, which needs a third of the time of torch's convolution in groups.
    """
    if pictures.is_cuda:
        weights = pictures.new_tensor(kernel).expand(pictures.shape[-1], 1, -1, -1)
        reach = [kernel.shape[1] // 2] * 2 + [kernel.shape[0] // 2] * 2
        padded = nnf.pad(pictures.movedim(-1, 1), reach, mode="reflect")
        return nnf.conv2d(padded, weights, groups=pictures.shape[-1]).movedim(1, -1).contiguous()
    filtered = [cv2.filter2D(p.numpy(), -1, kernel, borderType=cv2.BORDER_REFLECT_101) for p in pictures]
    return torch.from_numpy(np.stack(filtered)).view(pictures.shape)


def _jpeg(pictures: Tensor, quality: int) -> Tensor:
    """Compress and decompress."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    decoded = []
    for picture in pictures.cpu().numpy():
        _, data = cv2.imencode(".jpg", picture[..., ::-1], options)
        decoded.append(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1])
    return torch.from_numpy(np.stack(decoded)).to(pictures.device)
