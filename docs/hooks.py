"""Writes the page of commands when the site is built, from what `--help` says."""

import os
import subprocess
import sys

from rmis_calib.cli import COMMANDS
from rmis_calib.cli.study_commands import STUDIES


def on_page_markdown(markdown: str, page, **_) -> str:
    """The page with the help of every command in place of its marker."""
    if page.file.src_uri != "commands.md":
        return markdown
    names = [*COMMANDS, *(f"study {name}" for name in STUDIES)]
    parts = [f"## {name}\n\n```text\n{_help(name)}\n```\n" for name in names]
    return "\n".join(["# Commands\n", *parts])


def _help(name: str) -> str:
    command = [sys.executable, "-m", "rmis_calib", *name.split(), "--help"]
    environment = os.environ | {"COLUMNS": "82", "NO_COLOR": "1", "TERM": "dumb"}
    return subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.strip()
