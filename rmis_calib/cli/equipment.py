"""Sub-commands about what a set-up is made of: cameras and robots."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from rmis_calib.cli import EXIT_OK
from rmis_calib.cli.console import say
from rmis_calib.cli.paths import beside
from rmis_calib.errors import RmisCalibError
from rmis_calib.io.outputs import check_apart, check_file


@dataclass(frozen=True, kw_only=True)
class CamerasShow:
    """Print a camera calibration of any known format as stereo.yaml writes it, and draw both cameras.

    Formats: stereo.yaml, ROS camera_info (a pair: the folder, or FILE and --left), OpenCV FileStorage, kalibr camchain,
    MATLAB stereoParameters (.mat by toStruct, JSON), SurgPose .ini, stereo_calib_params.json, EndoVis 2018 .txt,
    scikit-surgery. The output is a valid stereo.yaml: what was guessed stands in comments.
    """

    file: tyro.conf.Positional[Path]
    """Calibration file, or the folder that holds the files of a pair; with --left, the right camera's."""
    left: Path | None = None
    """ROS camera_info of the left camera."""
    image_size: tuple[int, int] | None = None
    """Width and height of the pictures, px, for formats that do not say."""
    out: Path | None = None
    """Picture to write (.png). Default: FILE_cameras.png, numbered."""

    def run(self) -> int:
        import yaml

        from rmis_calib.io.stereo import read_camera_pair, read_stereo

        notes: list[str] = []
        size = None if self.image_size is None else (self.image_size[1], self.image_size[0])
        if self.left is not None:
            cameras = read_camera_pair(self.file, self.left, notes.append)
        else:
            cameras = read_stereo(self.file, notes.append, None if size is None else lambda: size)
        inputs = [path for path in (self.file, self.left) if path is not None]
        out = self.out or beside(self.file.with_suffix(""), "_cameras", ".png")
        check_apart(out, [path for path in inputs if path.is_file()])
        check_file(out, lambda _: False, overwrite=False)
        from rmis_calib.io.recording import camera_rig
        from rmis_calib.report import draw_cameras

        rig = camera_rig(cameras)
        draw_cameras(rig, out)
        for sentence in (*_angles(rig), *notes):
            say(f"# {sentence}")
        try:
            say(yaml.safe_dump(cameras.to_dict(), sort_keys=False, default_flow_style=None, width=120).rstrip())
        except RmisCalibError as problem:
            say(f"# {problem}")
        say(f"# drawn: {out}")
        return EXIT_OK


def _angles(rig: object) -> list[str]:
    """What the cameras see, in words."""
    from rmis_calib.report.equipment import field_of_view_deg

    lines = []
    for side in ("right", "left"):
        camera = getattr(rig, side)
        if camera is not None:
            horizontal, vertical = field_of_view_deg(camera)
            lines.append(f"{side}: {camera.model}, field of view {horizontal:.1f} x {vertical:.1f} deg")
    extrinsics = getattr(rig, "camera_left_T_camera_right", None)
    if extrinsics is not None:
        lines.append(f"baseline {float(extrinsics.t.norm()):.3f} mm; camera axes: x right, y down, z forward")
    return lines
