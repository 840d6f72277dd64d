"""Flight truth: an aircraft that flies a plan or a recorded track, and the view of a motion."""

from __future__ import annotations

from typing import Any

import numpy as np

from terrafix.components.fields import XYZ
from terrafix.components.noisy import NoisyComponent
from terrafix.components.rows import Row, Rows
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model
from terrafix.models.motion.flight import TURBULENCE, Segment, flight_model, rates_of
from terrafix.models.motion.strapdown import EARTHS, level_view_model
from terrafix.models.motion.waypoints import Waypoint, plan_through

NED = ("north", "east", "down")
BODY = ("along", "right", "down")
_POLE = np.pi / 2

_SEGMENT = {
    "duration": Parameter(None, unit="s"),
    "turn": Parameter(None, unit="rad"),
    "bank": Parameter(None, unit="rad"),
    "climb": Parameter(None, unit="m"),
    "speed": Parameter(None, unit="m/s"),
}
_WAYPOINT = {
    "at": Parameter(shape=(2,), unit="rad"),
    "height": Parameter(unit="m"),
    "speed": Parameter(None, unit="m/s"),
    "bank": Parameter(None, unit="rad"),
}


class Flight(NoisyComponent):
    """Aircraft that flies segments or by waypoints, in wind and turbulence, and its ideal IMU.

    Segments follow each other: duration, turn (angle), climb (height), speed (at its end); a turn
    with a bank needs no duration. Waypoints: at (latitude, longitude), height, speed, bank (of the
    turn there); the first is the start. Without either, and after the last, straight and level.
    """

    default_rate = Rate(hz=100)

    earth = Choice(
        EARTHS, "wgs84", doc="the real one, or flat and at rest, e north, east, down"
    )
    turbulence = Choice(TURBULENCE, "none", doc="gusts")
    segments = Rows(_SEGMENT, doc="duration or bank, turn, climb, speed of each")
    waypoints = Rows(_WAYPOINT, doc="at, height, speed, bank of each, instead of segments")
    latitude = Parameter(0.0, unit="rad", minimum=-_POLE, maximum=_POLE, doc="at t = 0")
    longitude = Parameter(0.0, unit="rad", minimum=-2 * np.pi, maximum=2 * np.pi, doc="at t = 0")
    height = Parameter(1000.0, unit="m", doc="at t = 0, above the ellipsoid")
    course = Parameter(0.0, unit="rad", doc="over ground at t = 0, from north to east")
    speed = Parameter(70.0, unit="m/s", positive=True, doc="over ground at t = 0, horizontal")
    wind_n = Parameter([0.0] * 3, shape=(3,), unit="m/s", frame="n", doc="motion of the air")
    gust_sigma = Parameter(
        1.5, shape=(3,), unit="m/s", minimum=0.0, doc="along, right, down (dryden)"
    )
    gust_length = Parameter(
        533.4, shape=(3,), unit="m", positive=True, doc="scales along, right, down (dryden)"
    )
    response_time = Parameter(1.0, unit="s", positive=True, doc="to follow the air (dryden)")
    hold_time = Parameter(
        30.0, unit="s", positive=True, infinite=True, doc="to fly back to the plan (dryden)"
    )
    attitude_response = Parameter(1.0, minimum=0.0, doc="turn into gusts, 1: whole (dryden)")

    r_e = Output((3,), unit="m", frame="e", labels=XYZ, doc="position")
    v_e = Output((3,), unit="m/s", frame="e", labels=XYZ, doc="velocity relative to the Earth")
    q_be = Output((4,), unit="1", frame="b", doc="attitude, e to body")
    delta_v_b = Output(
        (3,), unit="m/s", frame="b", labels=XYZ, doc="integral of specific force in turning axes"
    )
    delta_theta_b = Output(
        (3,), unit="rad", frame="b", labels=XYZ, doc="integral of the rate in turning axes"
    )
    delta_v_end_b = Output(
        (3,),
        unit="m/s",
        frame="b",
        labels=XYZ,
        doc="change of velocity by specific force, in the axes of the step's end",
    )
    gust = Output((3,), unit="m/s", labels=BODY, doc="velocity of the air, without the wind")

    def validate(self) -> None:
        """Look whether the plan can be flown."""
        super().validate()
        if self.setting("segments") and self.setting("waypoints"):
            raise ConfigurationError(
                f"'{self.name}' has segments and waypoints\n  give it one of them"
            )
        try:
            rates_of(self._segments(), float(self.setting("speed")))
        except ValueError as error:
            raise ConfigurationError(f"'{self.name}' cannot fly its plan: {error}") from error

    def build_model(self) -> Model:
        """Build the model for the chosen Earth, air and plan."""
        segments, start = self._segments(), None
        if self.setting("waypoints"):
            points = [_waypoint(row) for row in self.setting("waypoints")]
            start, segments = plan_through(points, self.setting("earth"))
        return flight_model(segments, self.setting("earth"), self.setting("turbulence"), start)

    def _segments(self) -> list[Segment]:
        found = []
        for k, row in enumerate(self.setting("segments")):
            try:
                found.append(Segment(**row))
            except ValueError as error:
                raise ValueError(f"segment {k + 1}: {error}") from None
        return found


def _waypoint(row: Row) -> Waypoint:
    latitude, longitude = row["at"]
    given: dict[str, Any] = {n: v for n, v in row.items() if n != "at"}
    return Waypoint(latitude, longitude, **given)


class LevelView(SymbolicComponent):
    """Latitude, longitude, height, velocity and angles of a motion, true or estimated."""

    default_rate = Rate(hz=10)

    earth = Choice(EARTHS, "wgs84", doc="that of the motion")
    latitude0 = Parameter(
        0.0, unit="rad", minimum=-_POLE, maximum=_POLE, doc="of the origin (flat)"
    )
    longitude0 = Parameter(
        0.0, unit="rad", minimum=-2 * np.pi, maximum=2 * np.pi, doc="of the origin (flat)"
    )

    r_e = Input((3,), unit="m", frame="e", doc="position")
    v_e = Input((3,), unit="m/s", frame="e", doc="velocity relative to the Earth")
    q_be = Input((4,), unit="1", frame="b", doc="attitude, e to body")
    latitude = Output((), unit="rad", doc="geodetic")
    longitude = Output((), unit="rad")
    height = Output((), unit="m", doc="above the ellipsoid")
    v_n = Output((3,), unit="m/s", frame="n", labels=NED, doc="velocity")
    roll = Output((), unit="rad", doc="right wing down")
    pitch = Output((), unit="rad", doc="nose up")
    heading = Output((), unit="rad", doc="from north to east")

    def build_model(self) -> Model:
        """Build the model for the chosen Earth."""
        return level_view_model(self.setting("earth"))
