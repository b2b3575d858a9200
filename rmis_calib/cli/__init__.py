"""The command line: one sub-command is one public Python function, with its settings as flags.

Exit codes: 0 a result that passed its own checks; 1 no trustworthy result; 2 bad usage or bad input; 3 a bug (with its
traceback); 130 interrupted. Nothing heavy is imported before a command's arguments are understood.
"""

import difflib
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from rmis_calib import __version__
from rmis_calib.cli.streams import guarded_output

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("Demo", "render a stereo recording, calibrate it, compare with the truth, leave a report"),
    "synth": ("Synth", "render a synthetic recording folder with its ground truth"),
    "detect": ("Detect", "find the instrument shaft in a recording, a video, a folder of images or an image"),
    "check": ("Check", "look a recording over before it is calibrated: files, clocks, motion, a few pictures"),
    "calibrate": ("Calibrate", "estimate camera_right_T_arm from a recording folder"),
    "batch": ("Batch", "calibrate, or detect in, all recordings of a tree; resumes where it stopped"),
    "compare": ("Compare", "pool results of one set-up, test whether they agree, name what does not fit"),
    "study": ("Study", "Monte-Carlo studies: the paper's experiments and your own robot (noise, motions, plan, ...)"),
    "solve": ("Solve", "estimate camera_right_T_arm from an observations file (.npz)"),
    "export": ("Export", "write a result as another program reads it: dVRK, ROS, MoveIt, OpenCV, URDF and more"),
    "baseline": ("Baseline", "hand-eye calibration with a board: published methods side by side, from pairs of poses"),
    "evaluate": ("Evaluate", "measure a result against head points and against a truth file"),
    "convert": ("Convert", "make a recording of a ROS bag, a dVRK session, a data set, or pictures with a table"),
    "view": ("View", "show arms, cameras, shaft and uncertainty in a browser, motion by motion"),
    "info": ("Info", "print versions, devices and paths, for a bug report"),
    "completion": ("Completion", "print a script for bash or zsh that completes commands and options"),
    "cameras show": ("CamerasShow", "print a camera file of any known format as stereo.yaml, and draw it"),
    "robots list": ("RobotsList", "list the shipped robots"),
    "robots show": ("RobotsShow", "print a robot as robot.yaml"),
    "robots check": ("RobotsCheck", "test a robot: RCM fixed, limits, reach; and draw it"),
    "robots import": ("RobotsImport", "make robot.yaml of a dVRK arm, tool and system, or of a URDF"),
}
"""Class in cli/commands.py and what it does, by name; a name of two words is one of a group."""

EXIT_OK, EXIT_NOT_TRUSTWORTHY, EXIT_BAD_INPUT, EXIT_BUG, EXIT_INTERRUPTED = 0, 1, 2, 3, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code, which follows the result and never the reader of standard output."""
    with guarded_output() as output:
        code = _run(list(sys.argv[1:] if argv is None else argv))
        output.flush()
        if output.failure:
            code = _fail(f"standard output: expected a place that can be written, found {output.failure}")
    return code


def _run(argv: list[str]) -> int:
    if argv and argv[0] == "help":
        argv = [*argv[1:], "--help"]
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview())
        return EXIT_OK if argv else EXIT_BAD_INPUT
    if argv[0] in ("--version", "-V"):
        print(f"rmis-calib {__version__}")
        return EXIT_OK
    words = 2 if " ".join(argv[:2]) in COMMANDS else 1
    name, arguments = " ".join(argv[:words]), argv[words:]
    if name not in COMMANDS:
        return _not_a_command(argv)
    if {"-h", "--help"} & set(arguments):
        print(help_page(f"{name} {arguments[0]}") or help_page(name), end="")
        return EXIT_OK
    try:
        command = import_module("rmis_calib.cli.commands").parse(COMMANDS[name][0], name, arguments)
    except SystemExit as exit_request:  # tyro has printed the help
        return int(exit_request.code or 0)
    except Exception as error:
        return _report(error)
    try:
        return command.run()
    except KeyboardInterrupt:
        print("rmis-calib: interrupted; no result was written", file=sys.stderr)
        return EXIT_INTERRUPTED
    except Exception as error:
        return _report(error)


def help_page(name: str) -> str:
    """What `--help` prints of a command, read from a file: nothing is imported for it. Empty where there is none."""
    page = Path(__file__).with_name("help") / f"{name.replace(' ', '_')}.txt"
    return page.read_text(encoding="utf-8") if page.is_file() else ""


def _not_a_command(argv: list[str]) -> int:
    """What a group holds, or the nearest command's name."""
    group = [name for name in COMMANDS if name.startswith(f"{argv[0]} ")]
    if group and argv[1:] == ["--help"]:
        print("\n".join(f"rmis-calib {name}: {COMMANDS[name][1]}" for name in group))
        return EXIT_OK
    if group:
        found = repr(argv[1]) if len(argv) > 1 else "nothing"
        return _fail(f"rmis-calib {argv[0]}: expected one of {', '.join(group)}, found {found}")
    near = difflib.get_close_matches(argv[0], COMMANDS, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    return _fail(f"unknown command {argv[0]!r}{hint}; expected one of {', '.join(COMMANDS)}")


def _report(error: Exception) -> int:
    from rmis_calib.errors import CalibrationFailed, RmisCalibError

    if isinstance(error, CalibrationFailed):
        print(f"rmis-calib: no trustworthy result: {error}", file=sys.stderr)
        return EXIT_NOT_TRUSTWORTHY
    if isinstance(error, RmisCalibError):
        return _fail(str(error))
    import traceback

    traceback.print_exception(error)
    print("rmis-calib: this is a bug; please report it with the lines above", file=sys.stderr)
    return EXIT_BUG


def _fail(message: str) -> int:
    print(f"rmis-calib: error: {message}", file=sys.stderr)
    return EXIT_BAD_INPUT


def _overview() -> str:
    lines = [f"rmis-calib {__version__}: markerless hand-eye calibration of a stereo laparoscope", ""]
    lines += ["usage: rmis-calib COMMAND [options]     (rmis-calib help COMMAND shows one command's options)", ""]
    lines += [f"  {name:<13} {sentence}" for name, (_, sentence) in COMMANDS.items()]
    lines += [
        "",
        "exit codes: 0 trustworthy result, 1 no trustworthy result, 2 bad usage or input, 3 a bug, 130 interrupted",
    ]
    return "\n".join(lines)
