"""The order in which components are initialized, where some take inputs to find their start.

Without such components it is the order of stepping. `Settling` ones come after the sources of all
their inputs, also of those that a step reads at its start. Where components wait for each other,
outputs are asked for one by one, in the order of what they depend on; those that depend on each
other are repeated from start values until they stand still. A component that is initialized once,
and not in parts, cannot be repeated: a link of such a loop that is read at the start of a step
carries nothing then, and its reader keeps the start value.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from terrafix.cosim.declare.settling import Settling
from terrafix.cosim.system.flat import Connection, FlatSystem
from terrafix.cosim.system.order import is_feedthrough

N = TypeVar("N")
Node = tuple[str, str]
"""Path of a component, and one of its outputs; ``""`` for its being initialized, whole."""
Outputs = tuple[tuple[str, tuple[str, ...]], ...]
"""Components, and outputs that are asked for."""


@dataclass(frozen=True)
class Together:
    """Components that wait for each other.

    Attributes
    ----------
    settling : tuple of str
        Those that are begun first.
    steps : tuple of str or Outputs
        What is initialized (a path), or repeated until it stands still.
    """

    settling: tuple[str, ...]
    steps: tuple[str | Outputs, ...]


@dataclass
class Start:
    """How a system is initialized.

    Attributes
    ----------
    stages : list of str or Together
        Components one by one, or several together.
    taken : dict of str to list of Connection
        What `Settling` components take before they are initialized, by path.
    loops : list of list of Connection
        Links whose outputs depend on each other at t = 0.
    dropped : list of Connection
        Links of loops that carry nothing at t = 0.
    """

    stages: list[str | Together] = field(default_factory=list)
    taken: dict[str, list[Connection]] = field(default_factory=dict)
    loops: list[list[Connection]] = field(default_factory=list)
    dropped: list[Connection] = field(default_factory=list)


def starting_order(flat: FlatSystem, order: Sequence[str]) -> Start:
    """Find the order of initialization of a system that is stepped in `order`."""
    start = Start()
    settling = {p: c for p, c in flat.components.items() if isinstance(c, Settling)}
    if not settling:
        start.stages = list(order)
        return start
    start.taken = {p: [] for p in settling}
    wanted = {p: c.taken_at_start() for p, c in settling.items()}
    for connection in flat.connections:
        owner, _, name = connection.target.rpartition(".")
        if not connection.delay and name in wanted.get(owner, ()):
            start.taken[owner].append(connection)
    place = {path: k for k, path in enumerate(order)}
    links = [(flat.owner(c.source), p) for p, taken in start.taken.items() for c in taken]
    if all(place[source] < place[target] for source, target in links):
        start.stages = list(order)
        return start
    after: dict[str, set[str]] = {path: set() for path in order}
    for a, b in _waiting(flat, start, place):
        after[a].add(b)
    for group in _in_order(after, place):
        if len(group) == 1 and group[0] not in after[group[0]]:
            start.stages.append(group[0])
        else:
            start.stages.append(_Cluster(flat, start, place, group).together())
    return start


def _waiting(flat: FlatSystem, start: Start, place: Mapping[str, int]) -> Iterable[tuple[str, str]]:
    """Pairs of components of which the first is initialized before the second."""
    taken = {c for links in start.taken.values() for c in links}
    for connection in flat.connections:
        source, target = flat.owner(connection.source), flat.owner(connection.target)
        if connection in taken or is_feedthrough(flat, connection):
            yield source, target
        elif not connection.delay and place[target] < place[source]:
            yield target, source  # it may look at the source's memory, which must be empty yet


class _Cluster:
    """Components that wait for each other."""

    def __init__(
        self, flat: FlatSystem, start: Start, place: Mapping[str, int], group: Sequence[str]
    ) -> None:
        self._flat, self._start, self._place = flat, start, place
        self._group = sorted(group, key=place.__getitem__)
        members = set(group)
        self._links = [
            c
            for c in flat.connections
            if flat.owner(c.source) in members and flat.owner(c.target) in members
        ]
        self._settling = [p for p in self._group if p in start.taken]

    def together(self) -> Together:
        """Order what is to do, and note loops and links that are dropped."""
        while True:
            after = self._graph()
            rank = {node: (self._place[node[0]], node[1]) for node in after}
            parts = _in_order(after, rank)
            loops = [p for p in parts if len(p) > 1 or p[0] in after[p[0]]]
            stuck = [c for p in loops if not self._repeatable(p) for c in self._soft(p)]
            if not stuck:
                break
            for connection in stuck:
                self._start.taken[self._flat.owner(connection.target)].remove(connection)
            self._start.dropped += stuck
        self._start.loops += [self._inside(p) for p in loops]
        return Together(tuple(self._settling), _steps([node for p in parts for node in p]))

    def _graph(self) -> dict[Node, set[Node]]:
        """What comes after each node."""
        taken = {c for links in self._start.taken.values() for c in links}
        waits = [c for c in self._links if c in taken or is_feedthrough(self._flat, c)]
        after: dict[Node, set[Node]] = {(p, ""): set() for p in self._group}
        for connection in waits:
            source = self._source(connection)
            after.setdefault(source, set())
            if source[1]:
                after[source].add((source[0], ""))
        nodes = defaultdict(list)
        for node in after:
            nodes[node[0]].append(node)
        for connection in self._links:
            path, _, name = connection.target.rpartition(".")
            component = self._flat.components[path]
            if connection in waits:
                source = self._source(connection)
                after[source].add((path, ""))
                if connection in taken and isinstance(component, Settling):
                    after[source] |= {
                        n for n in nodes[path] if n[1] and name in component.needed_by(n[1])
                    }
            elif not connection.delay:
                other = self._flat.owner(connection.source)
                if self._place[path] < self._place[other]:
                    after[path, ""] |= set(nodes[other])
        return after

    def _source(self, connection: Connection) -> Node:
        """The node that publishes what a link carries."""
        path, _, name = connection.source.rpartition(".")
        component = self._flat.components[path]
        in_part = isinstance(component, Settling) and component.in_parts
        in_part = in_part and self._flat.port(connection.source).kind == "signal"
        return path, name if in_part else ""

    def _repeatable(self, part: Sequence[Node]) -> bool:
        return all(output and path in self._start.taken for path, output in part)

    def _inside(self, part: Sequence[Node]) -> list[Connection]:
        """Links between the nodes of a loop."""
        nodes, owners = set(part), {path for path, _ in part}
        return [
            c
            for c in self._links
            if self._source(c) in nodes
            and self._flat.owner(c.target) in owners
            and c in self._start.taken.get(self._flat.owner(c.target), ())
        ]

    def _soft(self, part: Sequence[Node]) -> list[Connection]:
        """Links of a loop that a step reads at its start: these alone may be dropped."""
        return [c for c in self._inside(part) if not is_feedthrough(self._flat, c)]


def _steps(nodes: Sequence[Node]) -> tuple[str | Outputs, ...]:
    """Outputs that come one after another are repeated together."""
    steps: list[str | Outputs] = []
    asked: list[tuple[str, tuple[str, ...]]] = []
    for path, output in nodes:
        if not output:
            steps += [tuple(asked), path] if asked else [path]
            asked = []
        elif asked and asked[-1][0] == path:
            asked[-1] = (path, (*asked[-1][1], output))
        else:
            asked.append((path, (output,)))
    return (*steps, tuple(asked)) if asked else tuple(steps)


def _in_order(after: Mapping[N, set[N]], rank: Mapping[N, Any]) -> list[list[N]]:
    """Nodes in the order of their edges, those of a cycle together; by rank where they are free."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    nodes = sorted(after, key=rank.__getitem__)
    index = {node: k for k, node in enumerate(nodes)}
    pairs = [(index[a], index[b]) for a, following in after.items() for b in following]
    n = len(nodes)
    rows, columns = zip(*pairs, strict=True) if pairs else ((), ())
    graph = csr_array(([1] * len(pairs), (rows, columns)), shape=(n, n))
    _, label = connected_components(graph, connection="strong")
    groups: dict[int, list[int]] = defaultdict(list)
    for k in range(n):
        groups[int(label[k])].append(k)
    edges = {(int(label[a]), int(label[b])) for a, b in pairs if label[a] != label[b]}
    waiting = dict.fromkeys(groups, 0)
    following: dict[int, list[int]] = defaultdict(list)
    for a, b in sorted(edges):
        waiting[b] += 1
        following[a].append(b)
    ready = [(members[0], g) for g, members in groups.items() if not waiting[g]]
    heapq.heapify(ready)
    found = []
    while ready:
        _, g = heapq.heappop(ready)
        found.append([nodes[k] for k in groups[g]])
        for b in following[g]:
            waiting[b] -= 1
            if not waiting[b]:
                heapq.heappush(ready, (groups[b][0], b))
    return found
