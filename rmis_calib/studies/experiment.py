"""The unit of work on pictures: one set-up rendered and measured once, then solved by every method with many draws of
the robot's noise."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rmis_calib import __version__
from rmis_calib.errors import InputError, InsufficientDataError, RmisCalibError
from rmis_calib.studies.cells import Columns, Part, Report, content_of, file_digest, finite_or_infinite, write_table
from rmis_calib.studies.registry import Method, find_method, load_extensions
from rmis_calib.studies.settings import Cameras, EquipmentSettings, PictureSettings

if TYPE_CHECKING:
    from torch import Tensor

    from rmis_calib.studies.pictures import Measured
    from rmis_calib.studies.robot_noise import RobotNoise

LINES, BOARD = "lines", "board"
_LEFT_BOARD = ("ata",)
"""Board methods that use the second camera, where there is one."""
_OF_TRIALS = ("kinematics_noise_mm", "kinematics_noise_deg", "source", "coefficient")
"""Settings that the pictures do not depend on."""


@dataclass(frozen=True)
class Experiment:
    """A set-up and everything that is tried on it; a cell for the engine.

    Attributes:
        number: 0 has the scene's own hand-eye transform, others a random one.
        measured: file of what the pictures say.
        pictures: what is rendered, and how noisy the robot is.
        setup: robot, cameras and motion.
        motions, board_motions: numbers to draw from all that are measured.
        extensions: files of own methods.
        trials: draws of motions and noise, for each number and method.
        seed: of everything random.
        parts: methods, and where their trials are stored; `cameras` of a board method is "mono" or "stereo" too.
        board_methods: names among the parts that are of the board.
    """

    number: int
    measured: Path
    pictures: PictureSettings
    setup: EquipmentSettings
    motions: tuple[int, ...]
    board_motions: tuple[int, ...]
    extensions: tuple[Path, ...]
    trials: int
    seed: int
    parts: tuple[Part, ...]
    board_methods: tuple[str, ...]

    @property
    def weight(self) -> int:
        """About how much work it is."""
        return max(self.motions) + max(self.board_motions, default=0)


def make_experiments(
    folder: Path,
    count: int,
    methods: Sequence[str],
    board_methods: Sequence[str],
    cameras: Sequence[Cameras],
    motions: Sequence[int],
    board_motions: Sequence[int],
    settings: Any,
) -> list[Experiment]:
    """Set-ups of a study; their files' names tell what their numbers depend on."""
    pictures, run = settings.pictures, settings.run
    preset = Path(pictures.preset)
    rendered = {name: value for name, value in asdict(pictures).items() if name not in _OF_TRIALS}
    look = [__version__, rendered, file_digest(preset) if preset.is_file() else ""]
    look += [asdict(settings.setup), content_of(settings.setup)]
    draws = [asdict(pictures), settings.n_trials, run.seed, [file_digest(path) for path in run.extensions]]
    wanted: list[tuple[str, Cameras]] = [(name, view) for view in cameras for name in methods]
    for name in board_methods:
        wanted.append((name, "stereo" if name in _LEFT_BOARD and "stereo" in cameras else "mono"))
    made = []
    for number in range(count):
        mark = _mark([look, max(motions), max(board_motions, default=0), run.seed, number])
        parts = []
        for name, view in wanted:
            counts = board_motions if name in board_methods else motions
            label = f"experiment-{number}_{view}_{name}_{_mark([mark, draws, sorted(counts), name])}.parquet"
            parts.append(Part(name, view, folder / label))
        made.append(
            Experiment(
                number=number,
                measured=folder / f"measured-{number}_{mark}.npz",
                pictures=pictures,
                setup=settings.setup,
                motions=tuple(sorted(motions)),
                board_motions=tuple(sorted(board_motions)),
                extensions=run.extensions,
                trials=settings.n_trials,
                seed=run.seed,
                parts=tuple(parts),
                board_methods=tuple(board_methods),
            )
        )
    return made


