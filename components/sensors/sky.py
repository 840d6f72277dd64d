"""Sensors of the sky: star tracker, Sun sensor, horizon sensor."""

from __future__ import annotations

import numpy as np

from terrafix.components.fields import DIRECTION_FIX, ENVIRONMENT, STAR_FIX
from terrafix.components.noisy import NoisyComponent
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import BundleInput, Input, MessageOutput, Output
from terrafix.models.core.model import Model
from terrafix.models.geometry.earth import EARTH
from terrafix.models.sensors.directions import horizon_sensor_model, sun_sensor_model
from terrafix.models.sensors.star_tracker import BLOCKED, SKIES, star_tracker_model

_ARC_SECOND = np.pi / 180 / 3600


def _angle(default: float, doc: str, maximum: float = np.pi) -> Parameter:
    return Parameter(np.radians(default), unit="rad", minimum=0.0, maximum=maximum, doc=doc)


def _boresight(*axis: float) -> Parameter:
    return Parameter(list(axis), shape=(3,), frame="b", doc="where it looks, of any length")


class _Boresighted(NoisyComponent):
    """A sensor that looks along an axis of the body: base."""

    def validate(self) -> None:
        """Check that the boresight has a direction."""
        super().validate()
        if not np.linalg.norm(self.setting("boresight_b")) > 0.0:
            raise ConfigurationError(
                f"'{self.name}.boresight_b' is [0, 0, 0], which is no direction\n"
                "  write where it looks in body axes, [0, 0, -1] say"
            )


class StarTracker(_Boresighted):
    """Star tracker: attitude, better across its boresight than about it, of a latency ago.

    No fix comes while the body turns too fast, or Sun, Moon or the Earth's limb are too near the
    boresight. With sky = none it needs no environment: inertial axes are those that turn
    uniformly, as of `orbit`, and neither Sun nor Moon blinds it.
    """

    default_rate = Rate("0.25", offset="0.25")

    sky = Choice(SKIES, "environment", doc="environment: GCRF, Sun and Moon; none: without")
    boresight_b = _boresight(0.0, 0.0, -1.0)
    cross_sigma = Parameter(
        5 * _ARC_SECOND, unit="rad", minimum=0.0, doc="noise about each axis across the boresight"
    )
    roll_sigma = Parameter(
        40 * _ARC_SECOND, unit="rad", minimum=0.0, doc="noise about the boresight"
    )
    alignment_sigma = Parameter(
        0.0, unit="rad", minimum=0.0, doc="of its alignment about each axis, drawn at the start"
    )
    latency = Parameter(0.0, unit="s", minimum=0.0, doc="age of the stars seen, a step at most")
    largest_rate = Parameter(
        float(np.radians(2.0)), unit="rad/s", positive=True, infinite=True, doc="it still follows"
    )
    sun_exclusion = _angle(35.0, "of the Sun to the boresight; 0: never blinds")
    moon_exclusion = _angle(15.0, "of the Moon to the boresight; 0: never blinds")
    earth_exclusion = _angle(20.0, "of the Earth's limb to the boresight", maximum=np.pi / 2)
    rotation_rate = Parameter(EARTH.rotation_rate, unit="rad/s", doc="Earth rotation (none)")
    earth_angle0 = Parameter(0.0, unit="rad", doc="inertial to Earth-fixed at t = 0 (none)")

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude, Earth-fixed to body")
    surroundings = BundleInput(ENVIRONMENT, doc="inertial axes, Sun and Moon of an environment")
    fix = MessageOutput(fields=STAR_FIX, doc="attitude")
    blocked = Output((), unit="1", doc=f"why nothing is measured: {', '.join(BLOCKED)} (0 to 4)")

    def prepare(self) -> None:
        """Keep the input of the surroundings where they are read."""
        if self.setting("sky") == "none":
            self.ports = {n: p for n, p in self.ports.items() if n != "surroundings"}

    def validate(self) -> None:
        """Check the latency against the step."""
        super().validate()
        period = self.rate.period if self.rate is not None else None
        latency = float(self.setting("latency"))
        if period is not None and latency > float(period):
            raise ConfigurationError(
                f"'{self.name}.latency' is {latency:g} s, more than a step of {float(period):g} s\n"
                "  delay its connections by whole steps, and set the rest"
            )

    def build_model(self) -> Model:
        """Build the model for the chosen sky."""
        return star_tracker_model(self.setting("sky"))


class _Direction(_Boresighted):
    """A sensor of a direction within a round field: base."""

    default_rate = Rate("1", offset="1")

    half_angle = Parameter(
        float(np.radians(60.0)), unit="rad", positive=True, maximum=np.pi, doc="of its field"
    )
    sigma = Parameter(
        float(np.radians(0.1)), unit="rad", minimum=0.0, doc="white noise about each axis"
    )
    bias_sigma = Parameter(0.0, unit="rad", minimum=0.0, doc="of the bias about each axis")
    bias_time = Parameter(
        np.inf, unit="s", positive=True, infinite=True, doc="its correlation; inf: it lasts"
    )

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude, Earth-fixed to body")


class SunSensor(_Direction):
    """Sun sensor: the direction to the Sun, in its field and out of the Earth's shadow."""

    boresight_b = _boresight(0.0, 0.0, -1.0)
    surroundings = BundleInput(ENVIRONMENT, doc="inertial axes, Sun and Moon of an environment")
    fix = MessageOutput(fields=DIRECTION_FIX, doc="direction to the Sun")
    lit = Output((), unit="1", doc="1 where the Earth does not hide the Sun")

    def build_model(self) -> Model:
        """Build the model."""
        return sun_sensor_model()


class HorizonSensor(_Direction):
    """Horizon sensor: the direction to the center of the Earth's disk, while it is in its field."""

    boresight_b = _boresight(0.0, 0.0, 1.0)
    fix = MessageOutput(fields=DIRECTION_FIX, doc="direction to the Earth's center")

    def build_model(self) -> Model:
        """Build the model."""
        return horizon_sensor_model()
