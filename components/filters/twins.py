"""What a filter believes, made true: a truth and a sensor to try it against.

A filter that is not consistent with its own twins is not made right; one that is may still believe
what is not so. Both have the parameters of the filter by the same names, and can be given others.
"""

from __future__ import annotations

from typing import Any, ClassVar

from terrafix.components.filters.family import (
    declare,
    fix_fields,
    says,
    start_fields,
    starting_sigmas,
    value_field,
)
from terrafix.components.noisy import NoisyComponent
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Input, MessageInput, MessageOutput, Output
from terrafix.models.core.model import Model
from terrafix.models.filters.error_state import ErrorState
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.models import sensor_model, truth_model
from terrafix.models.filters.process import Process


class FilterTruth(NoisyComponent):
    """A truth that starts, and moves, as a filter believes: base of one's own.

    Attributes
    ----------
    error_state, process, told, sigmas
        As of `terrafix.components.filters.family.FilterPredict`; what the process reads besides is
        declared on the class, as there.
    """

    error_state: ClassVar[ErrorState]
    process: ClassVar[Process]
    told: ClassVar[tuple[str, ...]] = ()
    sigmas: ClassVar[dict[str, str]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        if says(cls, "error_state", "told"):
            state, ports = cls.error_state.present, dict[str, Any]()
            for block in state:
                field = value_field(block)
                ports[block.name] = Output(
                    field.fixed_shape, unit=field.unit, frame=field.frame, labels=field.labels
                )
            if cls.told:
                ports["start"] = MessageInput(
                    fields=start_fields(state, cls.told),
                    needed_at_start=True,
                    doc="state about which the true one is drawn, at t = 0",
                )
            declare(cls, **ports)
        super().__init_subclass__(**options)

    def build_model(self) -> Model:
        """Build the model of the process, with its noise drawn."""
        return truth_model(
            type(self).__name__.lower(),
            self.error_state,
            self.process,
            told=self.told,
            sigmas=starting_sigmas(self.error_state, self.told, self.sigmas),
        )


class FilterSensor(NoisyComponent):
    """A sensor that measures as an observation says, with white noise: base of one's own.

    Its inputs are the true blocks that the observation is of, and what it reads besides, which is
    declared on the class.

    Attributes
    ----------
    error_state : ErrorState
    observation : Observation
    """

    error_state: ClassVar[ErrorState]
    observation: ClassVar[Observation]

    def __init_subclass__(cls, **options: Any) -> None:
        if says(cls, "error_state", "observation"):
            seen = cls.observation
            units = tuple(seen.elements.values())
            model = sensor_model(cls.__name__.lower(), cls.error_state, seen)
            fields = {b.name: b for b in (*cls.error_state.present, *seen.fields)}
            ports: dict[str, Any] = {
                "sigma": Parameter(
                    shape=(seen.size,),
                    unit=units[0] if len(set(units)) == 1 else units,
                    minimum=0.0,
                    doc="of the noise of each element",
                ),
                "fix": MessageOutput(fields=fix_fields(seen), doc="what it measured"),
            }
            for name in (n for n in model.inputs if n in fields):
                field = value_field(fields[name])
                ports[name] = Input(field.fixed_shape, unit=field.unit, frame=field.frame)
            declare(cls, **ports)
        super().__init_subclass__(**options)

    def build_model(self) -> Model:
        """Build the model of the observation, with its noise drawn."""
        return sensor_model(type(self).__name__.lower(), self.error_state, self.observation)
