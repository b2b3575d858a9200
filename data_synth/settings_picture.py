"""Settings of what the pictures show and of the cameras that take them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

NonNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(ge=0, le=1)]


@dataclass(frozen=True, config=_STRICT)
class IntrinsicsSettings:
    """One camera of the pair."""

    fx_px: Positive = 702.4
    """Horizontal focal length."""
    fy_px: Positive = 701.1
    """Vertical focal length."""
    cx_px: float = 322.7
    """Column of the principal point."""
    cy_px: float = 236.4
    """Row of the principal point."""
    distortion: tuple[float, float, float, float, float] = (-0.2, 0.05, 0.0006, -0.0004, 0.0)
    """k1, k2, p1, p2, k3."""


@dataclass(frozen=True, config=_STRICT)
class CameraSettings:
    """The stereo laparoscope's cameras and what their optics and electronics do to the picture."""

    width_px: Annotated[int, Field(ge=64)] = 640
    """Width of the pictures."""
    height_px: Annotated[int, Field(ge=64)] = 480
    """Height of the pictures."""
    right: IntrinsicsSettings = IntrinsicsSettings()
    """Right camera."""
    left: IntrinsicsSettings | None = IntrinsicsSettings(
        fx_px=699.8, fy_px=698.9, cx_px=315.2, cy_px=241.9, distortion=(-0.19, 0.045, -0.0004, 0.0005, 0.0)
    )
    """Left camera; null: a monocular recording."""
    blur_px: Annotated[float, Field(ge=0.3)] = 0.55
    """1 sigma of the point spread (defocus, lens and pixel together); every edge is an error function of this width."""
    gamma: Positive = 2.2
    """Encoding of linear light."""
    vignette: Fraction = 0.5
    """Loss of encoded brightness at 31 degrees from the axis."""
    round_field: NonNegative = 0.0
    """Radius of the bright field over half the picture's width, black outside; 0: the whole picture is bright."""
    exposure_s: NonNegative = 0.0
    """Exposure time: motion blur, centred on the frame's time."""
    readout_s: NonNegative = 0.0
    """Time of reading all rows (rolling shutter); the middle row is read at the frame's time."""
    readout_told: bool = False
    """Whether recording.yaml tells it (`rolling_shutter_s`); frame_times.csv then has the times of the first rows."""
    field_delay_s: NonNegative = 0.0
    """Interlaced: odd rows are taken this long after the even ones, half before and half after the frame's time; 0: not
    so."""
    sharpening: NonNegative = 0.0
    """Strength of the video processor's unsharp mask: halos along edges."""
    bayer: bool = False
    """One colour a pixel (RGGB), interpolated bilinearly."""
    noise_levels: NonNegative = 1.5
    """White sensor noise, 1 sigma, in levels of 0 to 255."""
    colour_noise_levels: NonNegative = 0.0
    """Noise of the colour differences with a grain of four pixels, 1 sigma."""
    gain_variation: NonNegative = 0.0
    """Slow drift of the brightness over the frames, 1 sigma, relative."""
    white_balance_variation: NonNegative = 0.0
    """Slow drift of red and blue against green, 1 sigma, relative."""
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None = None
    """Compress every picture once by JPEG."""


@dataclass(frozen=True, config=_STRICT)
class LookSettings:
    """What the pictures show."""

    tissue: Literal["mixed", "liver", "bowel"] = "mixed"
    """Colours and shapes of the background: mixed organs, dark red liver, or pale pink bowel."""
    brightness: Positive = 1.0
    """Encoded brightness of the tissue's light."""
    fat: Fraction = 0.15
    """Share of yellow fat."""
    vessels: Fraction = 0.7
    """Contrast of the vessels."""
    folds: Fraction = 0.2
    """Depth of folds and creases."""
    gloss: NonNegative = 0.8
    """Strength of the wet highlights."""
    blood: Fraction = 0.0
    """Pools of blood on the tissue and films of it on the shaft."""
    cavities: Fraction = 0.0
    """Share of the background that is nearly black."""
    smoke: Fraction = 0.0
    """Density of smoke."""
    shadow: Fraction = 0.5
    """Darkness of the instruments' shadows."""
    shaft: Literal["dark_grey", "carbon", "anodised", "slate"] = "dark_grey"
    """Surface of the shaft; `slate` is as bright as dark liver and differs from it by its colour."""
    glare: NonNegative = 1.0
    """Strength of the shaft's glare stripe; from about 15 it saturates."""
    wrist_radius_ratio: Annotated[float, Field(gt=0.3, le=1.0)] = 0.94
    """Radius of the metal wrist over that of the shaft."""
    other_instruments: Annotated[tuple[Literal["metal", "dark", "white"], ...], Field(max_length=2)] = ()
    """Further instruments that no joint is logged for: all metal, dark shaft with metal wrist, dark with a white
    tip."""
    tissue_over_shaft: bool = False
    """A loop of tissue in the foreground hides a part of the shaft."""
    absent_fraction: Fraction = 0.0
    """Share of frames in which the logged instrument is not there."""
