"""The radar as navigation sees it: the antenna's true mounting, and fixes without images."""

from __future__ import annotations

from terrafix.components.fields import FIX
from terrafix.components.noisy import NoisyComponent
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input, MessageOutput, Output
from terrafix.models.core.model import Model
from terrafix.models.geometry.earth import EARTH
from terrafix.models.sensors.sar import (
    BORESIGHTS,
    IN_TRACK,
    antenna_mount_model,
    synthetic_fix_model,
)


class AntennaMount(NoisyComponent):
    """True misalignment of the antenna: drawn at the start, then a random walk."""

    default_rate = Rate(hz=100)

    misalignment = Parameter(
        0.0, shape=(3,), unit="rad", frame="s", doc="mean at t = 0, rotation vector"
    )
    misalignment_sigma0 = Parameter(0.0, unit="rad", minimum=0.0, doc="drawn at t = 0, per axis")
    misalignment_walk = Parameter(0.0, unit="rad/s^0.5", minimum=0.0, doc="random walk, per axis")

    q_mu = Output((4,), unit="1", frame="s", doc="misalignment, nominal to true antenna frame")

    def build_model(self) -> Model:
        """Build the model."""
        return antenna_mount_model()


class SyntheticSarFix(NoisyComponent):
    """A SAR fix without an image: where the boresight meets the ellipsoid, with given errors.

    No fix appears where the boresight misses the Earth.
    """

    default_rate = Rate("8.2", offset="8.2")

    boresight = Choice(
        BORESIGHTS,
        "true",
        doc="nominal: pixel where the misaligned antenna does not look (control)",
    )
    in_track = Choice(IN_TRACK, "speed", doc="what the fourth element is, as in mekf_correct")
    look = Parameter(unit="rad", doc="off-nadir angle of the boresight, to the right")
    squint = Parameter(0.0, unit="rad", doc="forward angle of the boresight")
    range_sigma = Parameter(1.0, unit="m", minimum=0.0, doc="noise of the slant range")
    speed_sigma = Parameter(0.54, unit="m/s", minimum=0.0, doc="noise of the in-track velocity")
    geolocation_sigma = Parameter(
        5.0, shape=(3,), unit="m", positive=True, doc="error of the geocoded pixel, Earth-fixed"
    )
    geolocation_bias = Parameter(
        0.0,
        shape=(3,),
        unit="m",
        frame="e",
        doc="constant error of the geocoded pixel, not reported",
    )
    error_scale = Parameter(
        1.0, minimum=0.0, doc="size of the random errors relative to what the fix reports"
    )
    radius = Parameter(EARTH.radius, unit="m", positive=True, doc="equatorial radius")
    flattening = Parameter(EARTH.flattening, minimum=0.0, maximum=0.1, doc="of the ellipsoid")

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude, Earth-fixed to body")
    q_mu = Input((4,), unit="1", frame="s", doc="true misalignment")
    fix = MessageOutput(fields=FIX, doc="the fix")

    def build_model(self) -> Model:
        """Build the model for the chosen boresight and measurement."""
        return synthetic_fix_model(self.boresight, self.in_track)
