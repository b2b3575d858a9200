"""Pictures drawn by the tests themselves: exact bars seen through a Gaussian, their truth from no code under test."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import ndtr


@dataclass(frozen=True)
class Bar:
    """A drawn shaft: `centre` on its axis, unit `along` towards the tip, unit `left` of that direction."""

    image: np.ndarray
    centre: np.ndarray
    along: np.ndarray
    left: np.ndarray
    width_px: float
    end_px: float
    """Place of the end along the axis, from `centre`."""

    @property
    def batch(self) -> torch.Tensor:
        """(1, 3, h, w) uint8."""
        return torch.from_numpy(self.image.copy()).permute(2, 0, 1)[None]


def draw_bar(
    angle_deg: float = 25.0,
    *,
    size: tuple[int, int] = (480, 640),
    width_px: float = 44.0,
    offset_px: float = 0.3,
    end_px: float = 120.0,
    blur_px: float = 0.7,
    noise_levels: float = 0.0,
    inside: tuple[float, float, float] = (40.0, 42.0, 45.0),
    outside: tuple[float, float, float] = (170.0, 110.0, 100.0),
    wrist: tuple[float, float, float] | None = None,
    seed: int = 0,
) -> Bar:
    """A bar along `angle_deg` (x right, y down), from the border behind to `end_px` beyond the middle."""
    height, width = size
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    angle = np.deg2rad(angle_deg)
    along = np.array([np.cos(angle), np.sin(angle)])
    left = np.array([along[1], -along[0]])
    centre = np.array([width / 2 + offset_px, height / 2 + 0.7 * offset_px])
    x = (u - centre[0]) * along[0] + (v - centre[1]) * along[1]
    y = (u - centre[0]) * left[0] + (v - centre[1]) * left[1]
    across = ndtr((y + width_px / 2) / blur_px) * ndtr((width_px / 2 - y) / blur_px)
    before_end = ndtr((end_px - x) / blur_px)
    image = np.broadcast_to(np.array(outside), (height, width, 3)).copy()
    if wrist is not None:
        image = _over(image, wrist, across * ndtr((end_px + 1.5 * width_px - x) / blur_px))
    image = _over(image, inside, across * before_end)
    image += noise_levels * np.random.default_rng(seed).standard_normal(image.shape)
    return Bar(np.clip(np.round(image), 0, 255).astype(np.uint8), centre, along, left, width_px, end_px)


def _over(image: np.ndarray, colour: tuple[float, float, float], cover: np.ndarray) -> np.ndarray:
    return image * (1 - cover[..., None]) + np.array(colour) * cover[..., None]


def tissue(size: tuple[int, int] = (480, 640), seed: int = 3) -> np.ndarray:
    """Blotchy pink without a shaft."""
    generator = np.random.default_rng(seed)
    coarse = torch.from_numpy(generator.standard_normal((1, 3, 12, 16)).astype(np.float32))
    smooth = torch.nn.functional.interpolate(coarse, size=size, mode="bicubic", align_corners=False)[0].permute(1, 2, 0)
    noise = generator.normal(0, 3, (*size, 3))
    return np.clip(np.array([180.0, 105.0, 95.0]) + 14 * smooth.numpy() + noise, 0, 255).astype(np.uint8)
