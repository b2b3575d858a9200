"""The configuration of a calibration: one definition for Python, YAML presets and command-line flags.

Nothing here has to be set: `CalibrationConfig()` runs the whole pipeline. Precedence: defaults < one YAML file < flags.
"""

from dataclasses import asdict, field, fields
from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError, field_validator, model_validator
from pydantic.dataclasses import dataclass

from rmis_calib.errors import ConfigError
from rmis_calib.io.configs import config_path, load_yaml
from rmis_calib.io.validation import first_finding
from rmis_calib.solver.settings import NotNegative, SolverSettings
from rmis_calib.vision.settings import DetectorSettings

Measurement = Literal["axis", "contours", "ends", "heads"]


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class PictureErrors:
    """Errors of pictures and cameras beyond what the detector claims: from them come the sigmas of the observations
    (`sigma_contour_right`, ..., `sigma_edge_bias`, `sigma_focal`, `sigma_centre`, `sigma_lens`)."""

    model_sigma_px: NotNegative = 0.3
    """What the picture model leaves out (lens, glare, compression, a shaft not quite round): 1 sigma, px, added in
    quadrature to what the detector claims for a contour or an end. Without it sharp pictures outvote the kinematics: on
    the real recording of the tests the answer is 9.8 mm from the reference, with 0.3 px 3.6 mm, with 0.7 px 2.6 mm.
    It is where the estimated noise level sets out from, not a floor: where the lines fit better the level falls (the
    demo ends at a twentieth of it), unless `solver.noise.estimate` is `never`."""
    edge_bias_px: NotNegative = 0.02
    """Error of a contour point that every picture of a camera shares (lens model, edge detector), 1 sigma, px. It does
    not average out, so each is an unknown with this prior. 0.02 to 0.04 px were measured on rendered pictures;
    estimating it took a rendered recording from 0.084 deg and 0.25 mm off to 0.02 deg and 0.11 mm."""
    focal_sigma_relative: NotNegative = 0.005
    """How well the cameras' focal lengths are known, 1 sigma, relative. Where the data see them they are corrected;
    where not (a camera that stands still absorbs a wrong one without a trace), this enters the covariance."""
    centre_sigma_px: NotNegative = 3.0
    """The same of the principal points, px per axis."""
    lens_sigma: NotNegative = 0.03
    """The same of the radial distortion k1."""
    readout_sigma_s: NotNegative = 0.01
    """Time from reading the first row to reading the last, 1 sigma about zero, where recording.yaml does not tell it
    (`rolling_shutter_s`): estimated where the data ask for it, else allowed for. 0: all rows are read at once."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class CalibrationConfig:
    """Everything a calibration can be told."""

    device: str = "cpu"
    """Where images and estimation live: `cpu`, `cuda` or `cuda:N`."""
    batch_size: int = 8
    """Frames decoded, moved and detected together."""
    every: int = 1
    """Process every n-th frame; adjacent frames of a slow video add little."""
    search_every: int = 8
    """Search every n-th of these from the start, as a rule; the others only where both neighbours put the shafts. Where
    these do not agree, or a shaft is not where it should be, each picture is searched. It changes lines by less than
    their uncertainty. 1: search all from the start. With masks of your own all are."""
    masks: str | None = None
    """Use your own segmentation masks instead of colour detection: a folder of pictures in the order of the frames,
    white on shafts (for stereo two folders below it, `right` and `left`), or a TorchScript (.pt) or ONNX (.onnx) model
    from pictures (b, 3, h, w) in [0, 1] to masks (b, h, w), above 0.5 on shafts."""
    mask_labels: tuple[int, ...] | None = None
    """Class numbers of the shaft, where `masks` are pictures of classes (0, 1, 2, ..., as grey values or in a palette):
    all else is background. Without it, white is shaft."""
    prior: str | None = None
    """A first idea of the answer: a result.json, or a YAML file with camera_right_T_arm (4x4 rows, mm). Of several
    shafts in a picture the one nearest to where it puts the instrument is taken at first; it is no measurement."""
    instrument_at: tuple[int, float, float] | None = None
    """Frame, and pixel (u, v) of the right camera, on the shaft of the logged instrument, where pictures show several.
    Without it, and without a prior, it is the one that moves with the joints."""
    look_again: bool = True
    """Look again, along the contours that a first answer predicts, at pictures that show no shaft there. Not with masks
    of your own."""
    measurements: tuple[Measurement, ...] = ("axis", "contours", "ends")
    """What the estimate may use of each picture; `heads` are the labelled head points, else kept for evaluation."""
    picture_errors: PictureErrors = field(default_factory=PictureErrors)
    """What pictures and camera calibrations leave out."""
    clock_search_s: float = 3.0
    """With `solver.unknowns.clock`: clock offsets are searched this far to either side of the recording's own. Public
    recordings are off by up to 2.4 s."""
    min_motions: int = 6
    """Fewest motions with a usable shaft."""
    detector: DetectorSettings = field(default_factory=DetectorSettings)
    """Finding the shaft in a picture."""
    solver: SolverSettings = field(default_factory=SolverSettings)
    """Estimating the transform."""

    @model_validator(mode="before")
    @classmethod
    def _picture_errors_in_their_group(cls, given: Any) -> Any:
        """Settings that stood at the top once are refused with their place."""
        names = given if isinstance(given, dict) else getattr(given, "kwargs", None) or {}
        moved = [spec.name for spec in fields(PictureErrors) if spec.name in names]
        if moved:
            raise ValueError(f"expected {moved[0]} in the group picture_errors, found it outside")
        return given

    @field_validator("device")
    @classmethod
    def _known_device(cls, value: str) -> str:
        kind, _, index = value.partition(":")
        if kind not in ("cpu", "cuda") or (index and not index.isdigit()) or value.endswith(":"):
            raise ValueError("cpu, cuda or cuda:N")
        return value

    @field_validator("batch_size", "every", "search_every", "min_motions")
    @classmethod
    def _positive(cls, value: int) -> int:
        if value < 1:
            raise ValueError("1 or more")
        return value

    @field_validator("clock_search_s")
    @classmethod
    def _not_negative(cls, value: float) -> float:
        if value < 0:
            raise ValueError("0 or more")
        return value

    @field_validator("measurements")
    @classmethod
    def _some_measurement(cls, value: tuple[Measurement, ...]) -> tuple[Measurement, ...]:
        if not {"axis", "contours", "heads"} & set(value):
            raise ValueError("at least one of axis, contours, heads")
        return value

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def parse_config(raw: dict[str, Any], where: str = "config") -> CalibrationConfig:
    """A configuration from plain values.

    Raises:
        ConfigError: an unknown key or an impossible value; names the key.
    """
    try:
        return TypeAdapter(CalibrationConfig).validate_python(raw)
    except ValidationError as error:
        raise first_finding(error, CalibrationConfig, where, ConfigError) from None


def load_config(name_or_path: str | Path) -> CalibrationConfig:
    """A configuration from a YAML file, or from a shipped preset by name (`configs/calibration`).

    Raises:
        ConfigError: an unknown key or an impossible value; names file and key.
        FileError: no such file or preset.
    """
    path = Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        path = config_path("calibration", str(name_or_path))
    raw = load_yaml(path)
    if not isinstance(raw, dict):
        raise ConfigError(where=str(path), expected="a mapping of keys", found=type(raw).__name__)
    return parse_config(raw, where=str(path))
