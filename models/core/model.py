r"""The symbolic model: named inputs, states, parameters and noise; what follows from them.

A model is the map of one step of length :math:`\Delta t`,

.. math::
    x_0 = x_0(u, p, w), \qquad
    x^+ = f(x, u, p, w, \Delta t), \qquad
    y = g(x^+, u, p, w, \Delta t),

with states :math:`x`, inputs :math:`u`, parameters :math:`p` and standard normal noise
:math:`w`. Outputs are functions of the state *at the end* of the step, as in FMI; at the start
they are :math:`g(x_0, u, p, w, 0)`. Continuous models give :math:`\dot x` instead of :math:`x^+`
and are integrated over the step by the classical Runge-Kutta method of order four, unless they
bring an integrator of their own (`flow`); others who integrate them go by :math:`\dot x`. The
symbol of time is the time *at the end* of the step in outputs, next states and flow, and the
running time in derivatives; inputs, parameters and noise are held.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.division import sharing_reciprocals

Symbols = Mapping[str, Any]
"""Names to CasADi SX symbols or expressions (CasADi carries no type information)."""


def rk4(derivative: Callable[[Any, Any], Any], x: Any, dt: Any) -> Any:
    r"""One step of the classical fourth-order Runge-Kutta method.

    Parameters
    ----------
    derivative : callable
        Maps the time since the start of the step [s] and a state to :math:`\dot x`, same shape.
    x : SX or ndarray, shape (n,)
        State at the start of the step.
    dt : SX or float
        Length of the step [s].
    """
    k1 = derivative(0.0, x)
    k2 = derivative(dt / 2, x + dt / 2 * k1)
    k3 = derivative(dt / 2, x + dt / 2 * k2)
    k4 = derivative(dt, x + dt * k3)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _row_major(expression: Any) -> Any:
    """Flatten to a column in C order, the order in which NumPy keeps a member's row."""
    return ca.vec(expression.T)


def _from_row_major(flat: Any, shape: tuple[int, int]) -> Any:
    return ca.reshape(flat, shape[1], shape[0]).T


