"""Component types by name, from the entry-point group ``terrafix.components``.

A package adds its own on equal terms, in its pyproject.toml::

    [project.entry-points."terrafix.components"]
    star_tracker = "mypackage.sensors:StarTracker"

Without a package a type is ``MODULE:CLASS``, of a module that lies beside the system's file or can
be imported.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.declare.component import Component

GROUP = "terrafix.components"


def component_entries() -> dict[str, EntryPoint]:
    """Entry points of all installed component types, by name, without importing them."""
    return dict(_entries(tuple((path, _changed(path)) for path in sys.path)))


def _changed(path: str) -> int:
    """When a folder of modules was changed last; 0 if it is none."""
    try:
        return Path(path).stat().st_mtime_ns
    except OSError:
        return 0


@lru_cache(maxsize=4)
def _entries(_paths: tuple[tuple[str, int], ...]) -> dict[str, EntryPoint]:
    """Those of the folders as they are: what is installed meanwhile is found."""
    return {e.name: e for e in entry_points(group=GROUP)}


_OWN: dict[type[Component], str] = {}
"""Classes that were asked for as ``MODULE:CLASS``, and how."""


def component_type(name: str, folder: Path | None = None) -> type[Component]:
    """The class of a component type.

    Parameters
    ----------
    name : str
        Registered, or ``MODULE:CLASS``.
    folder : Path, optional
        Where modules are looked for first: that of the system's file.

    Raises
    ------
    ConfigurationError
        If there is no such type, or it cannot be imported.
    """
    if ":" in name:
        return _own(name, folder)
    entries = component_entries()
    if name not in entries:
        raise ConfigurationError(
            f"there is no component type '{name}'\n"
            f"  {nearest(name, entries, what='component types')}"
        )
    try:
        found = entries[name].load()
    except Exception as error:  # a foreign package may fail in any way
        raise ConfigurationError(
            f"component type '{name}' ({entries[name].value}) cannot be imported\n"
            f"  {type(error).__name__}: {error}"
        ) from error
    if not _is_component(found):
        raise ConfigurationError(
            f"component type '{name}' ({entries[name].value}) is not a terrafix Component"
        )
    return found  # type: ignore[no-any-return]


def _is_component(found: object) -> bool:
    return isinstance(found, type) and issubclass(found, Component)


def _own(name: str, folder: Path | None) -> type[Component]:
    """A class by its module and name."""
    module, _, kind = name.partition(":")
    parts = (*module.split("."), kind)
    if module.endswith(".py") or not all(part.isidentifier() for part in parts):
        raise ConfigurationError(
            f"component type '{name}' is neither a registered name nor MODULE:CLASS\n"
            "  write the module without .py, and its class, as in 'tracker:Predict'"
        )
    top = module.partition(".")[0]
    beside = None if folder is None else folder.resolve()
    if beside is not None and ((beside / f"{top}.py").is_file() or (beside / top).is_dir()):
        if str(beside) not in sys.path:  # processes that are started from here look there, too
            sys.path.insert(0, str(beside))
    else:
        beside = None
    try:
        loaded = import_module(module)
    except Exception as error:  # what is somebody's own may fail in any way
        absent = isinstance(error, ModuleNotFoundError) and error.name == top
        where = f" beside the system's file, in '{folder}'," if folder is not None else ""
        said = f"there is no module '{top}'{where} or installed" if absent else ""
        raise ConfigurationError(
            f"component type '{name}' cannot be imported\n"
            f"  {said or f'{type(error).__name__}: {error}'}"
        ) from error
    origin = getattr(loaded, "__file__", None)
    if beside is not None and origin and beside not in Path(origin).resolve().parents:
        raise ConfigurationError(
            f"component type '{name}' is meant to be in '{beside}', but a module '{module}' was "
            f"imported from '{origin}' before\n  give one of them another name"
        )
    there = {n: c for n, c in vars(loaded).items() if _is_component(c)}
    if kind not in there:
        what = "is not a terrafix Component" if hasattr(loaded, kind) else "is not there"
        own = [n for n, c in there.items() if c.__module__ == loaded.__name__]
        raise ConfigurationError(
            f"component type '{name}': '{kind}' {what}\n"
            f"  {nearest(kind, own, what=f'components of {module}')}"
        )
    found: type[Component] = there[kind]
    _OWN[found] = name
    return found


def own_type(kind: type[Component]) -> str | None:
    """How a class was asked for as ``MODULE:CLASS``, if it was."""
    return _OWN.get(kind)


def type_name(kind: type[Component]) -> str:
    """Name under which a class is registered or was asked for, else the name of the class."""
    if kind in _OWN:
        return _OWN[kind]
    value = f"{kind.__module__}:{kind.__qualname__}"
    return next((n for n, e in component_entries().items() if e.value == value), kind.__name__)
