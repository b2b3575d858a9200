"""Synthetic laparoscopy with exact truth: scenes, pictures, recordings, line studies. Imports nothing of rmis_calib."""

from importlib import import_module
from typing import Any

_EXPORTS = {
    "LineStudyConfig": "settings",
    "SceneSettings": "settings",
    "SynthConfig": "settings",
    "SideTruth": "truth",
    "load_synth_config": "presets",
    "paint_strips": "strips",
    "render_bench": "bench",
    "render_frames": "render",
    "simulate_lines": "lines",
    "synth_presets": "presets",
    "write_recording": "write",
}

__all__ = sorted(_EXPORTS)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_EXPORTS[name]}"), name)


def __dir__() -> list[str]:
    return __all__
