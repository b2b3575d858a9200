"""How the surfaces of instruments answer to the scope's light. Pixels only (torch, float32)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from data_synth.instruments import Hit, dot, unit
from data_synth.settings_picture import LookSettings

REFERENCE_MM = 100.0
"""Distance of the light at which reflectances are nominal."""
WEAVE_MM = 1.3
"""Half a period of carbon cloth."""
GLARE, GLARE_SHARPNESS = 0.05, 28.0
"""The stripe that the light draws along a shaft, over the soft highlight of its surface."""
BLOOD = (0.11, 0.004, 0.004)


@dataclass(frozen=True)
class Surface:
    """Linear reflectance, strength and sharpness of the highlight, a pattern, the share under blood, and the glare
    stripe's strength."""

    reflectance: tuple[float, float, float]
    highlight: float
    sharpness: float
    pattern: Literal["plain", "carbon", "metal", "clevis"] = "plain"
    blood: float = 0.0
    glare: float = 0.0


DARK_GREY = Surface((0.022, 0.023, 0.026), 0.035, 10.0)
CARBON = Surface((0.014, 0.014, 0.015), 0.06, 9.0, "carbon")
ANODISED = Surface((0.014, 0.020, 0.040), 0.05, 14.0)
SLEEVE = Surface((0.27, 0.27, 0.275), 0.60, 26.0, "metal")
CLEVIS = Surface((0.23, 0.23, 0.235), 0.75, 20.0, "clevis")
STEEL = Surface((0.22, 0.22, 0.225), 0.55, 16.0, "metal")
WHITE = Surface((0.70, 0.66, 0.58), 0.25, 10.0)
SLATE = Surface((0.055, 0.059, 0.073), 0.03, 6.0)
SHAFTS = {"dark_grey": DARK_GREY, "carbon": CARBON, "anodised": ANODISED, "slate": SLATE}


@dataclass(frozen=True)
class Band:
    """A ring around an instrument: its radius over the shaft's, and where it lies, mm beyond the shaft's end."""

    ratio: float
    surface: Surface
    s_from_mm: float
    s_to_mm: float


@dataclass(frozen=True)
class Finish:
    """Surfaces of one instrument from the shaft to the tip, and rings around it."""

    shaft: Surface
    sleeve: Surface
    clevis: Surface
    bands: tuple[Band, ...] = ()


def own_finish(look: LookSettings) -> Finish:
    """The logged instrument."""
    shaft = SHAFTS[look.shaft]
    shaft = replace(shaft, glare=GLARE * look.glare, blood=0.6 * look.blood)
    return Finish(shaft, replace(SLEEVE, blood=0.5 * look.blood), CLEVIS)


def other_finish(kind: str) -> Finish:
    """An instrument that is not logged."""
    return {
        "metal": Finish(STEEL, SLEEVE, CLEVIS),
        "dark": Finish(DARK_GREY, SLEEVE, CLEVIS),
        "white": Finish(ANODISED, WHITE, WHITE),
    }[kind]


def light_cylinder(hit: Hit, light: Tensor, surface: Surface, gamma: float) -> Tensor:
    """Encoded colour (M, 3) of the hit points under a point light (3, M), both in the cylinder's frame."""
    to_light = light - hit.point
    distance = torch.sqrt(dot(to_light, to_light))
    to_light = to_light / distance
    half = unit(to_light - unit(hit.point))
    nu, nw = hit.normal
    diffuse = torch.clamp(nu * to_light[0] + nw * to_light[1], min=0.0)
    # A turned tube has fine grooves round it: they spread the highlight along the axis, so only the angle round it
    # counts.
    across = torch.hypot(half[0], half[1]).clamp_min(1e-3)
    mirror = torch.clamp((nu * half[0] + nw * half[1]) / across, min=0.0)
    highlight = surface.highlight * across * mirror**surface.sharpness
    reflectance = torch.tensor(surface.reflectance, device=diffuse.device).expand(len(diffuse), 3)
    # The square of the cosine fades in proportion to the distance from the limb; the cosine itself would fade like its
    # root,
    # within a pixel, and so move the visible edge (measured: 0.03 px against 0.01 px).
    body = 0.7 + 0.3 * diffuse * diffuse
    if surface.pattern != "plain":
        relief = _pattern(hit, surface.pattern)
        body, highlight = body * relief, highlight * relief
    if surface.blood > 0.0:
        film = _blood_film(hit, surface.blood)[:, None]
        reflectance = torch.lerp(reflectance, torch.tensor(BLOOD, device=film.device).expand_as(reflectance), film)
        highlight = highlight + 0.5 * film[:, 0] * mirror**60
    if surface.glare > 0.0:
        highlight = highlight + surface.glare * mirror**GLARE_SHARPNESS
    gain = torch.clamp((REFERENCE_MM / distance) ** 2, max=6.0)
    linear = (body[:, None] * reflectance + highlight[:, None]) * gain[:, None]
    return torch.clamp(linear, 1e-4, 1.0) ** (1.0 / gamma)


def _pattern(hit: Hit, pattern: str) -> Tensor:
    """Brightness factor (M,) of the surface's pattern, from axis coordinate and angle."""
    angle = torch.atan2(hit.normal[1], -hit.normal[0])
    if pattern == "carbon":
        arc = 4.0 * angle
        return 1.0 + 0.28 * torch.sin(torch.pi * (hit.s + arc) / WEAVE_MM) * torch.sin(
            torch.pi * (hit.s - arc) / WEAVE_MM
        )
    if pattern == "metal":
        return 0.85 + 0.25 * torch.sin(5.0 * angle + 0.8) + 0.06 * torch.sin(13.0 * angle)
    return 0.62 + 0.38 * torch.tanh(5.0 * (torch.sin(2.1 * hit.s) * torch.cos(2.0 * angle + 0.5) + 0.35))


def _blood_film(hit: Hit, share: float) -> Tensor:
    """Soft mask (M,) of patches on the surface: a sum of waves in axis coordinate and angle above a threshold."""
    angle = torch.atan2(hit.normal[1], -hit.normal[0])
    waves = torch.sin(0.31 * hit.s + 1.3 * angle) + torch.sin(0.53 * hit.s - 2.1 * angle + 1.0)
    waves = waves + 0.6 * torch.sin(1.3 * hit.s + 3.0 * angle + 2.0)
    level = 2.0 - 3.2 * share
    return torch.clamp((waves - level) / 0.5, 0.0, 1.0)
