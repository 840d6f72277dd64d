"""What commands print: tables for a person, one JSON object for a program."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import Any

FAILED, REFUSED = 1, 2
"""Exit status of a run that failed, and of bad input."""


def keep_standard_output() -> None:
    """Let standard output be Python's alone: what foreign code prints goes to standard error."""
    out = sys.__stdout__
    if out is None or sys.stdout is not out:
        return  # somebody has taken care
    with suppress(OSError, ValueError):  # it was closed
        if out.fileno() != 1:
            return
        out.flush()
        ours = os.dup(1)
        os.dup2(2, 1)
        sys.stdout = sys.__stdout__ = os.fdopen(  # type: ignore[misc]
            ours, "w", encoding=out.encoding, errors=out.errors
        )


def print_json(content: dict[str, Any]) -> None:
    """Print one JSON object on one line."""
    import json

    print(json.dumps(plain(content), allow_nan=False))


def plain(value: Any) -> Any:
    """Turn a value into what JSON can hold; numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):  # NumPy arrays and numbers
        return plain(value.tolist())
    if isinstance(value, float):
        return value if value - value == 0.0 else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


def show(*renderables: Any) -> None:
    """Print for a person; wide enough for tables where nobody's terminal says otherwise.

    A text that is not to be wrapped (a command to copy) is one line, however long.
    """
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = 100
    for each in renderables:
        console.print(each, soft_wrap=bool(getattr(each, "no_wrap", None)))
