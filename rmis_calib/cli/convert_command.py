"""Sub-command: what people have, as a recording folder."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from rmis_calib.cli import EXIT_OK
from rmis_calib.cli.console import progress_reporter, say
from rmis_calib.cli.paths import beside
from rmis_calib.convert.settings import ConvertSettings


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Make a recording of a ROS bag, a dVRK recorder's session, a data set, or pictures with a table.

    ROS1 .bag, ROS2 (folder, .mcap, .db3), recorder mp4 with sidecar JSON and bag or CSV, SurgPose, SurgSync, LeRobot,
    or a folder with right, left and a .csv. Topics are found by type and name; what is guessed is printed and kept in
    recording.yaml.
    """

    source: tyro.conf.Positional[Path]
    """Bag, video or folder."""
    out: Path | None = None
    """Recording folder to make; it appears only when it is complete. Default: SOURCE_recording, numbered."""
    overwrite: bool = False
    """Replace OUT, if all of it was written by this program."""
    settings: Annotated[ConvertSettings, tyro.conf.arg(name="")] = field(default_factory=ConvertSettings)

    def run(self) -> int:
        out = self.out or beside(self.source if self.source.is_dir() else self.source.with_suffix(""), "_recording")
        from rmis_calib.convert import convert

        with progress_reporter() as progress:
            convert(
                self.source,
                out,
                self.settings,
                overwrite=self.overwrite,
                progress=progress,
                on_note=lambda note: say(f"note: {note}"),
            )
        say(f"recording: {out}   next: rmis-calib check {out}")
        return EXIT_OK
