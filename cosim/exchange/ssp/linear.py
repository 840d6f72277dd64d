"""The linear transformation that a connection of an SSP package may carry."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from terrafix.cosim.declare.parameters import Count, Flag, Text
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.declare.settling import Settling


class Linear(Settling):
    """Numbers times a factor plus an offset, in the unit that the receiving side has."""

    factor = Text("1", doc="of each element, by commas")
    shift = Text("0", doc="offset of each element, by commas, in unit_out")
    width = Count(1, minimum=1, doc="number of elements")
    flat = Flag(True, doc="a number instead of an array")
    unit_in = Text("1", doc="unit of x")
    unit_out = Text("1", doc="unit of y")

    def prepare(self) -> None:
        """Declare the ports."""
        shape: Any = () if self.given_parameters["flat"] else (self.given_parameters["width"],)
        x = Input(shape, unit=self.given_parameters["unit_in"], doc="what is transformed")
        y = Output(shape, unit=self.given_parameters["unit_out"], doc="factor * x + offset")
        x.name, y.name = "x", "y"
        self.ports = {"x": x, "y": y}
        self._factor, self._offset = self._numbers("factor"), self._numbers("shift")

    def _numbers(self, name: str) -> Any:
        values = np.array([float(v) for v in self.given_parameters[name].split(",")])
        return values[0] if self.given_parameters["flat"] else values

    def settle(self, known: Iterable[str], outputs: Iterable[str]) -> None:
        """Transform what there is."""
        self._initialize_impl()

    def _initialize_impl(self) -> None:
        self._step_impl(0.0, 0.0)

    def _step_impl(self, t: float, dt: float) -> None:
        self.port_views["y"][...] = self._factor * self.port_views["x"] + self._offset
