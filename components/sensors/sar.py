"""The radar as navigation sees it: its antenna's mounting and steering, fixes without images."""

from __future__ import annotations

import numpy as np

from terrafix.components.fields import FIX
from terrafix.components.noisy import NoisyComponent
from terrafix.components.sensors.files import steps_within
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.units import conversion_factor, split_quantity
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Parameter, Text
from terrafix.cosim.declare.ports import Input, MessageOutput, Output
from terrafix.models.core.model import Model
from terrafix.models.geometry.antenna import steered_array
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


class AntennaSteering(Component):
    """Look and squint of an antenna that is steered: other ones for each image.

    It gives the attitude of axes whose z is the commanded boresight, of the truth and as measured.
    What declares a look and a squint (echo, reference, former, filter) takes this in place of the
    attitude of the body, with a look of zero: there is one schedule, and all follow it. It steps
    when images are taken; between them it holds.
    """

    default_rate = Rate("8.2", offset="8.2")

    looks = Text(
        doc="off-nadir angles, one for each step or for all, as [34.3, -34.3] deg; "
        "positive to the right"
    )
    squints = Text("0 deg", doc="forward angles, one for each step or for all")

    q_be_true = Input((4,), unit="1", frame="b", doc="true attitude, Earth-fixed to body")
    q_be = Input((4,), unit="1", frame="b", doc="measured attitude, Earth-fixed to body")
    steered_true = Output((4,), unit="1", frame="b", doc="Earth-fixed to the true steered axes")
    steered = Output((4,), unit="1", frame="b", doc="Earth-fixed to them, as measured")

    def validate(self) -> None:
        """Read the schedule."""
        self._schedule()

    def validate_duration(self, duration: float) -> None:
        """Look whether there is a look for every step."""
        n, (looks, _) = len(steps_within(self.rate, duration)), self._schedule()
        if n > len(looks) > 1:
            raise ConfigurationError(
                f"'{self.name}' steps {n} times within {duration:g} s, but is steered "
                f"{len(looks)} times\n"
                f"  give a look or a squint for each step, or list fewer times"
            )

    def _schedule(self) -> tuple[FloatArray, FloatArray]:
        """Look and squint of every step [rad]."""
        looks, squints = (self._angles(name) for name in ("looks", "squints"))
        n = max(len(looks), len(squints))
        if not {len(looks), len(squints)} <= {1, n}:
            raise ConfigurationError(
                f"'{self.name}' has {len(looks)} looks and {len(squints)} squints\n"
                "  give as many of both, or one for all steps"
            )
        return np.broadcast_to(looks, n), np.broadcast_to(squints, n)

    def _angles(self, name: str) -> FloatArray:
        text = self.setting(name)
        try:
            value, unit = split_quantity(text)
            factor = conversion_factor(unit, "rad") if unit else None
            if factor is None:
                raise ValueError(text)
            angles = np.atleast_1d(np.asarray(value, np.float64)) * factor
        except (TypeError, ValueError, ConfigurationError) as error:
            raise ConfigurationError(
                f"{self.name}.{name} is '{text}', not angles with a unit\n"
                f'  write them as {name} = "[34.3, -34.3] deg"'
            ) from error
        if angles.ndim != 1 or not (np.abs(angles) < np.pi / 2).all():
            raise ConfigurationError(
                f"{self.name}.{name} is '{text}'; an antenna looks less than 90 deg to a side"
            )
        return angles

    def _initialize_impl(self) -> None:
        self.steered_true = self.steered = [0.0, 0.0, 0.0, 1.0]

    def _step_impl(self, t: float, dt: float) -> None:
        looks, squints = self._schedule()
        k = self.step_index - 1 if len(looks) > 1 else 0
        if k >= len(looks):
            raise ConfigurationError(
                f"'{self.name}' has no look for its step {k + 1}\n"
                "  give a look or a squint for each step"
            )
        self.steered_true = steered_array(self.q_be_true, looks[k], squints[k])
        self.steered = steered_array(self.q_be, looks[k], squints[k])


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
    look = Parameter(unit="rad", doc="off-nadir angle of the boresight, positive to the right")
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
