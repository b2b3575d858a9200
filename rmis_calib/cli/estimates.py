"""What every estimating command can be told: the settings as flags, and the file that sets their defaults."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from rmis_calib.cli.paths import setting_inputs
from rmis_calib.config import CalibrationConfig
from rmis_calib.solver.settings import Method

Settings = Annotated[CalibrationConfig, tyro.conf.arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Estimates:
    """What every estimating command can be told."""

    config: str | None = None
    """YAML file, or name of a shipped preset, that sets the defaults of the flags below."""
    method: Method | None = None
    """Estimator: joint (default), global (rotation first, then translation) or paper (IJCARS 2020)."""
    settings: Settings = field(default_factory=CalibrationConfig)
    uses: ClassVar[tuple[str, ...] | None] = None
    """Settings that the command uses, and that become its flags; None: all of them."""

    def resolved(self) -> CalibrationConfig:
        if self.method is None:
            return self.settings
        return replace(self.settings, solver=replace(self.settings.solver, method=self.method))

    def inputs(self) -> list[Path]:
        """Files that the settings name, which exist.

        Raises:
            FileError: masks or a prior that are not there.
        """
        return setting_inputs(self.config, self.settings)
