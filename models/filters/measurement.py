r"""A measurement of an estimate, and its correction by it: update, underweighting, gate, reasons.

An observation says what would be measured at values of the blocks, :math:`h(x, u)`; its derivative
by the error follows. Its noise is the one it reports, :math:`R`, and that of what else the message
holds: a field :math:`p` with a covariance :math:`D` of its own (the position of a pixel, say) is
mapped by the derivative,

.. math::
    R' = R + H_p D H_p^T, \qquad H_p = \frac{\partial h}{\partial p}.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca

from terrafix.models.core.symmetric import mirrored
from terrafix.models.filters.error_state import AGE, Block, ErrorState, Values
from terrafix.models.filters.updates import Measurement, Update, nth

REASONS = (
    "accepted",
    "gate",
    "innovation covariance not positive definite",
    "nothing measured",
    "not of this instant",
)
"""What became of a fix, indexed by ``innovation.reason``."""

TIME = "t"
"""Name by which an observation finds the time that its fix is of [s]."""

SAME_INSTANT = 1e-6
"""Largest difference of time between a fix and the prior that it corrects [s]."""


@dataclass(frozen=True)
class Observation:
    """What a sensor would measure, as a function of the blocks.

    Parameters
    ----------
    predict : callable
        Of the values of the blocks, and of inputs, parameters and the message's fields, by name,
        with ``t``, the time that the fix is of [s]: what is measured, (m, 1).
    elements : mapping of str to str
        The unit of each of the m elements, by its label.
    fields : sequence of Block
        Vectors that the message holds besides, of which `predict` may make use.
    mapped : mapping of str to str
        Further fields that are not exactly known: the field that holds the covariance of each.
    angles : sequence of str
        Labels of elements that are angles, in radians: their differences are within half a turn.
    inputs, parameters : mapping of str to int
        Sizes of what else it reads.
    instant : str
        Of the clones that it is a measurement of; empty: of now.
    valid_at : str
        Field of the message that holds the time that the fix is of, for sensors that say it there;
        empty: the message's own time.

    Raises
    ------
    ValueError
        If a mapped field or the one of the time is none of the message's, an angle no element in
        radians, or something is called ``t``.
    """

    predict: Callable[[Values, Values], Any]
    elements: Mapping[str, str]
    fields: Sequence[Block] = ()
    mapped: Mapping[str, str] = field(default_factory=dict)
    angles: Sequence[str] = ()
    inputs: Mapping[str, int] = field(default_factory=dict)
    parameters: Mapping[str, int] = field(default_factory=dict)
    instant: str = ""
    valid_at: str = ""
    of_ensembles: ClassVar[bool] = False

    def __post_init__(self) -> None:
        names = [block.name for block in self.fields]
        if self.valid_at and self.valid_at not in names:
            raise ValueError(
                f"an observation is valid at '{self.valid_at}', which is no field of its message; "
                f"the fields are {', '.join(names) or 'none'}"
            )
        if TIME in (*names, *self.inputs, *self.parameters):
            raise ValueError(
                f"an observation reads '{TIME}', which is the time that a fix is of: choose "
                "another name"
            )
        for name in self.mapped:
            if name not in names:
                raise ValueError(
                    f"an observation maps the error of '{name}', which is no field of its message;"
                    f" the fields are {', '.join(names) or 'none'}"
                )
        for label in self.angles:
            if self.elements.get(label) != "rad":
                listed = ", ".join(f"{k} [{unit}]" for k, unit in self.elements.items())
                raise ValueError(
                    f"'{label}' is said to be an angle, and is no element in radians; the "
                    f"elements are {listed}"
                )

    @property
    def size(self) -> int:
        """M."""
        return len(self.elements)

    def shapes(self) -> dict[str, tuple[int, int]]:
        """Shapes of the message's fields."""
        m = self.size
        sizes = {block.name: block.size for block in self.fields}
        found = {"y": (m, 1)} | {name: (size, 1) for name, size in sizes.items()}
        found["R"] = (m, m)
        for name, covariance in self.mapped.items():
            found[covariance] = (sizes[name], sizes[name])
        return found | {"present": (m, 1)}

    def symbols(self, name: str) -> dict[str, Any]:
        """Symbols of the message by field, named for `name`."""
        return {k: ca.SX.sym(f"{name}_{k}", *shape) for k, shape in self.shapes().items()}

    def about(
        self, state: ErrorState, prior: Values, message: Values, given: Values
    ) -> Measurement:
        """The measurement as a function of the error of the prior.

        Parameters
        ----------
        state : ErrorState
        prior : mapping of str to SX
            Values by block.
        message : mapping of str to SX
            By field, absent elements marked.
        given : mapping of str to SX
            Inputs and parameters.

        Raises
        ------
        ValueError
            If what is predicted has another size, or is of an instant without a clone.
        """
        self.check_instant(state)
        error = ca.SX.sym("error", state.size)
        told = {block.name: message[block.name] for block in self.fields}
        uncertain = {name: ca.SX.sym(name, *told[name].shape) for name in self.mapped}
        told |= uncertain
        y = ca.SX(self.predict(state.retract(prior, error), {**given, **told}))
        if y.shape != (self.size, 1):
            raise ValueError(
                f"an observation predicts an array of shape {y.shape}; it measures {self.size} "
                "elements"
            )
        symbols = ca.vertcat(error, *uncertain.values())
        reported = [message[name] for name in uncertain]

        def at(expression: Any) -> Callable[[Any], Any]:
            return lambda e: ca.substitute(expression, symbols, ca.vertcat(e, *reported))

        by_field = [at(ca.jacobian(y, symbol)) for symbol in uncertain.values()]

        def noise(e: Any) -> Any:
            total = message["R"]
            for derivative, covariance in zip(by_field, self.mapped.values(), strict=True):
                H = derivative(e)
                total = total + ca.mtimes(H, ca.mtimes(message[covariance], H.T))
            return total

        return Measurement(
            message["y"],
            at(y),
            at(ca.jacobian(y, error)),
            noise,
            message["present"],
            self.angular,
        )

    @property
    def angular(self) -> tuple[int, ...]:
        """Which elements are angles."""
        return tuple(k for k, label in enumerate(self.elements) if label in self.angles)

    def check_instant(self, state: ErrorState) -> None:
        """Raise ValueError if it is of an instant without a clone."""
        if self.instant and self.instant not in state.instants:
            raise ValueError(
                f"an observation is of the instant '{self.instant}', of which there is no clone; "
                f"the instants are {', '.join(state.instants) or 'none'}"
            )

    def answers(self) -> dict[str, Any]:
        """Symbols of predictions that are made elsewhere; none, if it is an expression itself."""
        return {}


