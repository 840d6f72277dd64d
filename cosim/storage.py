"""Where a run keeps its files: result, records on their way, checkpoint, what a kill left."""

from __future__ import annotations

import shutil
from pathlib import Path

from terrafix.cosim.errors import ConfigurationError, TerrafixError


def writable(out: Path) -> Path:
    """Return `out`, or raise ConfigurationError if no file can be written there."""
    if out.is_dir():
        raise ConfigurationError(f"'{out}' is a folder; name a file in it")
    if not out.parent.is_dir():
        raise ConfigurationError(f"cannot write '{out}': there is no folder '{out.parent}'")
    try:
        probe = out.with_name(f".{out.name}.probe")
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ConfigurationError(f"cannot write '{out}': {error.strerror or error}") from error
    return out


def checkpoint_path(system: str, given: str | Path | None, out: Path | None) -> Path:
    """Where checkpoints go: as given, beside `out`, or named after the system."""
    if given is not None:
        return Path(given)
    return out.with_suffix(".ckpt") if out is not None else Path(f"{system}.ckpt")


def records_folder(out: Path | None, checkpoint: Path | None) -> Path | None:
    """Where records live during the run: with the checkpoint if there is one, else with `out`."""
    anchor = checkpoint or out
    return None if anchor is None else anchor.with_name(f"{anchor.name}.parts")


def rescue(folder: Path) -> None:
    """Turn what an interrupted run left into a file of its own before its folder is used again.

    What cannot be read is moved aside, never removed.
    """
    from terrafix.cosim.results import salvage, write_netcdf

    if not folder.is_dir():
        return
    number = 0
    while (target := folder.with_name(f"{folder.stem}.interrupted{number or ''}.nc")).exists() or (
        aside := target.with_suffix(".parts")
    ).exists():
        number += 1
    if any(folder.glob("*.npz")):
        try:
            write_netcdf(salvage(folder), target)
        except TerrafixError:
            folder.rename(aside)
            return
    shutil.rmtree(folder)
