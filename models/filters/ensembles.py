r"""Observations that are functions of whole ensembles: of a map, an image, hundreds of vertices.

What is symbolic for one member is unrolled into instructions, and that ends at some thousands. An
`EnsembleObservation` predicts for all members at once instead, in NumPy or by a CasADi ``map``, and
brings its derivative. The rules of `terrafix.models.filters.updates` do not know the difference:
they are followed once with symbols in the place of predictions, which tells at which errors they
ask for what, and which of these points depend on answers before them. A correction is then made in
as many stages as there are rounds of questions, one for an extended or an unscented update, six for
an iterated one, and a last one that is the model with the answers among its inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.batch import over_members
from terrafix.models.core.model import Model
from terrafix.models.filters.error_state import ErrorState, Values
from terrafix.models.filters.measurement import TIME, Observation
from terrafix.models.filters.models import correct_model
from terrafix.models.filters.updates import Measurement

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class EnsembleObservation(Observation):
    """What a sensor would measure, as a function of arrays of blocks.

    Parameters
    ----------
    predict : callable
        Of the values of the blocks (k, size), and of inputs, parameters, the message's fields and
        its time ``t`` (k, ...) and shared arrays by name: what is measured, (k, m).
    derivative : callable
        Likewise the derivative by the error of all blocks, (k, m, n).
    shared : sequence of str
        Arrays that are one for all members (a map, a contour): shared inputs of the component.

    The other parameters are those of `Observation`; the noise is the one that is reported.

    Raises
    ------
    ValueError
        If there is no derivative, or an error of a field is to be mapped.
    """

    derivative: Callable[[Arrays, Arrays], NDArray[Any]] | None = None
    shared: Sequence[str] = ()
    of_ensembles: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.derivative is None:
            raise ValueError(
                "an observation of ensembles brings its derivative by the error: a function of the "
                "same arguments as `predict`, or both from `ensemble_observation`"
            )
        if self.mapped:
            raise ValueError(
                f"an observation of ensembles cannot map the error of {', '.join(self.mapped)}: "
                "let the sensor report it in R"
            )


def ensemble_observation(
    state: ErrorState,
    predict: Callable[[Values, Values], Any],
    elements: Mapping[str, str],
    *,
    shared: Mapping[str, tuple[int, ...]] | None = None,
    **kinds: Any,
) -> EnsembleObservation:
    """An observation of ensembles from an expression, and its derivative with it.

    Parameters
    ----------
    state : ErrorState
    predict : callable
        Of MX symbols, as `Observation.predict` is of SX: here a ``map`` over vertices stays a loop.
    elements : mapping of str to str
        As of `Observation`.
    shared : mapping of str to tuple of int
        Shapes of arrays that are one for all members.
    **kinds
        `fields`, `angles`, `inputs`, `parameters`, `instant` of `Observation`.
    """
    shapes = dict(shared or {})
    sizes = {b.name: b.size for b in kinds.get("fields", ())}
    sizes |= {**kinds.get("inputs", {}), **kinds.get("parameters", {})}
    values = {b.name: ca.MX.sym(b.name, b.value_size) for b in state}
    given = {name: ca.MX.sym(name, size) for name, size in {**sizes, TIME: 1}.items()}
    common = {name: ca.MX.sym(name, *shape) for name, shape in shapes.items()}
    error = ca.MX.sym("error", state.size)
    y = predict(state.retract(values, error), {**given, **common})
    if y.shape != (len(elements), 1):
        raise ValueError(
            f"an observation predicts an array of shape {y.shape}; it measures {len(elements)} "
            "elements"
        )
    symbols = [error, *values.values(), *given.values(), *common.values()]
    functions = [
        _scalar(ca.Function(name, symbols, [ca.densify(expression)]))
        for name, expression in (("predict", y), ("derivative", ca.jacobian(y, error)))
    ]

    def evaluator(function: Any) -> Callable[[Arrays, Arrays], NDArray[Any]]:
        def evaluate(estimate: Arrays, told: Arrays) -> NDArray[Any]:
            k = len(next(iter(estimate.values())))
            columns = [np.zeros((state.size, 1))]
            columns += [np.reshape(estimate[name], (k, -1)).T for name in values]
            timed = {TIME: np.zeros(k), **told}
            columns += [np.reshape(timed[name], (k, -1)).T for name in given]
            # one for all: as it is, and CasADi maps over the columns of the others
            found = function.call([ca.DM(c) for c in (*columns, *(told[n] for n in common))])[0]
            rows, size = function.size_out(0)
            # column after column of k matrices side by side
            array = found.full().reshape(rows, k, size).transpose(1, 0, 2)
            return np.ascontiguousarray(array[:, :, 0] if function is functions[0] else array)

        return evaluate

    return EnsembleObservation(
        evaluator(functions[0]),
        elements,
        derivative=evaluator(functions[1]),
        shared=tuple(shapes),
        **kinds,
    )


def _scalar(function: Any) -> Any:
    """The same function in scalar instructions, 13 times as fast for a contour of 240 corners.

    As it is, where a part has none: an interpolant, a callback, an external function.
    """
    try:
        return function.expand()
    except RuntimeError:
        return function


@dataclass(frozen=True, eq=False)
class _Question:
    """An error at which a rule asks for a prediction, the symbol of the answer, and of H's."""

    error: Any
    y: Any
    H: Any

    @property
    def symbols(self) -> Any:
        """All that it is answered with."""
        return ca.veccat(self.y, self.H)


@dataclass(frozen=True, eq=False)
class _Held:
    """An error that a rule went on with: its symbol, and how it was found."""

    symbol: Any
    error: Any

    @property
    def symbols(self) -> Any:
        """All that stands for it."""
        return self.symbol


