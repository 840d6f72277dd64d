"""What the unknowns of an exported FMU depend on, by the sparsity of its functions, exactly.

Reach is a table of booleans: a row for each number the FMU keeps (integers after all reals), a
column for each element of the knowns. It spreads from the knowns through the parts in their order,
by copies, messages and the sparsity of each function.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.exchange.fmi.write.layout import Call, Layout, Part, Target
from terrafix.cosim.exchange.fmi.write.variables import Variable

BoolArray = NDArray[np.bool_]


@dataclass
class Unknown:
    """An output, derivative or start value, and what it depends on, element by element."""

    variable: Variable
    knowns: list[Variable]
    pattern: BoolArray  # (elements of the variable, elements of all knowns together)

    def of_element(self, element: int) -> list[tuple[Variable, int]]:
        """What one element depends on: (variable, element)."""
        columns = [(v, k) for v in self.knowns for k in range(v.size)]
        return [columns[c] for c in np.flatnonzero(self.pattern[element])]

    def variables(self) -> list[Variable]:
        """Variables that any element depends on."""
        starts = np.cumsum([0] + [v.size for v in self.knowns])
        return [
            v
            for v, a, b in zip(self.knowns, starts, starts[1:], strict=False)
            if self.pattern[:, a:b].any()
        ]


class Dependencies:
    """What every output, derivative and calculated start value depends on.

    Attributes
    ----------
    outputs, derivatives, initial_unknowns : list of Unknown
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        outputs = [
            v for v in [*self.layout.reals, *self.layout.integers] if v.causality == "output"
        ]
        inputs = [v for v in [*self.layout.reals, *self.layout.integers] if v.causality == "input"]
        exact = inputs + [
            v for v in [*self.layout.reals, *self.layout.integers] if v.causality == "parameter"
        ]
        started = self._spread(exact, lambda part: part.initial, starting=True)
        states = self.layout.continuous.states if self.layout.continuous else []
        rates = self.layout.continuous.derivatives if self.layout.continuous else []
        if self.layout.continuous is None:
            known = [v for v in inputs if not v.at_start]
            stepped = self._spread(known, lambda part: part.step)
        else:
            known = states + inputs
            stepped = self._seeded(known)
            for variable in states:
                self._seed(stepped, variable, known, at=variable.state)
            self._take_inputs(stepped, self.layout.parts[0])
            self._through(stepped, self.layout.continuous.rate, self.layout.continuous.targets)
            self._through(started, self.layout.continuous.rate, self.layout.continuous.targets)
        self.outputs = [self._unknown(v, stepped, known) for v in outputs]
        self.derivatives = [self._unknown(v, stepped, known) for v in rates]
        calculated = dict.fromkeys([*outputs, *states, *rates])
        self.initial_unknowns = [self._unknown(v, started, exact) for v in calculated]

    def _row(self, variable: Variable) -> int:
        """Row of a variable's first element: integers follow all reals."""
        return variable.offset + (len(self.layout.start_real) if variable.kind == "integer" else 0)

    def _seeded(self, known: Sequence[Variable]) -> BoolArray:
        width = sum(v.size for v in known)
        reach = np.zeros(
            (len(self.layout.start_real) + len(self.layout.start_integer), width), dtype=np.bool_
        )
        for variable in known:
            self._seed(reach, variable, known, at=self._row(variable))
        return reach

    @staticmethod
    def _seed(reach: BoolArray, variable: Variable, known: Sequence[Variable], at: Any) -> None:
        column = 0
        for other in known:
            if other is variable:
                break
            column += other.size
        for k in range(variable.size):
            reach[at + k, column + k] = True

    def _take_inputs(self, reach: BoolArray, part: Part) -> None:
        """Reach of inputs that are read at the start of a step, and are set outside."""
        inputs = {v.offset for v in self.layout.reals if v.causality == "input"}
        for copy in part.latch:
            if not copy.integer and copy.source in inputs:
                source = reach[copy.source : copy.source + copy.size]
                reach[copy.target : copy.target + copy.size] = source

    def _spread(
        self, known: Sequence[Variable], choose: Any, *, starting: bool = False
    ) -> BoolArray:
        """Reach of `known` through all parts in their order, when the start is found or later."""
        reach = self._seeded(known)
        n_real = len(self.layout.start_real)
        noise = [n_real + p for p in (self.layout.seed, self.layout.member) if p >= 0]
        for part in self.layout.parts:
            for copy in part.convert:
                if not copy.integer:
                    source = reach[copy.source : copy.source + copy.size]
                    reach[copy.target : copy.target + copy.size] = source
            if starting:
                self._take_inputs(reach, part)
            for message in part.received:
                if message.fresh >= 0:
                    reach[message.fresh] = reach[n_real + message.sequence]
            for stream in part.streams:
                reach[stream.offset : stream.offset + stream.size] = reach[noise].any(axis=0)
            self._through(reach, choose(part), part.targets, part)
        return reach

    def _through(
        self, reach: BoolArray, call: Call, targets: Sequence[Target], part: Part | None = None
    ) -> None:
        """Reach of the results of a function, from that of its arguments."""
        pattern = _sparsity(call.function)
        function = call.function
        ranges = [np.arange(a, a + function.numel_in(i)) for i, a in enumerate(call.arguments)]
        arguments = np.concatenate([np.arange(0), *ranges])  # of a function without any: none
        results = (pattern @ reach[arguments].astype(np.int64)) > 0
        at = 0
        sent: dict[int, BoolArray] = {}
        if part is not None:
            for number, message in enumerate(part.published):
                if message.valid >= 0:
                    sent[number] = results[message.valid]
                    row = len(self.layout.start_real) + message.sequence
                    reach[row] = results[message.valid]
        for target in targets:
            rows = results[at : at + target.size]
            at += target.size
            if target.message in sent:
                rows = rows | sent[target.message]
            reach[target.offset : target.offset + target.size] = rows

    def _unknown(self, variable: Variable, reach: BoolArray, known: Sequence[Variable]) -> Unknown:
        row = self._row(variable) if variable.state is None else variable.state
        return Unknown(variable, list(known), reach[row : row + variable.size].copy())


def _sparsity(function: Any) -> NDArray[np.int64]:
    """Which results depend on which arguments, all in a row: (results, arguments)."""
    import casadi as ca

    symbols = [ca.SX.sym(f"x{i}", function.numel_in(i)) for i in range(function.n_in())]
    results = function.call(symbols)
    n_results, n_arguments = sum(r.numel() for r in results), sum(s.numel() for s in symbols)
    pattern = np.zeros((n_results, n_arguments), dtype=np.int64)
    if n_results and n_arguments:
        found = ca.jacobian_sparsity(ca.vertcat(*results), ca.vertcat(*symbols))
        rows, columns = found.get_triplet()
        pattern[list(rows), list(columns)] = 1
    return pattern
