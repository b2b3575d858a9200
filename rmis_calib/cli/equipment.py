"""Sub-commands about what a set-up is made of: cameras and robots."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import tyro

from rmis_calib.cli import EXIT_NOT_TRUSTWORTHY, EXIT_OK
from rmis_calib.cli.console import say
from rmis_calib.cli.paths import beside
from rmis_calib.errors import InputError, RmisCalibError
from rmis_calib.io.dvrk_robot import Endoscope
from rmis_calib.io.outputs import check_apart, check_file
from rmis_calib.robot import Robot


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


@dataclass(frozen=True, kw_only=True)
class RobotsList:
    """List the shipped robots: arms, joints, and what has to be filled in."""

    def run(self) -> int:
        from rmis_calib.io.configs import config_names
        from rmis_calib.io.robot import load_robot

        for name in config_names("robots"):
            arms = load_robot(name).arms
            said = ", ".join(f"{arm} ({len(table.joints)} joints)" for arm, table in arms.items())
            say(f"{name:<22} {said}")
        return EXIT_OK


@dataclass(frozen=True, kw_only=True)
class RobotsShow:
    """Print a robot as robot.yaml writes it: a place to start from, and what the program understood of yours."""

    robot: tyro.conf.Positional[str]
    """Name of a shipped robot, or a robot.yaml."""

    def run(self) -> int:
        from rmis_calib.io.robot import load_robot

        notes: list[str] = []
        say(robot_text(load_robot(self.robot, notes.append)).rstrip())
        for note in notes:
            say(f"# {note}")
        return EXIT_OK


@dataclass(frozen=True, kw_only=True)
class RobotsCheck:
    """Test a robot over 2,000 random poses within its limits, and draw it.

    Exit code 0: the shaft passes through its RCM to a micrometre and points to the tip, and the bases differ; 1: not.
    """

    robot: tyro.conf.Positional[str]
    """Name of a shipped robot, or a robot.yaml."""
    out: Path | None = None
    """Picture to write (.png). Default: NAME_robot.png beside the file, or in the current folder; numbered."""

    def run(self) -> int:
        from rmis_calib.io.robot import load_robot

        robot = load_robot(self.robot)
        out = self.out or beside(Path(self.robot).with_suffix(""), "_robot", ".png")
        check_file(out, lambda _: False, overwrite=False)
        from rmis_calib.kinematics import check_robot
        from rmis_calib.report import draw_robot

        reports = check_robot(robot)
        draw_robot(reports, out)
        for report in reports:
            say(f"{report.name}: {'; '.join(report.joints)}")
            low, high = report.reach_mm
            what = "head point" if report.is_instrument else "tool"
            spans = ", ".join(f"{axis} {a:.0f} to {b:.0f}" for axis, a, b in zip("xyz", low, high, strict=True))
            say(f"  {what} reaches {spans} mm in base")
            if report.is_instrument:
                misses, moves = report.shaft_misses_mm or 0.0, report.rcm_moves_mm or 0.0
                say(f"  shaft misses the RCM by {misses:.2g} mm; the RCM moves by {moves:.2g} mm")
            for remark in report.remarks:
                say(f"  note: {remark}")
            for problem in report.problems:
                say(f"  PROBLEM: {problem}")
        say(f"drawn: {out}")
        return EXIT_NOT_TRUSTWORTHY if any(report.problems for report in reports) else EXIT_OK


@dataclass(frozen=True, kw_only=True)
class RobotsImport:
    """Make robot.yaml of other programs' files: dVRK JSON (arm and tool, ECM, system), or a URDF.

    dVRK: `robots import PSM1.json --tool LARGE_NEEDLE_DRIVER_400006.json --ecm ECM.json --system system.json`. Take the
    generation of the arm from the arm, and that of the tool from the tool: an Si tool on a Classic arm is fine.
    URDF: `robots import PSM1.urdf --shaft-link tool_main --head-link tool_wrist`; an arm at a time.
    """

    file: tyro.conf.Positional[Path]
    """kinematic/PSM.json or arm/PSM1.json of the dVRK; or a .urdf (of a .xacro: its output)."""
    tool: Path | None = None
    """dVRK: tool/NAME.json of the instrument."""
    ecm: Path | None = None
    """dVRK: the same of the endoscope's arm."""
    system: Path | None = None
    """dVRK: console or system JSON, or suj-fixed.json, that places the arms' bases."""
    endoscope: Endoscope = "straight"
    """What looks out of the ECM: a straight scope, or a 30 degree one that looks up or down."""
    shaft_link: str | None = None
    """URDF: the link that the shaft is; the axis of the joint that moves it is the shaft's."""
    head_link: str | None = None
    """URDF: the link whose origin is the head point, where the jaws are hinged."""
    rcm_link: str | None = None
    """URDF: a link whose origin is the RCM; by default the point where the first two joints' axes meet."""
    out: Path = Path("robot.yaml")
    """File to write."""

    def run(self) -> int:
        from rmis_calib.io.atomic import atomic_write
        from rmis_calib.io.configs import check_regular

        inputs = [path for path in (self.file, self.tool, self.ecm, self.system) if path is not None]
        for path in inputs:
            check_regular(path)
        check_apart(self.out, inputs)
        check_file(self.out, lambda _: False, overwrite=False)
        notes: list[str] = []
        robot = self._robot(notes.append)
        text = "".join(f"# {note}\n" for note in notes) + robot_text(robot)
        with atomic_write(self.out) as temporary:
            temporary.write_text(text, encoding="utf-8")
        for note in notes:
            say(f"note: {note}")
        say(f"written: {self.out} ({', '.join(robot.arms)}); test it: rmis-calib robots check {self.out}")
        return EXIT_OK

    def _robot(self, note: Callable[[str], None]) -> Robot:
        if self.file.suffix.lower() == ".urdf":
            from rmis_calib.kinematics.urdf import robot_from_urdf

            if self.shaft_link is None or self.head_link is None:
                raise InputError(
                    where="robots import", expected="--shaft-link and --head-link for a URDF", found="none"
                )
            links = (self.shaft_link, self.head_link, self.rcm_link)
            return robot_from_urdf(self.file.read_bytes(), self.file.stem, *links, note=note)
        if self.tool is None:
            raise InputError(where="robots import", expected="--tool, the instrument's tool/NAME.json", found="nothing")
        from rmis_calib.io.dvrk_robot import import_dvrk

        return import_dvrk(self.file, self.tool, self.ecm, self.system, self.endoscope, note=note)


def robot_text(robot: Robot) -> str:
    """A robot as the text of a robot.yaml."""
    import yaml

    from rmis_calib.io.robot import robot_to_dict

    return yaml.safe_dump(robot_to_dict(robot), sort_keys=False, default_flow_style=None, width=200)
