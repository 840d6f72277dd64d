"""Files that are written: refused before the work if they cannot be, and whole or not there."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from terrafix.cosim.basics.errors import ConfigurationError


def writable_target(
    path: str | Path, suffixes: tuple[str, ...] = (), *, option: str = "", reason: str = ""
) -> Path:
    """The file to write, refused now if it could not be written later.

    Parameters
    ----------
    path : path
    suffixes : tuple of str
        What it may end with, the usual one first; anything if empty.
    option : str
        Option that names it, for messages.
    reason : str
        Why it ends so, for messages.

    Raises
    ------
    ConfigurationError
        If it has another ending, is a folder, or its folder does not exist or is read-only.
    """
    what = f"{option} '{path}'".lstrip()
    target = Path(path)
    if not str(path).strip():
        raise ConfigurationError(f"cannot write {what}: it names no file\n  name one")
    probe = target.with_name(f".{target.name}.{os.getpid()}.probe") if target.name else target
    try:
        if target.is_dir():
            raise ConfigurationError(f"{what} is a folder; name a file in it")
        if suffixes and target.suffix.lower() not in suffixes:
            raise ConfigurationError(
                f"{what} is no {' or '.join(suffixes)} file\n"
                f"  {reason}name it '{target.with_suffix(suffixes[0]).name}'"
            )
        if not target.parent.is_dir():
            raise ConfigurationError(f"cannot write {what}: there is no folder '{target.parent}'")
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ConfigurationError(f"cannot write {what}: {error.strerror or error}") from error
    return target


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """A name beside `target` to write to, which takes its place at the end: whole or not at all.

    Raises
    ------
    ConfigurationError
        If it cannot be written.
    """
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        yield partial
        partial.replace(target)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise ConfigurationError(
            f"cannot write '{target}': {error.strerror or error}\n"
            "  choose another place, or make room"
        ) from error
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def write_atomically(target: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Have `write` fill a file that is whole or not there; errors as of `replacing`."""
    with replacing(target) as partial, partial.open("wb") as file:
        write(file)
