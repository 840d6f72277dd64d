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
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import (
    ConfigurationError,
    RateError,
    SystemCheckError,
    TerrafixError,
    WiringError,
    nearest,
)
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import PATHS, Count, FilePath, FileTable, shown
from terrafix.cosim.declare.registry import component_entries, component_type
from terrafix.cosim.files.choices import (
    TABLES,
    TIMING,
    TOP,
    Settings,
    Value,
    choose,
    override,
    refuse_parameter,
    refuse_strange,
    try_others,
)
from terrafix.cosim.files.loading import Load
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.check import check
from terrafix.cosim.system.dispersion import KINDS, Dispersion
from terrafix.cosim.system.system import System, checked_epoch

SCHEMA = "terrafix-system/1"
_CONNECTION = re.compile(r"\s*([\w.]+)\s*->\s*([\w.]+)\s*(?:\(\s*delay\s+([^)]+?)\s*\))?\s*\Z")
_PORT = re.compile(r"[A-Za-z]\w*(?:\.\w+)+")


def read_toml(path: Path, settings: Settings = (), *, outside: bool = False) -> System:
    """Read a system from a TOML file, apply settings, and check it whole.

    What it takes is explained in `terrafix.cosim.files.readers.read_system`.

    Raises
    ------
    ConfigurationError
        If the file is absent, is not TOML, or is of another schema.
    SystemCheckError
        With every mistake in it.
    """
    system, load = _load((path,), settings)
    problems = list(load.problems)
    try:
        check(system, outside=outside)
    except SystemCheckError as error:
        said = {str(p) for p in problems}
        problems += [
            p for p in error.problems if str(p) not in said and not load.follows(p, system)
        ]
    if problems:
        raise SystemCheckError(system.name, problems, file=str(path))
    return system


def _load(files: tuple[Path, ...], settings: Settings) -> tuple[System, Load]:
    path = files[-1]
    content = _parse(path)
    load = Load(files)
    schema = content.get("schema")
    if schema is None:
        load.refuse(f"'{path}' has no schema\n  write schema = \"{SCHEMA}\" first")
    elif schema != SCHEMA:
        raise ConfigurationError(
            f"'{path}' has schema {shown(schema)}; this version reads '{SCHEMA}'\n"
            "  read it with the version of terrafix that it was written for, or convert it"
        )
    for key in load.refuse_unknown(content, (*TOP, *TABLES)):
        # what stands in a table of another name is not there, but was meant to be
        load.broken |= set(content[key]) if isinstance(content[key], dict) else set()
        load.unread |= "wiring" not in content
    choices = load.tables(content, "choice")
    chosen, others = choose(load, choices, settings)
    given = [(k, v, False) for k, v in settings if k not in choices]
    settable = TOP[1:]
    top = {k: content[k] for k in TOP if k in content}
    system = _make(load, top | {k: v for k, v, _ in given if k in settable}, path)
    values = [*chosen, *((k, v, f) for k, v, f in given if k not in settable)]
    components = load.tables(content, "component")
    refuse_strange(load, values, components, choices)
    for name, table in components.items():
        mine = [(k.removeprefix(f"{name}."), *v) for k, *v in values if k.startswith(f"{name}.")]
        if table.get("type") == "system":
            _nested(load, system, name, table, mine)
        else:
            _component(load, system, name, table, mine)
    refuse_strange(load, others, components, choices)
    try_others(load, system, others)
    observing = {kind: load.tables(content, kind) for kind in ("record", "dispersion")}
    override(load, observing, [v for v in values if v[0].split(".")[0] in TABLES])
    _wire(load, system, load.table(content, "wiring"))
    for name, target in load.table(content, "expose").items():
        if not load.is_lost([str(target)]):
            load.attempt(_expose, system, name, target)
    _records(load, system, observing["record"])
    _dispersions(load, system, observing["dispersion"])
    return system, load