def run_experiment(cell: Experiment, report: Report) -> str:
    """Render and measure, solve and store; the empty string, or what went wrong in a line. Raises nothing."""
    from rmis_calib.studies.pictures import Measured, measure, staged

    try:
        load_extensions(cell.extensions)
        if not cell.measured.is_file():
            count = max(cell.motions) + cell.pictures.validation
            stage = staged(cell.pictures, cell.setup, count, cell.seed, cell.number)
            boards = max(cell.board_motions, default=0)
            measure(stage, boards, lambda _, done, total: report("measuring", done, 2 * total)).save(cell.measured)
        measured = Measured.load(cell.measured)
        for number, part in enumerate(cell.parts):
            report("solving", len(cell.parts) + number, 2 * len(cell.parts))
            is_board = part.method in cell.board_methods
            write_table(part.path, _board_rows(cell, part, measured) if is_board else _line_rows(cell, part, measured))
    except RmisCalibError as error:
        return str(error)
    except Exception as error:
        return f"experiment {cell.number}: {type(error).__name__}: {' '.join(str(error).split())}"
    return ""


def _line_rows(cell: Experiment, part: Part, measured: "Measured") -> Columns:
    import torch

    from rmis_calib.solver import Problem, Solution

    method = find_method(part.method)

    def solve(motions: int, generator: np.random.Generator) -> "Tensor":
        arrays = drawn_lines(measured, motions, cell, generator)
        problem = Problem.from_arrays(arrays).only(*method.measurements).cameras(2 if part.cameras == "stereo" else 1)
        found = _answer(method, problem)
        return found.camera_right_T_arm if isinstance(found, Solution) else torch.as_tensor(found).double()

    return _rows(cell, part, measured, LINES, cell.motions, solve)


def _board_rows(cell: Experiment, part: Part, measured: "Measured") -> Columns:
    import torch

    from rmis_calib import baselines

    board, noise = measured.board, _robot_noise(cell)

    def solve(motions: int, generator: np.random.Generator) -> "Tensor":
        index = _choose(len(board["base_T_arm"]), motions, cell.trials, generator)
        told: dict[str, Any] = {
            "base_T_arm": board["base_T_arm"][index] @ noise.arm(index.shape, generator),
            "camera_right_T_board": board["camera_right_T_board"][index],
        }
        if part.cameras == "stereo":
            told["camera_left_T_board"] = board["camera_left_T_board"][index]
            extrinsics = noise.extrinsics(board["camera_left_T_camera_right"], cell.trials, generator)
            told["camera_left_T_camera_right"] = extrinsics
        noise.disturb_board(told, generator)
        found = baselines.hand_eye(
            told["base_T_arm"], told["camera_right_T_board"], part.method, covariance=False,
            camera_left_T_board=told.get("camera_left_T_board"),
            camera_left_T_camera=told.get("camera_left_T_camera_right"),
        )  # fmt: skip
        flange_T_camera = found.flange_T_camera  # the flange is `arm` here
        usable = torch.isfinite(flange_T_camera).flatten(-2).all(-1)
        safe = torch.where(usable[..., None, None], flange_T_camera, torch.eye(4, dtype=flange_T_camera.dtype))
        return torch.where(usable[..., None, None], torch.linalg.inv(safe), torch.nan)

    return _rows(cell, part, measured, BOARD, cell.board_motions, solve)


def _rows(
    cell: Experiment,
    part: Part,
    measured: "Measured",
    target: str,
    counts: Sequence[int],
    solve: "Callable[[int, np.random.Generator], Tensor]",
) -> Columns:
    """Rows of one method: every number of motions, every trial."""
    import torch

    from rmis_calib.studies.measures import rotation_deg, transform_errors, translation_mm

    truth = torch.as_tensor(measured.camera_right_T_arm)
    exact = np.broadcast_to(measured.camera_right_T_arm, (cell.trials, 4, 4))
    floor = head_errors_px(measured, exact, cell)
    columns: dict[str, list[Any]] = {}
    for motions in counts:
        generator = np.random.default_rng([cell.seed, cell.number, motions])  # the same draws for every method
        try:
            estimate = solve(motions, generator)
        except InsufficientDataError:
            estimate = torch.full((cell.trials, 4, 4), torch.nan, dtype=torch.float64)
        errors = transform_errors(estimate, truth)
        pixels = head_errors_px(measured, estimate.numpy(), cell)
        values = {
            "reprojection_error_px": torch.as_tensor(pixels),
            "rotation_error_deg": rotation_deg(errors),
            "translation_error_mm": translation_mm(errors),
        }
        rows: dict[str, list[Any]] = {
            "experiment": [cell.number + 1] * cell.trials,
            "target": [target] * cell.trials,
            "motions": [motions] * cell.trials,
            "cameras": [part.cameras] * cell.trials,
            "method": [part.method] * cell.trials,
            "trial": list(range(cell.trials)),
            "seed": [cell.seed] * cell.trials,
            **{name: finite_or_infinite(value) for name, value in values.items()},
            "reprojection_of_truth_px": floor.tolist(),
            "version": [__version__] * cell.trials,
        }
        for name, column in rows.items():
            columns.setdefault(name, []).extend(column)
    return dict(columns)


