"""Systems written as TOML; `terrafix.read_system` reads the same system back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.clock import Rate, text_seconds
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.files import write_atomically
from terrafix.cosim.declare.parameters import PATHS
from terrafix.cosim.declare.registry import component_entries
from terrafix.cosim.files.reading import SCHEMA
from terrafix.cosim.system.dispersion import KINDS
from terrafix.cosim.system.flat import Record
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
    types = {e.value: name for name, e in component_entries().items()}
    flat = system.flatten()
    lines = [f'schema = "{SCHEMA}"', f'name = "{system.name}"']
    if system.doc:
        lines.append(f"doc = {_toml(system.doc)}")
    if system.duration is not None:
        lines.append(f'duration = "{text_seconds(system.duration)} s"')
    lines += [f"members = {system.members}", f"seed = {system.seed}"]
    names = {path: path.replace(".", "_") for path in flat.components}
    for name in names.values():
        same = [path for path, other in names.items() if other == name]
        if len(same) > 1:
            raise ConfigurationError(
                f"'{same[0]}' and '{same[1]}' would both be called '{name}' in a file, where "
                "nesting is resolved\n  rename one"
            )

    def port(path: str) -> str:
        owner, _, name = path.rpartition(".")
        return f"{names[owner]}.{name}"

    for path, component in flat.components.items():
        kind = f"{type(component).__module__}:{type(component).__qualname__}"
        if kind not in types:
            raise ConfigurationError(
                f"'{path}' is a {type(component).__name__}, which is no registered component type\n"
                "  register it in the entry-point group terrafix.components"
            )
        lines += ["", f"[component.{names[path]}]", f'type = "{types[kind]}"']
        lines += _rate_lines(component.rate)
        for name, setting in component.settings().items():
            if name in component.given_parameters:
                value = component.setting(name)
                if value is None:
                    continue
                if isinstance(setting, PATHS):  # the same file from any folder
                    value = value.absolute()
                written = setting.write(value)
                lines.append(f"{name} = {_toml(written)}")
    if flat.connections:
        lines += ["", "[wiring]", "connect = ["]
        for c in flat.connections:
            delay = f" (delay {text_seconds(c.delay)} s)" if c.delay else ""
            lines.append(f'    "{port(c.source)} -> {port(c.target)}{delay}",')
        lines.append("]")
    for record in flat.records:
        lines += _record_lines(record, [port(p) for p in record.ports])
    for d in flat.dispersions:
        spread = KINDS[d.kind]
        value = d.write_spread(flat.components)
        lines += ["", f"[dispersion.{d.name.replace('.', '_')}]", f'kind = "{d.kind}"']
        if d.design != "random":
            lines.append(f'design = "{d.design}"')
        if d.kind == "truncated":
            lines.append(f"limit = {d.limit!r}")
        lines += [f"{spread} = {_toml(value)}", f"to = {_toml([port(t) for t in d.targets])}"]
    return "\n".join(lines) + "\n"


def _rate_lines(rate: Rate | None) -> list[str]:
    if rate is None:
        return []
    if rate.times is not None:
        return [f"times = {_toml([text_seconds(t) for t in rate.times])}"]
    assert rate.period is not None
    lines = [f'period = "{text_seconds(rate.period)} s"']
    if rate.offset:
        lines.append(f'offset = "{text_seconds(rate.offset)} s"')
    return lines


def _record_lines(record: Record, ports: list[str]) -> list[str]:
    lines = ["", f"[record.{record.name}]", f"ports = {_toml(ports)}"]
    return lines + _rate_lines(record.rate)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)  # a string of JSON is one of TOML
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_toml(str(k))} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(value)
