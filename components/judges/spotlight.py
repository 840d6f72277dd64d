"""Judge of spotlight images that were formed with a wrong track."""

from __future__ import annotations

import numpy as np

from terrafix.components.fields import SPOTLIGHT_FIX
from terrafix.cosim.basics.arrays import FloatArray, Mask
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import MessageInput, Output, SharedInput
from terrafix.models.radar.compensation import straight_line


class SpotlightEvaluation(Component):
    """What a spotlight image measured, less what is true; NaN where nothing was accepted."""

    default_rate = Rate("1", offset="1")

    r = SharedInput((None, 3), unit="m", frame="scene", doc="true places of the antenna")
    times = SharedInput((None,), unit="s", doc="of its pulses")
    fix = MessageInput(fields=SPOTLIGHT_FIX, doc="what the image says of its track")
    accepted = Output(doc="1 where the image was recognized, else 0")
    range_error = Output(unit="m", doc="measured less true")
    along_error = Output(unit="m", doc="measured less true")
    speed_error = Output(unit="m/s", doc="of map drift, measured less true")

    def _initialize_impl(self) -> None:
        self.accepted = self.range_error = self.along_error = self.speed_error = np.nan

    def _step_impl(self, t: float, dt: float) -> None:
        if not self.fix.fresh.any():
            return
        true = straight_line(np.asarray(self.times), np.asarray(self.r))
        good = self.fix.accepted > 0
        self.accepted = np.where(self.fix.fresh, self.fix.accepted, np.nan)
        ahead = -(true.v @ true.r) / self.fix.speed
        self.range_error = _where(good, self.fix.range - np.linalg.norm(true.r))
        self.along_error = _where(good, self.fix.ahead - ahead)
        self.speed_error = _where(good & (self.fix.focused > 0), self.fix.velocity - true.speed)


def _where(good: Mask, value: FloatArray) -> FloatArray:
    return np.where(good, value, np.nan)
