"""The help that a person reads: a screen each, nothing in it that the command does not know, and the Tab key."""

import dataclasses
import os
import pty
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from rmis_calib.cli import COMMANDS, commands, help_page, main
from rmis_calib.cli.study_commands import STUDIES
from rmis_calib.config import CalibrationConfig

ROOT = Path(__file__).resolve().parents[2]
KINDS = {name: getattr(commands, kind) for name, (kind, _) in COMMANDS.items() if name != "study"}
KINDS |= {f"study {name}": kind for name, (kind, _) in STUDIES.items()}
SLOW_TO_IMPORT = ("tyro", "pydantic", "rich", "yaml", "numpy", "torch")
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "100"}


def options(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """What `--help-all` says in the end of each flag: its default, `required`, or nothing."""
    monkeypatch.setenv("COLUMNS", "100")  # one column
    assert main([*name.split(), "--help-all"]) == 0
    text = "\n".join(line.strip("│ ") for line in capsys.readouterr().out.splitlines())
    entries = re.findall(r"^(--[a-z][\w.-]*)((?:.|\n(?!--|[a-z.]+ options|-{9}))*)", text, flags=re.M)
    ends = [(flag, re.search(r"\((?:default:\s)?([^()]*)\)$", rest.strip())) for flag, rest in entries]
    return {flag: end[1] if end else "" for flag, end in ends}


@pytest.mark.parametrize("name", [*KINDS, "study"])
def test_help_fits_a_screen_and_shows_two_examples(name) -> None:
    page = help_page(name)
    lines = page.splitlines()
    assert page.startswith(f"usage: rmis-calib {name}")
    assert len(lines) <= 40 and max(map(len, lines)) <= 100
    after = lines[lines.index("Examples") + 1 :]
    examples = [line.strip() for line in after[: after.index("")] if line] if "" in after else [*map(str.strip, after)]
    assert len(examples) == 2 and all(example.startswith("rmis-calib ") for example in examples)


@pytest.mark.parametrize("name", KINDS)
def test_help_says_what_the_command_knows(name, capsys, monkeypatch) -> None:
    page, known = help_page(name), options(name, capsys, monkeypatch)
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", page)) - {"--help", "--help-all"}
    assert named <= set(known)
    assert {flag for flag, said in known.items() if said == "required"} <= named
    assert named == set(known) or f"rmis-calib {name} --help-all" in page
    for entry in re.split(r"\n(?=  --)", page):
        said = re.match(r"  (--[a-z-]+)[^(]*(?:\([^d][^)]*\)[^(]*)*\(default: ([\d.a-z_]+)\)", entry)
        if said:
            assert known[said[1]] in (said[2], ""), said[1]  # no default in the code: the command makes it


@pytest.mark.parametrize("name", KINDS)
def test_examples_are_understood(name) -> None:
    for line in re.findall(r"^  (rmis-calib .*)$", help_page(name), flags=re.M):
        words = shlex.split(line.partition(" | ")[0].partition(" > ")[0])[1:]
        assert words[: len(name.split())] == name.split()
        kind, command = (COMMANDS[name][0], name) if name in COMMANDS else ("Study", "study")
        commands.parse(kind, command, words[len(command.split()) :])


@pytest.mark.parametrize("name", ["calibrate", "detect", "study plan", "robots import"])
def test_help_imports_nothing_slow(name) -> None:
    """What makes it answer in a twentieth of a second, whatever the machine does besides."""
    code = (
        "import sys; from rmis_calib.cli import main; code = main(sys.argv[1:]); "
        f"print(code, *(name for name in {SLOW_TO_IMPORT!r} if name in sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *name.split(), "--help"], capture_output=True, text=True, env=ENVIRONMENT
    )
    assert done.stdout.splitlines()[-1] == "0", done.stderr


def test_help_all_groups_the_flags_that_a_command_uses(capsys) -> None:
    assert main(["detect", "--help-all"]) == 0
    shown = capsys.readouterr().out
    assert "--detector.max-shafts" in shown and "detector options" in shown
    assert "--solver" not in shown and "--prior" not in shown
    assert main(["solve", "--help-all"]) == 0
    shown = capsys.readouterr().out
    assert "--solver.noise.image" in shown and "solver.noise options" in shown
    assert "--detector" not in shown and "--masks" not in shown and "OBSERVATIONS" in shown


@pytest.mark.parametrize(
    ("argv", "found"),
    [
        (["solve", "observations.npz", "--masks", "masks"], "--masks, which has no effect on solve"),
        (["solve", "observations.npz", "--every", "2"], "--every, which has no effect on solve"),
        (["detect", "video.mp4", "--solver.seed", "1"], "--solver.seed, which has no effect on detect"),
        (["check", "recording", "--every", "2"], "--every, which has no effect on check"),
    ],
    ids=" ".join,
)
def test_a_flag_without_effect_is_refused(argv, found, capsys) -> None:
    assert main(argv) == 2
    assert found in capsys.readouterr().err


@pytest.mark.parametrize("kind", [kind for kind in KINDS.values() if getattr(kind, "uses", None)])
def test_flags_that_commands_use_are_settings(kind) -> None:
    assert set(kind.uses) <= {spec.name for spec in dataclasses.fields(CalibrationConfig)}


def test_a_settings_file_counts_for_detect_too(tmp_path) -> None:
    (tmp_path / "mine.yaml").write_text("every: 7\ndetector: {max_shafts: 2}\nsolver: {method: paper}\n")
    words = ["video.mp4", "--config", str(tmp_path / "mine.yaml"), "--detector.max-shafts", "3"]
    settings = commands.parse("Detect", "detect", words).settings
    assert type(settings) is CalibrationConfig
    assert (settings.every, settings.detector.max_shafts, settings.solver.method) == (7, 3, "paper")


def on_a_terminal(argv: list[str], **environment: str) -> str:
    """What a command writes where a terminal reads."""
    master, terminal = pty.openpty()
    environment = ENVIRONMENT | {"TERM": "xterm-256color"} | environment
    done = subprocess.Popen([sys.executable, *argv], stdout=terminal, stderr=subprocess.DEVNULL, env=environment)
    os.close(terminal)
    text = b""
    while True:
        try:
            part = os.read(master, 65536)
        except OSError:  # Linux: everybody else has closed it
            break
        if not part:
            break
        text += part
    os.close(master)
    assert done.wait() == 0
    return text.decode()


BOLD = ["-c", "from rmis_calib.cli.console import console; console.print('ok', style='bold green')"]
HELP_ALL = ["-m", "rmis_calib", "solve", "--help-all"]


@pytest.mark.parametrize("argv", [BOLD, HELP_ALL], ids=["result", "help"])
def test_colours_are_for_terminals_that_want_them(argv) -> None:
    environment = {"NO_COLOR": ""}
    assert "\x1b[" in on_a_terminal(argv, **environment)
    assert "\x1b[" not in on_a_terminal(argv, NO_COLOR="1")
    piped = subprocess.run([sys.executable, *argv], capture_output=True, text=True, env=ENVIRONMENT, check=True)
    assert piped.stdout and "\x1b[" not in piped.stdout


COMPLETE = """
source completion.bash
COMP_WORDS=(rmis-calib {words}); COMP_CWORD=$(( ${{#COMP_WORDS[@]}} - 1 )); COMPREPLY=()
COMP_LINE="${{COMP_WORDS[*]}}"; COMP_POINT=${{#COMP_LINE}}
_tyro_rmis_calib; echo "${{COMPREPLY[@]}}"
"""


def test_the_tab_key_completes(tmp_path, capsys) -> None:
    assert main(["completion", "zsh"]) == 0
    assert capsys.readouterr().out.startswith("#compdef rmis-calib")
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    assert "complete -o default -F _tyro_rmis_calib rmis-calib" in script  # file names come from bash
    (tmp_path / "completion.bash").write_text(script)

    def completed(words: str) -> set[str]:
        code = COMPLETE.format(words=words)
        done = subprocess.run(["bash", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
        return set(done.stdout.split())

    assert completed("cal") == {"calibrate"}
    assert completed("robots im") == {"import"}
    assert completed("study rep") == {"reprojection"}
    assert completed("solve --meth") == {"--method"}
    assert completed("calibrate --method j") == {"joint"}
    assert completed("detect --detector.max-s") == {"--detector.max-shafts"}
    assert completed("detect --solver") == set()
