"""Systems written as TOML; `terrafix.read_system` reads the same system back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.clock import Rate, text_seconds
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.files import write_atomically
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import PATHS
from terrafix.cosim.declare.registry import component_entries, own_type
from terrafix.cosim.files.reading import SCHEMA
from terrafix.cosim.system.dispersion import KINDS
from terrafix.cosim.system.system import System


def write_system(system: System, path: str | Path) -> None:
    """Write a system as TOML.

    Nested systems are flattened: ``nav.imu`` is called ``nav_imu`` there, and draws as such.

    Raises
    ------
    ConfigurationError
        If a component's type is not registered, two would have the same name, or the file cannot
        be written.
    """
    text = system_text(system).encode()
    write_atomically(Path(path), lambda f: f.write(text))


def system_text(system: System) -> str:
    """The TOML text of a system (nested systems flattened)."""
    import tomlkit

    document = tomlkit.document()
    for key, value in _content(system).items():
        if key == "wiring":
            connections = _inline(value["connect"]).multiline(multiline=True)
            document.append(key, tomlkit.table().append("connect", connections))
        elif key == "expose":
            document.append(key, _table(value))
        elif isinstance(value, dict):
            tables = tomlkit.table(is_super_table=True)
            for name, entries in value.items():
                tables.append(name, _table(entries))
            document.append(key, tables)
        else:
            document.append(key, value)
    return tomlkit.dumps(document)


def _table(entries: Mapping[str, Any]) -> Any:
    import tomlkit

    table = tomlkit.table()
    for key, value in entries.items():
        table.append(key, _inline(value))
    return table


def _inline(value: Any) -> Any:
    """What stands on one line: tables in braces, also in lists."""
    import tomlkit

    if isinstance(value, dict):
        table = tomlkit.inline_table()
        for key, entry in value.items():
            table.append(str(key), _inline(entry))
        return table
    if isinstance(value, list | tuple):
        array = tomlkit.array()
        array.extend(_inline(v) for v in value)
        return array
    return value


def _content(system: System) -> dict[str, Any]:
    """What a file says of a system: values, and tables of them, in plain types."""
    flat = system.flatten()
    content: dict[str, Any] = {"schema": SCHEMA, "name": system.name}
    content |= _doc(system.doc)
    if system.duration is not None:
        content["duration"] = f"{text_seconds(system.duration)} s"
    content |= {} if system.epoch is None else {"epoch": system.epoch}
    content |= {"members": system.members, "seed": system.seed}
    names = _names(flat.components)

    def port(path: str) -> str:
        owner, _, name = path.rpartition(".")
        return f"{names[owner]}.{name}"

    types = {e.value: name for name, e in component_entries().items()}
    content["component"] = {names[p]: _component(p, c, types) for p, c in flat.components.items()}
    connections = [
        f"{port(c.source)} -> {port(c.target)}"
        + (f" (delay {text_seconds(c.delay)} s)" if c.delay else "")
        for c in flat.connections
    ]
    content["wiring"] = {"connect": connections} if connections else {}
    content["expose"] = {n: port(system.resolve(p)[0]) for n, p in system.exposed.items()}
    content["record"] = {
        r.name: _doc(r.doc) | {"ports": [port(p) for p in r.ports]} | _timing(r.rate)
        for r in flat.records
    }
    content["dispersion"] = {
        d.name.replace(".", "_"): {
            **_doc(d.doc),
            "kind": d.kind,
            **({"design": d.design} if d.design != "random" else {}),
            **({"limit": d.limit} if d.kind == "truncated" else {}),
            KINDS[d.kind]: d.write_spread(flat.components),
            "to": [port(t) for t in d.targets],
        }
        for d in flat.dispersions
    }
    return {key: value for key, value in content.items() if value != {}}


def _names(components: Iterable[str]) -> dict[str, str]:
    """Names in a file by path, where nesting is resolved."""
    names = {path: path.replace(".", "_") for path in components}
    for name in names.values():
        same = [path for path, other in names.items() if other == name]
        if len(same) > 1:
            raise ConfigurationError(
                f"'{same[0]}' and '{same[1]}' would both be called '{name}' in a file, where "
                "nesting is resolved\n  rename one"
            )
    return names


def _component(path: str, component: Component, types: Mapping[str, str]) -> dict[str, Any]:
    """Type, times and what was set of one component."""
    kind = f"{type(component).__module__}:{type(component).__qualname__}"
    known = types.get(kind) or own_type(type(component))
    if known is None:
        raise ConfigurationError(
            f"'{path}' is a {type(component).__name__}, which is no registered component type\n"
            "  register it in the entry-point group terrafix.components, or read it from a file as "
            "MODULE:CLASS"
        )
    table = {"type": known} | _doc(component.doc) | _timing(component.rate)
    for name, setting in component.settings().items():
        value = component.setting(name) if name in component.given_parameters else None
        if value is not None:
            if isinstance(setting, PATHS):  # the same file from any folder
                value = value.absolute()
            table[name] = setting.write(value)
    return table


def _doc(text: str) -> dict[str, Any]:
    return {"doc": text} if text else {}


def _timing(rate: Rate | None) -> dict[str, Any]:
    """The keys of a table that say when."""
    if rate is None:
        return {}
    if rate.times is not None:
        return {"times": [text_seconds(t) for t in rate.times]}
    assert rate.period is not None
    offset = {"offset": f"{text_seconds(rate.offset)} s"} if rate.offset else {}
    return {"period": f"{text_seconds(rate.period)} s"} | offset
