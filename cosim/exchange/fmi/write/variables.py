"""Variables of an FMU as they are declared, whichever FMI they are written for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from terrafix.cosim.memory.fields import Unit


@dataclass(eq=False)
class Variable:
    """One variable: a number or an array of FMI 3, one or several scalars of FMI 2.

    Attributes
    ----------
    name : str
    kind : {"real", "integer"}
    causality : {"independent", "input", "output", "parameter", "local"}
    offset : int
        Place of its first number among those of its kind.
    shape : tuple of int
    start : array_like or None
        Start value; None where the FMU calculates it.
    unit : str or tuple of str
        One, or one for each element of the last axis.
    frame : str or None
    doc : str
    discrete : bool
        Whether it changes at events alone.
    minimum, maximum : float or None
    positive, infinite : bool
    state : int or None
        Place where the continuous state is kept that this variable shows.
    derivative_of : Variable or None
    nominal : float or None
    at_start : bool
        An input that is read at the start of a step.
    """

    name: str
    kind: str
    causality: str
    offset: int
    shape: tuple[int, ...] = ()
    start: Any = None
    unit: Unit = "1"
    frame: str | None = None
    doc: str = ""
    discrete: bool = False
    minimum: float | None = None
    maximum: float | None = None
    positive: bool = False
    infinite: bool = False
    state: int | None = None
    derivative_of: Variable | None = None
    nominal: float | None = None
    at_start: bool = False

    @property
    def size(self) -> int:
        """Number of its elements."""
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def is_derivative(self) -> bool:
        """Whether it is the derivative of a continuous state."""
        return self.derivative_of is not None

    def element_names(self) -> list[str]:
        """Names of its scalars: ``r[1]``, ``P[1,2]``, ``der(r[1])``; as they stand in `real`."""
        if not self.shape:
            return [self.name]
        inner = self.derivative_of.name if self.derivative_of is not None else self.name
        names = [
            f"{inner}[{','.join(str(i + 1) for i in index)}]" for index in np.ndindex(self.shape)
        ]
        return [f"der({name})" for name in names] if self.is_derivative else names

    def elements(self) -> list[Variable]:
        """Its scalars as variables of their own, but for what a derivative is derived from."""
        starts = [None] * self.size if self.start is None else self.starts()
        states = [None if self.state is None else self.state + k for k in range(self.size)]
        pairs = zip(self.element_names(), self.units(), starts, states, strict=True)
        return [
            replace(self, name=n, unit=u, start=s, state=x, shape=(), offset=self.offset + k)
            for k, (n, u, s, x) in enumerate(pairs)
        ]

    def starts(self) -> list[float]:
        """Start values of its scalars."""
        value = np.broadcast_to(np.asarray(self.start, dtype=np.float64), self.shape)
        return [float(v) for v in value.ravel()]

    def units(self) -> list[str]:
        """Units of its scalars."""
        if isinstance(self.unit, str):
            return [self.unit] * self.size
        return [self.unit[index[-1]] for index in np.ndindex(self.shape)]

    @property
    def common_unit(self) -> str | None:
        """The unit of all its elements; None where they differ or it has none."""
        unit = self.unit if isinstance(self.unit, str) else None
        return None if unit in ("", "1") else unit


@dataclass
class PortVariables:
    """The variables that one port of a component has become.

    Attributes
    ----------
    name : str
        As the FMU shows it.
    kind : {"signal", "message"}
    is_input : bool
    at : {"start", "end"}
    fields : dict of str to Variable
        By field; a plain signal has one named ``""``.
    t, sequence : Variable or None
        Of a message.
    """

    name: str
    kind: str
    is_input: bool
    at: str
    fields: dict[str, Variable] = field(default_factory=dict)
    t: Variable | None = None
    sequence: Variable | None = None
