"""Single elements of arrays, from several sources, that an SSP package connects to one input."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from terrafix.cosim.declare.parameters import Text
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.declare.settling import Settling

NOWHERE = "-"


class Elements(Settling):
    """An array, each element one of some input times a factor plus an offset."""

    shapes = Text("", doc="of the inputs x1, x2, ..., by semicolons: 3; 2,2; nothing of a number")
    units = Text("1", doc="of the inputs, by semicolons")
    shape = Text("", doc="of y")
    unit = Text("1", doc="of y")
    take = Text("1:0", doc="of each element of y the input and the place in it, as 2:0; - for none")
    factor = Text("1", doc="of each element, by commas")
    shift = Text("0", doc="offset of each element, by commas; its value where it has no input")

    def prepare(self) -> None:
        """Declare the ports."""
        given = self.given_parameters
        shapes, units = given["shapes"].split(";"), given["units"].split(";")
        y = Output(_shape(given["shape"]), unit=given["unit"], doc="the elements")
        y.name = "y"
        self.ports = {"y": y}
        for k, (shape, unit) in enumerate(zip(shapes, units, strict=True)):
            x = Input(_shape(shape), unit=unit.strip(), doc="what elements are taken from")
            x.name = f"x{k + 1}"
            self.ports[x.name] = x
        self._takes = []
        for place, word in enumerate(given["take"].split(",")):
            if word.strip() != NOWHERE:
                port, _, element = word.partition(":")
                self._takes.append((place, f"x{int(port)}", int(element)))
        self._factor, self._offset = (
            np.array([float(v) for v in given[name].split(",")]) for name in ("factor", "shift")
        )

    def settle(self, known: Iterable[str], outputs: Iterable[str]) -> None:
        """Take what there is."""
        self._initialize_impl()

    def _initialize_impl(self) -> None:
        self._step_impl(0.0, 0.0)

    def _step_impl(self, t: float, dt: float) -> None:
        y = self.port_views["y"]
        flat = y.reshape(len(y), -1)
        flat[:] = self._offset
        for place, port, element in self._takes:
            x = self.port_views[port]
            flat[:, place] += self._factor[place] * x.reshape(len(x), -1)[:, element]


def _shape(text: str) -> Any:
    return tuple(int(n) for n in text.split(",") if n.strip())
