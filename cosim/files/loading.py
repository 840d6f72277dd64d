"""What is found wrong while a system file is read, and what merely follows from it.

A mistake is reported once: an input is not also "not connected" because its connection was refused,
a parameter does not also "need a value" because its value was.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from terrafix.cosim.basics.errors import (
    ConfigurationError,
    EpochError,
    SystemCheckError,
    TerrafixError,
    WiringError,
    nearest,
)
from terrafix.cosim.declare.parameters import shown
from terrafix.cosim.declare.ports import Port
from terrafix.cosim.system.system import System
from terrafix.cosim.system.wiring import check_connection

_UNCONNECTED = re.compile(r"input '([\w.]+)' is not connected")


@dataclass
class Load:
    """One file being read.

    Attributes
    ----------
    files : tuple of Path
        The file, and before it those it is nested in.
    problems : list of TerrafixError
        What was wrong.
    broken : set of str
        Components that were written but could not be made.
    unknown : set of str
        Names that are of no component, reported once each.
    refused : list of (str, str)
        Source and target of connections that were not made; the source may be empty.
    unread : bool
        Whether connections were written that could not even be read.
    withheld : set of str
        Parameters that an option would set, had the choice been possible.
    bare : set of str
        Keys of records and dispersions that need no unit, as they were set and not written.
    """

    files: tuple[Path, ...]
    problems: list[TerrafixError] = field(default_factory=list)
    broken: set[str] = field(default_factory=set)
    unknown: set[str] = field(default_factory=set)
    refused: list[tuple[str, str]] = field(default_factory=list)
    unread: bool = False
    withheld: set[str] = field(default_factory=set)
    bare: set[str] = field(default_factory=set)

    @property
    def folder(self) -> Path:
        """Where the file is: what paths in it are relative to."""
        return self.files[-1].parent

    def refuse(self, text: str) -> None:
        """Note a mistake, unless it was noted before."""
        if all(str(p) != text for p in self.problems):
            self.problems.append(ConfigurationError(text))

    def attempt(self, action: Any, *arguments: Any, **options: Any) -> Any:
        """What `action` returns; None where it raises, which is noted."""
        try:
            return action(*arguments, **options)
        except SystemCheckError as error:
            self.problems.extend(error.problems)
        except TerrafixError as error:
            self.problems.append(error)
        return None

    def table(self, content: Mapping[str, Any], name: str) -> dict[str, Any]:
        """The table `name`, empty if there is none."""
        value = content.get(name, {})
        if not isinstance(value, dict):
            self.refuse(f"'{name}' is {shown(value)}, not a table\n  begin one with [{name}]")
            return {}
        return value

    def tables(self, content: Mapping[str, Any], name: str) -> dict[str, dict[str, Any]]:
        """The tables in the table `name`."""
        found = {}
        for key, value in self.table(content, name).items():
            if isinstance(value, dict):
                found[key] = value
            else:
                what = f"'{name}.{key}' is {shown(value)}"
                self.refuse(f"{what}, not a table\n  begin one with [{name}.{key}]")
                self.broken.add(key)
        return found

    def refuse_unknown(
        self, table: Mapping[str, Any], known: Iterable[str], where: str = ""
    ) -> list[str]:
        """Note the keys that are not known, and return them."""
        known = list(known)
        strange = [key for key in table if key not in known]
        for key in strange:
            prefix = f"{where}: " if where else ""
            self.refuse(f"{prefix}there is no key '{key}'\n  {nearest(key, known, what='keys')}")
        return strange

    def is_lost(self, paths: Iterable[str]) -> bool:
        """Whether one of these ports or parameters is of a component that is not there."""
        return not {p.split(".")[0] for p in paths}.isdisjoint(self.broken | self.unknown)

    def include(self, inner: Load, name: str) -> None:
        """Take over what was wrong with a nested system."""
        self.problems += [type(p)(f"in '{name}' ({inner.files[-1]}): {p}") for p in inner.problems]
        self.refused += [(f"{name}.{a}", f"{name}.{b}") for a, b in inner.refused]

    def follows(self, problem: TerrafixError, system: System) -> bool:
        """Whether a problem of the whole system merely follows from what was noted."""
        if not system.nodes and self.problems:
            return True
        if any(str(problem).startswith(f"'{name}' has no rate") for name in self.broken):
            return True  # its file may have brought one
        dated = any(isinstance(p, EpochError) for p in self.problems)
        if dated and isinstance(problem, EpochError):
            return True  # it has none now
        match = _UNCONNECTED.match(str(problem))
        return match is not None and (
            self.unread or any(_meant(system, a, b, match[1]) for a, b in self.refused)
        )


def _port(system: System, path: str) -> Port[Any] | None:
    try:
        return system.resolve(path)[1]
    except WiringError:
        return None


def _meant(system: System, source: str, target: str, path: str) -> bool:
    """Whether a refused connection may have been meant for the input `path`."""
    if target == path:
        return True
    written = _port(system, target)
    owner, own = target.rpartition(".")[0], path.rpartition(".")[0]
    if (written is not None and written.is_input) or (owner != own and owner in system.nodes):
        return False
    output, wanted = _port(system, source), _port(system, path)
    if output is None or wanted is None:
        return True
    try:
        check_connection(source, output, path, wanted)
    except WiringError:
        return False
    return True
