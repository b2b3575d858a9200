"""Comments and numbers of the markup that several formats share."""

import json
import re
from typing import Any

import numpy as np
import yaml


def xml_comment(lines: list[str], indent: str = "  ") -> str:
    """One comment; two hyphens in a row end one, so they are set apart."""
    text = f"\n{indent}     ".join(line.replace("--", "- -").rstrip("-") for line in lines)
    return f"{indent}<!-- {text} -->"


def yaml_comment(lines: list[str]) -> list[str]:
    """Lines of a comment."""
    return [f"# {line}" for line in lines]


def yaml_text(comment: list[str], value: dict[str, Any]) -> str:
    """A commented YAML file, keys in the order given; numbers are numbers to readers of YAML 1.1 and 1.2."""
    return "\n".join(yaml_comment(comment)) + "\n" + yaml.safe_dump(value, sort_keys=False, width=1000)


def json_text(value: dict[str, Any]) -> str:
    """Indented JSON with a row of numbers on a line."""
    text = json.dumps(value, indent=4, allow_nan=False)
    return re.sub(r"\[\s+([^\[\]{}\"]+?)\s+\]", lambda found: f"[{' '.join(found[1].split())}]", text) + "\n"


def rows(matrix: np.ndarray) -> list[list[float]]:
    """A matrix as nested lists."""
    return [[float(value) for value in row] for row in matrix]
