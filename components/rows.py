"""A setting that is a list of tables: waypoints, segments of a flight."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.declare.parameters import Parameter, Setting, shown

Row = dict[str, Any]
"""Numbers, or lists of them, in SI by column; what was not given is not there."""


class Rows(Setting[tuple[Row, ...]]):
    """Tables with the same columns, in their order; none if absent.

    Parameters
    ----------
    columns : mapping of str to Parameter
        Read as a parameter would be, with units.
    needed : sequence of str
        Columns that each row must have.
    """

    def __init__(
        self, columns: Mapping[str, Parameter], needed: Sequence[str] = (), *, doc: str = ""
    ) -> None:
        super().__init__((), doc=doc)
        self.columns, self.needed = columns, tuple(needed)

    def kind(self) -> str:
        """Describe what is accepted, for listings."""
        return f"list of {{ {', '.join(self.columns)} }}"

    def _arguments(self) -> list[str]:
        return [f"columns={list(self.columns)}"]

    def read(self, value: object, *, where: str, bare: bool = True) -> tuple[Row, ...]:
        """Turn a list of tables, or its text as in a file, into rows in SI.

        Raises
        ------
        ConfigurationError
            If it is none, or a column is unknown, missing or cannot be read.
        """
        if isinstance(value, str):
            with suppress(tomllib.TOMLDecodeError):
                value = tomllib.loads(f"rows = {value}")["rows"]
        if not isinstance(value, list | tuple) or not all(isinstance(row, dict) for row in value):
            raise ConfigurationError(
                f"{where} is {shown(value)}; it takes a {self.kind()}\n"
                f"  write {where.split('.')[-1].strip(chr(39))} = [{{ ... }}, {{ ... }}]"
            )
        return tuple(self._row(row, f"{where}[{k + 1}]", bare) for k, row in enumerate(value))

    def _row(self, row: Mapping[str, Any], where: str, bare: bool) -> Row:
        for name in row:
            if name not in self.columns:
                raise ConfigurationError(
                    f"{where} has no '{name}'\n  {nearest(name, self.columns, what='its columns')}"
                )
        for name in self.needed:
            if name not in row:
                kind = self.columns[name].kind()
                raise ConfigurationError(f"{where} needs '{name}': it takes {kind}")
        return {
            name: self.columns[name].read(value, where=f"{where}.{name}", bare=bare).tolist()
            for name, value in row.items()
        }

    def write(self, value: tuple[Row, ...]) -> Any:
        """Write rows so that `read` accepts them again."""
        return [{n: self.columns[n].write(v) for n, v in row.items()} for row in value]