@dataclass(frozen=True)
class Model:
    """Named symbolic inputs, outputs, states, parameters and noise of one step.

    Names may carry a dot (``"fix.y"``): the component binds them to the fields of a message.

    Parameters
    ----------
    name : str
        An identifier; names the generated functions.
    inputs, states, parameters, noise : mapping of str to SX symbol
        ``(n,)`` columns or ``(n, m)`` matrices. Noise is standard normal, a new draw each step.
    outputs : mapping of str to SX expression
        Functions of the states (their values at the end of the step) and everything else.
    next : mapping of str to SX expression
        The states at the end of the step, as functions of those at its start. A state absent
        from both `next` and `derivatives` is constant.
    derivatives : mapping of str to SX expression
        Time derivatives of continuous states, integrated by `rk4` over the step.
    flow : mapping of str to SX expression
        An integrator of their own in place of `rk4`: the same states at the end of the step, as
        functions of all states at its start. All of them, or none.
    initial : mapping of str to SX expression
        The states at the start, functions of inputs, parameters and noise; zero where absent.
    step : SX symbol, optional
        Length of the step [s].
    time : SX symbol, optional
        Time at the end of the step; in `derivatives`, the time they are taken at [s].
    jacobians : sequence of (str, str)
        Pairs (output, input, state or parameter) to be offered by `jacobian`.

    Raises
    ------
    ValueError
        If an expression depends on a symbol that was not declared, or shapes disagree.
    """

    name: str
    inputs: Symbols = field(default_factory=dict)
    outputs: Symbols = field(default_factory=dict)
    states: Symbols = field(default_factory=dict)
    parameters: Symbols = field(default_factory=dict)
    noise: Symbols = field(default_factory=dict)
    next: Symbols = field(default_factory=dict)
    derivatives: Symbols = field(default_factory=dict)
    flow: Symbols = field(default_factory=dict)
    initial: Symbols = field(default_factory=dict)
    step: Any = None
    time: Any = None
    jacobians: Sequence[tuple[str, str]] = ()

    def __post_init__(self) -> None:
        for kind in ("next", "derivatives", "flow", "initial"):
            for key, expression in getattr(self, kind).items():
                if key not in self.states:
                    raise ValueError(
                        f"model '{self.name}': {kind} names '{key}', which is no state; "
                        f"the states are {sorted(self.states)}"
                    )
                if ca.SX(expression).shape != self.states[key].shape:
                    raise ValueError(
                        f"model '{self.name}': {kind}['{key}'] has shape "
                        f"{ca.SX(expression).shape}, the state has {self.states[key].shape}"
                    )
        both = set(self.next) & set(self.derivatives)
        if both:
            raise ValueError(
                f"model '{self.name}': {sorted(both)} are given both as next values and as "
                "derivatives; a state is either discrete or continuous"
            )
        if self.flow and set(self.flow) != set(self.derivatives):
            raise ValueError(
                f"model '{self.name}': flow integrates {sorted(self.flow)}, and derivatives are "
                f"those of {sorted(self.derivatives)}; an integrator of its own takes all of them"
            )
        known = {
            element.element_hash()
            for group in self._symbol_groups()
            for symbol in group.values()
            for element in ca.symvar(symbol)
        }
        for kind in ("outputs", "next", "derivatives", "flow", "initial"):
            for key, expression in getattr(self, kind).items():
                for element in ca.symvar(ca.SX(expression)):
                    if element.element_hash() not in known:
                        raise ValueError(
                            f"model '{self.name}': {kind}['{key}'] depends on '{element}', which "
                            "is not declared as an input, state, parameter, noise, step or time"
                        )

    def without_noise_of(self, zero: Collection[str]) -> Model:
        """Make the same model without the noise that parameters of value zero cancel.

        The parameters in `zero` are zero in its expressions, though still declared.
        """
        gone = [self.parameters[k] for k in zero]
        kinds: dict[str, Any] = {}
        for kind in ("outputs", "next", "derivatives", "flow", "initial"):
            expressions = [ca.SX(e) for e in getattr(self, kind).values()]
            if expressions:
                expressions = ca.substitute(
                    expressions, gone, [ca.SX.zeros(*p.shape) for p in gone]
                )
            kinds[kind] = dict(zip(getattr(self, kind), expressions, strict=True))
        left = ca.veccat(*(e for group in kinds.values() for e in group.values()))
        noise = {k: s for k, s in self.noise.items() if ca.depends_on(left, s)}
        return replace(self, noise=noise, **kinds)

    def _symbol_groups(self) -> list[dict[str, Any]]:
        clock = {k: s for k, s in (("step", self.step), ("time", self.time)) if s is not None}
        return [
            dict(self.inputs),
            dict(self.states),
            dict(self.parameters),
            dict(self.noise),
            clock,
        ]

    def uses(self, parameter: str) -> bool:
        """Whether any expression depends on a parameter; false if the model has none of that name.

        A choice (two-body gravity, say) may leave a parameter (J2) without any effect.
        """
        if parameter not in self.parameters:
            return False
        symbol = ca.vec(self.parameters[parameter])
        expressions = [
            ca.vec(ca.densify(ca.SX(e)))
            for kind in (self.outputs, self.next, self.derivatives, self.flow, self.initial)
            for e in kind.values()
        ]
        return bool(expressions) and bool(ca.depends_on(ca.vertcat(*expressions), symbol))

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of a named quantity as NumPy sees it: ``(n,)`` for a column, else ``(n, m)``."""
        for group in (*self._symbol_groups(), dict(self.outputs)):
            if name in group:
                rows, columns = ca.SX(group[name]).shape
                return (rows,) if columns == 1 else (rows, columns)
        raise KeyError(name)

    @cached_property
    def _advanced(self) -> dict[str, Any]:
        """States at the end of the step, as expressions of those at its start."""
        advanced = {
            key: ca.densify(ca.SX(self.flow.get(key, self.next.get(key, symbol))))
            for key, symbol in self.states.items()
        }
        if self.derivatives and not self.flow:
            if self.step is None:
                raise ValueError(f"model '{self.name}' has derivatives but declares no step")
            keys = list(self.derivatives)
            x = ca.vertcat(*(ca.vec(self.states[k]) for k in keys))
            xdot = ca.vertcat(*(ca.vec(ca.SX(self.derivatives[k])) for k in keys))
            offsets = np.cumsum([0] + [self.states[k].numel() for k in keys])
            end = rk4(lambda since, value: self._rate(xdot, x, since, value), x, self.step)
            for i, k in enumerate(keys):
                advanced[k] = ca.reshape(end[offsets[i] : offsets[i + 1]], *self.states[k].shape)
        return advanced

    def _rate(self, xdot: Any, x: Any, since: Any, value: Any) -> Any:
        """Put a state and the time since the start of the step into the derivatives."""
        if self.time is None:
            return ca.substitute(xdot, x, value)
        now = self.time - self.step + since  # `time` is that of the end of the step
        return ca.substitute(xdot, ca.vertcat(x, self.time), ca.vertcat(value, now))

    def _function(self, name: str, outputs: Symbols, *, drop_states: bool = False) -> Any:
        """Build a function of flat row-major inputs, states, parameters, noise and clock."""
        groups = self._symbol_groups()
        if drop_states:
            groups[1] = {}
        names = [key for group in groups for key in group]
        symbols = [s for group in groups for s in group.values()]
        flat = [
            ca.SX.sym(key.replace(".", "_"), s.numel())
            for key, s in zip(names, symbols, strict=True)
        ]
        shaped = [_from_row_major(f, s.shape) for f, s in zip(flat, symbols, strict=True)]
        expressions = [ca.SX(e) for e in outputs.values()]
        if expressions and symbols:
            expressions = ca.substitute(expressions, list(symbols), shaped)
        results = [_row_major(ca.densify(e)) for e in expressions]
        return ca.Function(
            name,
            flat,
            results,
            [key.replace(".", "_") for key in names],
            [key.replace(".", "_") + "_" for key in outputs],
            {"cse": True},
        )

    @cached_property
    def step_outputs(self) -> dict[str, Any]:
        """Expressions of one step: every output, then every state at the end of the step."""
        keys = list(self.states)
        before = [self.states[k] for k in keys]
        after = [self._advanced[k] for k in keys]
        outputs = {k: ca.SX(e) for k, e in self.outputs.items()}
        if keys and outputs:
            replaced = ca.substitute(list(outputs.values()), before, after)
            outputs = dict(zip(outputs, replaced, strict=True))
        return outputs | {f"next:{k}": e for k, e in zip(keys, after, strict=True)}

    def step_function(self, name: str | None = None) -> Any:
        """Build the step as a function of flat row-major arguments, called `name` in C.

        Inputs, states, parameters, noise, step and time, in this order, to outputs and states.
        """
        return self._step if name is None else self._step_called(name)

    @cached_property
    def _step(self) -> Any:
        return self._step_called(f"{self.name}_step")

    def _step_called(self, name: str) -> Any:
        outputs = {k.replace("next:", "next_"): e for k, e in self.step_outputs.items()}
        return sharing_reciprocals(self._function(name, outputs))

    def rate_function(self, name: str | None = None) -> Any:
        """Build outputs and derivatives of continuous states as a function.

        Of the arguments of `step_function`, with the states as they are, not a step earlier.
        """
        outputs = {k: ca.SX(e) for k, e in self.outputs.items()}
        rates = {f"der_{k}": ca.SX(e) for k, e in self.derivatives.items()}
        return self._function(name or f"{self.name}_rate", outputs | rates)

    def initial_function(self, name: str | None = None) -> Any:
        """Build the start: as `step_function` without states among its arguments; the step is 0."""
        start = {
            k: ca.densify(ca.SX(self.initial.get(k, ca.SX.zeros(*s.shape))))
            for k, s in self.states.items()
        }
        outputs = {k: ca.SX(e) for k, e in self.outputs.items()}
        if start and outputs:
            replaced = ca.substitute(
                list(outputs.values()), list(self.states.values()), list(start.values())
            )
            outputs = dict(zip(outputs, replaced, strict=True))
        return self._function(
            name or f"{self.name}_initial",
            outputs | {f"next_{k}": e for k, e in start.items()},
            drop_states=True,
        )

    @cached_property
    def _output_function(self) -> Any:
        return self._function(self.name, self.outputs)

    def __call__(self, **values: ArrayLike) -> dict[str, FloatArray]:
        """Evaluate the outputs at given states and everything else (absent quantities are 0).

        Names with a dot are written with an underscore. Returns arrays of each output's shape.
        """
        result = self._call(self._output_function, values)
        return {
            k: np.asarray(r, dtype=np.float64).reshape(self.shape(k))
            for k, r in zip(self.outputs, result, strict=True)
        }

    def advance(self, **values: ArrayLike) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
        """Evaluate one step: (outputs, states at its end), for tests and single evaluations."""
        result = self._call(self._step_function, values)
        shaped = [np.asarray(r, dtype=np.float64) for r in result]
        n = len(self.outputs)
        outputs = {
            k: r.reshape(self.shape(k)) for k, r in zip(self.outputs, shaped[:n], strict=True)
        }
        states = {k: r.reshape(self.shape(k)) for k, r in zip(self.states, shaped[n:], strict=True)}
        return outputs, states

    @cached_property
    def _step_function(self) -> Any:
        return self.step_function()

    def _call(self, function: Any, values: Mapping[str, ArrayLike]) -> list[Any]:
        names = function.name_in()
        unknown = sorted(set(values) - set(names))
        if unknown:
            raise ValueError(f"model '{self.name}' has no {unknown}; it takes {names}")
        arguments = []
        for i, name in enumerate(names):
            value = np.asarray(values.get(name, 0.0), dtype=np.float64)
            size = function.numel_in(i)
            arguments.append(np.full(size, value) if value.ndim == 0 else value.reshape(size))
        return list(function.call(arguments))  # a list, also where there are no arguments

    def jacobian_expression(self, output: str, wrt: str) -> Any:
        """Symbolic derivative of an output by a declared quantity, both in row-major order."""
        for group in self._symbol_groups():
            if wrt in group:
                symbol = group[wrt]
                break
        else:
            raise KeyError(f"model '{self.name}' has no '{wrt}'")
        jacobian = ca.jacobian(_row_major(ca.SX(self.outputs[output])), ca.vec(symbol))
        if symbol.shape[1] > 1:  # CasADi derives by the column-major symbol
            order = np.arange(symbol.numel()).reshape(symbol.shape, order="F").ravel()
            jacobian = jacobian[:, order.tolist()]
        return jacobian

    def jacobian(self, output: str, wrt: str, **values: ArrayLike) -> FloatArray:
        """Evaluate d(output)/d(wrt), shape (output size, wrt size), at given values."""
        key = (output, wrt)
        if key not in self._jacobians:
            self._jacobians[key] = self._function(
                f"{self.name}_jacobian", {"jacobian": self.jacobian_expression(output, wrt)}
            )
        function = self._jacobians[key]
        flat = self._call(function, values)[0]
        rows = ca.SX(self.outputs[output]).numel()
        return np.asarray(flat, dtype=np.float64).reshape(rows, -1)

    @cached_property
    def _jacobians(self) -> dict[tuple[str, str], Any]:
        return {}
