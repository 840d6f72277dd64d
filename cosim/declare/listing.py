"""The installed component types: one line each, or all that one of them takes and gives."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import docstring
from terrafix.cosim.declare.display import port_content, port_table, setting_content, setting_table
from terrafix.cosim.declare.ports import Port
from terrafix.cosim.declare.registry import component_entries, component_type
from terrafix.cosim.show.tables import Block, Table


def types_content() -> dict[str, Any]:
    """List all installed component types with one line each."""
    listed = []
    for name, entry in sorted(component_entries().items()):
        try:
            doc = docstring(component_type(name)).partition("\n")[0]
        except ConfigurationError as error:  # one package that is broken hides no others
            doc = " ".join(str(error).split())
        listed.append({"type": name, "class": entry.value, "doc": doc})
    return {"components": listed}


def type_content(name: str) -> dict[str, Any]:
    """Describe the parameters and ports of one component type.

    Raises
    ------
    ConfigurationError
        If there is no such type, or it cannot be imported.
    """
    kind = component_type(name, Path())
    ports = {n: p for n, p in kind.declarations.items() if isinstance(p, Port)}
    return {
        "type": name,
        "class": f"{kind.__module__}:{kind.__qualname__}",
        "doc": docstring(kind),
        "default_rate": None if kind.default_rate is None else str(kind.default_rate),
        "parameters": [setting_content(n, s) for n, s in kind.settings().items()],
        "ports": [port_content(n, p) for n, p in ports.items()],
    }


def types_tables(content: Mapping[str, Any]) -> list[Block]:
    """Show what `types_content` lists."""
    from rich.text import Text

    if not content["components"]:
        return [Text("no component types are installed")]
    rows = [[kind["type"], kind["doc"]] for kind in content["components"]]
    return [Table(["type", "what it is"], rows)]


def type_tables(content: Mapping[str, Any]) -> list[Block]:
    """Show what `type_content` describes."""
    from rich.text import Text

    shown: list[Block] = [
        Text(f"{content['type']}  ({content['class']})", style="bold"),
        Text(content["doc"]),
        Text(f"\nsteps {content['default_rate'] or 'at the rate that its system gives'}"),
    ]
    if content["parameters"]:
        shown += [Text(), setting_table(content["parameters"])]
    if content["ports"]:
        shown += [Text(), port_table(content["ports"])]
    return shown
