"""Settings of the studies. Importing this module imports neither torch nor anything heavy."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

Count = Annotated[int, Field(ge=1)]
NotNegative = Annotated[float, Field(ge=0.0)]
Positive = Annotated[float, Field(gt=0.0)]
Vector = tuple[float, float, float]
Cameras = Literal["mono", "stereo"]

QUICK_TRIALS = 8
FULL_TRIALS = 100


@dataclass(frozen=True, config=_STRICT)
class EquipmentSettings:
    """The robot, the cameras, how far the arms move, and where the instrument is. Defaults: the built-in scene."""

    robot: str | None = None
    """Your robot: a preset's name or robot.yaml. The study places its arms so that the instrument is where
    --instrument-rcm-mm and --target-mm say. Default: two arms of three joints."""
    stereo: Path | None = None
    """Your cameras: stereo.yaml or another calibration file. Rendered pictures have their distortion; without pictures,
    focal length, picture size and extrinsics count."""
    laparoscope_arm: str = "laparoscope"
    """Name of the laparoscope's arm in the robot."""
    instrument_arm: str = "instrument"
    """Name of the instrument's arm in the robot."""
    rotation_range_deg: Positive = 10.0
    """Full range of every revolute joint that moves."""
    translation_range_mm: Positive = 20.0
    """Full range of every insertion."""
    laparoscope_rcm_behind_mm: Positive | None = None
    """Distance of the laparoscope's remote centre of motion behind the camera, in the middle of the motion."""
    instrument_rcm_mm: Vector | None = None
    """The instrument's remote centre of motion, in the right camera's frame."""
    target_mm: Vector | None = None
    """The instrument's head point in the middle of the motion, in the right camera's frame: the working point, where
    errors count."""
    shaft_diameter_mm: Positive | None = None
    """Diameter of the instrument's shaft."""


@dataclass(frozen=True, config=_STRICT)
class SetupSettings(EquipmentSettings):
    """What is simulated without pictures."""

    pixel_noise_px: NotNegative = 0.5
    """Noise of every image point, 1 sigma per coordinate."""


@dataclass(frozen=True, config=_STRICT)
class RunSettings:
    """How a study is run."""

    trials: Count | None = None
    """Trials of every condition. Default: 100, and 8 with --quick; of `plan` 200 and 40."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of everything random."""
    quick: bool = False
    """Fewer conditions and trials: under a minute on two cores."""
    extensions: tuple[Path, ...] = ()
    """Python files that add methods or noise sources of your own (docs/studies.md)."""
    workers: Count | None = None
    """Processes that work side by side. Default: one a core. 1 works in this process."""
    cluster: str | None = None
    """Address of a dask scheduler (tcp://host:8786), or `local` to start one here, in place of own processes. The
    workers must see the output folder and the extensions under the same paths."""

    @property
    def n_trials(self) -> int:
        return self.trials or (QUICK_TRIALS if self.quick else FULL_TRIALS)


@dataclass(frozen=True, config=_STRICT)
class NoiseStudySettings:
    """Error against the noise coefficient (the paper's Fig. 2)."""

    methods: tuple[str, ...] = ("paper", "global", "joint-axis", "joint-contours")
    """Methods to compare."""
    sources: tuple[str, ...] = ("kinematics", "kinematics-camera", "kinematics-camera-stereo")
    """Noise sources, each a column of the figure."""
    coefficients: tuple[NotNegative, ...] | None = None
    """Noise coefficients: a coefficient c is c mm and c deg, 1 sigma per axis. Default: 0 to 2 by 0.2; with --quick
    0, 1 and 2."""
    cameras: tuple[Cameras, ...] = ("mono", "stereo")
    """Cameras used."""
    positions_laparoscope: Count = 3
    """Positions a joint of the laparoscope, M_L."""
    positions_instrument: Count = 4
    """Positions a joint of the instrument, M_I: there are M_L^3 M_I^3 motions."""
    setup: SetupSettings = SetupSettings()
    """What is simulated."""
    run: RunSettings = RunSettings()
    """How it is run."""


@dataclass(frozen=True, config=_STRICT)
class MotionsStudySettings:
    """Error against the number of motions, N = M_L^3 M_I^3 (the paper's Fig. 3)."""

    methods: tuple[str, ...] = ("paper", "global", "joint-axis", "joint-contours")
    """Methods to compare."""
    source: str = "kinematics-camera-stereo"
    """Noise source."""
    coefficient: NotNegative = 1.0
    """Noise coefficient: c mm and c deg, 1 sigma per axis."""
    positions: tuple[Annotated[int, Field(ge=2)], ...] | None = None
    """Products M_L M_I, of which all splits are simulated. Default: 3 to 12, which is 27 to 1,728 motions; with --quick
    3, 4, 6 and 8."""
    cameras: tuple[Cameras, ...] = ("mono", "stereo")
    """Cameras used."""
    setup: SetupSettings = SetupSettings()
    """What is simulated."""
    run: RunSettings = RunSettings()
    """How it is run."""


