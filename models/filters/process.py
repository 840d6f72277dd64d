r"""How an estimate moves between measurements, and how its error does: all of it from one function.

A continuous process gives the rates :math:`\dot x = f(x, u, w, t)` of its blocks, with white noise
:math:`w` of given densities; of a rotation the rate of its rotation vector, in the axes of its
error. They are integrated by the classical Runge-Kutta method of order four in the coordinates of
the error, :math:`x(t + h) = \hat x \oplus e(h)`, where a rotation's error moves by [1]_

.. math::
    \dot\theta = \omega \pm \tfrac12 \theta \times \omega
        + \tfrac1{12} \theta \times (\theta \times \omega)

(upper sign on the left). A discrete process gives the values at the end of a step.

The error about the estimate is carried over a step by

.. math::
    \Phi = \frac{\partial}{\partial e} \bigl( F(\hat x \oplus e) \ominus F(\hat x) \bigr)_{e=0},

derived from the very step :math:`F` that the estimate makes. The noise of a continuous process adds
Van Loan's integral [2]_ as its series to a stated order,

.. math::
    Q = \int_0^h e^{A s} Q_c\, e^{A^T s} ds
      = \sum_{k=0} \frac{h^{k+1}}{(k+1)!} M_k, \qquad
    M_0 = Q_c = G S G^T, \quad M_{k+1} = A M_k + M_k A^T,

with :math:`A` and :math:`G` the derivatives of the error's rate by error and noise. Order 3 is
exact for a double integrator.

Blocks that drive themselves need no function: a constant stays, a random walk of density
:math:`q^2` spreads by :math:`q^2 h`, a Gauss-Markov process of time :math:`\tau` and sigma
:math:`\sigma` decays by :math:`\varphi = e^{-h / \tau}` and spreads by
:math:`\sigma^2 (1 - \varphi^2)`, both exactly.

References
----------
.. [1] H. Munthe-Kaas, "High order Runge-Kutta methods on manifolds", Applied Numerical
       Mathematics 29(1), 1999.
.. [2] C. F. Van Loan, "Computing integrals involving the matrix exponential", IEEE Trans.
       Automatic Control 23(3), 1978.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from terrafix.models.core.model import rk4
from terrafix.models.core.symmetric import mirrored
from terrafix.models.filters.error_state import Block, ErrorState, Values

Rates = Callable[[Values, Values, Values, Any], Mapping[str, Any]]
"""Of values, inputs and parameters, noise, time [s]: the rates of blocks by name."""
Steps = Callable[[Values, Values, Any, Any], Mapping[str, Any]]
"""Of values, inputs and parameters, step [s], time at its end [s]: values at the end of a step."""

ORDER = 3
"""Of the series of the noise, unless a process says otherwise."""


@dataclass(frozen=True)
class Process:
    """How the blocks of an error state move.

    Parameters
    ----------
    rates : callable, optional
        Continuous: rates of blocks that move. What it leaves out stays, or drives itself.
    step : callable, optional
        Discrete, in its place: values at the end of a step. Noise then comes from `spread` and
        from blocks that drive themselves.
    noise : mapping of str to (str, int)
        White noise of a continuous process: by name the parameter that holds its density (of the
        square of the unit that its rate has, per hertz), and its size.
    walks : mapping of str to str
        Blocks that are random walks: the parameter that holds the density [unit^2/s].
    decays : mapping of str to (str, str)
        Blocks that are Gauss-Markov processes: parameters of their time [s] and sigma.
    inputs : mapping of str to int
        Sizes of what it reads.
    parameters : mapping of str to int
        Sizes of its parameters, without those named above.
    order : int
        Of the series of the noise.
    transition : callable, optional
        A closed form in the place of the derived transition: of values at the start and the end,
        inputs and parameters, and the step; (n, n).
    spread : callable, optional
        A closed form in the place of the derived noise of the moving blocks, likewise.

    Raises
    ------
    ValueError
        If it is neither continuous nor discrete, or both, or noise has no rates to drive.
    """

    rates: Rates | None = None
    step: Steps | None = None
    noise: Mapping[str, tuple[str, int]] = field(default_factory=dict)
    walks: Mapping[str, str] = field(default_factory=dict)
    decays: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    inputs: Mapping[str, int] = field(default_factory=dict)
    parameters: Mapping[str, int] = field(default_factory=dict)
    order: int = ORDER
    transition: Callable[..., Any] | None = None
    spread: Callable[..., Any] | None = None

    def __post_init__(self) -> None:
        if self.rates is not None and self.step is not None:
            raise ValueError("a process is continuous (rates) or discrete (step), not both")
        if self.noise and self.rates is None:
            raise ValueError(
                f"noise {', '.join(self.noise)} has no rates to drive; a discrete process says "
                "what it adds in `spread`"
            )

    def named(self) -> dict[str, int]:
        """Sizes of all parameters by name."""
        found = dict(self.parameters)
        found |= {density: 1 for density, _ in self.noise.values()}
        found |= dict.fromkeys(self.walks.values(), 1)
        for time, sigma in self.decays.values():
            found |= {time: 1, sigma: 1}
        return found


@dataclass(frozen=True)
class Propagation:
    """One step of an estimate: what follows from a process, as expressions.

    Attributes
    ----------
    values : dict of str to SX
        At the end.
    transition : SX, shape (n, n)
    spread : SX, shape (n, n)
        Covariance that noise adds.
    """

    values: dict[str, Any]
    transition: Any
    spread: Any

    def covariance(self, P: Any) -> Any:
        """A covariance (n, n) at the end of the step."""
        P = mirrored(P)
        return mirrored(ca.mtimes(self.transition, ca.mtimes(P, self.transition.T)) + self.spread)


def propagate(
    state: ErrorState, process: Process, values: Values, given: Values, step: Any, time: Any
) -> Propagation:
    """Move an estimate over a step.

    Parameters
    ----------
    state : ErrorState
    process : Process
    values : mapping of str to SX
        At the start, by block.
    given : mapping of str to SX
        Inputs and parameters by name.
    step, time : SX
        Length of the step, and the time at its end [s].

    Raises
    ------
    ValueError
        If the process names a block that does not exist, twice, or its noise has another size.
    """
    _check(state, process)
    values = {block.name: values[block.name] for block in state}
    end = _end(state, process, values, given, step, time)
    if process.transition is not None:
        phi = process.transition(values, end, given, step)
    else:
        error = ca.SX.sym("error", state.size)
        off = _end(state, process, state.retract(values, error), given, step, time)
        phi = _at_zero(ca.jacobian(state.difference(off, end), error), error)
    spread = _driven(state, process, given, step)
    if process.spread is not None:
        spread += process.spread(values, end, given, step)
    elif process.noise:
        spread += _van_loan(state, process, values, given, step, time)
    return Propagation(end, phi, spread)


def _check(state: ErrorState, process: Process) -> None:
    names = [block.name for block in state]
    for kind, named in (("walks", process.walks), ("decays", process.decays)):
        for name in named:
            if name not in names:
                raise ValueError(
                    f"a process names '{name}' in {kind}, which is no block; "
                    f"the blocks are {', '.join(names)}"
                )
    both = set(process.walks) & set(process.decays)
    if both:
        raise ValueError(f"block '{min(both)}' is a walk and a Gauss-Markov process: choose one")


def _rates(
    state: ErrorState, process: Process, values: Values, given: Values, noise: Values, time: Any
) -> dict[str, Any]:
    """Rates of the blocks that a continuous process moves."""
    assert process.rates is not None
    found = {k: ca.SX(v) for k, v in process.rates(values, given, noise, time).items()}
    sizes = {block.name: block.size for block in state}
    for name, rate in found.items():
        if name not in sizes:
            raise ValueError(
                f"a process moves '{name}', which is no block; the blocks are {', '.join(sizes)}"
            )
        if name in process.walks or name in process.decays:
            raise ValueError(
                f"block '{name}' is moved by the process, and drives itself: choose one"
            )
        if rate.shape != (sizes[name], 1):
            raise ValueError(
                f"a process moves '{name}' by a rate of shape {rate.shape}; its error has "
                f"{sizes[name]} elements{_sizes_of(process)}"
            )
    return found


def _sizes_of(process: Process) -> str:
    """Sizes of its noise, as the end of a sentence: one may be what makes a rate too long."""
    noise = ", ".join(f"'{name}' {size}" for name, (_, size) in process.noise.items())
    return f" (its noise has: {noise})" if noise else ""


def _quiet(process: Process) -> dict[str, Any]:
    return {name: ca.SX.zeros(size) for name, (_, size) in process.noise.items()}


def _end(
    state: ErrorState, process: Process, values: Values, given: Values, step: Any, time: Any
) -> dict[str, Any]:
    """Values at the end of a step."""
    end = dict(values)
    if process.rates is not None:
        quiet = _quiet(process)

        def rate(since: Any, error: Any) -> Any:
            now = state.retract(values, error)
            moved = _rates(state, process, now, given, quiet, time - step + since)
            return ca.vertcat(
                *(
                    _of_error(block, state.part(error, block.name), moved[block.name])
                    if block.name in moved
                    else ca.SX.zeros(block.size)
                    for block in state
                )
            )

        moved = _rates(state, process, values, given, quiet, time)
        error = rk4(rate, ca.SX.zeros(state.size), step)
        turned = state.normalized(state.retract(values, error))
        end |= {name: turned[name] for name in moved}
    elif process.step is not None:
        end |= process.step(values, given, step, time)
    for name, (constant, _) in process.decays.items():
        end[name] = ca.exp(-step / given[constant]) * values[name]
    return end


def _of_error(block: Block, error: Any, rate: Any) -> Any:
    """Rate of an error (3,) from that of the rotation it leads to; a vector's is the same."""
    if not block.is_rotation:
        return rate
    turned = ca.cross(error, rate)
    sign = 1 if block.side == "left" else -1
    return rate + sign * turned / 2 + ca.cross(error, turned) / 12


