"""The two components of every filter: its ports follow from what it estimates.

A filter of one's own is two classes, each of a few lines:

    class TrackerPredict(FilterPredict):
        error_state, process, told = STATE, PROCESS, ("r", "v")
        accel_psd = Parameter(unit="m^2/s^3")

    class TrackerCorrect(FilterCorrect):
        error_state, observation = STATE, RANGE

What the process and the observation read are inputs and parameters of the class, declared as those
of any component; the check before a run compares their shapes. `predict` reads the posterior at
the start of its step; `correct` reads the prior at the end.

Several corrections in a tick are a chain, in the order that the wiring shows: each reads the
``estimate`` of the one before it as its prior, and the ``posterior`` of that one as ``earlier``;
the last one's posterior goes to `predict`. They step at one rate, their fixes come at any.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, ClassVar

import numpy as np

from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import (
    BundleInput,
    BundleOutput,
    MessageInput,
    MessageOutput,
    Output,
)
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.memory.fields import Field, Unit
from terrafix.models.core.model import Model
from terrafix.models.filters.consistency import gate_thresholds
from terrafix.models.filters.error_state import AGE, Block, ErrorState
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.models import correct_model, predict_model
from terrafix.models.filters.process import Process
from terrafix.models.filters.robust import HUBER, WEIGHTS
from terrafix.models.filters.updates import UPDATES

USUAL = 0.99
"""Share of good fixes that weights by their NIS take as they are, unless said otherwise."""


def value_field(block: Block) -> Field:
    """The field of a block's value."""
    unit = "1" if block.is_rotation else block.unit
    return Field(
        (block.value_size,), unit, block.frame, labels=() if block.is_rotation else _axes(block)
    )


def _axes(block: Block) -> tuple[str, ...]:
    return block.axes if block.size > 1 else ()


def estimate_fields(state: ErrorState) -> dict[str, Field]:
    """Fields of an estimate: every block, and the covariance of the error."""
    P = Field(
        (state.size, state.size), "1", doc="covariance of the error, in units of its elements"
    )
    times = {
        time: Field((1,), "s", doc="since its correction" if time == AGE else "of its clones")
        for time in state.times
    }
    return {block.name: value_field(block) for block in state} | times | {"P": P}


def start_fields(state: ErrorState, told: Collection[str]) -> dict[str, Field]:
    """Fields of a message that tells some blocks: their values, and the covariance P."""
    blocks = [block for block in state if block.name in told]
    size = sum(block.size for block in blocks)
    P = Field((size, size), "1", doc="covariance of their error")
    return {block.name: value_field(block) for block in blocks} | {"P": P}


def starting_sigmas(
    state: ErrorState, told: Collection[str], named: Mapping[str, str]
) -> dict[str, str]:
    """Parameters that hold the sigma of blocks that are not told: ``NAME_sigma0``, or as named."""
    usual = {b.name: f"{b.name}_sigma0" for b in state if b.name not in told and not b.clone_of}
    return usual | dict(named)


def fix_fields(observation: Observation) -> dict[str, Field]:
    """Fields of the message that an observation takes."""
    labels = tuple(observation.elements)
    found = {"y": Field((observation.size,), _units(observation), labels=labels, doc="measured")}
    found |= {block.name: value_field(block) for block in observation.fields}
    m, told = observation.size, {block.name: block for block in observation.fields}
    found["R"] = Field((m, m), "1", doc="covariance of the noise of y, in its units")
    for name, covariance in observation.mapped.items():
        block = told[name]
        unit = "1" if block.unit == "1" else f"{block.unit}^2"
        found[covariance] = Field(
            (block.size, block.size), unit, block.frame, doc=f"covariance of the error of {name}"
        )
    doc = "1 where an element was measured, else 0"
    return found | {"present": Field((observation.size,), "1", labels=labels, doc=doc)}


def _units(observation: Observation) -> Unit:
    units = tuple(observation.elements.values())
    return units[0] if len(set(units)) == 1 else units


def innovation_fields(observation: Observation) -> dict[str, Field]:
    """Fields of what a correction says about a fix."""
    each: dict[str, Any] = {"unit": _units(observation), "labels": tuple(observation.elements)}
    shape = (observation.size,)
    return {
        "residual": Field(shape, doc="measured minus predicted", **each),
        "sigma": Field(shape, doc="predicted, not underweighted", **each),
        "nis": Field((), "1", doc="normalized innovation squared, not underweighted"),
        "dof": Field((), "1", doc="number of elements used"),
        "accepted": Field((), "1", doc="1 if the fix corrected the estimate, else 0"),
        "reason": Field((), "1", doc="index into terrafix.models.filters.measurement.REASONS"),
    }


