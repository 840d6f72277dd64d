"""Jacobians of components' steps, evaluated where the nominal run stands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.kernels.base import BoundKernel
from terrafix.cosim.kernels.symbolic import SymbolicComponent

Key = tuple[str, str, str]
"""(kind, component, name) of what deviates: kind ``"state"``, ``"slot"``, ``"held"`` (a slot as it
was when a step began), ``"parameter"`` or ``"noise"``."""


class Read(NamedTuple):
    """Columns of a Jacobian: what they are the derivative by, and its conversion of units."""

    key: Key
    columns: slice
    factor: FloatArray | None


class Written(NamedTuple):
    """Rows of a Jacobian; those of a message count only where it is published."""

    key: Key
    rows: slice
    message: str


class Call(NamedTuple):
    """One step of one component in the nominal run: its Jacobian, which messages it published."""

    path: str
    jacobian: FloatArray
    published: tuple[bool, ...]


class Linear:
    """A symbolic component, and the Jacobian of its step by what deviates.

    Parameters
    ----------
    path : str
    component : SymbolicComponent
        Bound.
    inputs : mapping of str to (Key, ndarray or None)
        What its inputs read, with the conversion of units, where that deviates.
    outputs : sequence of str
        Those that anybody reads.
    parameters : sequence of str
        Those that are dispersed.
    """

    def __init__(
        self,
        path: str,
        component: SymbolicComponent,
        inputs: Mapping[str, tuple[Key, FloatArray | None]],
        outputs: Sequence[str],
        parameters: Sequence[str],
    ) -> None:
        self.path = path
        self.component = component
        model = component.model
        shapes = {n: model.shape(n) for n in (*model.states, *model.outputs, *model.noise)}
        self.states = [n for n in model.states if len(shapes[n]) == 1]
        self.outputs = [n for n in model.outputs if n in outputs and len(shapes[n]) == 1]
        self.noise = list(model.noise)
        self.parameters = list(parameters)
        self.inputs = dict(inputs)
        self.sizes = {n: int(np.prod(model.shape(n))) for n in self._named()}
        self.written: list[Written] = []
        n_rows = 0
        for kind, names in (("slot", self.outputs), ("state", self.states)):
            for name in names:
                rows = slice(n_rows, n_rows + self.sizes[name])
                message = name.partition(".")[0] if kind == "slot" else ""
                self.written.append(Written((kind, path, name), rows, message))
                n_rows = rows.stop
        self.reads = {start: self._reads(start=start) for start in (True, False)}
        self._functions = {
            start: _jacobian(self, component.kernel.function, start=start)
            for start in (True, False)
        }

    def _named(self) -> list[str]:
        return [*self.states, *self.outputs, *self.noise, *self.parameters, *self.inputs]

    def _reads(self, *, start: bool) -> list[Read]:
        keys: list[tuple[Key, FloatArray | None]] = [
            (("state", self.path, n), None) for n in self.states if not start
        ]
        keys += self.inputs.values()
        keys += [(("parameter", self.path, n), None) for n in self.parameters]
        keys += [(("noise", self.path, n), None) for n in self.noise]
        names = [n for n in self.states if not start]
        names += [*self.inputs, *self.parameters, *self.noise]
        found, width = [], 0
        for name, (key, factor) in zip(names, keys, strict=True):
            found.append(Read(key, slice(width, width + self.sizes[name]), factor))
            width += self.sizes[name]
        return found

    def now_written(self, published: Sequence[bool]) -> list[Written]:
        """What a step changes: states, signals, and those messages that it published."""
        silent = {n for n, sent in zip(self.component.messages, published, strict=True) if not sent}
        return [w for w in self.written if w.message not in silent]

    def at_start(self) -> FloatArray | None:
        """Jacobian of the values at t = 0; None where nothing is read or written."""
        evaluation = self.evaluation(start=True)
        return None if evaluation is None else evaluation()

    def evaluation(self, *, start: bool) -> Evaluation | None:
        """The Jacobian of a step, or of the values at t = 0, on the arrays of the component."""
        function, names = self._functions[start]
        if function is None:
            return None
        arrays = self.component.arguments()
        if start:
            arrays |= {n: np.zeros(1) for n in ("step", "time")}
        return Evaluation(function, [arrays[n] for n in names])


class Evaluation:
    """A function of arrays that change in place, called on what they hold."""

    def __init__(self, function: Any, arguments: Sequence[FloatArray]) -> None:
        rows, columns = function.size_out(0)
        self._buffer, self._evaluate = function.buffer()
        self._kept = (function, arguments)
        self._result = np.zeros((columns, rows))  # CasADi's order
        for i, array in enumerate(arguments):  # of the first member
            self._buffer.set_arg(i, array[:1].reshape(-1).data)
        self._buffer.set_res(0, self._result.data)

    def __call__(self) -> FloatArray:
        """Evaluate; (rows, columns)."""
        self._evaluate()
        return self._result.T.copy()


class Notes:
    """Calls in the order in which components stepped, while `listening`."""

    def __init__(self) -> None:
        self.listening = False
        self.calls: list[Call] = []


class Listener(BoundKernel):
    """The kernel of a component, noting Jacobians where somebody listens.

    A stretch of ticks that is handed to compiled code goes past it.
    """

    def __init__(self, linear: Linear, notes: Notes) -> None:
        self._linear = linear
        self._notes = notes
        self._kernel = linear.component.call
        self._jacobian = linear.evaluation(start=False)
        self.stage = getattr(self._kernel, "stage", None)

    def __call__(self, step: int) -> int:
        """Step."""
        if not self._notes.listening or self._jacobian is None:
            return self._kernel(step)
        jacobian = self._jacobian()
        failed = self._kernel(step)
        published = tuple(bool(f[0] > 0.5) for f in self._linear.component.messages.values())
        self._notes.calls.append(Call(self._linear.path, jacobian, published))
        return failed


def _jacobian(linear: Linear, step: Any, *, start: bool) -> tuple[Any, list[str]]:
    """Function of the arguments that matter to a Jacobian, and their names."""
    import casadi as ca

    model = linear.component.model
    if not linear.written or not linear.reads[start]:
        return None, []
    function = model.initial_function() if start else step
    states = [] if start else [f"state:{n}" for n in model.states]
    names = [*model.inputs, *states, *model.parameters, *model.noise]
    names += ["step"] * (model.step is not None) + ["time"] * (model.time is not None)
    symbols = {n: ca.SX.sym(f"a{i}", function.numel_in(i)) for i, n in enumerate(names)}
    keys = [*(("slot", n) for n in model.outputs), *(("state", n) for n in model.states)]
    results = dict(zip(keys, function.call(list(symbols.values())), strict=True))
    rows = [results[w.key[0], w.key[2]] for w in linear.written]
    by = [symbols[f"state:{n}"] for n in linear.states if not start]
    by += [symbols[n] for n in (*linear.inputs, *linear.parameters, *linear.noise)]
    jacobian = ca.densify(ca.jacobian(ca.vertcat(*rows), ca.vertcat(*by)))

    def elements(expression: Any) -> set[int]:
        return {e.element_hash() for e in ca.symvar(expression)}

    free = elements(jacobian)
    needed = [n for n in names if free & elements(symbols[n])]
    made = ca.Function("jacobian", [symbols[n] for n in needed], [jacobian])
    return made, needed


def error_jacobian(model: Any) -> Any:
    """Derivative of the error by all inputs of its model, one after the other."""
    import casadi as ca

    symbols = list(model.inputs.values())
    by = ca.vertcat(*(ca.vec(s) for s in symbols))
    jacobian = ca.jacobian(ca.SX(model.outputs["error"]), by)
    return ca.Function("by", symbols, [ca.densify(jacobian)])
