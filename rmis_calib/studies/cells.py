"""The unit of work: some trials of one condition, simulated once, solved by every method, and stored a file a method.

A file appears whole or not at all, and its name tells everything that its numbers depend on: whoever starts the study
again goes on with the files that are missing.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rmis_calib import __version__
from rmis_calib.errors import InputError, RmisCalibError
from rmis_calib.io.atomic import atomic_write
from rmis_calib.studies.registry import Method, NoiseSource, find_method, find_noise_source, load_extensions
from rmis_calib.studies.settings import Cameras, EquipmentSettings, SetupSettings

if TYPE_CHECKING:
    from torch import Tensor

    from rmis_calib.studies.measures import Bound
    from rmis_calib.studies.simulation import Condition, Trials

Report = Callable[[str, int, int], None]
Columns = dict[str, Any]
"""Name of a column -> one value a trial."""

_BLOCK_MOTIONS = 2**18
"""Motions (times trials) that are simulated together: about 300 MB."""
_MOST_TRIALS = 1000
"""Trials of a block, however few motions: what is lost when a study is interrupted."""


@dataclass(frozen=True)
class Part:
    """A file of a cell.

    Attributes:
        method: name.
        cameras: used.
        path: of the file.
    """

    method: str
    cameras: Cameras
    path: Path


@dataclass(frozen=True)
class Cell:
    """Trials of one condition, and the files that are still to be made of them.

    Attributes:
        condition: of all trials.
        setup: what is simulated.
        extensions: files of own methods and noise sources.
        first: number of the first trial.
        trials: how many.
        seed: of these trials.
        parts: what is to be solved and stored.
    """

    condition: "Condition"
    setup: SetupSettings
    extensions: tuple[Path, ...]
    first: int
    trials: int
    seed: int
    parts: tuple[Part, ...]

    @property
    def weight(self) -> int:
        """About how much work it is."""
        return self.trials * self.condition.motions * len(self.parts)


def make_cells(
    folder: Path,
    conditions: "Sequence[Condition]",
    methods: Sequence[str],
    cameras: Sequence[Cameras],
    setup: SetupSettings,
    extensions: tuple[Path, ...],
    trials: int,
    seed: int,
) -> list[Cell]:
    """All cells of a study, the trials of each condition in blocks.

    Noise is drawn from the same seeds in every condition, so that differences between conditions are not those of luck.
    """
    common = [__version__, asdict(setup), content_of(setup), [file_digest(path) for path in extensions]]
    cells = []
    for condition in conditions:
        block = min(_MOST_TRIALS, max(1, _BLOCK_MOTIONS // condition.motions))
        for first in range(0, trials, block):
            count = min(block, trials - first)
            block_seed = int(np.random.SeedSequence([seed, first]).generate_state(1)[0])
            parts = []
            for view in cameras:
                for name in methods:
                    what = [*common, asdict(condition), view, name, first, count, block_seed]
                    mark = hashlib.blake2b(json.dumps(what, default=str).encode(), digest_size=6).hexdigest()
                    parts.append(Part(name, view, folder / f"{_label(condition)}_{view}_{name}_{first}_{mark}.parquet"))
            cells.append(Cell(condition, setup, extensions, first, count, block_seed, tuple(parts)))
    return cells


def run_cell(cell: Cell, report: Report) -> str:
    """Simulate, solve and store; the empty string, or what went wrong in a line. Raises nothing."""
    from rmis_calib.studies.simulation import make_setup, simulate

    try:
        load_extensions(cell.extensions)
        source = find_noise_source(cell.condition.noise) if cell.condition.noise else None
        trials = simulate(make_setup(cell.setup), cell.condition, source, cell.trials, cell.seed)
        bounds: dict[tuple[Any, ...], Bound] = {}
        for done, part in enumerate(cell.parts):
            report("solving", done, len(cell.parts))
            method = find_method(part.method)
            key = (method.measurements, part.cameras)
            if key not in bounds:
                bounds[key] = trials.bound(method.measurements, _count(part.cameras))
            write_table(part.path, _columns(cell, part, method, source, trials, bounds[key]))
        report("solving", len(cell.parts), len(cell.parts))
    except RmisCalibError as error:
        return str(error)
    except Exception as error:
        return f"{cell.condition}: {type(error).__name__}: {' '.join(str(error).split())}"
    return ""


def write_table(path: Path, columns: Columns) -> None:
    """A Parquet file, whole or not at all."""
    import pyarrow
    import pyarrow.parquet

    with atomic_write(path) as temporary:
        pyarrow.parquet.write_table(pyarrow.table(columns), temporary)


def _columns(
    cell: Cell, part: Part, method: Method, source: NoiseSource | None, trials: "Trials", bound: "Bound"
) -> Columns:
    """A row a trial."""
    n = cell.trials
    condition = cell.condition
    constant = {
        "noise": condition.noise,
        "coefficient": condition.coefficient,
        "motions": condition.motions,
        "laparoscope_positions": condition.laparoscope,
        "instrument_positions": condition.instrument,
        "cameras": part.cameras,
        "method": part.method,
    }
    bounds = {f"bound_{name}": value for name, value in vars(bound).items()}
    if source is not None and source.disturb is not None:
        bounds = dict.fromkeys(bounds, float("nan"))  # not of the noise that was simulated
    errors = solve_trials(method, trials, _count(part.cameras))
    rows: Columns = {name: [value] * n for name, value in constant.items()}
    rows |= {"trial": list(range(cell.first, cell.first + n)), "seed": [cell.seed] * n}
    return rows | errors | {name: [value] * n for name, value in bounds.items()} | {"version": [__version__] * n}


def solve_trials(method: Method, trials: "Trials", cameras: int) -> Columns:
    """Errors of a method in every trial, all solved in one batch; infinite where the method found no answer.

    Raises:
        InputError: the method raised, or did not return transforms.
    """
    import torch

    from rmis_calib.errors import InsufficientDataError
    from rmis_calib.solver import Solution, SolveStatus
    from rmis_calib.studies.measures import rotation_deg, transform_errors, translation_mm, working_point_mm

    n = len(trials.truth)
    status, sigma_deg, sigma_mm = ["answered"] * n, [float("nan")] * n, [float("nan")] * n
    try:
        found = method.solve(trials.problem.with_exact_setup().only(*method.measurements).cameras(cameras))
        estimate = found.camera_right_T_arm if isinstance(found, Solution) else torch.as_tensor(found).double()
        if estimate.shape != trials.truth.shape:
            raise ValueError(f"expected transforms {tuple(trials.truth.shape)}, found {tuple(estimate.shape)}")
    except InsufficientDataError:
        estimate, found, status = torch.full_like(trials.truth, torch.nan), None, ["insufficient data"] * n
    except Exception as error:
        text = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise InputError(where=f"method {method.name}", expected="an answer", found=text) from error
    if isinstance(found, Solution):
        status = [SolveStatus(int(code)).name.lower() for code in found.status]
        sigma_deg, sigma_mm = found.rotation_sigma_deg.tolist(), found.translation_sigma_mm.tolist()
    errors = transform_errors(estimate, trials.truth)
    point = working_point_mm(estimate, trials.truth, trials.setup.camera_p_working_point)
    measures = {
        "rotation_error_deg": rotation_deg(errors),
        "translation_error_mm": translation_mm(errors),
        "working_point_error_mm": point,
    }
    columns: Columns = {name: finite_or_infinite(value) for name, value in measures.items()}
    return columns | {"rotation_sigma_deg": sigma_deg, "translation_sigma_mm": sigma_mm, "status": status}


def finite_or_infinite(errors: "Tensor") -> list[float]:
    """Errors of trials (trials,); no answer is infinitely wrong."""
    import torch

    return torch.nan_to_num(errors, nan=torch.inf, posinf=torch.inf).tolist()


def _count(cameras: Cameras) -> int:
    return 2 if cameras == "stereo" else 1


def _label(condition: "Condition") -> str:
    """A condition in a file's name."""
    grid = f"{condition.laparoscope}x{condition.instrument}"
    return f"{condition.noise or 'levels'}-{condition.coefficient:g}_{grid}_{condition.motions}"


def content_of(setup: EquipmentSettings) -> list[str]:
    """Digests of the files that a set-up names: other content, other numbers."""
    named = [Path(item) for item in (setup.robot, setup.stereo) if item is not None]
    return [file_digest(path) for path in named if path.is_file()]


def file_digest(path: Path) -> str:
    """Of a file's content.

    Raises:
        InputError: it cannot be read.
    """
    try:
        return hashlib.blake2b(path.read_bytes(), digest_size=8).hexdigest()
    except OSError as error:
        raise InputError(where=str(path), expected="a file that can be read", found=error.strerror) from error
