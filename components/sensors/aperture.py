"""The airborne radar as navigation sees it: its apertures, and fixes without images."""

from __future__ import annotations

import numpy as np

from terrafix.components.fields import MOTION, SHIFT_FIX, XYZ
from terrafix.components.noisy import NoisyComponent
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice, Flag, Parameter
from terrafix.cosim.declare.ports import BundleInput, Input, MessageInput, MessageOutput, Output
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.memory.fields import Field
from terrafix.models.core.model import Model
from terrafix.models.motion.strapdown import EARTHS
from terrafix.models.sensors.aperture import LOOKS, ROWS, aperture_model, synthetic_shift_model

MARK = {"index": Field((), "1", doc="number of the aperture")}
_QUARTER = np.pi / 2


class Aperture(SymbolicComponent):
    """Apertures one after the other: marks their centers, averages the specific force.

    At the rate of the IMU. The mark makes the navigator keep its position and velocity.
    """

    default_rate = Rate(hz=100)

    length = Parameter(1.0, unit="s", positive=True, doc="of an aperture")

    delta_v_b = Input((3,), unit="m/s", frame="b", doc="measured increment")
    delta_theta_b = Input((3,), unit="rad", frame="b", doc="measured increment")
    center = MessageOutput(fields=MARK, doc="now is the center of an aperture")
    f_b = Output(
        (3,), unit="m/s^2", frame="b", labels=XYZ, doc="mean specific force since it began"
    )

    def build_model(self) -> Model:
        """Build the model."""
        return aperture_model()


class SyntheticShift(NoisyComponent):
    """A fix without an image, at the end of each aperture: of a ground point abeam of its center.

    What image formation, correlation and map drift would measure, from the true motion and with
    given errors. It steps at centers and ends of apertures.
    """

    default_rate = Rate("0.5", offset="0.5")

    earth = Choice(EARTHS, "wgs84", doc="that of the motion")
    on = Flag(True, doc="whether it sends fixes")
    looks = Choice(LOOKS, "right", doc="side that apertures look to")
    rows = Choice(ROWS, "shift", doc="what is measured: with what map drift reads, or without")
    ground_range = Parameter(1200.0, unit="m", positive=True, doc="of the point, level")
    ground = Parameter(0.0, unit="m", doc="height of the point")
    largest_bank = Parameter(
        _QUARTER, unit="rad", positive=True, maximum=_QUARTER, doc="with which the beam is on it"
    )
    range_sigma = Parameter(0.5, unit="m", minimum=0.0, doc="white noise of range")
    range_bias_sigma = Parameter(0.3, unit="m", minimum=0.0, doc="of the bias of range")
    range_bias_time = Parameter(100.0, unit="s", positive=True, doc="its correlation")
    cross_range_sigma = Parameter(0.5, unit="m", minimum=0.0, doc="white noise of cross-range")
    cross_range_bias_sigma = Parameter(0.3, unit="m", minimum=0.0, doc="of the bias of cross-range")
    cross_range_bias_time = Parameter(100.0, unit="s", positive=True, doc="its correlation")
    map_drift_sigma = Parameter(0.04, unit="m/s", minimum=0.0, doc="white noise of map drift")
    force_sigma = Parameter(
        0.001, unit="m/s^2", minimum=0.0, doc="the IMU's white noise in the mean specific force"
    )

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude, e to body")
    f_b = Input((3,), unit="m/s^2", frame="b", default=0.0, doc="mean specific force of the IMU")
    center = MessageInput(fields=MARK, doc="now is the center of an aperture")
    prior = BundleInput(MOTION, doc="estimate of now and of the center")
    fix = MessageOutput(fields=SHIFT_FIX, doc="the fix")
    range_bias = Output((1,), unit="m", doc="true bias of range")
    cross_range_bias = Output((1,), unit="m", doc="true bias of cross-range")

    def build_model(self) -> Model:
        """Build the model for the chosen Earth, looks and rows."""
        return synthetic_shift_model(*(self.setting(n) for n in ("earth", "looks", "rows", "on")))
