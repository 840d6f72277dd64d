"""What a system comes down to: components by path, and the connections between their ports."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import Protocol

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import WiringError, nearest
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Port
from terrafix.cosim.system.dispersion import Dispersion


@dataclass(frozen=True)
class Connection:
    """From an output to an input, by path, with a delay in seconds."""

    source: str
    target: str
    delay: Fraction = Fraction(0)

    def __str__(self) -> str:
        return f"{self.source} -> {self.target}"


@dataclass(frozen=True)
class Record:
    """What a recorder writes, and when: at a rate, or whenever its one component steps."""

    name: str
    ports: tuple[str, ...]
    rate: Rate | None = None
    doc: str = ""


@dataclass
class FlatSystem:
    """A system with nesting resolved: what checks, ordering and the master work on."""

    name: str
    components: dict[str, Component]
    connections: list[Connection]
    records: list[Record] = field(default_factory=list)
    dispersions: list[Dispersion] = field(default_factory=list)

    def port(self, path: str) -> Port[object]:
        """The port at ``"component.port"``; WiringError if there is none."""
        owner, _, name = path.rpartition(".")
        if not owner:
            raise WiringError(f"'{path}' is no port; write 'component.port'")
        if owner not in self.components:
            raise WiringError(
                f"there is no component '{owner}' in '{path}'\n"
                f"  {nearest(owner, self.components, what='components')}"
            )
        return self.components[owner][name].declared

    def owner(self, path: str) -> str:
        """Path of the component that a port belongs to."""
        return path.rpartition(".")[0]


class Flattened(Protocol):
    """Anything that comes down to a flat system: a `terrafix.System`."""

    name: str
    exposed: dict[str, str]
    """Paths of ports, by the names they are exposed under."""
    notes: list[str]
    """What whoever read it found worth knowing."""
    epoch: str | None
    """What time it is at t = 0, in words that components know."""

    def resolve(self, path: str) -> tuple[str, Port[object]]:
        """Follow exposed ports down to (path of the component's port, port)."""

    def flatten(self) -> FlatSystem:
        """Every component by path, every connection between their ports."""