def _parse(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8-sig")  # editors of Windows put a mark first
    except FileNotFoundError:
        there = [p.name for p in path.parent.glob("*.toml")]
        near = nearest(path.name, there, what="system files there")
        if not path.parent.is_dir():
            near = f"there is no folder '{path.parent}' either"
        raise ConfigurationError(f"there is no system file '{path}'\n  {near}") from None
    except IsADirectoryError:
        raise ConfigurationError(
            f"'{path}' is a folder; name a system file (.toml) in it"
        ) from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(
            f"'{path}' is no system file: it is not text in UTF-8\n  name a .toml file"
        ) from error
    except OSError as error:
        raise ConfigurationError(
            f"cannot read system file '{path}': {error.strerror or error}"
        ) from error
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message = f"'{path}' is not TOML: {error}"
        where = re.search(r"at line (\d+)", str(error))
        line = text.splitlines()[int(where[1]) - 1].strip()[:80] if where else ""
        if where and line.isprintable():
            message += f"\n  line {where[1]}: {line}"
        raise ConfigurationError(message) from error


def _make(load: Load, top: Mapping[str, Any], path: Path) -> System:
    name = top.get("name", path.stem)
    system: System | None = load.attempt(System, name, doc=str(top.get("doc", "")))
    if system is None:
        system = System("unnamed")
    if "duration" in top:
        made = load.attempt(System, "x", duration=top["duration"])
        system.duration = made.duration if made is not None else None
    if "epoch" in top:
        system.epoch = load.attempt(checked_epoch, top["epoch"])
    for key, least in (("members", 1), ("seed", 0)):
        if key in top:
            value = load.attempt(Count(minimum=least).read, top[key], where=f"'{key}'")
            if value is not None:
                setattr(system, key, value)
    return system


# ---------------------------------------------------------------------- components


def _nested(
    load: Load, system: System, name: str, table: Mapping[str, Any], values: list[Value]
) -> None:
    load.refuse_unknown(table, ("type", "file", "doc"), f"'{name}'")
    load.broken.add(name)
    file = load.attempt(FilePath().read, table.get("file", ""), where=f"'{name}.file'")
    if file is None:
        return
    path = load.folder / file
    if path.resolve() in [f.resolve() for f in load.files]:
        load.refuse(f"'{name}' is the system '{path}', which contains it\n  nest another file")
        return
    settings = [(k, _text(v)) for k, v, _ in values]
    try:
        if path.suffix.lower() == ".toml":
            inner, its_load = _load((*load.files, path), settings)
            load.include(its_load, name)
        else:
            inner = read_system(path, settings)
    except TerrafixError as error:
        load.problems.append(type(error)(f"'{name}': {error}"))
        return
    if load.attempt(system.add, inner, name) is not None:
        load.broken.discard(name)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else shown(value)


def _component(
    load: Load, system: System, name: str, table: Mapping[str, Any], values: list[Value]
) -> None:
    kind = table.get("type")
    if not isinstance(kind, str):
        what = "no type" if kind is None else f"the type {shown(kind)}, which is no name"
        near = nearest("", component_entries(), what="component types")
        load.refuse(f"'{name}' has {what}\n  {near}")
        load.broken.add(name)
        return
    try:
        made = component_type(kind, load.folder)()
    except TerrafixError as error:
        load.problems.append(type(error)(f"'{name}': {error}"))
        load.broken.add(name)
        return
    if load.attempt(system.add, made, name) is None:
        load.broken.add(name)
        return
    made.doc = str(table.get("doc", ""))
    timing = {k: table[k] for k in TIMING if k in table}
    given = {k: v for k, v in table.items() if k not in (*TIMING, "type", "doc")}
    for key, value, _ in values:
        if key in TIMING:
            if key != "offset":
                timing = {k: v for k, v in timing.items() if k == "offset" and key != "times"}
            timing[key] = value
    settable = [(k, v, True) for k, v in given.items()]
    settable += [each for each in values if each[0] not in TIMING]
    early = type(made).settings()
    later = [e for e in settable if e[0] not in early] if made.declares_settings() else []
    settable = [e for e in settable if e[0] in early] if later else settable
    refused = sum(not _set(load, made, *each) for each in settable)
    refused += _set_later(load, made, later, lost=bool(refused or made.missing_settings()))
    for key in made.missing_settings():
        if f"{name}.{key}" in load.withheld:
            made.given_parameters[key] = None
            refused += 1
    made.rate = load.attempt(_rate, timing, f"'{name}'") or made.rate
    if not refused:
        for key in (k for k, _, from_file in values if not from_file and k not in TIMING):
            reason = made.idle(key)
            if reason is not None:
                load.refuse(f"cannot set '{name}.{key}'\n  {reason}\n  choose otherwise, too")
    if not refused and not made.missing_settings():
        before = len(load.problems)
        load.attempt(made.prepare)
        if len(load.problems) > before:
            load.broken.add(name)
    elif type(made).prepare is not Component.prepare:
        load.broken.add(name)  # its ports depend on its parameters


def _set_later(load: Load, component: Component, later: list[Value], *, lost: bool) -> int:
    """Set parameters that depend on others, if these could be set; how many were refused."""
    if not later:
        return 0
    before = len(load.problems)
    if not lost:
        load.attempt(component.declare_settings)
    if lost or len(load.problems) > before:
        return len(later)
    keys = component.in_order_of_setting(dict.fromkeys(key for key, _, _ in later))
    later = sorted(later, key=lambda each: keys.index(each[0]))
    return sum(not _set(load, component, *each) for each in later)


def _set(load: Load, component: Component, key: str, value: Any, from_file: bool) -> bool:
    """Set a parameter; False if it was refused, which is noted, and not again as missing."""
    settings = component.settings()
    if key not in settings:
        refuse_parameter(load, component, key)
        return False
    before = len(load.problems)
    load.attempt(component.set_parameter, key, value, bare=not from_file)
    if len(load.problems) > before:
        component.given_parameters[key] = None
        if settings[key].default is None:  # a file that need not be named
            component.parameter_values.pop(key, None)
        return False
    setting = settings[key]
    if isinstance(setting, FileTable) and from_file:
        placed = setting.beside(component.setting(key), load.folder)
        component.parameter_values[key] = component.given_parameters[key] = placed
    if isinstance(setting, PATHS) and from_file:
        file = component.setting(key)
        component.parameter_values[key] = component.given_parameters[key] = load.folder / file
    return True


def _rate(timing: Mapping[str, Any], where: str) -> Rate | None:
    if not timing:
        return None
    options = dict(timing)
    kinds = [k for k in options if k != "offset"]
    if not kinds:
        raise RateError(f"{where} has an offset but no period\n  give it a period or a rate too")
    if len(kinds) > 1:
        raise RateError(f"{where} has {' and '.join(kinds)}\n  give one of them")
    if "rate" in options:
        options["hz"] = options.pop("rate")
    times = options.get("times")
    if isinstance(times, str):
        options["times"] = [t for t in re.split(r"[,\[\]\"']+", times) if t.strip()]
    elif times is not None and not isinstance(times, list):
        raise RateError(f'{where}: times is {shown(times)}; write a list, ["0 s", "10 s"]')
    try:
        return Rate(**options)
    except RateError as error:
        raise RateError(f"{where}: {error}") from error


# ---------------------------------------------------------------------- the rest


def _wire(load: Load, system: System, table: Mapping[str, Any]) -> None:
    strange = load.refuse_unknown(table, ("connect",), "[wiring]")
    load.unread |= bool(strange) and "connect" not in table
    entries = table.get("connect", [])
    if not isinstance(entries, list):
        load.refuse(
            f"[wiring]: connect is {shown(entries)}, not a list\n"
            '  write connect = ["orbit.r_e -> attitude.r_e", ...]'
        )
        load.unread = True
        return
    for entry in entries:
        match = _CONNECTION.match(entry) if isinstance(entry, str) else None
        if match is None:
            load.problems.append(
                WiringError(
                    f"{shown(entry)} is no connection\n"
                    '  write "orbit.r_e -> attitude.r_e", with "(delay 0.1 s)" where there is one'
                )
            )
            named = _PORT.findall(entry) if isinstance(entry, str) else []
            load.refused += [("", port) for port in named]
            load.unread |= not named
            continue
        source, target, delay = match.groups()
        ends = (source, target)
        if not load.is_lost(ends) and load.attempt(_connect, system, *ends, delay or 0):
            continue
        load.refused.append(ends)
        heads = {end.split(".")[0] for end in ends if "." in end}
        load.unknown |= heads - set(system.nodes)


def _connect(system: System, source: str, target: str, delay: Any) -> bool:
    system.connect(source, target, delay=delay)
    return True


def _expose(system: System, name: str, target: object) -> None:
    try:
        system.expose(name, str(target))
    except WiringError as error:
        raise WiringError(f"cannot expose '{name}'\n  {error}") from error


def _records(load: Load, system: System, tables: Mapping[str, dict[str, Any]]) -> None:
    for name, table in tables.items():
        where = f"record '{name}'"
        load.refuse_unknown(table, ("ports", "doc", *TIMING), where)
        rate = load.attempt(_rate, {k: table[k] for k in TIMING if k in table}, where)
        ports = table.get("ports", [])
        if isinstance(ports, str):
            ports = [p for p in re.split(r"[\s,\[\]\"']+", ports) if p]
        if not isinstance(ports, list) or not all(isinstance(p, str) for p in ports):
            load.refuse(
                f"{where}: ports is {shown(ports)}, not a list of ports\n"
                '  write ports = ["orbit.r_e", ...]'
            )
        elif not load.is_lost(ports):
            load.attempt(system.record, name, ports, rate=rate, doc=str(table.get("doc", "")))


def _dispersions(load: Load, system: System, tables: Mapping[str, dict[str, Any]]) -> None:
    components = system.flatten().components
    for name, table in tables.items():
        where = f"dispersion '{name}'"
        kind = str(table.get("kind", "normal"))
        spread = KINDS.get(kind, "sigma")
        targets = table.get("to", [])
        targets = [targets] if isinstance(targets, str) else targets
        others = sorted((set(KINDS.values()) - {spread}) & set(table))
        if spread not in table and others:
            load.refuse(f"{where} is {kind}: it takes {spread}, not {others[0]}")
            continue
        options = ("limit",) if kind == "truncated" else ()
        load.refuse_unknown(table, ("kind", "to", "doc", "design", spread, *options), where)
        if spread not in table:
            load.refuse(f'{where} needs a {spread}\n  write it with its unit, {spread} = "1.0 m"')
        elif not isinstance(targets, list) or not all(isinstance(t, str) for t in targets):
            load.refuse(
                f"{where}: to is {shown(targets)}, not a list of parameters\n"
                '  write to = ["orbit.r0_i"]'
            )
        elif not load.is_lost(targets):
            limit = load.attempt(_limit, table.get("limit", 3.0), where)
            dispersion = Dispersion(
                name,
                tuple(targets),
                table[spread],
                kind=kind,
                design=str(table.get("design", "random")),
                limit=3.0 if limit is None else limit,
                doc=str(table.get("doc", "")),
            )
            load.attempt(system.disperse, dispersion)
            bare = f"dispersion.{name}.{spread}" in load.bare
            load.attempt(dispersion.read_spread, components, bare=bare)


def _limit(value: object, where: str) -> float:
    try:
        return float(str(value))
    except ValueError:
        raise ConfigurationError(
            f"{where}: limit is {shown(value)}; it is a number of sigma, such as 3"
        ) from None
