"""Altimeters: height by air pressure, and the clearance that a radar measures over the ground."""

from __future__ import annotations

from terrafix.components.filters.family import fix_fields
from terrafix.components.noisy import NoisyComponent
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input, MessageOutput, Output
from terrafix.models.core.model import Model
from terrafix.models.filters.navigator import altimeter_observation
from terrafix.models.motion.strapdown import EARTHS
from terrafix.models.sensors.altimeter import altimeter_model


class Altimeter(NoisyComponent):
    """Barometric altimeter: height with a bias that wanders, and white noise."""

    default_rate = Rate(hz=10, offset="0.1")

    earth = Choice(EARTHS, "wgs84", doc="that of the motion; heights above its ellipsoid or ground")
    sigma = Parameter(1.0, unit="m", minimum=0.0, doc="white noise")
    bias_sigma = Parameter(0.8, unit="m", minimum=0.0, doc="of the bias")
    bias_time = Parameter(100.0, unit="s", positive=True, doc="correlation of the bias")

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    fix = MessageOutput(fields=fix_fields(altimeter_observation("wgs84")), doc="measured height")
    bias = Output((1,), unit="m", doc="true bias")

    def build_model(self) -> Model:
        """Build the model for the chosen Earth."""
        return altimeter_model(self.setting("earth"))
