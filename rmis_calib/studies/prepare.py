"""What every study looks at before it works: names that must be known, cameras that must be there."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rmis_calib.errors import InputError
from rmis_calib.studies.pictures import staged
from rmis_calib.studies.registry import Method, NoiseSource, find_method, find_noise_source, load_extensions
from rmis_calib.studies.robot_noise import RobotNoise
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
    return Ready(methods, found, _views(settings.cameras, setup.cameras), setup)


def prepare_pictures(settings: Any, cameras: Sequence[Cameras]) -> tuple[tuple[Method, ...], tuple[Cameras, ...]]:
    """The same for a study on rendered pictures, before anything is rendered: its methods on lines, and those numbers
    of cameras that the set-up has.

    Raises:
        FileError, InputError: as `prepare`; a noise source that pictures cannot have.
    """
    methods = find_methods(settings.methods, settings.run.extensions)
    RobotNoise.of(settings.pictures)
    stage = staged(settings.pictures, settings.setup, motions=1, seed=0, experiment=0)
    return methods, _views(cameras, stage.n_cameras)


def _views(asked: Sequence[Cameras], cameras: int) -> tuple[Cameras, ...]:
    """Those asked for that there are."""
    views: list[Cameras] = [view for view in dict.fromkeys(asked) if cameras == 2 or view == "mono"]
    if not views:
        raise InputError(where="--cameras", expected="mono: there is one camera", found="stereo")
    return tuple(views)


def find_methods(names: Sequence[str], extensions: Sequence[Path]) -> tuple[Method, ...]:
    """Methods by name, with those of the extensions.

    Raises:
        FileError, InputError: an extension that does not work, no name, or one that is not known.
    """
    load_extensions(extensions)
    if not names:
        raise InputError(where="--methods", expected="at least one method", found="none")
    return tuple(find_method(name) for name in dict.fromkeys(names))
