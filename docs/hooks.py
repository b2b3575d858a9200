"""Writes the page of commands when the site is built, from what `--help` and `--help-all` say."""

import os
import subprocess
import sys
from textwrap import indent

from rmis_calib.cli import COMMANDS, help_page
from rmis_calib.cli.study_commands import STUDIES


def on_page_markdown(markdown: str, page, **_) -> str:
    """The page with the help of every command in place of its marker."""
    if page.file.src_uri != "commands.md":
        return markdown
    names = [*COMMANDS, *(f"study {name}" for name in STUDIES)]
    return "\n".join(["# Commands\n", *(_section(name) for name in names)])


def _section(name: str) -> str:
    page = help_page(name).strip()
    section = f"## {name}\n\n```text\n{page}\n```\n"
    if f"rmis-calib {name} --help-all" not in page:
        return section
    return f'{section}\n??? note "All options of {name}"\n\n' + indent(f"```text\n{_all_options(name)}\n```\n", "    ")


def _all_options(name: str) -> str:
    command = [sys.executable, "-m", "rmis_calib", *name.split(), "--help-all"]
    environment = os.environ | {"COLUMNS": "82", "NO_COLOR": "1", "TERM": "dumb"}
    return subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.strip()