@dataclass(frozen=True)
class Correction:
    """What a fix did to an estimate, as expressions.

    Attributes
    ----------
    values : dict of str to SX
        The posterior where it was accepted, else the prior; with ``P``.
    accepted, reason : SX
        1 or 0; index into `REASONS`.
    dof : SX
        Number of elements measured.
    update : Update
    """

    values: dict[str, Any]
    accepted: Any
    reason: Any
    dof: Any
    update: Update


def corrected(
    state: ErrorState,
    prior: Values,
    measurement: Measurement,
    rule: Callable[..., Update],
    *,
    gate: Any,
    beta: Any = 0.0,
    lateness: Any = 0.0,
    recentered: bool = True,
) -> Correction:
    """Correct a prior by a measurement, where it passes the gate.

    Parameters
    ----------
    state : ErrorState
    prior : mapping of str to SX
        Values by block, and ``P``.
    measurement : Measurement
        About the prior; no element present where there is no fix.
    rule : callable
        One of `terrafix.models.filters.updates`.
    gate : SX, shape (m, 1)
        Largest NIS accepted with 1 to m elements.
    beta : SX
        Factor of underweighting.
    lateness : SX
        Time of the fix minus that of the prior [s].
    recentered : bool
        Express the covariance about the posterior; else it stays about the prior, an error of
        second order in the correction of rotations.

    Raises
    ------
    ValueError
        If the gate is for another number of elements.
    """
    m = measurement.y.shape[0]
    if ca.SX(gate).shape != (m, 1):
        raise ValueError(
            f"a gate for {ca.SX(gate).numel()} elements, of a measurement that has {m}: give the "
            "largest NIS accepted with 1, 2, ... of them"
        )
    outcome = rule(mirrored(prior["P"]), measurement, beta, state.kept)
    dof = ca.sum1(measurement.present > 0.5)
    threshold = nth(gate, dof)
    reason = ca.if_else(
        dof < 0.5,
        REASONS.index("nothing measured"),
        ca.if_else(
            ca.logic_not(outcome.positive),
            REASONS.index("innovation covariance not positive definite"),
            ca.if_else(outcome.nis <= threshold, 0, REASONS.index("gate")),
        ),
    )
    # between what was measured and a prior of another instant lie meters per millisecond
    reason = ca.if_else(
        ca.fabs(lateness) <= SAME_INSTANT, reason, REASONS.index("not of this instant")
    )
    accepted = reason == 0
    P = state.recentered(outcome.P, outcome.correction, prior) if recentered else outcome.P
    posterior = {**state.normalized(state.retract(prior, outcome.correction)), "P": P}
    if state.carried:
        posterior[AGE] = ca.SX(0)
    values = {**prior, **{k: ca.if_else(accepted, posterior[k], prior[k]) for k in posterior}}
    return Correction(values, accepted, reason, dof, outcome)
