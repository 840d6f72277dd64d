"""Flight truth: an aircraft that flies a plan or a recorded track, and the view of a motion."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.components.fields import XYZ
from terrafix.components.noisy import NoisyComponent
from terrafix.components.rows import Row, Rows
from terrafix.components.shared import require_common, shared_setting
from terrafix.components.truth.playback import CLOSE, last_step
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component, Environment
from terrafix.cosim.declare.parameters import Choice, FilePath, Parameter
from terrafix.cosim.declare.ports import Input, Output, State
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model
from terrafix.models.motion.flight import TURBULENCE, Segment, flight_model, rates_of
from terrafix.models.motion.strapdown import EARTHS, Motion, level_view_model
from terrafix.models.motion.track import SmoothTrack, follow_array, read_track
from terrafix.models.motion.waypoints import Waypoint, plan_through

NED = ("north", "east", "down")
BODY = ("along", "right", "down")
_POLE = np.pi / 2

_SEGMENT = {
    "duration": Parameter(unit="s"),
    "turn": Parameter(unit="rad"),
    "bank": Parameter(unit="rad"),
    "climb": Parameter(unit="m"),
    "speed": Parameter(unit="m/s"),
}
_WAYPOINT = {
    "at": Parameter(shape=(2,), unit="rad", frame="geodetic"),
    "height": Parameter(unit="m"),
    "speed": Parameter(unit="m/s"),
    "bank": Parameter(unit="rad"),
}


class Flight(NoisyComponent):
    """Aircraft that flies segments or by waypoints, in wind and turbulence, and its ideal IMU.

    Segments follow each other: duration, turn (angle), climb (height), speed (at its end); a turn
    with a bank needs no duration. Waypoints: at (latitude, longitude), height, speed, bank (of the
    turn there); the first is the start. Without either, and after the last, straight and level.
    """

    default_rate = Rate(hz=100)

    earth = Choice(EARTHS, "wgs84", doc="the real one, or flat and at rest, e north, east, down")
    turbulence = Choice(TURBULENCE, "none", doc="gusts")
    segments = Rows(_SEGMENT, doc="duration or bank, turn, climb, speed of each")
    waypoints = Rows(
        _WAYPOINT, ("at", "height"), doc="at, height, speed, bank of each, instead of segments"
    )
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
    wind_20ft = Parameter(
        15.4, unit="m/s", minimum=0.0, doc="mean, 20 ft above ground; 30 kn: moderate (mil-f-8785c)"
    )
    ground = Parameter(0.0, unit="m", doc="its height under the start (mil-f-8785c)")
    response_time = Parameter(1.0, unit="s", positive=True, doc="to follow the air (gusts)")
    hold_time = Parameter(
        30.0, unit="s", positive=True, infinite=True, doc="to fly back to the plan (gusts)"
    )
    attitude_response = Parameter(1.0, minimum=0.0, doc="turn into the air, 1: whole (gusts)")

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


class RecordedFlight(Component):
    """Aircraft along a recorded track, smoothed, and its ideal IMU: on the ports of `flight`.

    One flight for all members. What is flown follows the splines by the trapezoidal rule: to 1e-5 m
    at 100 Hz, some millimeters at 10 Hz.
    """

    default_rate = Rate(hz=100)

    earth = Choice(EARTHS, "wgs84", doc="the real one, or flat and at rest, e north, east, down")
    track_file = FilePath(doc="track (.csv): time, latitude, longitude, height, attitude or none")
    position_sigma = Parameter(0.0, unit="m", minimum=0.0, doc="noise of its places, smoothed out")
    start = Parameter(0.0, unit="s", minimum=0.0, doc="t = 0, after the first row")

    r_e = Flight.r_e
    v_e = Flight.v_e
    q_be = Flight.q_be
    delta_v_b = Flight.delta_v_b
    delta_theta_b = Flight.delta_theta_b
    delta_v_end_b = Flight.delta_v_end_b

    r = State((3,), unit="m", frame="e", doc="position")
    v = State((3,), unit="m/s", frame="e", doc="velocity relative to the Earth")
    q = State((4,), doc="attitude, e to body")

    def validate(self) -> None:
        """Read the track."""
        track = self._read().track
        start, covered = float(shared_setting(self, "start")), track.t[-1] - track.t[0]
        if start >= covered:
            raise ConfigurationError(
                f"'{self.name}.start' is {start:g} s, but '{self.setting('track_file').name}' "
                f"covers {covered:g} s"
            )

    def validate_duration(self, duration: float) -> None:
        """Look whether the track covers the run."""
        t = self._read().track.t
        last = float(shared_setting(self, "start")) + last_step(self.rate, duration)
        if last > t[-1] - t[0] + CLOSE:
            raise ConfigurationError(
                f"'{self.name}' is to fly until {last:g} s after the first row of "
                f"'{self.setting('track_file').name}', which covers {t[-1] - t[0]:g} s\n"
                f"  fly shorter (--duration), or set an earlier {self.name}.start"
            )

    def _read(self) -> SmoothTrack:
        path: Path = self.setting("track_file")
        try:
            stat = path.stat()
            sigma = float(shared_setting(self, "position_sigma"))
            stamp = (stat.st_mtime_ns, stat.st_size)
            return _read_once(path, stamp, self.setting("earth"), sigma)
        except (OSError, ValueError) as error:
            told = getattr(error, "strerror", None)
            reason = f"'{path}': {told.lower()}" if told else str(error)
            raise ConfigurationError(
                f"'{self.name}' cannot fly its track: {reason}\n"
                f"  set {self.name}.track_file to another, or mend it"
            ) from error

    def bind(self, environment: Environment) -> None:
        """Read the track."""
        super().bind(environment)
        require_common(self)
        self._track = self._read()
        self._ahead: tuple[int, Motion] | None = None

    def _initialize_impl(self) -> None:
        self.r, self.v, self.q = self._track.at(self._times(np.zeros(1)))
        self.r_e, self.v_e, self.q_be = self.r, self.v, self.q
        self.delta_v_b = self.delta_theta_b = self.delta_v_end_b = 0.0

    def _times(self, t: FloatArray) -> FloatArray:
        track = self._track.track.t
        return np.asarray(np.minimum(t + (track[0] + self.start[0]), track[-1]))

    def _step_impl(self, t: float, dt: float) -> None:
        v_e, q_be = self._wanted(t)
        follow = follow_array[self.setting("earth")]
        told = follow(self.r[:1], self.v[:1], self.q[:1], v_e, q_be, dt)
        self.r, self.v, self.q = told[:3]
        self.r_e, self.v_e, self.q_be = told[:3]
        self.delta_v_b, self.delta_theta_b, self.delta_v_end_b = told[3:]

    def _wanted(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Velocity and attitude of the track at the end of this step, at `t` [s]."""
        rate = self.rate
        if rate is None or rate.period is None:
            now = self._track.at(self._times(np.array([t])))
            return now.v_e[0], now.q_be[0]
        block, k = divmod(self.step_index, _BLOCK)
        if self._ahead is None or self._ahead[0] != block:
            first = rate.offset or rate.period
            steps = range(block * _BLOCK, (block + 1) * _BLOCK)
            times = np.array([float(first + (step - 1) * rate.period) for step in steps])
            self._ahead = block, self._track.at(self._times(np.maximum(times, 0.0)))
        return self._ahead[1].v_e[k], self._ahead[1].q_be[k]


_BLOCK = 1024
"""Steps for which the splines are evaluated at once."""


@lru_cache(maxsize=2)
def _read_once(path: Path, _stamp: tuple[int, ...], earth: str, sigma: float) -> SmoothTrack:
    """A track as its file was at its time stamp and size, read once for check and start."""
    return SmoothTrack(read_track(path), earth, sigma)


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
    longitude = Output((), unit="rad", doc="east of Greenwich")
    height = Output((), unit="m", doc="above the ellipsoid")
    v_n = Output((3,), unit="m/s", frame="n", labels=NED, doc="velocity")
    roll = Output((), unit="rad", doc="right wing down")
    pitch = Output((), unit="rad", doc="nose up")
    heading = Output((), unit="rad", doc="from north to east")

    def build_model(self) -> Model:
        """Build the model for the chosen Earth."""
        return level_view_model(self.setting("earth"))
