"""Methods and noise sources that the studies know by name. A file of a few lines adds another (docs/studies.md)."""

import importlib.util
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rmis_calib.errors import InputError
from rmis_calib.io.configs import check_regular, did_you_mean

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from rmis_calib.solver import Problem, Solution

    Solve = Callable[[Problem], Tensor | Solution]
    Disturb = Callable[[dict[str, Any], float, np.random.Generator], None]

Levels = Callable[[float], Mapping[str, float]]
_Levels = TypeVar("_Levels", bound=Levels)
MEASUREMENTS = ("axis", "contours", "ends", "heads")


@dataclass(frozen=True)
class Method:
    """An estimator.

    Attributes:
        name: of the method.
        title: in figures.
        measurements: what of each picture it is given.
        solve: from a problem with a batch of trials to `camera_right_T_arm` (trials, 4, 4), mm, or to a solution.
    """

    name: str
    title: str
    measurements: tuple[str, ...]
    solve: "Solve"


@dataclass(frozen=True)
class NoiseSource:
    """What a noise coefficient means.

    Attributes:
        name: of the source.
        title: in figures.
        levels: from a coefficient to noise levels of `data_synth.LineStudyConfig` (`kinematics_noise_mm`, ...).
        disturb: changes the simulated arrays of an observations file, (trials, N, ...), in place; the Cramer-Rao bound
            does not know of it.
        disturb_board: the same for a board: `base_T_arm` (trials, N, 4, 4), `camera_right_T_board`, and with two
            cameras `camera_left_T_board` and `camera_left_T_camera_right` (trials, 4, 4).
    """

    name: str
    title: str
    levels: Levels
    disturb: "Disturb | None" = None
    disturb_board: "Disturb | None" = None


METHODS: dict[str, Method] = {}
NOISE_SOURCES: dict[str, NoiseSource] = {}


def method(
    name: str, title: str | None = None, measurements: Sequence[str] = ("axis",)
) -> Callable[["Solve"], "Solve"]:
    """Register a method: `@method("mine") def mine(problem): ...`.

    Raises:
        InputError: the name is taken, or there is no such measurement.
    """
    for kind in measurements:
        if kind not in MEASUREMENTS:
            raise InputError(where=f"method {name}", expected=f"measurements of {', '.join(MEASUREMENTS)}", found=kind)

    def register(solve: "Solve") -> "Solve":
        _add(METHODS, Method(name, title or name, tuple(measurements), solve), "method")
        return solve

    return register


def noise_source(
    name: str,
    title: str | None = None,
    disturb: "Disturb | None" = None,
    disturb_board: "Disturb | None" = None,
) -> Callable[[_Levels], _Levels]:
    """Register a noise source: `@noise_source("mine") def levels(coefficient): return {"kinematics_noise_mm": ...}`.

    Args:
        name, title, disturb, disturb_board: as in `NoiseSource`; `disturb_board` is needed by `study_comparison` where
            there is `disturb`.

    Raises:
        InputError: the name is taken.
    """

    def register(levels: _Levels) -> _Levels:
        _add(NOISE_SOURCES, NoiseSource(name, title or name, levels, disturb, disturb_board), "noise source")
        return levels

    return register


def find_method(name: str) -> Method:
    """A method by name.

    Raises:
        InputError: no such method; lists those that there are.
    """
    return _find(METHODS, name, "method")


def find_noise_source(name: str) -> NoiseSource:
    """A noise source by name.

    Raises:
        InputError: no such noise source; lists those that there are.
    """
    return _find(NOISE_SOURCES, name, "noise source")


def load_extensions(paths: Sequence[Path]) -> None:
    """Run files that register methods and noise sources, each once a process.

    Raises:
        FileError: no such file.
        InputError: it cannot be run; says why.
    """
    for path in paths:
        check_regular(path)
        name = f"rmis_calib_extension_{path.resolve().as_posix()}"
        if name in sys.modules:
            continue
        spec = importlib.util.spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise InputError(where=str(path), expected="a Python file (.py)", found=path.name)
        module = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except InputError:
            raise
        except Exception as error:
            found = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise InputError(where=str(path), expected="a Python file that can be run", found=found) from error
        sys.modules[name] = module


def _add(known: dict[str, Any], item: Method | NoiseSource, what: str) -> None:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9-]*", item.name):  # it is part of a file's name
        raise InputError(where=what, expected="a name of letters, digits and hyphens", found=repr(item.name))
    if item.name in known:
        raise InputError(where=f"{what} {item.name}", expected="a name that is not taken", found="one that is")
    known[item.name] = item


def _find(known: dict[str, Any], name: str, what: str) -> Any:
    import rmis_calib.studies.builtin  # noqa: F401  registers what is shipped

    if name not in known:
        expected = f"one of {', '.join(known)}"
        raise InputError(where=what, expected=expected, found=f"{name}{did_you_mean(name, list(known))}")
    return known[name]
