"""Corrections by what is predicted for a whole ensemble at once: a map, a contour, an image."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from terrafix.components.filters.family import FilterCorrect
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.declare.component import Environment
from terrafix.cosim.declare.ports import Capabilities
from terrafix.models.core.model import Model
from terrafix.models.filters.ensembles import ANSWER, EnsembleObservation, Stage, staged_model
from terrafix.models.filters.measurement import TIME


class _Same:
    """A thing that equals itself alone, to be remembered by."""

    def __init__(self, thing: Any) -> None:
        self.thing = thing

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.thing is other.thing

    def __hash__(self) -> int:
        return id(self.thing)


@lru_cache(maxsize=32)
def _staged(
    name: str, state: _Same, observation: _Same, update: str, weights: str
) -> tuple[Model, list[Stage]]:
    """A model and its stages: those of a second filter of a kind, or of a second run, at once."""
    return staged_model(name, state.thing, observation.thing, update, weights=weights, chained=True)


class EnsembleCorrect(FilterCorrect):
    """Correction by a fix whose prediction is a function of the whole ensemble: base.

    Its observation is an `terrafix.models.filters.ensembles.EnsembleObservation`; the arrays that
    it shares are shared inputs of the class. It runs here alone: there is no symbol of all of it
    that could be linearized or exported.
    """

    capabilities: ClassVar[Capabilities] = Capabilities(symbolic=False)
    observation: ClassVar[EnsembleObservation]
    of_ensembles: ClassVar[bool] = True
    fix: Any

    _stages: tuple[Model, list[Stage]] | None = None

    def chosen_observation(self) -> EnsembleObservation:
        """What is observed for the present choices: that of the class, unless a subclass has."""
        return self.observation

    def build_model(self) -> Model:
        """Build the model for the chosen update and weights, whose predictions are inputs."""
        self._stages = _staged(
            self.model_name,
            _Same(self.error_state),
            _Same(self.chosen_observation()),
            self.update,
            self.weights,
        )
        return self._stages[0]

    def __getstate__(self) -> dict[str, Any]:
        """What goes to another process: no stages, which are made there."""
        return {k: v for k, v in super().__getstate__().items() if k not in ("_stages", "_answers")}

    def _check_name(self, name: str, ports: Mapping[str, Any], extra: set[str], side: str) -> None:
        if not name.startswith(f"{ANSWER}."):
            super()._check_name(name, ports, extra, side)

    def validate(self) -> None:
        """Check besides that all that the observation reads is declared."""
        super().validate()
        for name, kind in (
            *((n, "input") for n in self.observation.inputs),
            *((n, "shared input") for n in self.observation.shared),
            *((n, "parameter") for n in self.observation.parameters),
        ):
            known = self.settings() if kind == "parameter" else self.inputs()
            if name not in known:
                raise ConfigurationError(
                    f"the observation of {type(self).__name__} reads '{name}', which is no {kind} "
                    f"of it\n  {nearest(name, known, what=f'its {kind}s')}"
                )

    def takes(self, name: str) -> bool:
        """Whether a parameter has any effect: those of the observation have."""
        return name in self.observation.parameters or super().takes(name)

    def bind(self, environment: Environment) -> None:
        """Get arrays for the answers."""
        super().bind(environment)
        self._answers = {
            name: np.zeros((environment.n_members, *self.model.shape(name)))
            for name in self.model.inputs
            if name.startswith(f"{ANSWER}.")
        }

    def _input_array(self, name: str) -> FloatArray:
        found = self._answers.get(name)
        return super()._input_array(name) if found is None else found

    def _initialize_impl(self) -> None:
        self._ask()  # a fix may be there at the start
        super()._initialize_impl()

    def _step_impl(self, t: float, dt: float) -> None:
        self._ask()
        super()._step_impl(t, dt)

    def _ask(self) -> None:
        """Predict for the members that have a fix, where the update asks for it."""
        who = np.flatnonzero(self.fix.fresh & self.environment.active)
        if not len(who):
            return
        assert self._stages is not None  # made with the model, which the kernel is of
        given = self.arguments()
        for stage in self._stages[1]:
            arrays = [
                given[n][who].reshape(len(who), *shape) for n, shape in stage.arguments.items()
            ]
            n_points = len(stage.numbers)
            found = stage.points(*arrays)
            values = {
                b.name: np.reshape(v, (len(who) * n_points, b.value_size))
                for b, v in zip(self.error_state, found, strict=False)
            }
            for number, error in zip(stage.held, found[len(values) :], strict=True):
                self._answers[f"{ANSWER}.e{number}"][who] = error
            self._answer(stage, who, values, self._given(who, n_points))

    def _given(self, who: NDArray[np.int64], n_points: int) -> dict[str, Any]:
        """What the observation reads besides, a row for every point."""
        seen = self.chosen_observation()
        given = {n: self.port_views[n][who] for n in seen.inputs}
        given |= {n: self.parameter_values[n][who] for n in seen.parameters}
        given |= {b.name: getattr(self.fix, b.name)[who] for b in seen.fields}
        given[TIME] = self.fix.t[who][:, None]
        repeated = {n: np.repeat(values, n_points, axis=0) for n, values in given.items()}
        return repeated | {n: getattr(self, n) for n in seen.shared}

    def _answer(
        self, stage: Stage, who: NDArray[np.int64], values: dict[str, Any], given: dict[str, Any]
    ) -> None:
        seen = self.chosen_observation()
        n, m = self.error_state.size, seen.size
        k, p = len(who), len(stage.numbers)
        kinds: list[tuple[str, Callable[..., Any], tuple[int, ...]]] = [("y", seen.predict, (m,))]
        if stage.derived:
            assert seen.derivative is not None
            kinds.append(("H", seen.derivative, (m, n)))
        for kind, function, shape in kinds:
            found = np.asarray(function(values, given), dtype=np.float64)
            if found.shape != (k * p, *shape):
                raise ConfigurationError(
                    f"the observation of {type(self).__name__} gives an array of shape "
                    f"{found.shape} for {k * p} estimates; '{kind}' needs {(k * p, *shape)}\n  "
                    "return one row for every row of the values"
                )
            for i, number in enumerate(stage.numbers):
                array = self._answers.get(f"{ANSWER}.{kind}{number}")
                if array is not None:
                    array[who] = found.reshape(k, p, *shape)[:, i]
