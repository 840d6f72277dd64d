"""Folders of this process alone: gone when it ends, however it ends.

All lie in one, ``terrafix-<random>`` among the system's temporary files, beside a lock that this
process holds. A shell waits for the end of this process, and removes what it left if it was killed.
Where there is none, or it was killed too, who makes such a folder next removes those whose lock
nobody holds any more.
"""

from __future__ import annotations

import atexit
import os
import re
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from filelock import BaseFileLock

_NAME = re.compile(r"terrafix-[0-9a-f]{16}\Z")


def scratch_folder(what: str) -> Path:
    """A new folder that is there until this process ends; `what` begins its name."""
    return Path(tempfile.mkdtemp(prefix=f"{what}-", dir=_root()))


def shown(path: Path) -> str:
    """A path for people: of what lies in such a folder its name there."""
    inside = [k for k, part in enumerate(path.parts) if _NAME.match(part)]
    return str(Path(*path.parts[inside[0] + 2 :])) if inside else str(path)


@contextmanager
def scratch(what: str) -> Iterator[Path]:
    """A new folder for a ``with`` block."""
    folder = scratch_folder(what)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@cache
def _root() -> Path:
    everybodys = Path(tempfile.gettempdir())
    _sweep(everybodys)
    folder = everybodys / f"terrafix-{secrets.token_hex(8)}"
    janitor = _janitor(folder)
    lock = _lock(folder)
    lock.acquire(blocking=False)
    folder.mkdir(mode=0o700)
    atexit.register(_leave, folder, lock, os.getpid(), janitor)
    return folder


_REMOVE = 'trap "" INT TERM HUP; read _; rm -rf -- "$1" "$1.lock"'


def _janitor(folder: Path) -> subprocess.Popen[bytes] | None:
    """A shell that removes a folder when nobody holds the other end of its input any more."""
    if sys.platform == "win32":
        return None
    with suppress(OSError):
        return subprocess.Popen(
            ["/bin/sh", "-c", _REMOVE, "sh", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd="/",
            start_new_session=True,
        )
    return None


def _lock(folder: Path) -> BaseFileLock:
    from filelock import FileLock

    return FileLock(f"{folder}.lock", thread_local=False)


def _sweep(everybodys: Path) -> None:
    """Remove the folders of processes that were killed."""
    from filelock import Timeout

    for folder in everybodys.glob("terrafix-*"):
        lock = _lock(folder)
        with suppress(OSError, Timeout):  # another user's, or in use
            if _NAME.match(folder.name) and os.access(folder, os.W_OK):
                lock.acquire(blocking=False)
                _remove(folder, lock)


def _leave(
    folder: Path, lock: BaseFileLock, process: int, janitor: subprocess.Popen[bytes] | None = None
) -> None:
    if os.getpid() != process:  # a fork's end is not ours
        return
    _remove(folder, lock)
    if janitor is not None:
        janitor.kill()
        janitor.wait()


def _remove(folder: Path, lock: BaseFileLock) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    with suppress(OSError):  # while it is held: a lock on a file that is gone is none
        Path(lock.lock_file).unlink()
    lock.release()