def _at_zero(expression: Any, symbols: Any) -> Any:
    """An expression where symbols are zero; what that cancels is gone."""
    return ca.SX(ca.substitute(expression, symbols, ca.SX.zeros(*symbols.shape)))


def _driven(state: ErrorState, process: Process, given: Values, step: Any) -> Any:
    """What walks and Gauss-Markov processes add, (n, n)."""
    parts = []
    for block in state:
        variance = ca.SX(0)
        if block.name in process.walks:
            variance = given[process.walks[block.name]] * step
        elif block.name in process.decays:
            constant, sigma = (given[name] for name in process.decays[block.name])
            variance = sigma**2 * (1 - ca.exp(-2 * step / constant))
        parts.append(variance * ca.SX.eye(block.size))
    return ca.diagcat(*parts)


def _van_loan(
    state: ErrorState, process: Process, values: Values, given: Values, step: Any, time: Any
) -> Any:
    """What the noise of a continuous process adds over a step, (n, n), about its start."""
    error, since = ca.SX.sym("error", state.size), ca.SX.sym("since")
    noise = {name: ca.SX.sym(name, size) for name, (_, size) in process.noise.items()}

    def moved(start: Values, w: Values) -> dict[str, Any]:
        """A moment later: enough for a derivative by time."""
        rates = _rates(state, process, start, given, w, time)
        return {
            b.name: b.plus(start[b.name], since * rates[b.name])
            if b.name in rates
            else start[b.name]
            for b in state
        }

    off = state.difference(
        moved(state.retract(values, error), noise), moved(values, _quiet(process))
    )
    rate = _at_zero(ca.jacobian(off, since), since)
    w = ca.vertcat(*noise.values())
    A = _at_zero(ca.jacobian(rate, error), ca.vertcat(error, w))
    G = _at_zero(ca.jacobian(rate, w), ca.vertcat(error, w))
    S = ca.diagcat(*(given[density] * ca.SX.eye(size) for density, size in process.noise.values()))
    term = ca.mtimes(G, ca.mtimes(S, G.T))
    factor, total = step, step * term
    for k in range(1, process.order):
        half = ca.mtimes(A, term)
        term, factor = half + half.T, factor * step / (k + 1)
        total += factor * term
    return total