def declare(cls: type, **ports: Any) -> None:
    """Declare on a class what neither it nor a class mixed into it declares itself."""
    own = [c for c in cls.__mro__ if c is cls or not issubclass(c, Component)]
    for name, port in ports.items():
        if not any(name in vars(c) for c in own):
            setattr(cls, name, port)
            port.__set_name__(cls, name)


def says(cls: type, *names: str) -> bool:
    """Whether a class says all of `names`, and at least one of them otherwise than its bases.

    Its ports follow from them; what a base of the family said has been followed there.
    """
    if not all(hasattr(cls, name) for name in names):
        return False
    said = tuple(getattr(cls, name) for name in names)
    before = getattr(cls, "_said", None)
    cls._said = said  # type: ignore[attr-defined]
    return before is None or any(a is not b for a, b in zip(said, before, strict=True))


def _correct_ports(state: ErrorState, observation: Observation) -> dict[str, Any]:
    """Ports and gate of a correction."""
    fields, m = estimate_fields(state), observation.size
    return {
        "gate": Parameter(
            np.inf,
            shape=(m,),
            infinite=True,
            positive=True,
            doc=f"largest NIS accepted with 1 to {m} elements; infinity accepts all",
        ),
        "nis_threshold": Parameter(
            gate_thresholds(USUAL, m),
            shape=(m,),
            infinite=True,
            positive=True,
            doc=f"largest NIS with 1 to {m} elements that is taken as it is",
        ),
        "prior": BundleInput(fields, doc="estimate before the fix"),
        "earlier": MessageInput(
            fields=fields, optional=True, doc="posterior of the correction before this one"
        ),
        "fix": MessageInput(fields=fix_fields(observation), doc="the fix"),
        "estimate": BundleOutput(fields, doc="the posterior where there is one, or the prior"),
        "posterior": MessageOutput(fields=fields, doc="the estimate, where it was corrected"),
        "innovation": MessageOutput(
            fields=innovation_fields(observation), doc="what became of the fix"
        ),
    }


def transition_ports(state: ErrorState) -> tuple[Output, Output]:
    """Ports of what a smoother needs besides the estimates: the transition, and since when.

    Raises
    ------
    ValueError
        If a block is considered, or errors are carried, which cannot be smoothed.
    """
    if state.carried:
        raise ValueError(
            f"errors of {', '.join(state.carried.blocks)} are carried along from correction to "
            "correction, and a smoother's are not\n  leave `smoothed` out, or `carried`"
        )
    kept = [block.name for block in state if block.considered]
    if kept:
        raise ValueError(
            f"{', '.join(kept)} is considered, not corrected: such a filter's estimate is no "
            "optimum, and cannot be smoothed\n  leave `smoothed` out, or estimate it"
        )
    shape = (state.size, state.size)
    return (
        Output(shape, doc=f"{TRANSITION_OF}{state.text}"),
        Output((1,), unit="s", doc="time that the transition counts from"),
    )


def check_start(component: SymbolicComponent) -> None:
    """Fail members whose start message has a covariance that is none."""
    P = np.asarray(component.port_views["start"].P)
    given = component.environment.active & np.isfinite(P).all(axis=(1, 2))
    P = np.where(given[:, None, None], P, np.eye(P.shape[1]))
    variance = np.diagonal(P, axis1=1, axis2=2)
    scale = 1.0 / np.sqrt(np.where(variance > 0.0, np.abs(variance), 1.0))
    P = P * scale[:, :, None] * scale[:, None, :]
    off = np.abs(P - P.transpose(0, 2, 1)).max(axis=(1, 2)) > _NEARLY
    component.fail(off, "the covariance in 'start' is not symmetric")
    least = np.linalg.eigvalsh((P + P.transpose(0, 2, 1)) / 2)[:, 0]
    bad = ~off & ((variance < 0.0).any(axis=1) | (least < -_NEARLY))
    component.fail(bad, "the covariance in 'start' is not positive definite")


_NEARLY = 1e-9
"""Of a correlation matrix, what rounding may make of zero."""

TRANSITION, SINCE = "error_transition", "transition_since"
TRANSITION_OF = "of the error of "
"""How the description of a transition's port begins; the error state's text follows."""


