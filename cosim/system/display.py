"""How a system looks to a person: what it consists of, what it lacks, and what a check found."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any, Protocol

from terrafix.cosim.basics.clock import text_seconds
from terrafix.cosim.basics.errors import TerrafixError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.registry import type_name
from terrafix.cosim.show.tables import Block, Table, first, named
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.flat import Connection, FlatSystem, Flattened, Record

MOST_ROWS = 12
MOST_LINES = 6
MOST_NAMES = 4

# ---------------------------------------------------------------------- a system


class Whole(Flattened, Protocol):
    """Anything that is shown as a system: a `terrafix.System`."""

    doc: str
    duration: Fraction | None
    members: int
    seed: int
    epoch: str | None
    connections: list[Connection]
    records: list[Record]
    dispersions: list[Dispersion]

    @property
    def nodes(self) -> Mapping[str, Component | Whole]:
        """Components and systems by name."""


def system_shown(system: Whole) -> list[Block]:
    """A system in whatever state: components, connections, and what it lacks."""
    from rich.text import Text

    parts = [_count(len(system.nodes), "component")]
    parts.append(_count(len(system.connections), "connection"))
    header = Text(f"System '{system.name}'", style="bold")
    header.append(f": {', '.join(parts)}", style="not bold")
    flight = [] if system.duration is None else [f"{text_seconds(system.duration)} s"]
    flight += [_count(system.members, "member"), f"seed {system.seed}"]
    flight += [] if system.epoch is None else [f"epoch {system.epoch}"]
    shown: list[Block] = [header, Text(", ".join(flight))]
    doc = system.doc.strip().partition("\n")[0]
    shown += [Text(doc)] if doc else []
    if system.nodes:
        nodes, more = first(system.nodes.items(), MOST_ROWS)
        rows = [_node_row(name, node) for name, node in nodes]
        shown += ["", Table(["component", "type", "steps"], rows), *_and_more(more)]
    if system.connections:
        arrows, more = first(_arrows(system.connections), MOST_ROWS)
        shown += ["", Table(["from", "to", "ports"], arrows), *_and_more(more)]
    listed = [Text(line) for line in _lists(system)]
    lacking, more = first(_lacking(system), MOST_LINES)
    listed += [Text(f"missing: {line}", style="red") for line in lacking]
    return [*shown, *([""] if listed else []), *listed, *_and_more(more)]


def _and_more(count: int) -> list[Block]:
    from rich.text import Text

    return [Text(f"and {count} more", style="dim")] if count else []


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"


def _node_row(name: str, node: Component | Whole) -> list[str]:
    if isinstance(node, Component):
        return [name, type(node).__name__, str(node.rate or "-")]
    return [name, f"System of {_count(len(node.nodes), 'component')}", ""]


def _arrows(connections: Sequence[Connection]) -> list[list[str]]:
    """Connections with the same ends in one row each; ports once where both ends agree."""
    bundles: dict[tuple[str, str], list[str]] = defaultdict(list)
    for c in connections:
        (source, _, output), (target, _, entry) = c.source.partition("."), c.target.partition(".")
        text = output if output == entry else f"{output} -> {entry}"
        delay = f" ({text_seconds(c.delay)} s late)" if c.delay else ""
        bundles[source, target].append(text + delay)
    return [[*ends, ", ".join(ports)] for ends, ports in bundles.items()]


def _lists(system: Whole) -> Iterator[str]:
    exposed = [f"{name} = {path}" for name, path in system.exposed.items()]
    records = [
        f"{r.name} ({_count(len(r.ports), 'port')}, {r.rate or 'with their component'})"
        for r in system.records
    ]
    dispersions = [f"{d.name} ({d.kind}, of {named(d.targets, 2)})" for d in system.dispersions]
    for title, items in (
        ("exposes", exposed),
        ("records", records),
        ("disperses", dispersions),
    ):
        if items:
            yield f"{title}: {named(items, MOST_NAMES)}"


def _lacking(system: Whole) -> Iterator[str]:
    """What must still be given before it can run."""
    if not system.nodes:
        yield "components"
    driven = set(_driven(system))
    for path, component in _leaves(system):
        for name in component.missing_settings():
            yield f"a value for '{path}.{name}': it takes {component.settings()[name].kind()}"
        if component.rate is None:
            yield f"a rate of '{path}'"
        for name, port in component.inputs().items():
            if not port.optional and f"{path}.{name}" not in driven:
                yield f"a connection to '{path}.{name}'"
    for c in system.connections:
        for end in (c.source, c.target):
            if _leaf(system, end) is None:
                yield f"'{end}', which '{c}' names"


def _leaves(system: Whole, prefix: str = "") -> Iterator[tuple[str, Component]]:
    for name, node in system.nodes.items():
        if isinstance(node, Component):
            yield f"{prefix}{name}", node
        else:
            yield from _leaves(node, f"{prefix}{name}.")


def _driven(system: Whole, *, exposed: bool = True) -> Iterator[str]:
    """Inputs that are connected, or that the whole exposes to whoever contains it."""
    ends = [c.target for c in system.connections] + list(system.exposed.values()) * exposed
    yield from filter(None, (_leaf(system, end) for end in ends))
    for name, node in system.nodes.items():
        if not isinstance(node, Component):
            yield from (f"{name}.{path}" for path in _driven(node, exposed=False))


def _leaf(system: Whole, path: str) -> str | None:
    try:
        return system.resolve(path)[0]
    except TerrafixError:
        return None


# ---------------------------------------------------------------------- a checked system


def plan_content(
    flat: FlatSystem,
    order: Sequence[str],
    base: Fraction,
    notes: Sequence[str],
    epoch: str | None = None,
) -> dict[str, Any]:
    """Describe a checked system in plain types, its components in stepping order."""
    return {
        "system": flat.name,
        "ok": True,
        "base_step_s": float(base),
        "base_step": f"{text_seconds(base)} s",
        **({} if epoch is None else {"epoch": epoch}),
        "order": list(order),
        "components": {
            path: {
                "type": type_name(type(flat.components[path])),
                "rate": str(flat.components[path].rate),
            }
            for path in order
        },
        "connections": [
            {
                "source": c.source,
                "target": c.target,
                "delay_s": float(c.delay),
                "at": flat.port(c.target).at,
            }
            for c in flat.connections
        ],
        "notes": list(notes),
        "problems": [],
    }


def plan_shown(content: Mapping[str, Any]) -> list[Block]:
    """Show what `plan_content` describes."""
    from rich.text import Text

    rows = [
        [
            str(number),
            path,
            content["components"][path]["type"],
            content["components"][path]["rate"],
        ]
        for number, path in enumerate(content["order"], 1)
    ]
    return [
        Text(
            f"{content['system']}: {_count(len(rows), 'component')} in stepping order, "
            f"{_count(len(content['connections']), 'connection')}, base step {content['base_step']}"
            + (f", epoch {content['epoch']}" if "epoch" in content else "")
        ),
        Table(["", "component", "type", "steps"], rows),
        *(Text(f"note: {note}") for note in content["notes"]),
        Text("ok", style="green"),
    ]
