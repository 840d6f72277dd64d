"""A system: components, connections, exposed ports, records and dispersions; nestable.

    with System("coast") as system:
        orbit = system.add(OrbitTruth(...), name="orbit")
        imu = system.add(Imu(...), name="imu")
        system.connect(orbit["delta_v_e"], imu["delta_v_true"])

The same object comes from a system file (`terrafix.read_system`); both roads raise the same errors.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Self, TypeAlias, TypeVar, overload

from terrafix.cosim.basics.clock import Exact, Rate, seconds
from terrafix.cosim.basics.errors import (
    ConfigurationError,
    EpochError,
    RateError,
    SystemCheckError,
    WiringError,
    nearest,
)
from terrafix.cosim.declare.component import Component, PortRef
from terrafix.cosim.declare.parameters import shown
from terrafix.cosim.declare.ports import Port
from terrafix.cosim.show.tables import Block, Shown
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.flat import Connection, FlatSystem, Record
from terrafix.cosim.system.wiring import check_connection

if TYPE_CHECKING:
    from terrafix.cosim.system.check import Plan
    from terrafix.cosim.system.graph import Diagram

TABLES = frozenset({"component", "wiring", "expose", "record", "dispersion", "choice"})
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")
Node = TypeVar("Node", bound="Component | System")
End: TypeAlias = "PortRef | Component | System | str"
"""A port or its path; what ``system[...]`` gives is taken, and refused where it is no port."""


class Nodes(dict[str, "Component | System"]):
    """Components and systems by name; shown by the names of their classes."""

    def __repr__(self) -> str:
        return f"{{{', '.join(f'{n!r}: {type(node).__name__}' for n, node in self.items())}}}"


class System(Shown):
    """Components and what connects them.

    Parameters
    ----------
    name : str
        An identifier.
    doc : str
        What the system is for.
    duration : exact time, optional
        How long a run lasts unless told otherwise [s].
    members : int
        Size of the ensemble unless told otherwise.
    seed : int
        Root seed unless told otherwise.
    epoch : str, optional
        What time it is at t = 0; components know what it means.
    """

    def __init__(
        self,
        name: str,
        *,
        doc: str = "",
        duration: Exact | None = None,
        members: int = 1,
        seed: int = 0,
        epoch: str | None = None,
    ) -> None:
        self.name = _checked_name(name, "system")
        self.doc = doc
        self.duration = None if duration is None else _positive(duration, "duration")
        self.members = members
        self.seed = seed
        self.epoch = epoch if epoch is None else checked_epoch(epoch)
        self.nodes: dict[str, Component | System] = Nodes()
        self.connections: list[Connection] = []
        self._drivers: tuple[list[Connection], int, dict[str, Connection]] = [], 0, {}
        self.exposed: dict[str, str] = {}
        self.records: list[Record] = []
        self.dispersions: list[Dispersion] = []
        self.notes: list[str] = []
        self._contained = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        """Nothing to undo: the ``with`` block only groups what belongs together."""

    # ------------------------------------------------------------------ building

    def add(self, node: Node, name: str) -> Node:
        """Add a component or a system under a name, and return it.

        Raises
        ------
        ConfigurationError
            If the name is no identifier or is taken, or the node belongs to a system already.
        """
        _checked_name(name, "component")
        if not isinstance(node, Component | System):
            what = f"the class {node.__name__}" if isinstance(node, type) else repr(node)
            raise ConfigurationError(f"cannot add {what} as '{name}': make a component of it first")
        if name in TABLES:
            raise ConfigurationError(
                f"'{name}' cannot name a component: it is a table of system files"
            )
        if name in self.nodes:
            raise ConfigurationError(f"system '{self.name}' has a component '{name}' already")
        if isinstance(node, Component):
            if node.name:
                raise ConfigurationError(
                    f"this {type(node).__name__} is '{node.name}' already; make another one"
                )
            node.name = name
            try:
                if not node.missing_settings():
                    node.prepare()
            except BaseException:
                node.name = ""
                raise
        else:
            if self in node._systems():
                raise ConfigurationError(f"system '{self.name}' cannot contain itself")
            if node._contained:
                raise ConfigurationError(
                    f"system '{node.name}' is part of a system already; make another one"
                )
            node.name, node._contained = name, True
        self.nodes[name] = node
        return node

    def _node(self, name: str) -> Component | System:
        """What has a name here; ConfigurationError if nothing has."""
        if name not in self.nodes:
            raise ConfigurationError(
                f"system '{self.name}' has no component '{name}'\n"
                f"  {nearest(name, self.nodes, what='components')}"
            )
        return self.nodes[name]

    def __getitem__(self, name: str) -> Component | System | PortRef:
        """Name an exposed port, a component, or a port of one.

        ``nav["fix"]``, ``system["orbit"]``, ``system["orbit.r_e"]``; where an exposed port and a
        component have one name, the port.

        Raises
        ------
        WiringError
            If there is nothing of that name.
        """
        if name in self.exposed:
            return self._exposed(name)
        head, dot, rest = name.partition(".")
        if head not in self.nodes:
            raise WiringError(
                f"system '{self.name}' has no component and exposes no port '{head}'\n"
                f"  {nearest(head, [*self.nodes, *self.exposed], what='components and ports')}"
            )
        node = self.nodes[head]
        return node[rest] if dot else node

    def _exposed(self, port: str) -> PortRef:
        if port not in self.exposed:
            raise WiringError(
                f"system '{self.name}' exposes no port '{port}'\n"
                f"  {nearest(port, self.exposed, what='exposed ports')}"
            )
        return PortRef(self, port, self.resolve(self.exposed[port])[1])

    def _ipython_key_completions_(self) -> list[str]:
        ports = {n: node.ports for n, node in self.nodes.items() if isinstance(node, Component)}
        inner = [f"{name}.{port}" for name, own in ports.items() for port in own]
        return [*self.nodes, *self.exposed, *inner]

    def expose(self, name: str, port: End) -> None:
        """Make a port of a component a port of this system."""
        _checked_name(name, "port")
        if name in self.exposed:
            raise ConfigurationError(
                f"system '{self.name}' exposes '{self.exposed[name]}' as '{name}' already"
            )
        path = self._path(port)
        self.resolve(path)
        self.exposed[name] = path

    def connect(self, source: End, target: End, *, delay: Exact = 0) -> None:
        """Connect an output to an input, optionally with a delay [s].

        Raises
        ------
        WiringError
            If a port does not exist, the two do not fit, or the input has a driver already.
        RateError
            If the delay is negative or not exact.
        """
        source_path, target_path = self._path(source), self._path(target)
        wrong, found = [], []
        for path in (source_path, target_path):
            try:
                found.append(self.resolve(path))
            except WiringError as error:
                wrong.append(f"  {error}")
        if wrong:
            raise WiringError(
                "\n".join([f"cannot connect '{source_path}' to '{target_path}'", *wrong])
            )
        (_, source_port), (target_leaf, target_port) = found
        check_connection(source_path, source_port, target_path, target_port)
        other = self._driver(target_leaf)
        if other is not None:
            raise WiringError(
                f"input '{target_path}' has two drivers\n"
                f"  '{other.source}' is connected to it already\n"
                f"  '{source_path}' cannot be connected too: remove one of them"
            )
        exact = seconds(delay, f"delay of '{source_path} -> {target_path}'")
        if exact < 0:
            raise RateError(
                f"delay of '{source_path} -> {target_path}' is negative\n"
                "  a connection hands on what was published, never what will be"
            )
        if exact and (target_port.kind == "shared" or target_port.window):
            raise WiringError(
                f"cannot delay '{source_path} -> {target_path}': only signals and messages carry "
                "a delay, not shared values or windows"
            )
        self.connections.append(Connection(source_path, target_path, exact))

    def _driver(self, leaf: str) -> Connection | None:
        """The connection to a component's input; each is looked at once."""
        known, n, by_leaf = self._drivers
        if known is not self.connections or n > len(known):
            n, by_leaf = 0, {}
        for connection in self.connections[n:]:
            by_leaf.setdefault(self.resolve(connection.target)[0], connection)
        self._drivers = self.connections, len(self.connections), by_leaf
        return by_leaf.get(leaf)

    def record(
        self,
        name: str,
        ports: End | Sequence[End],
        *,
        period: Exact | None = None,
        rate: Rate | None = None,
        doc: str = "",
    ) -> None:
        """Record ports at a period or rate, or whenever their one component steps."""
        _checked_name(name, "record")
        if any(r.name == name for r in self.records):
            raise ConfigurationError(f"system '{self.name}' has a record '{name}' already")
        if period is not None:
            rate = Rate(period)
        listed = [ports] if isinstance(ports, PortRef | Component | System | str) else ports
        paths = tuple(self._path(p) for p in listed)
        if not paths:
            raise ConfigurationError(f"record '{name}' names no ports")
        self.records.append(Record(name, paths, rate, doc))

    def disperse(self, dispersion: Dispersion) -> None:
        """Add a dispersion of parameters."""
        if any(d.name == dispersion.name for d in self.dispersions):
            raise ConfigurationError(
                f"system '{self.name}' has a dispersion '{dispersion.name}' already"
            )
        self.dispersions.append(dispersion)

    def remove(self, name: str) -> None:
        """Remove a component with all that names it; `replace` puts another in its place.

        Its connections go, its exposed ports, and what of it is recorded and dispersed.
        """
        _free(self._node(name))
        del self.nodes[name]

        def others(paths: Iterable[str]) -> tuple[str, ...]:
            return tuple(path for path in paths if path.split(".")[0] != name)

        self.connections = [c for c in self.connections if len(others((c.source, c.target))) == 2]
        self.exposed = {port: path for port, path in self.exposed.items() if others([path])}
        self.records = [replace(r, ports=left) for r in self.records if (left := others(r.ports))]
        self.dispersions = [
            replace(d, targets=left) for d in self.dispersions if (left := others(d.targets))
        ]

    def _all_nodes(self, prefix: str = "") -> Iterator[tuple[str, Component | System]]:
        """Yield the path of everything within, and it."""
        for name, node in self.nodes.items():
            yield f"{prefix}{name}", node
            if isinstance(node, System):
                yield from node._all_nodes(f"{prefix}{name}.")

    def _systems(self) -> Iterator[System]:
        """Yield this system and all systems within."""
        yield self
        for node in self.nodes.values():
            if isinstance(node, System):
                yield from node._systems()

    def replace(self, name: str, node: Node) -> Node:
        """Put another component in the place of one, on the same ports, and return it.

        What the old one read is connected where the new one has that input too; everything that
        others read from it, and what is exposed or recorded, must be there.

        Raises
        ------
        ConfigurationError
            If there is no such component.
        WiringError
            If a port that is read is missing or does not fit; all is then as it was.
        """
        old = self._node(name)
        nodes, connections = self.nodes, self.connections
        called = node.name if isinstance(node, System) else ""
        self.nodes = Nodes({n: each for n, each in nodes.items() if n != name})
        try:
            self.add(node, name)
            self.connections = []
            for c in connections:
                owner, _, port = c.target.partition(".")
                if owner == name and isinstance(node, Component) and port not in node.inputs():
                    continue
                self.connect(c.source, c.target, delay=c.delay)
            for path in [*self.exposed.values(), *(p for r in self.records for p in r.ports)]:
                self.resolve(path)
        except BaseException:
            if name in self.nodes:
                _free(node, called)
            self.nodes, self.connections = nodes, connections
            raise
        _free(old)
        self.nodes = Nodes({n: self.nodes[n] for n in nodes})  # each in its place
        return node

    def _path(self, port: End) -> str:
        if isinstance(port, str):
            return port
        if not isinstance(port, PortRef):
            raise WiringError(
                f'{type(port).__name__} is no port\n  name one of its ports: part["port"]'
            )
        for path, node in self._all_nodes():
            if node is port.component:
                return f"{path}.{port.port}"
        raise WiringError(f"'{port}' belongs to no component of system '{self.name}'; add it first")

    # ------------------------------------------------------------------ reading

    def resolve(self, path: str) -> tuple[str, Port[object]]:
        """Follow exposed ports down to (path of the component's port, port).

        Raises
        ------
        WiringError
            If the path names no component or no port.
        """
        parts = path.split(".")
        if len(parts) < 2:
            raise WiringError(f"'{path}' is no port; write 'component.port'")
        head, rest = parts[0], parts[1:]
        if head not in self.nodes:
            raise WiringError(
                f"there is no component '{head}' in '{path}'\n"
                f"  {nearest(head, self.nodes, what='components')}"
            )
        node = self.nodes[head]
        if isinstance(node, System):
            inner = node.exposed.get(rest[0]) if len(rest) == 1 else ".".join(rest)
            if inner is None:
                raise AssertionError(node._exposed(rest[0]))  # it raises: names what is exposed
            leaf, port = node.resolve(inner)
            return f"{head}.{leaf}", port
        if len(rest) != 1:
            raise WiringError(f"'{path}' is no port; write 'component.port'")
        return path, node[rest[0]].declared

    def find(self, path: str) -> Component:
        """The component at a path; ConfigurationError if there is none."""
        flat = self.flatten()
        if path not in flat.components:
            raise ConfigurationError(
                f"there is no component '{path}'\n"
                f"  {nearest(path, flat.components, what='components')}"
            )
        return flat.components[path]

    def _resolved(self, record: Record) -> Record:
        """A record with exposed ports followed down; what does not exist is left to the check."""

        def leaf(path: str) -> str:
            try:
                return self.resolve(path)[0]
            except WiringError:
                return path

        return replace(record, ports=tuple(leaf(p) for p in record.ports))

    def check(self, duration: Exact | None = None, *, outside: bool = False) -> Plan:
        """Check the system whole, and give what it comes down to: order, base step, notes.

        Parameters
        ----------
        duration : exact time, optional
            Of the run that is meant [s], the system's own if absent: recordings that end before
            it are found too.
        outside : bool
            Whether exposed inputs are driven from outside, as in an exported system.

        Raises
        ------
        SystemCheckError
            With every problem found.
        """
        from terrafix.cosim.system.check import check, check_duration

        length = self.duration if duration is None else _positive(duration, "duration")
        plan = check(self, duration=length, outside=outside)
        if length is not None:
            try:
                check_duration(length, plan.base)
            except RateError as error:
                raise SystemCheckError(self.name, [error]) from error
        return plan

    @overload
    def graph(self, path: None = None) -> Diagram: ...
    @overload
    def graph(self, path: str | Path) -> None: ...
    def graph(self, path: str | Path | None = None) -> Diagram | None:
        """Draw the system: to an .svg or .png file, or as Mermaid text to an .mmd file.

        Without a file: a picture in a notebook, Mermaid text elsewhere.

        Raises
        ------
        SystemCheckError
            If the system has problems.
        ConfigurationError
            If the file is of another kind, or cannot be written.
        """
        from terrafix.cosim.system.graph import Diagram

        diagram = Diagram(self)
        if path is None:
            return diagram
        diagram.save(path)
        return None

    def _shown(self) -> list[Block]:
        from terrafix.cosim.system.display import system_shown

        return system_shown(self)

    def flatten(self) -> FlatSystem:
        """Resolve nesting: every component by path, every connection between their ports.

        Raises
        ------
        ConfigurationError
            If a system within has another epoch.
        """
        flat = FlatSystem(self.name, {}, [])
        for name, node in self.nodes.items():
            if isinstance(node, Component):
                flat.components[name] = node
                continue
            if node.epoch not in (None, self.epoch):
                own = f"'{self.epoch}'" if self.epoch else "none"
                raise ConfigurationError(
                    f"system '{name}' has the epoch '{node.epoch}', and '{self.name}', that it is "
                    f"part of, has {own}\n"
                    "  there is one time for all: give both the same, or the inner one none"
                )
            inner = node.flatten()
            flat.components |= {f"{name}.{path}": c for path, c in inner.components.items()}
            flat.connections += [
                Connection(f"{name}.{c.source}", f"{name}.{c.target}", c.delay)
                for c in inner.connections
            ]
            flat.records += [
                replace(r, name=f"{name}_{r.name}", ports=tuple(f"{name}.{p}" for p in r.ports))
                for r in inner.records
            ]
            flat.dispersions += [d.below(name) for d in inner.dispersions]
        flat.connections += [
            Connection(self.resolve(c.source)[0], self.resolve(c.target)[0], c.delay)
            for c in self.connections
        ]
        flat.records += [self._resolved(record) for record in self.records]
        flat.dispersions += self.dispersions
        return flat


def _free(node: Component | System, name: str = "") -> None:
    """Let go of what another system, or this one under another name, may take."""
    if isinstance(node, Component):
        node.name = name
    else:
        node.name, node._contained = name or node.name, False


def _checked_name(name: str, what: str) -> str:
    if not isinstance(name, str) or not _NAME.match(name):
        raise ConfigurationError(
            f"'{name}' cannot name a {what}: use letters, digits and underscores, a letter first"
        )
    return name


def checked_epoch(value: object) -> str:
    """Accept the text of an epoch, whatever it says; EpochError if it is none."""
    if not isinstance(value, str) or not value.strip():
        raise EpochError(
            f"the epoch is {shown(value)}; it takes text with date, time and time scale\n"
            '  write epoch = "2022-09-18T07:49:21.5 UTC"'
        )
    return value.strip()


def _positive(value: Exact, what: str) -> Fraction:
    exact = seconds(value, what)
    if exact <= 0:
        raise RateError(f"{what} is {value}; it must be positive")
    return exact