@dataclass(frozen=True, config=_STRICT)
class PlanSettings:
    """How many motions a wanted accuracy takes."""

    wanted_mm: Positive = 1.0
    """Wanted error at the working point."""
    wanted_deg: Positive | None = None
    """Wanted rotation error, too."""
    confidence: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.9
    """Share of recordings that must reach it."""
    most_motions: Annotated[int, Field(ge=4)] = 512
    """Largest number of motions to consider."""
    methods: tuple[str, ...] = ("joint",)
    """Methods; the answer is of the first one. `joint` uses what `calibrate` uses, joint-axis the paper's lines."""
    cameras: tuple[Cameras, ...] = ("stereo",)
    """Cameras used; the answer is of the first one."""
    laparoscope: Literal["moves", "still"] = "moves"
    """Whether the laparoscope moves, too."""
    kinematics_noise_mm: NotNegative = 0.3
    """Noise of the kinematics, 1 sigma per axis of every motion's `arm_T_rcm`."""
    kinematics_noise_deg: NotNegative = 0.1
    """Rotational part of the same."""
    stereo_noise_mm: NotNegative = 0.05
    """Error of the stereo extrinsics, 1 sigma per axis."""
    stereo_noise_deg: NotNegative = 0.05
    """Rotational part of the same."""
    source: str | None = None
    """A noise source, whose levels take the place of those above, and which may add errors of its own."""
    coefficient: NotNegative = 1.0
    """Its noise coefficient."""
    setup: SetupSettings = SetupSettings()
    """What is simulated."""
    run: RunSettings = RunSettings()
    """How it is run."""

    @property
    def n_trials(self) -> int:
        """A share of recordings takes more trials than a median."""
        return self.run.trials or (40 if self.run.quick else 200)


@dataclass(frozen=True, config=_STRICT)
class PictureSettings:
    """What is rendered, and how noisy the robot is."""

    preset: str = "demo"
    """Appearance: a preset of configs/synth or a YAML file."""
    kinematics_noise_mm: NotNegative = 0.3
    """Noise of each arm's end pose, 1 sigma per axis, drawn anew for every motion and trial."""
    kinematics_noise_deg: NotNegative = 0.1
    """Rotational part of the same."""
    source: str | None = None
    """A noise source for kinematics and stereo extrinsics, in place of the noise above. Noise of the cameras' poses or
    of points has no place here: the pictures have their own."""
    coefficient: NotNegative = 1.0
    """Its noise coefficient."""
    validation: Count = 15
    """Further poses of the instrument, whose head point is compared with where the calibration puts it."""


@dataclass(frozen=True, config=_STRICT)
class ReprojectionStudySettings:
    """Head-point reprojection error against the number of motions, through the whole vision pipeline (Fig. 5)."""

    methods: tuple[str, ...] = ("paper", "global", "joint-axis", "joint")
    """Methods to compare."""
    motions: tuple[Annotated[int, Field(ge=4)], ...] | None = None
    """Numbers of motions; as many are rendered as the largest. Default: 8 to 343; with --quick 8, 16 and 32."""
    cameras: tuple[Cameras, ...] = ("mono", "stereo")
    """Cameras used."""
    pictures: PictureSettings = PictureSettings()
    """What is rendered, and how noisy the robot is."""
    setup: EquipmentSettings = EquipmentSettings()
    """Robot, cameras and motion."""
    run: RunSettings = RunSettings()
    """How it is run."""

    @property
    def n_trials(self) -> int:
        """The paper's 20."""
        return self.run.trials or (8 if self.run.quick else 20)


@dataclass(frozen=True, config=_STRICT)
class ComparisonStudySettings:
    """Calibration from the instrument against calibration with a board (Fig. 6)."""

    methods: tuple[str, ...] = ("paper", "joint-axis", "joint")
    """Methods on lines."""
    board_methods: tuple[str, ...] = ("ata", "park", "refine")
    """Methods on the board, of `rc.baselines`; `ata` uses both cameras, as the paper's comparison does."""
    experiments: Count | None = None
    """Set-ups with another hand-eye transform each. Default: 6, and 1 with --quick."""
    motions: tuple[Annotated[int, Field(ge=4)], ...] | None = None
    """Numbers of motions of the instrument. Default: 12, 24, 48, 96, 192, 343; with --quick 12 and 32."""
    board_motions: tuple[Annotated[int, Field(ge=4)], ...] | None = None
    """Numbers of motions of the board. Default: 4, 6, 8, 12, 16, 24, 32; with --quick 6, 12 and 16."""
    pictures: PictureSettings = PictureSettings()
    """What is rendered, and how noisy the robot is."""
    setup: EquipmentSettings = EquipmentSettings()
    """Robot, cameras and motion."""
    run: RunSettings = RunSettings()
    """How it is run."""

    @property
    def n_trials(self) -> int:
        """The paper's 10."""
        return self.run.trials or (8 if self.run.quick else 10)
