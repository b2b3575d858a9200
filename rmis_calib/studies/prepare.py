"""What every study looks at before it works: names that must be known, cameras that must be there."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rmis_calib.errors import InputError
from rmis_calib.studies.registry import Method, NoiseSource, find_method, find_noise_source, load_extensions
from rmis_calib.studies.settings import Cameras
from rmis_calib.studies.simulation import Setup, make_setup


@dataclass(frozen=True)
class Ready:
    """Checked settings.

    Attributes:
        methods, sources: in the order asked for.
        cameras: those asked for that the set-up has.
        setup: what is simulated.
    """

    methods: tuple[Method, ...]
    sources: tuple[NoiseSource, ...]
    cameras: tuple[Cameras, ...]
    setup: Setup


def prepare(settings: Any, sources: Sequence[str] | None = None) -> Ready:
    """Load extensions and set-up, and look every name up.

    Args:
        settings: of a study.
        sources: names of noise sources; those of the settings when None.

    Raises:
        FileError, InputError: an extension, robot or stereo file that does not work, or a name that is not known.
    """
    methods = find_methods(settings.methods, settings.run.extensions)
    names = settings.sources if sources is None else sources
    found = tuple(find_noise_source(name) for name in dict.fromkeys(names))
    setup = make_setup(settings.setup)
    cameras: list[Cameras] = [view for view in dict.fromkeys(settings.cameras) if setup.cameras == 2 or view == "mono"]
    if not cameras:
        raise InputError(where="--cameras", expected="mono: the stereo file has one camera", found="stereo")
    return Ready(methods, found, tuple(cameras), setup)


def find_methods(names: Sequence[str], extensions: Sequence[Path]) -> tuple[Method, ...]:
    """Methods by name, with those of the extensions.

    Raises:
        FileError, InputError: an extension that does not work, no name, or one that is not known.
    """
    load_extensions(extensions)
    if not names:
        raise InputError(where="--methods", expected="at least one method", found="none")
    return tuple(find_method(name) for name in dict.fromkeys(names))
