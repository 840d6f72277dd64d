"""A monitor of any correction's innovations: alarms where they are too large, or one-sided.

One of one's own is a class of a few lines:

    class RangeMonitor(FilterMonitor):
        observation = RANGE

connected to the correction's ``innovation`` and stepped at its rate.
"""

from __future__ import annotations

from typing import Any, ClassVar

from terrafix.components.filters.family import declare, innovation_fields, says
from terrafix.cosim.declare.parameters import Count, Parameter
from terrafix.cosim.declare.ports import MessageInput, MessageOutput, Output
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.memory.fields import Field
from terrafix.models.core.model import Model
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.monitor import ALARMS, monitor_model

ALARM = {
    "test": Field((), "1", doc="index into terrafix.filters.ALARMS"),
    "element": Field((), "1", doc="of the measurement, from 0; -1: all together"),
    "statistic": Field((), "1", doc="the value that gave the alarm"),
    "threshold": Field((), "1", doc="that it exceeds"),
}
"""Fields of an alarm."""


class FilterMonitor(SymbolicComponent):
    """Tests innovations by a chi-square over a window and by cumulative sums: base.

    Fixes that the gate refused count. What gave an alarm keeps its value until the next fix, and
    starts anew with it.

    Attributes
    ----------
    observation : Observation
        Of the correction.
    false_alarm : float
        Share of sound windows that give an alarm.
    """

    observation: ClassVar[Observation]
    false_alarm: ClassVar[float] = 1e-3

    window = Count(10, minimum=1, doc="fixes that the chi-square is taken over")
    allowance = Parameter(0.5, minimum=0.0, doc="half the shift to be found, in sigmas")
    decision_interval = Parameter(5.0, positive=True, doc="largest sum without alarm, in sigmas")

    alarm = MessageOutput(fields=ALARM, doc="of several, the furthest beyond its threshold")
    chi_square = Output(doc="sum of the normalized innovations squared of the window")
    chi_square_dof = Output(doc="elements measured in it")
    chi_square_threshold = Output(doc="for so many; it holds once the window is full")
    alarms = Output((len(ALARMS),), labels=ALARMS, doc="how often each test gave one")

    def __init_subclass__(cls, **options: Any) -> None:
        if says(cls, "observation"):
            shape, labels = (cls.observation.size,), tuple(cls.observation.elements)
            fields = innovation_fields(cls.observation)
            declare(
                cls,
                innovation=MessageInput(fields=fields, doc="of the correction"),
                mean_high=Output(shape, labels=labels, doc="sum of innovations above zero"),
                mean_low=Output(shape, labels=labels, doc="sum of innovations below zero"),
            )
        super().__init_subclass__(**options)

    def build_model(self) -> Model:
        """Build the model for the window."""
        return monitor_model(
            type(self).__name__.lower(), self.observation.size, self.window, self.false_alarm
        )
