"""Readers of system files by suffix, from the entry-point group ``terrafix.readers``.

A package adds a format on equal terms, in its pyproject.toml::

    [project.entry-points."terrafix.readers"]
    yaml = "mypackage.reading:read_yaml"

A reader is called as `read_system` is, with the path as a Path; it applies the settings or refuses
them, and raises a `TerrafixError` where there is no such file or it cannot be read.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.files.choices import Settings
from terrafix.cosim.system.system import System

GROUP = "terrafix.readers"
UNPACKED = "SystemStructure.ssd"
"""What makes a folder a system: it is read as this file in it would be."""


def read_system(path: str | Path, settings: Settings = (), *, outside: bool = False) -> System:
    """Read a system from a file, as its suffix says: ``.toml``, ``.ssp``, or a package's own.

    Parameters
    ----------
    path : path
        A folder is read as its ``SystemStructure.ssd``: an SSP package that was unpacked.
    settings : sequence of (str, str)
        ``("orbit.gravity", "j2")``, as ``--set`` gives them; applied after the file and its
        choices. Numbers without a unit are in the declared (SI) unit.
    outside : bool
        Whether exposed inputs are driven from outside, as in an exported system.

    Raises
    ------
    ConfigurationError
        If no reader takes the suffix, or the file cannot be read.
    SystemCheckError
        With every mistake in the system.
    """
    path = Path(path)
    entry = _reader(path)
    read = _loaded(entry)
    system = read(path, settings, outside=outside)
    if not isinstance(system, System):
        raise ConfigurationError(
            f"the reader of .{entry.name} files ({entry.value}) returned "
            f"{type(system).__name__} for '{path}', not a System"
        )
    return system


def _reader(path: Path) -> EntryPoint:
    """The one reader of files that end as this one does."""
    entries = entry_points(group=GROUP)
    known = [f".{e.name.lower()}" for e in entries]
    suffix = (path / UNPACKED if (path / UNPACKED).is_file() else path).suffix.lower()
    if suffix not in known:
        if path.is_dir():
            raise ConfigurationError(
                f"'{path}' is a folder without {UNPACKED}; name a system file (.toml) in it"
            )
        if suffix == ".fmu":
            raise ConfigurationError(
                f"'{path}' is an FMU, which runs as a component of a system\n"
                f'  [component.NAME] with type = "fmu" and file = "{path.name}" in a .toml file; '
                f"terrafix check-fmu {path} checks it alone"
            )
        why = f"no reader takes {suffix} files" if suffix else "its name has no suffix"
        raise ConfigurationError(
            f"cannot tell how to read system file '{path}': {why}\n"
            f"  suffixes of system files: {', '.join(sorted(set(known)))}{_similar(path, known)}"
        )
    found = {e.value: e for e in entries if f".{e.name.lower()}" == suffix}
    if len(found) > 1:
        claims = ", ".join(sorted(f"{_package(e)} ({e.value})" for e in found.values()))
        raise ConfigurationError(
            f"cannot tell how to read '{path}': several packages read {suffix} files\n"
            f"  {claims}: uninstall all but one"
        )
    return next(iter(found.values()))


def _similar(path: Path, known: list[str]) -> str:
    """Hint at a file of that stem that can be read, if there is one."""
    there = [p.name for s in sorted(set(known)) if (p := path.with_suffix(s)).is_file()]
    return f"; did you mean '{there[0]}'?" if there else ""


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "unknown package"


def _loaded(entry: EntryPoint) -> Callable[..., object]:
    try:
        found = entry.load()
    except Exception as error:  # a foreign package may fail in any way
        raise ConfigurationError(
            f"the reader of .{entry.name} files ({entry.value}) cannot be imported\n"
            f"  {type(error).__name__}: {error}"
        ) from error
    if not callable(found):
        raise ConfigurationError(
            f"the reader of .{entry.name} files ({entry.value}) is {type(found).__name__}, "
            "not a function"
        )
    function: Callable[..., object] = found
    return function
