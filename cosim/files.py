"""Systems as TOML files: the same object as in Python, the same errors.

    schema = "terrafix-system/1"
    name = "coast"
    duration = "600 s"

    [component.orbit]
    type = "orbit"
    rate = "100 Hz"
    r0_i = "[7069637, 0, 0] m"

    [wiring]
    connect = ["orbit.r_e -> attitude.r_e", "correct.posterior -> predict.posterior (delay 1 s)"]

    [record.history]
    ports = ["orbit.r_e"]
    period = "1 s"

    [choice.case]
    default = "hot"
    [choice.case.hot]
    "imu.accel_bias_sigma0" = "1 mm/s^2"

Every number carries its unit; unknown keys are refused with the nearest name; all mistakes of a
file are reported together.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from terrafix.cosim.check import check
from terrafix.cosim.clock import Rate, text_seconds
from terrafix.cosim.component import Component
from terrafix.cosim.dispersion import KINDS, Dispersion
from terrafix.cosim.errors import (
    ConfigurationError,
    RateError,
    SystemCheckError,
    TerrafixError,
    WiringError,
    nearest,
)
from terrafix.cosim.parameters import Count, FilePath, shown
from terrafix.cosim.registry import component_entries, component_type
from terrafix.cosim.system import Record, System

SCHEMA = "terrafix-system/1"
TOP = ("schema", "name", "doc", "duration", "members", "seed")
TABLES = ("component", "wiring", "expose", "record", "dispersion", "choice")
TIMING = ("rate", "period", "offset", "times")
Settings = Sequence[tuple[str, str]]
"""(path, text) pairs as given with ``--set``."""
_CONNECTION = re.compile(r"\s*([\w.]+)\s*->\s*([\w.]+)\s*(?:\(\s*delay\s+([^)]+?)\s*\))?\s*\Z")


@dataclass
class _Load:
    """One file being read: what was built and what was wrong."""

    folder: Path
    problems: list[TerrafixError] = field(default_factory=list)
    broken: set[str] = field(default_factory=set)  # components that could not be made
    refused: list[tuple[str, str]] = field(default_factory=list)  # connections, source and target
    unread: bool = False  # connections were written that could not be read
    withheld: set[str] = field(default_factory=set)  # parameters that a refused choice would set
    bare: set[str] = field(default_factory=set)  # paths set without need of a unit

    def add(self, text: str) -> None:
        self.problems.append(ConfigurationError(text))

    def attempt(self, action: Any, *arguments: Any, **options: Any) -> Any:
        try:
            return action(*arguments, **options)
        except SystemCheckError as error:
            self.problems.extend(error.problems)
        except TerrafixError as error:
            self.problems.append(error)
        return None


def read_system(path: str | Path, settings: Settings = ()) -> System:
    """Read a system from a TOML file, apply settings, and check it whole.

    Parameters
    ----------
    path : path
    settings : sequence of (str, str)
        ``("orbit.gravity", "j2")``, as ``--set`` gives them; applied after the file and its
        choices. Numbers without a unit are in the declared (SI) unit.

    Raises
    ------
    ConfigurationError
        If the file is absent or is not TOML.
    SystemCheckError
        With every mistake in it.
    """
    path = Path(path)
    system, load = _load(path, settings)
    problems = list(load.problems)
    try:
        check(system)
    except SystemCheckError as error:
        said = {str(p) for p in problems}
        for problem in error.problems:
            text = str(problem)
            follows = any(f"input '{target}'" in text for target in load.attempted) or (
                not system.nodes and problems
            )
            if text not in said and not follows:
                problems.append(problem)
    if problems:
        raise SystemCheckError(system.name, problems, file=str(path))
    return system


def _load(path: Path, settings: Settings) -> tuple[System, _Load]:
    content = _parse(path)
    load = _Load(path.parent)
    _refuse_unknown(load, content, (*TOP, *TABLES), "key")
    schema = content.get("schema")
    if schema != SCHEMA:
        load.problems.append(
            ConfigurationError(
                f"'{path}' has schema {schema!r}; this version reads {SCHEMA!r}\n"
                f'  write schema = "{SCHEMA}" first, or convert the file'
            )
        )
    chosen, rest = _choose(load, _table(load, content, "choice"), settings)
    top = {k: content[k] for k in TOP if k in content}
    own = {k: v for k, v in rest if k in TOP}
    system = _make(load, top | own, path)
    values: list[tuple[str, Any, str | None]] = [
        *((k, v, "file") for k, v in chosen),
        *((k, v, None) for k, v in rest if k not in TOP),
    ]
    nested = _components(load, system, _table(load, content, "component"), values)
    overrides = _overrides(load, content, [v for v in values if v[0].split(".")[0] in TABLES])
    _wire(load, system, _table(load, content, "wiring"))
    for name, target in _table(load, content, "expose").items():
        load.attempt(system.expose, name, str(target))
    _records(load, system, overrides["record"])
    _dispersions(load, system, overrides["dispersion"])
    load.attempted |= nested
    return system, load


def _parse(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        near = nearest(path.name, [p.name for p in path.parent.glob("*.toml")], what="there are")
        raise ConfigurationError(f"there is no system file '{path}'\n  {near}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"cannot read system file '{path}': {error}") from error
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"'{path}' is not TOML: {error}") from error


def _table(load: _Load, content: Mapping[str, Any], name: str) -> dict[str, Any]:
    value = content.get(name, {})
    if not isinstance(value, dict):
        load.problems.append(ConfigurationError(f"'{name}' is {value!r}; it is a table [{name}]"))
        return {}
    return value


def _refuse_unknown(
    load: _Load, table: Mapping[str, Any], known: Iterable[str], what: str, where: str = ""
) -> None:
    known = list(known)
    for key in table:
        if key not in known:
            prefix = f"{where}: " if where else ""
            load.problems.append(
                ConfigurationError(
                    f"{prefix}there is no {what} '{key}'\n  {nearest(key, known, what=f'{what}s')}"
                )
            )


def _choose(
    load: _Load, choices: Mapping[str, Any], settings: Settings
) -> tuple[list[tuple[str, Any]], list[tuple[str, str]]]:
    """Settings of the chosen options, and the settings that choose nothing."""
    picked = {k: v for k, v in settings if k in choices}
    rest = [(k, v) for k, v in settings if k not in choices]
    values: list[tuple[str, Any]] = []
    for name, table in choices.items():
        options = {k: v for k, v in table.items() if isinstance(v, dict)}
        _refuse_unknown(
            load,
            {k: v for k, v in table.items() if k not in options},
            ("default", "doc"),
            "key",
            f"choice '{name}'",
        )
        choice = picked.get(name, table.get("default"))
        if choice not in options:
            load.problems.append(
                ConfigurationError(
                    f"choice '{name}' is {choice!r}; it takes {' | '.join(options)}\n"
                    f"  {nearest(str(choice), options)}"
                )
            )
            continue
        values += [(k, v) for k, v in options[choice].items() if k != "doc"]
    return values, rest


def _make(load: _Load, top: Mapping[str, Any], path: Path) -> System:
    name = top.get("name", path.stem)
    system: System | None = load.attempt(System, name, doc=str(top.get("doc", "")))
    if system is None:
        system = System("unnamed")
    if "duration" in top:
        made = load.attempt(System, "x", duration=top["duration"])
        system.duration = made.duration if made is not None else None
    for key, least in (("members", 1), ("seed", 0)):
        if key in top:
            value = load.attempt(Count(minimum=least).read, top[key], where=f"'{key}'")
            if value is not None:
                setattr(system, key, value)
    return system


# ---------------------------------------------------------------------- components


def _components(
    load: _Load,
    system: System,
    tables: Mapping[str, Any],
    values: list[tuple[str, Any, str | None]],
) -> set[str]:
    """Make components with everything that is set on them; inputs wired badly inside."""
    suppressed: set[str] = set()
    for name, table in tables.items():
        if not isinstance(table, dict):
            load.problems.append(
                ConfigurationError(f"'component.{name}' is {table!r}; it is a table")
            )
            load.broken.add(name)
            continue
        mine = [
            (k.removeprefix(f"{name}."), v, origin)
            for k, v, origin in values
            if k.startswith(f"{name}.")
        ]
        if table.get("type") == "system":
            suppressed |= _nested(load, system, name, table, mine)
        else:
            _component(load, system, name, table, mine)
    for key, _, _ in values:
        head = key.split(".")[0]
        if head not in tables and head not in TABLES:
            load.problems.append(
                ConfigurationError(
                    f"cannot set '{key}': there is no '{head}'\n"
                    f"  {nearest(head, [*tables, *TOP, 'record', 'dispersion'], what='there are')}"
                )
            )
    return suppressed


def _nested(
    load: _Load,
    system: System,
    name: str,
    table: Mapping[str, Any],
    values: list[tuple[str, Any, str | None]],
) -> set[str]:
    _refuse_unknown(load, table, ("type", "file", "doc"), "key", f"'{name}'")
    file = load.attempt(FilePath().read, table.get("file", ""), where=f"'{name}.file'")
    if file is None:
        load.broken.add(name)
        return set()
    text = [(k, v if isinstance(v, str) else str(v)) for k, v, _ in values]
    loaded = load.attempt(_load, load.folder / file, text)
    if loaded is None or load.attempt(system.add, loaded[0], name) is None:
        load.broken.add(name)
        return set()
    load.problems += loaded[1].problems
    return {f"{name}.{target}" for target in loaded[1].attempted}


def _component(
    load: _Load,
    system: System,
    name: str,
    table: Mapping[str, Any],
    values: list[tuple[str, Any, str | None]],
) -> None:
    kind = table.get("type")
    if not isinstance(kind, str):
        near = nearest("", component_entries(), what="component types")
        load.problems.append(ConfigurationError(f"'{name}' has no type\n  {near}"))
        load.broken.add(name)
        return
    try:
        made = component_type(kind)()
        system.add(made, name)
    except TerrafixError as error:
        load.problems.append(type(error)(f"'{name}': {error}"))
        load.broken.add(name)
        return
    timing = {k: table[k] for k in TIMING if k in table}
    given = {k: v for k, v in table.items() if k not in (*TIMING, "type", "doc")}
    for key, value in given.items():
        _set(load, made, key, value, from_file=True)
    for key, value, origin in values:
        if key in TIMING:
            if key in ("rate", "period", "times"):
                timing = {k: v for k, v in timing.items() if k == "offset" and key != "times"}
            timing[key] = value
        else:
            _set(load, made, key, value, from_file=origin == "file")
    rate = load.attempt(_rate, timing, f"'{name}'")
    made.rate = rate or made.rate
    load.attempt(made.prepare)


def _set(load: _Load, component: Component, key: str, value: Any, *, from_file: bool) -> None:
    settings = component.settings()
    if key not in settings:
        load.problems.append(
            ConfigurationError(
                f"'{component.name}' has no parameter '{key}'\n"
                f"  {nearest(key, [*settings, *TIMING], what='its parameters')}"
            )
        )
        return
    setting = settings[key]
    before = len(load.problems)
    load.attempt(component._set, key, value, bare=not from_file)
    if len(load.problems) > before:
        # a value that was refused must not be reported again as missing
        component._base.setdefault(key, None)
    elif isinstance(setting, FilePath) and from_file:
        file = component.setting(key)
        component._settings[key] = component._base[key] = load.folder / file


def _rate(timing: Mapping[str, Any], where: str) -> Rate | None:
    if not timing:
        return None
    options = dict(timing)
    if "rate" in options:
        options["hz"] = options.pop("rate")
    if isinstance(options.get("times"), str):
        options["times"] = [t for t in re.split(r"[\s,\[\]\"']+", options["times"]) if t]
    try:
        return Rate(**options)
    except RateError as error:
        raise RateError(f"{where} {error}") from error


# ---------------------------------------------------------------------- the rest


def _wire(load: _Load, system: System, table: Mapping[str, Any]) -> None:
    _refuse_unknown(load, table, ("connect",), "key", "[wiring]")
    entries = table.get("connect", [])
    if not isinstance(entries, list):
        load.problems.append(ConfigurationError("[wiring] connect is not a list"))
        return
    for entry in entries:
        match = _CONNECTION.match(entry) if isinstance(entry, str) else None
        if match is None:
            load.problems.append(
                WiringError(
                    f"{entry!r} is no connection\n"
                    '  write "orbit.r_e -> attitude.r_e", with "(delay 0.1 s)" where there is one'
                )
            )
            continue
        source, target, delay = match.groups()
        if {source.split(".")[0], target.split(".")[0]} & load.broken:
            load.attempted.add(target)
            continue
        before = len(load.problems)
        load.attempt(system.connect, source, target, delay=delay or 0)
        if len(load.problems) > before:
            load.attempted.add(target)


def _overrides(
    load: _Load, content: Mapping[str, Any], values: list[tuple[str, Any, str | None]]
) -> dict[str, dict[str, Any]]:
    """The record and dispersion tables with ``record.NAME.KEY`` settings applied."""
    tables = {
        kind: {
            k: dict(v) if isinstance(v, dict) else v for k, v in _table(load, content, kind).items()
        }
        for kind in ("record", "dispersion")
    }
    for key, value, _ in values:
        kind, _, rest = key.partition(".")
        name, _, option = rest.partition(".")
        if kind not in tables or name not in tables[kind] or not option:
            known = [f"{k}.{n}.{o}" for k, t in tables.items() for n, v in t.items() for o in v]
            load.problems.append(
                ConfigurationError(f"cannot set '{key}'\n  {nearest(key, known, what='there are')}")
            )
            continue
        if option in ("period", "rate"):
            for other in ("period", "rate", "offset"):
                tables[kind][name].pop(other, None)
        tables[kind][name][option] = value
    return tables


def _records(load: _Load, system: System, tables: Mapping[str, Any]) -> None:
    for name, table in tables.items():
        if not isinstance(table, dict):
            load.problems.append(ConfigurationError(f"'record.{name}' is {table!r}; it is a table"))
            continue
        _refuse_unknown(load, table, ("ports", "doc", *TIMING), "key", f"record '{name}'")
        rate = load.attempt(_rate, {k: table[k] for k in TIMING if k in table}, f"record '{name}'")
        ports = table.get("ports", [])
        if not isinstance(ports, list) or not all(isinstance(p, str) for p in ports):
            load.problems.append(
                ConfigurationError(f"record '{name}': ports is not a list of ports")
            )
            continue
        if {p.split(".")[0] for p in ports} & load.broken:
            continue
        load.attempt(system.record, name, ports, rate=rate)


def _dispersions(load: _Load, system: System, tables: Mapping[str, Any]) -> None:
    for name, table in tables.items():
        if not isinstance(table, dict):
            load.problems.append(
                ConfigurationError(f"'dispersion.{name}' is {table!r}; it is a table")
            )
            continue
        kind = table.get("kind", "normal")
        spread = KINDS.get(str(kind), "sigma")
        _refuse_unknown(load, table, ("kind", "to", "doc", spread), "key", f"dispersion '{name}'")
        if spread not in table:
            load.problems.append(ConfigurationError(f"dispersion '{name}' needs a {spread}"))
            continue
        targets = table.get("to", [])
        targets = [targets] if isinstance(targets, str) else targets
        if {str(t).split(".")[0] for t in targets} & load.broken:
            continue
        load.attempt(
            system.disperse, Dispersion(name, tuple(targets), table[spread], kind=str(kind))
        )


# ---------------------------------------------------------------------- writing


def write_system(system: System, path: str | Path) -> None:
    """Write a system as TOML; `read_system` reads the same system back.

    Raises
    ------
    ConfigurationError
        If a component's type is not registered, or a nested system has no file.
    """
    Path(path).write_text(system_text(system), encoding="utf-8")


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

    def port(path: str) -> str:
        owner, _, name = path.rpartition(".")
        return f"{names[owner]}.{name}"

    for path, component in flat.components.items():
        value = f"{type(component).__module__}:{type(component).__qualname__}"
        if value not in types:
            raise ConfigurationError(
                f"'{path}' is a {type(component).__name__}, which is no registered component type\n"
                "  register it in the entry-point group terrafix.components"
            )
        lines += ["", f"[component.{names[path]}]", f'type = "{types[value]}"']
        lines += _rate_lines(component.rate)
        for name, setting in component.settings().items():
            if name in component._base:
                written = setting.write(component.setting(name))
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
        declared = d.parameter(flat.components)
        value = declared.write(d.read_spread(flat.components))
        lines += ["", f"[dispersion.{d.name.replace('.', '_')}]", f'kind = "{d.kind}"']
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
        escaped = value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
        return f'"{escaped}"'
    if isinstance(value, list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(value)
