"""The command line: one sub-command is one public Python function, with its settings as flags.

Exit codes: 0 a result that passed its own checks; 1 no trustworthy result; 2 bad usage or bad input; 3 a bug (with its
traceback); 130 interrupted. Nothing heavy is imported before a command's arguments are understood.
"""

import os
import sys
from collections.abc import Sequence
from importlib import import_module

from rmis_calib import __version__

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("Demo", "render a stereo recording, calibrate it, compare with the truth, leave a report"),
    "synth": ("Synth", "render a synthetic recording folder with its ground truth"),
    "detect": ("Detect", "find the instrument shaft in a recording, a video, a folder of images or an image"),
    "calibrate": ("Calibrate", "estimate camera_right_T_arm from a recording folder"),
    "solve": ("Solve", "estimate camera_right_T_arm from an observations file (.npz)"),
    "evaluate": ("Evaluate", "measure a result against head points and against a truth file"),
}

EXIT_OK, EXIT_NOT_TRUSTWORTHY, EXIT_BAD_INPUT, EXIT_BUG, EXIT_INTERRUPTED = 0, 1, 2, 3, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview())
        return EXIT_OK if argv else EXIT_BAD_INPUT
    if argv[0] == "--version":
        print(f"rmis-calib {__version__}")
        return EXIT_OK
    if argv[0] not in COMMANDS:
        return _fail(f"unknown command {argv[0]!r}; expected one of {', '.join(COMMANDS)}")
    try:
        command = import_module("rmis_calib.cli.commands").parse(COMMANDS[argv[0]][0], argv[0], argv[1:])
    except SystemExit as exit_request:  # tyro has printed the help, or what is wrong with the usage
        return int(exit_request.code or 0)
    except BrokenPipeError:  # the help, to a reader that has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_OK
    except Exception as error:
        return _report(error)
    try:
        return command.run()
    except KeyboardInterrupt:
        print("rmis-calib: interrupted; no result was written", file=sys.stderr)
        return EXIT_INTERRUPTED
    except Exception as error:
        return _report(error)


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
    lines += ["usage: rmis-calib COMMAND [OPTIONS]     (rmis-calib COMMAND --help for one command's options)", ""]
    lines += [f"  {name:<10} {sentence}" for name, (_, sentence) in COMMANDS.items()]
    lines += [
        "",
        "exit codes: 0 trustworthy result, 1 no trustworthy result, 2 bad usage or input, 3 a bug, 130 interrupted",
    ]
    return "\n".join(lines)
