"""Arguments parsed by tyro, and what is wrong with them in one line of our words."""

import contextlib
import dataclasses
import io
import os
import re
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import tyro
from pydantic import ValidationError

from rmis_calib.cli.flags import flags_of, flags_with, from_flags
from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import ConfigError, InputError
from rmis_calib.io.configs import did_you_mean
from rmis_calib.io.validation import finding_of_option

_FLAG = re.compile(r"(--[a-z][a-z0-9.-]*)")


def parse_arguments(kind: type, argv: Sequence[str], prog: str, settings: Any = None) -> Any:
    """An instance of the dataclass `kind` from command-line words.

    Args:
        kind: a command.
        argv: the words after its name.
        prog: program and command, as the user wrote them.
        settings: defaults of its field `settings`, in place of its own.

    Raises:
        SystemExit: help was asked for, and printed.
        InputError: a word that is not understood, a value that cannot be, or something missing.
    """
    printed = io.StringIO()
    made = flags_of(kind)
    default = None if settings is None else flags_with(kind, settings)
    words = ["--help" if word == "--help-all" else word for word in argv]
    try:
        # Help goes to standard output; what is wrong with the usage is caught, to be said in one line.
        with contextlib.redirect_stderr(printed), _plain_if_asked():
            return from_flags(kind, tyro.cli(made, args=words, prog=prog, default=default, description=made.__doc__))
    except ValidationError as error:  # of the settings as a whole; tyro reports those of single groups itself
        raise finding_of_option(error, "", ConfigError) from None
    except SystemExit as request:
        if not request.code:
            raise
        lines = _unboxed(printed.getvalue())
        unused = _unused_option(kind, lines, prog)
        raise unused or _of_a_group(request, lines) or _in_our_words(lines, argv, prog) from None


@contextlib.contextmanager
def _plain_if_asked() -> Iterator[None]:
    """Help without colours where NO_COLOR is set; tyro itself looks only whether a terminal reads."""
    if not os.environ.get("NO_COLOR"):
        yield
        return
    plain = io.StringIO()
    try:
        with contextlib.redirect_stdout(plain):
            yield
    finally:
        sys.stdout.write(plain.getvalue())


def _of_a_group(request: BaseException, lines: list[str]) -> InputError | None:
    """What pydantic found in a group of settings, which tyro passes on as text; None where it found nothing."""
    cause: BaseException | None = request
    while cause is not None and not isinstance(cause, ValidationError):
        cause = cause.__cause__ or cause.__context__
    if cause is None:
        return None
    # The first part of a group's name is the command's own field for all settings, which options do not name.
    group = re.search(r"Error parsing \w+\.?([\w.-]*)", " ".join(lines))
    return finding_of_option(cause, group[1] if group else "", ConfigError)


def _unused_option(kind: type, lines: list[str], prog: str) -> InputError | None:
    """An option that is one of other commands, and that this one has no use for."""
    unknown = re.search(r"Unrecognized options: (--[a-z][a-z0-9.-]*)", " ".join(lines))
    uses = getattr(kind, "uses", None)
    if unknown is None or uses is None:
        return None
    setting = unknown[1].removeprefix("--").partition(".")[0].replace("-", "_")
    if setting in uses or setting not in {spec.name for spec in dataclasses.fields(CalibrationConfig)}:
        return None
    found = f"{unknown[1]}, which has no effect on {prog.partition(' ')[2]}"
    return InputError(where=prog, expected="an option that this command uses", found=found)


def _unboxed(text: str) -> list[str]:
    """Lines of a box drawn around text, without the box."""
    lines = (re.sub(r"\x1b\[[0-9;]*m", "", line).strip("│╭╮╰╯ ").rstrip() for line in text.splitlines())
    return [line for line in lines if line.strip("─ ")]


def _in_our_words(lines: list[str], argv: Sequence[str], prog: str) -> InputError:
    """The complaint that the lines hold; with a hint at the help where nothing better is known."""
    text = " ".join(line.strip() for line in lines)
    help_hint = f"{prog} --help lists them"
    if "Unrecognized options" in text:
        unknown = next((word for word in argv if word.startswith("-") and word.split("=")[0] in text), None)
        known = _FLAG.findall(text.partition("Perhaps you meant")[2])
        if unknown is None:
            extra = text.partition("Unrecognized options:")[2].split()[0].strip(",")
            return InputError(where=prog, expected="one argument less", found=f"{extra!r}, which is one too many")
        word = unknown.split("=")[0]
        near = did_you_mean(word, known) or (f" (did you mean {known[0]}?)" if known else f" ({help_hint})")
        return InputError(where=prog, expected="a known option", found=f"{word}{near}")
    if "Missing from" in text or "Required options" in text:
        missing = [line.strip() for line in lines if re.fullmatch(r"\s*(--[a-z.-]+ )?[A-Z|]+", line)]
        return InputError(where=prog, expected=", ".join(missing) or "more arguments", found=f"nothing ({help_hint})")
    choice = re.search(r"invalid choice '(.*?)' for argument '(.*?)'\. Expected one of \((.*?)\)", text)
    if choice:
        options = [option.strip(" '") for option in choice[3].split(",") if option.strip(" '") not in ("", "None")]
        near = did_you_mean(choice[1], options)
        return InputError(where=choice[2], expected=f"one of {', '.join(sorted(options))}", found=f"{choice[1]}{near}")
    missing_value = re.search(r"Missing value for argument '(.*?)'", text)
    if missing_value and not missing_value[1].startswith("-"):
        return InputError(where=prog, expected=missing_value[1].upper(), found=f"nothing ({help_hint})")
    if missing_value:
        return InputError(where=missing_value[1], expected="a value after it", found="nothing")
    parsing = re.search(r"Error parsing (--[\w.-]+)", text)
    if parsing:
        flag = parsing[1]
        shape = next((line for line in lines if line.strip().startswith(f"{flag} ")), f"{flag} VALUE")
        given = _values_after(flag, argv)
        shown = shape.strip().removeprefix(flag).strip().replace("{None}|", "").strip("{}")
        expected = {"N": "a whole number", "NUMBER": "a number"}.get(shown, shown)
        return InputError(where=flag, expected=expected, found=" ".join(given) or "nothing")
    return InputError(where=prog, expected="arguments as in --help", found=text[:200])


def _values_after(flag: str, argv: Sequence[str]) -> list[str]:
    for index, word in enumerate(argv):
        if word == flag:
            values = []
            for value in argv[index + 1 :]:
                if value.startswith("--"):
                    break
                values.append(value)
            return values
        if word.startswith(f"{flag}="):
            return [word.partition("=")[2]]
    return []
