"""Where a run keeps its files: result, records on their way, checkpoint, what a kill left."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from terrafix.cosim.basics.errors import CheckpointError, ConfigurationError
from terrafix.cosim.basics.files import writable_target

if TYPE_CHECKING:
    from filelock import BaseFileLock


def result_target(out: str | Path) -> Path:
    """Return `out`, or raise ConfigurationError if no result can be written there."""
    return writable_target(out, (".nc",), reason="results are NetCDF: ")


@dataclass
class Places:
    """The files of one run.

    Attributes
    ----------
    out : Path or None
        The result.
    checkpoint : Path
        Where checkpoints go, if any are written.
    folder : Path or None
        Where records are kept while the run goes on: ``<out>.parts``, or ``<checkpoint>.parts``
        without a result file.
    notes : list of str
        What a person should know of it.
    """

    out: Path | None
    checkpoint: Path
    folder: Path | None
    notes: list[str] = field(default_factory=list)
    _lock: BaseFileLock | None = None
    _had_result: bool = False

    @classmethod
    def of_run(
        cls,
        system: str,
        *,
        out: Path | None,
        checkpoint: Path | None,
        checkpointing: bool,
    ) -> Places:
        """Places of a run that starts at t = 0."""
        target = checkpoint
        if target is None:
            target = Path(f"{system}.ckpt") if out is None else out.with_suffix(".ckpt")
        anchor = out or (target if checkpointing else None)
        folder = None if anchor is None else anchor.with_name(f"{anchor.name}.parts")
        places = cls(out, target, folder, _had_result=out is not None and out.exists())
        if checkpointing and checkpoint is None and out is None:
            places.notes.append(f"checkpoints go to '{target}'")
        return places

    @classmethod
    def of_resumed(cls, resume: Path, saved: Mapping[str, Any], *, out: Path | None) -> Places:
        """Places of a run that continues: its records, and its result unless told otherwise."""
        told = saved["places"]
        if out is None and told["out"] is not None:
            out = result_target(resume.parent / told["out"])
        folder = resume.parent / told["folder"]
        return cls(out, resume, folder, _had_result=out is not None and out.exists())

    def described(self) -> dict[str, str | None]:
        """What a checkpoint needs to find the records and the result again, relative to itself."""
        base = self.checkpoint.absolute().parent

        def relative(path: Path | None) -> str | None:
            return None if path is None else os.path.relpath(path.absolute(), base)

        return {"out": relative(self.out), "folder": relative(self.folder)}

    def occupy(self, *, resumed: bool) -> None:
        """Take the records' folder for this process; rescue what an interrupted run left in it.

        Raises
        ------
        ConfigurationError
            If another run is writing there.
        CheckpointError
            If a resumed run's records are gone.
        """
        if self.folder is None:
            return
        if self.folder.exists() and not self.folder.is_dir():
            raise ConfigurationError(
                f"records are kept in a folder '{self.folder}' while a run goes on, but a file of "
                "that name is there\n  move it away"
            )
        if resumed and not self.folder.is_dir():
            raise CheckpointError(
                f"the records that belong to the checkpoint are gone: there is no folder "
                f"'{self.folder}'\n"
                "  a run that has ended keeps them in its result; start again without --resume"
            )
        self._lock = locked(self.folder)
        if not resumed:
            rescued = rescue(self.folder)
            if rescued is not None:
                self.notes.append(f"what an interrupted run had recorded is kept in '{rescued}'")

    def result_file(self, *, complete: bool) -> Path | None:
        """Where the result goes: a run that failed does not replace an earlier result."""
        if self.out is None or complete or not self._had_result:
            return self.out
        return self.out.with_suffix(".failed.nc")

    def leave(self, *, keep: bool) -> None:
        """Give the folder back, and remove it unless its records are still needed."""
        if self.folder is None or self._lock is None:
            return
        if not keep:
            shutil.rmtree(self.folder, ignore_errors=True)
        unlock(self._lock)
        self._lock = None


def locked(folder: Path) -> BaseFileLock:
    """Lock the folder for this process alone; the system frees it when we die.

    A lock of the system, not a marker: a marker of a process that died must be taken over by
    somebody, and two might. Over NFS the server keeps it; where a file system has no locks,
    filelock falls back to a marker.

    Raises
    ------
    ConfigurationError
        If another process has it, or nothing can be written beside the folder.
    """
    from filelock import FileLock, Timeout

    if not folder.parent.is_dir():  # filelock would make it
        raise ConfigurationError(f"cannot lock '{folder}': there is no folder '{folder.parent}'")
    lock = FileLock(folder.with_name(f"{folder.name}.lock"), thread_local=False)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise ConfigurationError(
            f"another run is writing its records to '{folder}'\n"
            "  wait for it, or give this one another --out"
        ) from None
    except OSError as error:
        raise ConfigurationError(f"cannot lock '{folder}': {error.strerror or error}") from error
    return lock


def unlock(lock: BaseFileLock) -> None:
    """Give a folder back, and remove the lock's file.

    It goes while the lock is held: a lock on a file that is gone is none to filelock. Removed
    afterwards, it could be the next one's.
    """
    with suppress(OSError):  # Windows removes it when it is released
        Path(lock.lock_file).unlink()
    lock.release()


def rescue(folder: Path) -> Path | None:
    """Turn what an interrupted run left into a file of its own before its folder is used again.

    Returns the file. What cannot be read is moved aside, never removed.
    """
    from terrafix.cosim.records.results import salvage, write_netcdf

    if not folder.is_dir():
        return None
    number = 0
    while (target := folder.with_name(f"{folder.stem}.interrupted{number or ''}.nc")).exists() or (
        aside := target.with_suffix(".parts")
    ).exists():
        number += 1
    if any(folder.glob("*.npz")):
        try:
            write_netcdf(salvage(folder), target)
        except Exception:  # damaged in whatever way: it must not block this run
            folder.rename(aside)
            return aside
        shutil.rmtree(folder)
        return target
    shutil.rmtree(folder)
    return None