class FilterPredict(SymbolicComponent):
    """The estimate between fixes, and the covariance of its error: base of a filter's own.

    Attributes
    ----------
    error_state : ErrorState
    process : Process
    told : tuple of str
        Blocks that the start message tells; the others start at zero, with a sigma.
    sigmas : dict of str to str
        Of the others: the parameter that holds it, ``NAME_sigma0`` unless said otherwise;
        a stationary Gauss-Markov block's may be the one that its process names.
    """

    error_state: ClassVar[ErrorState]
    process: ClassVar[Process]
    told: ClassVar[tuple[str, ...]] = ()
    sigmas: ClassVar[dict[str, str]] = {}
    smoothed: ClassVar[bool] = False

    def __init_subclass__(cls, **options: Any) -> None:
        if says(cls, "error_state", "told", "smoothed"):
            if cls.smoothed:
                transition, since = transition_ports(cls.error_state)
                declare(cls, **{TRANSITION: transition, SINCE: since})
            state = cls.error_state
            fields = estimate_fields(state)
            ports: dict[str, Any] = {
                "posterior": MessageInput(fields=fields, at="start", doc="corrected estimate"),
                "prior": BundleOutput(fields, doc="estimate before any fix of this instant"),
            }
            for instant in state.instants:
                ports[instant] = MessageInput(
                    fields={"index": Field((), "1")}, at="start", doc="makes its clones anew"
                )
            if cls.told:
                start = start_fields(state, cls.told)
                ports["start"] = MessageInput(
                    fields=start_fields(state, cls.told),
                    needed_at_start=True,
                    doc="last known state, at t = 0",
                )
                ports["restart"] = MessageInput(
                    fields=start, at="start", optional=True, doc="state to begin anew from, later"
                )
            declare(cls, **ports)
        super().__init_subclass__(**options)

    def _initialize_impl(self) -> None:
        super()._initialize_impl()
        if self.told:
            check_start(self)

    def chosen_process(self) -> Process:
        """The process for the present choices: that of the class, unless a subclass has some."""
        return self.process

    def build_model(self) -> Model:
        """Build the model of the process."""
        return predict_model(
            f"{type(self).__name__.lower()}",
            self.error_state,
            self.chosen_process(),
            told=self.told,
            sigmas=starting_sigmas(self.error_state, self.told, self.sigmas),
            smoothed=self.smoothed,
            restarts=bool(self.told),
        )


class FilterCorrect(SymbolicComponent):
    """Correction of the prior by a fix, where it passes the gate: base of a filter's own.

    Attributes
    ----------
    error_state : ErrorState
    observation : Observation
    """

    error_state: ClassVar[ErrorState]
    observation: ClassVar[Observation]
    of_ensembles: ClassVar[bool] = False

    update = Choice(UPDATES, "ekf", doc="how the measurement is weighed")
    weights = Choice(WEIGHTS, "none", doc="robust: what enlarges the noise of a fix far off")
    huber_threshold = Parameter(
        HUBER, positive=True, infinite=True, doc="largest innovation taken as it is, in sigmas"
    )
    underweighting = Parameter(0.0, minimum=0.0, doc="Lear's factor on H P H'")
    underweighted_updates = Parameter(0.0, minimum=0.0, doc="how many fixes it applies to")

    def __init_subclass__(cls, **options: Any) -> None:
        if says(cls, "error_state", "observation"):
            if cls.observation.of_ensembles != cls.of_ensembles:
                kind = "a function of ensembles" if cls.observation.of_ensembles else "symbolic"
                base = "EnsembleCorrect" if cls.observation.of_ensembles else "FilterCorrect"
                raise ValueError(
                    f"the observation of {cls.__name__} is {kind}: derive the class from {base}, "
                    f"not from {cls.__mro__[1].__name__}"
                )
            declare(cls, **_correct_ports(cls.error_state, cls.observation))
        super().__init_subclass__(**options)

    @property
    def model_name(self) -> str:
        """Of the model for the present choices."""
        robust = "" if self.weights == "none" else f"_{self.weights}"
        return f"{type(self).__name__.lower()}_{self.update}{robust}"

    def chosen_observation(self) -> Observation:
        """What is observed for the present choices: that of the class, unless a subclass has."""
        return self.observation

    def build_model(self) -> Model:
        """Build the model for the chosen update and weights."""
        return correct_model(
            self.model_name,
            self.error_state,
            self.chosen_observation(),
            self.update,
            weights=self.weights,
            chained=True,
        )
