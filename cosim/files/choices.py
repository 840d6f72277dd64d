"""Settings of a system file: what its choices set, and what is set from outside with ``--set``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from terrafix.cosim.basics.errors import nearest
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import PATHS, shown
from terrafix.cosim.files.loading import Load
from terrafix.cosim.system.system import System

TOP = ("schema", "name", "doc", "duration", "members", "seed", "epoch")
TABLES = ("component", "wiring", "expose", "record", "dispersion", "choice")
TIMING = ("rate", "period", "offset", "times")
Settings = Sequence[tuple[str, str]]
"""(path, text) pairs as given with ``--set``."""
Value = tuple[str, Any, bool]  # path, value, and whether it stands in the file


def _leaves(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Paths and values of an option, whether paths are quoted or tables of TOML."""
    for key, value in table.items():
        if isinstance(value, dict) and "value" not in value:
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def choose(
    load: Load, choices: Mapping[str, dict[str, Any]], settings: Settings
) -> tuple[list[Value], list[Value]]:
    """What the chosen options set, and what the others would."""
    picked = {k: v for k, v in settings if k in choices}
    chosen: list[Value] = []
    others: list[Value] = []
    for name, table in choices.items():
        options = {k: v for k, v in table.items() if isinstance(v, dict)}
        plain = {k: v for k, v in table.items() if k not in options}
        load.refuse_unknown(plain, ("default", "doc"), f"choice '{name}'")
        choice = picked.get(name, table.get("default"))
        for option, values in options.items():
            found = [(k, v, True) for k, v in _leaves(values) if k != "doc"]
            (chosen if option == choice else others).extend(found)
            if choice not in options:
                load.withheld |= {k for k, _, _ in found}
        if choice is None:
            load.refuse(f"choice '{name}' has no default\n  it takes {' or '.join(options)}")
        elif choice not in options:
            near = nearest(str(choice), options)
            hint = f"\n  {near}" if near.startswith("did you mean") else ""
            load.refuse(
                f"choice '{name}' is {shown(choice)}; it takes {' or '.join(options)}{hint}"
            )
    return chosen, others


def refuse_strange(
    load: Load,
    values: list[Value],
    components: Mapping[str, Any],
    choices: Mapping[str, Any],
) -> None:
    """Note settings of what does not exist."""
    for key, _, from_file in values:
        head, _, rest = key.partition(".")
        if head in components and not rest:
            load.refuse(
                f"cannot set '{key}': it is a component\n  set one of its parameters: '{key}.NAME'"
            )
        elif head in ("component", "choice") and rest:
            load.refuse(f"cannot set '{key}'\n  did you mean '{rest}'?")
        elif head in (*TOP, "component", "choice", "wiring", "expose"):
            load.refuse(f"cannot set '{key}'\n  it is written in the file alone")
        elif head not in components and head not in TABLES and head not in load.broken:
            known = [*components, *choices, *TOP[1:], "record", "dispersion"]
            load.refuse(
                f"cannot set '{key}': there is no '{head}'\n"
                f"  {nearest(head, known, what='what can be set')}"
            )
            load.unknown |= {head} if from_file else set()


def try_others(load: Load, system: System, others: list[Value]) -> None:
    """Note what is wrong with options that are not chosen now."""
    for key, value, _ in others:
        head, _, name = key.partition(".")
        node = system.nodes.get(head)
        if not isinstance(node, Component) or name in TIMING:
            continue
        setting = node.settings().get(name)
        if setting is None:
            refuse_parameter(load, node, name)
        elif not isinstance(setting, PATHS):
            load.attempt(setting.read, value, where=f"'{key}'", bare=False)


def override(
    load: Load, tables: Mapping[str, dict[str, dict[str, Any]]], values: list[Value]
) -> None:
    """Apply settings of records and dispersions, ``record.NAME.KEY``, to their tables."""
    for key, value, from_file in values:
        kind, _, rest = key.partition(".")
        name, _, option = rest.partition(".")
        if kind not in tables:
            continue
        if name not in tables[kind] or not option:
            known = [f"{k}.{n}.{o}" for k, t in tables.items() for n, v in t.items() for o in v]
            load.refuse(f"cannot set '{key}'\n  {nearest(key, known, what='there are')}")
            continue
        table = tables[kind][name] = dict(tables[kind][name])
        if option in ("period", "rate", "times"):
            for other in TIMING:
                table.pop(other, None)
        table[option] = value
        load.bare |= set() if from_file else {key}


def refuse_parameter(load: Load, component: Component, key: str) -> None:
    """Note a parameter that does not exist; the one that was meant is then not missing too."""
    known = [*component.settings(), *TIMING]
    near = nearest(key, known, what="its parameters")
    load.refuse(f"'{component.name}' has no parameter '{key}'\n  {near}")
    for meant in component.missing_settings():
        if near == f"did you mean '{meant}'?":
            component.given_parameters[meant] = None
