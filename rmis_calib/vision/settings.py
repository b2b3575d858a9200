"""Settings of the shaft detector."""

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, config=_STRICT)
class DetectorSettings:
    """How shafts are looked for. The defaults serve every picture that the project was tested on."""

    max_shafts: int = Field(default=6, ge=1, le=8)
    """Most candidates measured and reported a frame, the surest first. Before a chessboard, or furniture, it takes many
    for the shaft to be among them; what stands still while the instrument moves is left out by `calibrate`."""
    small_width_px: int = Field(default=320, ge=120, le=1280)
    """Width, px, of the small picture on which shafts are searched for; sub-pixel work is at full resolution."""
    min_width_fraction: float = Field(default=0.02, gt=0, lt=1)
    """Narrowest shaft, as a fraction of the picture's width."""
    max_width_fraction: float = Field(default=0.22, gt=0, lt=1)
    """Widest shaft, as a fraction of the picture's width."""
    max_convergence_deg: float = Field(default=14.0, gt=0, lt=45)
    """Largest angle, deg, between the two contour lines of one shaft (perspective)."""
    min_aspect: float = Field(default=0.8, gt=0)
    """Shortest visible shaft, in shaft widths."""
    min_contrast: float = Field(default=0.12, gt=0)
    """Smallest step across a contour that counts, in units of log brightness (0.12: twelve per cent)."""
    black_level: float = Field(default=0.035, ge=0, lt=0.5)
    """Brightness, fraction of full scale, up to which a border of the picture counts as outside the field of view."""
    second_look_below: float = Field(default=0.9, ge=0, le=1)
    """Pictures without a shaft as sure as this, or with more in them that may be one, are searched again in a second
    view, in which glare, blood, shadows and cavities hide less, at twice the time. 1 looks twice at all of them, 0 at
    none."""
    min_confidence: float = Field(default=0.40, ge=0, le=1)
    """Candidates below this confidence are not reported."""
    end_run_widths: float = Field(default=1.4, gt=0)
    """A stretch of shaft beyond an interruption (a ball, a clip) must be this many widths long to carry the end."""
    edge_samples: int = Field(default=256, ge=32, le=4096)
    """Sub-pixel edge points measured a contour."""
    sigma_floor_px: float = Field(default=0.03, gt=0)
    """Error, px, of the blurred-step model itself, added in quadrature to the uncertainty of every contour; ends carry
    five times as much."""