def drawn_lines(measured: "Measured", motions: int, cell: Experiment, generator: np.random.Generator) -> dict[str, Any]:
    """Arrays of an observations file (trials, motions, ...): in each trial other motions and other noise."""
    from rmis_calib.io.observations import OBSERVATION_KEYS

    lines = measured.lines
    n = len(lines["arm_T_rcm"]) - cell.pictures.validation
    index = _choose(n, motions, cell.trials, generator)
    extrinsics = lines.get("camera_left_T_camera_right")
    arrays: dict[str, Any] = {}
    for key in OBSERVATION_KEYS:
        value = lines.get(key)
        if value is None or key == "camera_left_T_camera_right":
            continue
        if key.startswith(("laparoscope_base_T_", "unknown_")):  # set-up and offsets are exact
            continue
        is_constant = np.ndim(value) == 0
        arrays[key] = np.broadcast_to(value, cell.trials).copy() if is_constant else value[index]
    noise = _robot_noise(cell)
    arrays["arm_T_rcm"] = noise.logged(lines["arm_T_rcm"][index], generator)
    if extrinsics is not None:
        arrays["camera_left_T_camera_right"] = noise.extrinsics(extrinsics, cell.trials, generator)
    noise.disturb(arrays, generator)
    return arrays


def head_errors_px(measured: "Measured", camera_right_T_arm: np.ndarray, cell: Experiment) -> np.ndarray:
    """Mean distance (trials,) of the head point from where each estimate (trials, 4, 4) puts it, over the poses of the
    validation, whose kinematics are as noisy as any; the same noise for every method."""
    generator = np.random.default_rng([cell.seed, cell.number, 0])
    lines, last = measured.lines, slice(-cell.pictures.validation, None)
    arm_T_rcm = np.broadcast_to(lines["arm_T_rcm"][last], (len(camera_right_T_arm), cell.pictures.validation, 4, 4))
    camera_right_T_rcm = camera_right_T_arm[:, None] @ _robot_noise(cell).logged(arm_T_rcm, generator)
    p = (
        np.einsum("tnij,nj->tni", camera_right_T_rcm[..., :3, :3], lines["rcm_p_head"][last])
        + camera_right_T_rcm[..., :3, 3]
    )
    in_front = p[..., 2] > 1.0
    depth = np.where(in_front, p[..., 2], 1.0)
    xy = np.where(in_front[..., None], p[..., :2] / depth[..., None], np.inf)  # behind the camera: nowhere near
    labelled = np.isfinite(lines["head_right"][last]).all(-1)
    distance = measured.focal_px * np.linalg.norm(xy - lines["head_right"][last], axis=-1)[:, labelled]
    return distance.mean(-1)


def _robot_noise(cell: Experiment) -> "RobotNoise":
    from rmis_calib.studies.robot_noise import RobotNoise

    return RobotNoise.of(cell.pictures)


def _choose(n: int, count: int, trials: int, generator: np.random.Generator) -> np.ndarray:
    """Different motions (trials, count) in each trial."""
    return np.stack([np.sort(generator.permutation(n)[:count]) for _ in range(trials)])


def _answer(method: Method, problem: Any) -> Any:
    try:
        return method.solve(problem)
    except InsufficientDataError:
        raise
    except Exception as error:
        text = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise InputError(where=f"method {method.name}", expected="an answer", found=text) from error


def _mark(what: Any) -> str:
    return hashlib.blake2b(json.dumps(what, default=str).encode(), digest_size=6).hexdigest()