@dataclass(frozen=True)
class _Traced(Observation):
    """An observation that answers with symbols, and keeps what it was asked."""

    asked: list[_Question] = field(default_factory=list)
    held: list[_Held] = field(default_factory=list)
    trace: list[_Question | _Held] = field(default_factory=list)  # both, in their order
    wanted: set[int] = field(default_factory=set)  # those whose derivative is asked for
    prior: dict[str, Any] = field(default_factory=dict)

    def about(
        self, state: ErrorState, prior: Values, message: Values, given: Values
    ) -> Measurement:
        """A measurement whose predictions are symbols."""
        self.check_instant(state)
        self.prior.update(prior)

        def place(error: Any) -> int:
            error = ca.SX(error)
            for k, question in enumerate(self.asked):
                if ca.is_equal(question.error, error, 1):
                    return k
            k = len(self.asked)
            y, H = ca.SX.sym(f"y{k}", self.size), ca.SX.sym(f"H{k}", self.size, state.size)
            self.asked.append(_Question(error, y, H))
            self.trace.append(self.asked[-1])
            return k

        def hold(error: Any) -> Any:
            symbol = ca.SX.sym(f"e{len(self.held)}", state.size)
            self.held.append(_Held(symbol, ca.densify(ca.SX(error))))
            self.trace.append(self.held[-1])
            return symbol

        def derivative(error: Any) -> Any:
            k = place(error)
            self.wanted.add(k)
            H = self.asked[k].H  # by the error about the point itself
            return ca.mtimes(H, state.recentering(error, prior)) if state.is_curved else H

        return Measurement(
            message["y"],
            lambda error: self.asked[place(error)].y,
            derivative,
            lambda _: message["R"],
            message["present"],
            self.angular,
            hold,
        )

    def answers(self) -> dict[str, Any]:
        """Symbols of the answers by name."""
        found = {f"{ANSWER}.y{k}": q.y for k, q in enumerate(self.asked)}
        found |= {f"{ANSWER}.H{k}": self.asked[k].H for k in sorted(self.wanted)}
        return found | {f"{ANSWER}.e{k}": h.symbol for k, h in enumerate(self.held)}

    def rounds(self) -> list[list[_Question | _Held]]:
        """What can be found one round after the other: errors, and what is asked at them."""
        level: list[int] = []
        for thing in self.trace:
            own = 0
            for other, at in zip(self.trace, level, strict=False):
                if ca.depends_on(thing.error, other.symbols):
                    # an answer is there a round later
                    own = max(own, at + isinstance(other, _Question))
            level.append(own)
        return [
            [thing for thing, at in zip(self.trace, level, strict=True) if at == depth]
            for depth in range(1 + max(level))
        ]


ANSWER = "answer"
"""Head of the names of a model's inputs that are answers: ``answer.y0``, ``answer.H0``; and errors
that were found from them, ``answer.e0``."""


@dataclass(frozen=True)
class Stage:
    """A round of questions.

    Attributes
    ----------
    points : callable
        Values of every block at the points, (..., p, size) each, and errors (..., n) that are held,
        from arrays of the arguments.
    arguments : dict of str to tuple of int
        Shapes of what it takes of the model, by name: inputs, parameters, ``state:NAME``.
    numbers : tuple of int
        Of the questions: the answers go to ``answer.yK`` and ``answer.HK``.
    held : tuple of int
        Of the errors, which go to ``answer.eK``.
    derived : bool
        Whether any of the questions asks for a derivative.
    """

    points: Callable[..., Any]
    arguments: dict[str, tuple[int, ...]]
    numbers: tuple[int, ...]
    held: tuple[int, ...]
    derived: bool


def staged_model(
    name: str, state: ErrorState, observation: EnsembleObservation, update: str, **options: Any
) -> tuple[Model, list[Stage]]:
    """A correction whose predictions are inputs, and the stages that find out which.

    Parameters are those of `terrafix.models.filters.models.correct_model`.
    """
    traced = _Traced(
        observation.predict,
        observation.elements,
        fields=observation.fields,
        angles=observation.angles,
        instant=observation.instant,
        valid_at=observation.valid_at,
    )
    model = correct_model(name, state, traced, update, **options)
    return model, [_stage(state, traced, model, found) for found in traced.rounds()]


def _stage(
    state: ErrorState, traced: _Traced, model: Model, found: list[_Question | _Held]
) -> Stage:
    numbers = tuple(k for k, question in enumerate(traced.asked) if question in found)
    held = tuple(k for k, error in enumerate(traced.held) if error in found)
    at = [state.retract(traced.prior, traced.asked[k].error) for k in numbers]
    values = [ca.horzcat(*(ca.SX(point[b.name]) for point in at)).T for b in state]
    for k in reversed(held):  # what is found now is asked at in the same round
        values = ca.substitute(values, [traced.held[k].symbol], [traced.held[k].error])
    values += [traced.held[k].error for k in held]
    if model.states:  # what a model puts out is of its states at the end of the step
        ends = [ca.SX(model.next.get(key, symbol)) for key, symbol in model.states.items()]
        values = ca.substitute(values, list(model.states.values()), ends)
    known = (
        dict(model.inputs)
        | {f"state:{n}": s for n, s in model.states.items()}
        | dict(model.parameters)
    )
    everything = ca.veccat(*values)
    used = {n: s for n, s in known.items() if ca.depends_on(everything, ca.vec(s))}

    def expressions(*given: Any) -> Any:
        return tuple(ca.substitute(values, list(used.values()), list(given)))

    shapes = {n: (s.shape[:1] if s.shape[1] == 1 else s.shape) for n, s in used.items()}
    points = over_members(expressions, *shapes.values())
    return Stage(points, shapes, numbers, held, bool(traced.wanted & set(numbers)))
