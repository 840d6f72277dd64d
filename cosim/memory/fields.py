"""A field: one array of a port, with its shape, unit and frame."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike

from terrafix.cosim.basics.errors import ConfigurationError

Unit = str | tuple[str, ...]


@dataclass(frozen=True, repr=False)
class Field:
    """One array of a port.

    Parameters
    ----------
    shape : tuple of int
        Of one member; ``None`` for an extent known only at run time (shared ports).
    unit : str or tuple of str
        One unit, or one for each element of the last axis.
    frame : str, optional
        Must match exactly between connected ports.
    dtype : dtype
        ``float64`` unless declared.
    ragged : bool
        The first axis is a capacity; a count per member says how much of it is used.
    labels : tuple of str
        Names of the elements of the last axis, for records and tables.
    """

    shape: tuple[int | None, ...] = ()
    unit: Unit = "1"
    frame: str | None = None
    dtype: DTypeLike = np.float64
    ragged: bool = False
    labels: tuple[str, ...] = ()
    doc: str = ""

    def __post_init__(self) -> None:
        n = self.shape[-1] if self.shape else None
        if not isinstance(self.unit, str) and len(self.unit) != n:
            raise ConfigurationError(
                f"{len(self.unit)} units for shape {self.shape}; give one, or one for each element "
                "of the last axis"
            )
        if self.labels and len(self.labels) != n:
            raise ConfigurationError(
                f"{len(self.labels)} labels for shape {self.shape}; give one for each element of "
                "the last axis"
            )

    @property
    def fixed_shape(self) -> tuple[int, ...]:
        """The shape, all extents known."""
        if any(n is None for n in self.shape):
            raise ConfigurationError(f"shape {self.shape} is open; only shared ports may be")
        return tuple(n for n in self.shape if n is not None)

    @property
    def size(self) -> int:
        """Number of elements of one member."""
        return int(np.prod(self.fixed_shape, dtype=np.int64))

    def unit_text(self) -> str:
        """The unit as a person writes it."""
        return self.unit if isinstance(self.unit, str) else "(" + ", ".join(self.unit) + ")"

    def arguments(self) -> list[str]:
        """What its constructor was given, as it is written in Python; its meaning left out."""
        written = [str(self.shape)] if self.shape else []
        if self.unit != "1":
            written.append(f"unit={quoted(self.unit)}")
        if self.frame is not None:
            written.append(f"frame={quoted(self.frame)}")
        if np.dtype(self.dtype) != np.float64:
            written.append(f"dtype={quoted(str(np.dtype(self.dtype)))}")
        if self.ragged:
            written.append("ragged=True")
        return written

    def __repr__(self) -> str:
        return f"Field({', '.join(self.arguments())})"


def quoted(text: str | tuple[str, ...]) -> str:
    """Write a text, or several, as they are written in our Python: in double quotes."""
    if isinstance(text, str):
        return json.dumps(text, ensure_ascii=False)
    return f"({', '.join(map(quoted, text))}{',' if len(text) == 1 else ''})"
