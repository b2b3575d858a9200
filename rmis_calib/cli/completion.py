"""`rmis-calib completion`: a script for the shell, with every command, option and choice."""

import contextlib
import dataclasses
import io
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union

import tyro

from rmis_calib.cli import COMMANDS, EXIT_OK


@dataclass(frozen=True, kw_only=True)
class Completion:
    """Print a script that completes commands, options and choices with the Tab key."""

    shell: tyro.conf.Positional[Literal["bash", "zsh"]]
    """Shell that reads the script."""

    def run(self) -> int:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            tyro.cli(_all_commands(), prog="rmis-calib", args=["--tyro-print-completion", self.shell])
        # Where tyro knows nothing, as for a path, the shell completes file names.
        print(printed.getvalue().replace("complete -F ", "complete -o default -F ").rstrip())
        return EXIT_OK


def _all_commands() -> Any:
    """Every command as one type, as tyro reads sub-commands: a union, in which a group of commands is a union again."""
    from rmis_calib.cli import commands
    from rmis_calib.cli.flags import flags_of
    from rmis_calib.cli.study_commands import STUDIES

    kinds = {name: getattr(commands, kind) for name, (kind, _) in COMMANDS.items() if name != "study"}
    kinds |= {f"study {name}": kind for name, (kind, _) in STUDIES.items()}
    groups: dict[str, dict[str, type]] = {}
    for name, kind in kinds.items():
        group, _, command = name.partition(" ")
        groups.setdefault(group, {})[command] = flags_of(kind)
    return _union({group: _member(group, members) for group, members in groups.items()})


def _member(group: str, members: dict[str, type]) -> Any:
    if len(members) > 1:
        return _union(members)
    ((command, kind),) = members.items()
    if not command:
        return kind
    # A union of one is none: the only command of its group is a word before its arguments.
    word = ("word", tyro.conf.Positional[Literal[command]])  # type: ignore[valid-type]
    return dataclasses.make_dataclass(group, [word], bases=(kind,), frozen=True, kw_only=True)


def _union(members: dict[str, Any]) -> Any:
    return Union[tuple(Annotated[kind, tyro.conf.subcommand(name=name)] for name, kind in members.items())]  # noqa: UP007
