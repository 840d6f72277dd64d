"""Component types by name, from the entry-point group ``terrafix.components``.

A package adds its own on equal terms, in its pyproject.toml::

    [project.entry-points."terrafix.components"]
    star_tracker = "mypackage.sensors:StarTracker"
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points

from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.declare.component import Component

GROUP = "terrafix.components"


def component_entries() -> dict[str, EntryPoint]:
    """Entry points of all installed component types, by name, without importing them."""
    return {e.name: e for e in entry_points(group=GROUP)}


def component_type(name: str) -> type[Component]:
    """The class of a component type.

    Raises
    ------
    ConfigurationError
        If there is no such type, or it cannot be imported.
    """
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
    if not (isinstance(found, type) and issubclass(found, Component)):
        raise ConfigurationError(
            f"component type '{name}' ({entries[name].value}) is not a terrafix Component"
        )
    return found


def type_name(kind: type[Component]) -> str:
    """Name under which a class is registered, else the name of the class."""
    value = f"{kind.__module__}:{kind.__qualname__}"
    return next((n for n, e in component_entries().items() if e.value == value), kind.__name__)
