"""Playback: a recorded orbit, attitude or IMU in the place of a simulated one, on the same ports.

A result of terrafix is played sample by sample, at the times it was recorded at and to the same
bytes; an orbit file is interpolated, and so is the attitude in a file of radar echo.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from terrafix.components.dated import read_epoch
from terrafix.components.truth.attitude import LvlhAttitude
from terrafix.components.truth.orbit import OrbitTruth
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.declare.component import Component, Environment
from terrafix.cosim.declare.parameters import FilePath, Parameter, Text
from terrafix.models.core.timescales import Instant, parse_epoch
from terrafix.models.geometry.celestial import Turning
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import inertial_from_earth_fixed_array
from terrafix.models.geometry.quaternion import (
    inverse_array,
    product_array,
    rotation_vector_array,
)
from terrafix.models.motion.ephemeris import Ephemeris
from terrafix.models.motion.orbits.files import read_orbit
from terrafix.models.radar.recordings.attitude import BodyAttitude, read_body_attitude

CLOSE = 1e-9  # [s] within which two times are the same: far below any step, far above rounding


_EARTH_RATE = EARTH.rotation_rate
_UNCOVERED = "the orbit file does not cover this time"


def _time_at_start(
    component: Component, epoch: str | None, since: Callable[[Instant], float]
) -> float:
    """Time of a file at t = 0 [s]: `since` its first state at the system's epoch, or `start`."""
    start = float(component.setting("start"))
    if epoch is None:
        return start
    if start:
        raise ConfigurationError(
            f"'{component.name}.start' is {start:g} s, but the run begins at the system's epoch, "
            f"{epoch}\n  leave one of them"
        )
    now = read_epoch(component, epoch)
    try:
        return since(now)
    except (ValueError, ImportError) as error:
        raise ConfigurationError(f"'{component.name}' cannot be at {epoch}: {error}") from error


class Recording:
    """Recorded outputs of one component of an earlier run.

    Parameters
    ----------
    component : Component
        Who plays them: named in errors, its ports give the shapes.
    path : Path
        Result file (.nc).
    source : str
        Path of the component in that run.
    names : sequence of str
        Ports that are needed.
    optional : sequence of str
        Ports that are played if they were recorded.

    Raises
    ------
    ConfigurationError
        If the file cannot be read, or does not hold what is needed.
    """

    def __init__(
        self,
        component: Component,
        path: Path,
        source: str,
        names: Sequence[str],
        optional: Sequence[str] = (),
    ) -> None:
        from terrafix.cosim.records.results import read_result

        self.component, self.path = component, path
        try:
            dataset = read_result(path)
        except ConfigurationError as error:
            raise ConfigurationError(
                f"'{component.name}' cannot play its recording: {error}\n"
                "  record the original in an earlier run, and name the result it was written to"
            ) from error
        self.epoch: str | None = dataset.attrs.get("epoch")
        self.members: NDArray[np.int64] = dataset["member"].to_numpy()
        self.samples: dict[str, tuple[FloatArray, FloatArray]] = {}
        for name in (*names, *optional):
            key = f"{source}.{name}"
            found = [str(v) for v in dataset.data_vars]
            # a port may have been recorded more than once: play the one with the most samples
            records = [v for v in found if v == key or v.startswith(f"{key}@")]
            if not records:
                if name in optional:
                    continue
                raise ConfigurationError(
                    f"'{component.name}' needs '{key}', which '{path}' does not hold\n"
                    f"  {nearest(key, found, what='it holds')}"
                )
            variable = max((dataset[v] for v in records), key=len)
            shape = component.ports[name].single.fixed_shape
            if variable.shape[2:] != shape:
                raise ConfigurationError(
                    f"'{component.name}': '{key}' has shape {variable.shape[2:]} in '{path}', "
                    f"the port has {shape}"
                )
            times = dataset[str(variable.dims[0])].to_numpy()
            self.samples[name] = times, variable.to_numpy()

    def check_times(self, first: float, rate: Rate | None) -> None:
        """Raise ConfigurationError if the first steps from `first` [s] on have no samples."""
        if rate is None:
            return
        steps = list(rate.times or ())
        if rate.period is not None:
            steps += [rate.offset, rate.offset + rate.period]
        for name in self.samples:
            for t in (0.0, *map(float, steps)):
                try:
                    self._index(name, first + t)
                except ConfigurationError as error:
                    raise ConfigurationError(f"'{self.component.name}': {error}") from None

    def check_end(self, last: float) -> None:
        """Raise ConfigurationError if a port was not recorded until `last` [s]."""
        for name, (times, _) in self.samples.items():
            if times[-1] < last - CLOSE:
                raise ConfigurationError(
                    f"'{self.component.name}' is to play '{name}' until {last:g} s, but "
                    f"'{self.path.name}' ends at {times[-1]:g} s\n"
                    "  fly shorter (--duration), or record the original longer"
                )

    def since_start(self, instant: Instant) -> float:
        """Seconds from the start of the recording to an instant.

        Raises
        ------
        ValueError
            If the recording has no epoch.
        """
        if not self.epoch:
            raise ValueError(f"'{self.path.name}' was recorded without an epoch")
        return float(instant.minus(parse_epoch(self.epoch)))

    def choose(self, members: NDArray[np.int64]) -> None:
        """Keep the members that are flown; the only one of a recording serves all."""
        if len(self.members) == 1:
            return
        missing = sorted(set(members.tolist()) - set(self.members.tolist()))
        if missing:
            raise ConfigurationError(
                f"'{self.component.name}': '{self.path}' does not hold member {missing[0]}\n"
                "  record one member (it serves all), or every member that is flown"
            )
        order = np.argsort(self.members)
        rows = order[np.searchsorted(self.members, members, sorter=order)]
        self.samples = {n: (times, values[:, rows]) for n, (times, values) in self.samples.items()}

    def publish(self, t: float) -> None:
        """Put the samples of time `t` [s] on the component's ports; a member without one fails."""
        component = self.component
        for name in self.samples:
            sample = self.samples[name][1][self._index(name, t)]
            setattr(component, name, sample)
            finite = np.isfinite(sample).reshape(len(sample), -1).all(axis=1)
            if not finite.all():
                component.fail(np.broadcast_to(~finite, component.n_members), "was not recorded")

    def _index(self, name: str, t: float) -> int:
        times = self.samples[name][0]
        k = int(np.searchsorted(times, t - CLOSE))
        if k == len(times) or abs(times[k] - t) > CLOSE:
            span = f"from {times[0]:g} s to {times[-1]:g} s" if len(times) else "of no time"
            raise ConfigurationError(
                f"'{self.path.name}' has no sample of '{name}' at {t:g} s; it has {len(times)}, "
                f"{span}\n  record the original whenever it steps, and play it at the same rate"
            )
        return k


def last_step(rate: Rate | None, duration: float) -> float:
    """Time of the last step within a run [s]; 0 if there is none."""
    if rate is None:
        return 0.0
    if rate.times is not None:
        return max((float(t) for t in rate.times if t <= duration), default=0.0)
    assert rate.period is not None
    period, offset = float(rate.period), float(rate.offset)
    if duration < offset:
        return 0.0
    return offset + math.floor((duration - offset) / period + CLOSE) * period


class RecordedOrbit(Component):
    """A satellite's real or earlier orbit, on the ports of `orbit`.

    From an orbit file of others (OEM, SP3-c, SP3-d, EOF, table, NISAR's HDF5, a leader of CEOS),
    whose states are interpolated to the eighth order, or from a result of terrafix (.nc), played
    sample by sample.
    A run begins at the system's epoch, or where it has none `start` after the first state. What a
    file does not hold is supplied: `delta_v_e` is zero; inertial axes are GCRF in a system with an
    epoch, else the Earth-fixed ones of t = 0 turned by `earth_angle0`.
    """

    default_rate = Rate(hz=100)

    orbit_file = FilePath(doc="orbit file (OEM, SP3, .EOF, .csv, .h5, LED-) or result (.nc)")
    source = Text("orbit", doc="path of the component whose outputs are played (.nc)")
    satellite = Text("", doc="which, in a file of several (OEM, SP3)")
    start = Parameter(
        0.0, unit="s", minimum=0.0, doc="t = 0, after the first state or start (without an epoch)"
    )
    interpolation_error = Parameter(
        1.0, unit="m", positive=True, doc="of positions, up to which states may lie apart"
    )
    rotation_rate = Parameter(EARTH.rotation_rate, unit="rad/s", doc="Earth rotation")
    earth_angle0 = Parameter(0.0, unit="rad", doc="inertial to Earth-fixed x axis at t = 0")

    r_i = OrbitTruth.r_i
    v_i = OrbitTruth.v_i
    r_e = OrbitTruth.r_e
    v_e = OrbitTruth.v_e
    delta_v_e = OrbitTruth.delta_v_e

    _epoch: str | None = None

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect on a file of this kind."""
        path: Path | None = self.given_parameters.get("orbit_file")
        if path is None:
            return super().takes(name)
        played = path.suffix == ".nc"
        if name == "source":
            return played
        return super().takes(name) and not (played and name in ("satellite", "interpolation_error"))

    @property
    def _path(self) -> Path:
        path: Path = self.setting("orbit_file")
        return path

    def validate(self) -> None:
        """Read the file."""
        self._read()

    def validate_epoch(self, epoch: str | None) -> None:
        """Look whether the file covers the epoch of the system."""
        self._epoch = epoch
        if epoch is None:
            return
        for name in ("rotation_rate", "earth_angle0"):
            if not self.is_default(name):
                raise ConfigurationError(
                    f"'{self.name}.{name}' is of axes that turn uniformly; in a system with the "
                    f"epoch '{epoch}' inertial axes are those of GCRF\n  leave one of them out"
                )
        self._check_span(0.0)

    def validate_duration(self, duration: float) -> None:
        """Look whether the file covers the run."""
        self._check_span(last_step(self.rate, duration))

    def _read(self) -> Ephemeris | Recording:
        path = self._path
        hint = f"set {self.name}.orbit_file, or TERRAFIX_DATA to the folder with the data"
        if not path.is_file():
            what = "is a folder" if path.is_dir() else "is not there"
            raise ConfigurationError(
                f"'{self.name}' needs the orbit file '{path}', which {what}\n  {hint}"
            )
        start = float(self.setting("start"))
        if path.suffix == ".nc":
            optional = ("r_i", "v_i", "delta_v_e")
            recording = Recording(self, path, self.setting("source"), ("r_e", "v_e"), optional)
            recording.check_times(start, self.rate)
            return recording
        try:
            stat = path.stat()
            stamp = (stat.st_mtime_ns, stat.st_size)
            ephemeris = _read_once(path, stamp, self.setting("satellite"))
        except (OSError, ValueError, ImportError) as error:
            raise ConfigurationError(
                f"'{self.name}' cannot read its orbit file: {error}\n  {hint}"
            ) from error
        if start >= ephemeris.t[-1]:
            raise ConfigurationError(
                f"'{self.name}.start' is {start:g} s, but '{path.name}' covers "
                f"{ephemeris.t[-1]:g} s from {ephemeris.tags[0]} {ephemeris.scale}"
            )
        return ephemeris

    def _first(self, orbit: Ephemeris | Recording, epoch: str | None) -> float:
        """Time of the file at t = 0 [s]: of the epoch, or `start`."""
        since = orbit.since_start if isinstance(orbit, Recording) else orbit.since_first
        return _time_at_start(self, epoch, since)

    def _check_span(self, flown: float) -> None:
        """Look whether the file covers a run of `flown` [s], without a gap and densely enough."""
        try:
            orbit = self._read()
        except ConfigurationError:
            return  # `validate` says so
        first = self._first(orbit, self._epoch)
        last = first + flown
        if isinstance(orbit, Recording):
            orbit.check_times(first, self.rate)
            orbit.check_end(last)
            return
        name = self._path.name
        if self._epoch is not None and not 0.0 <= first <= last <= orbit.t[-1]:
            raise ConfigurationError(
                f"'{self.name}' is to play {flown:g} s from {self._epoch} on, but '{name}' covers "
                f"{orbit.tag(0.0)} to {orbit.tag(float(orbit.t[-1]))}\n"
                "  set another epoch, fly shorter (--duration), or use another file"
            )
        if last > orbit.t[-1]:
            raise ConfigurationError(
                f"'{self.name}' is to play until {last:g} s after the first state of "
                f"'{name}', which covers {orbit.t[-1]:g} s\n"
                f"  fly shorter (--duration), or set an earlier {self.name}.start"
            )
        gap = orbit.gap_within(first, last)
        if gap is not None:
            raise ConfigurationError(
                f"'{self.name}' is to play from {first:g} s to {last:g} s after the first state of "
                f"'{name}', which has none between {gap[0]:g} s and {gap[1]:g} s "
                f"({orbit.tag(gap[0])} to {orbit.tag(gap[1])})\n"
                "  fly before or after that gap, or use another file"
            )
        error, most = orbit.error(first, last), float(self.setting("interpolation_error"))
        if error > most:
            raise ConfigurationError(
                f"'{self.name}' interpolates the states of '{name}' to {error:.2g} m, and "
                f"{self.name}.interpolation_error is {most:g} m\n"
                "  use a file with states closer to each other, or with velocities, or allow more"
            )

    def bind(self, environment: Environment) -> None:
        """Read the file."""
        super().bind(environment)
        self._orbit = self._read()
        if isinstance(self._orbit, Recording):
            self._orbit.choose(environment.members)

    def _initialize_impl(self) -> None:
        own = (self.start, self.earth_angle0, self.rotation_rate)
        alike = all(np.ptp(p) == 0.0 for p in own)
        if isinstance(self._orbit, Recording):
            if np.ptp(self.start) != 0.0:
                raise ConfigurationError(
                    f"'{self.name}.start' differs between members: a recording is played for all "
                    "from one time\n  disperse it with an orbit file, which is interpolated"
                )
            alike = alike and len(self._orbit.members) == 1
        epoch = self.environment.epoch
        self._turning = None if epoch is None else Turning(parse_epoch(epoch))
        since = 0.0 if epoch is None else self._first(self._orbit, epoch)
        self._begin = self.start + since
        # compute once for all members unless they differ
        self._who = slice(0, 1) if alike else slice(None)
        self._publish(0.0)

    def _step_impl(self, t: float, dt: float) -> None:
        self._publish(t)

    def _publish(self, t: float) -> None:
        held: Mapping[str, Any] = {}
        if isinstance(self._orbit, Recording):
            self._orbit.publish(float(self._begin[0]) + t)
            held = self._orbit.samples
        else:
            self._interpolate(self._orbit, self._begin[self._who] + t)
        if "r_i" not in held or "v_i" not in held:
            self._publish_inertial(t)
        if "delta_v_e" not in held:
            self.delta_v_e = 0.0

    def _publish_inertial(self, t: float) -> None:
        """Inertial states of the Earth-fixed ones: GCRF at an epoch, else of uniform rotation."""
        r_e, v_e = self.r_e[self._who], self.v_e[self._who]
        if self._turning is not None:
            C, omega = self._turning.at(t)
            self.r_i, self.v_i = r_e @ C, (v_e + np.cross(omega, r_e)) @ C
            return
        rate = self.rotation_rate[self._who]
        angle = self.earth_angle0[self._who] + rate * t
        self.r_i, self.v_i = inertial_from_earth_fixed_array(r_e, v_e, angle, rate)

    def _interpolate(self, orbit: Ephemeris, wanted: FloatArray) -> None:
        """Publish states at times of the file [s], of all members or one for all."""
        uncovered = ~orbit.covers(wanted)
        if uncovered.any():
            self.fail(np.broadcast_to(uncovered, self.n_members), _UNCOVERED)
            wanted = np.where(uncovered, orbit.t[np.argmax(orbit.known)], wanted)
        self.r_e, self.v_e = orbit.at(wanted)


@lru_cache(maxsize=2)
def _read_once(path: Path, _stamp: tuple[int, ...], satellite: str) -> Ephemeris:
    """An orbit file as it was at its time stamp and size, read once for check and start."""
    return read_orbit(path, satellite)


class Playback(Component):
    """Base of playbacks of one component's outputs from a terrafix result."""

    result_file = FilePath(doc="result of an earlier run (.nc)")
    source = Text(doc="path of the component in that run whose outputs are played")
    recorded: ClassVar[tuple[str, ...]] = ()

    def validate(self) -> None:
        """Read the file and find what is needed in it."""
        self._read()

    def validate_duration(self, duration: float) -> None:
        """Read the file and look whether it covers the run."""
        self._read().check_end(last_step(self.rate, duration))

    def _read(self) -> Recording:
        recording = Recording(
            self, self.setting("result_file"), self.setting("source"), self.recorded
        )
        recording.check_times(0.0, self.rate)
        return recording

    def bind(self, environment: Environment) -> None:
        """Read the recording of the members that are flown."""
        super().bind(environment)
        self._recording = self._read()
        self._recording.choose(environment.members)

    def _initialize_impl(self) -> None:
        self._recording.publish(0.0)

    def _step_impl(self, t: float, dt: float) -> None:
        self._recording.publish(t)


class RecordedAttitude(Playback):
    """A recorded attitude, on the ports of `lvlh_attitude`.

    From a result of terrafix (.nc), played sample by sample, or from a file of radar echo that
    holds the attitude of its antenna (NISAR's HDF5, CEOS's leader), between whose times the body
    turns evenly. A run begins at the system's epoch, or where it has none `start` after the first
    state of the orbit in that file, as that of `recorded_orbit` does. Body axes are those in which
    the antenna looks `look` off nadir, across the track.
    """

    default_rate = Rate(hz=100)
    recorded = ("q_be", "delta_v_b", "delta_theta_b")

    result_file = FilePath(doc="result of an earlier run (.nc), or file of radar echo (.h5, CEOS)")
    source = Text("attitude", doc="path of the component whose outputs are played (.nc)")
    start = Parameter(
        0.0, unit="s", minimum=0.0, doc="t = 0, after the first state (echo, without an epoch)"
    )
    look = Parameter(
        np.inf,
        unit="rad",
        infinite=True,
        doc="off-nadir angle that the antenna is mounted at, positive to the right (echo)",
    )

    q_be = LvlhAttitude.q_be
    delta_v_b = LvlhAttitude.delta_v_b
    delta_theta_b = LvlhAttitude.delta_theta_b

    _epoch: str | None = None
    _body: BodyAttitude | None = None

    @property
    def _played(self) -> bool:
        path: Path = self.setting("result_file")
        return path.suffix == ".nc"

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect on a file of this kind."""
        path: Path | None = self.given_parameters.get("result_file")
        if path is not None and name in ("source", "start", "look"):
            return (path.suffix == ".nc") == (name == "source")
        return super().takes(name)

    def validate(self) -> None:
        """Read the file and find what is needed in it."""
        if self._played:
            super().validate()
        else:
            self._read_body()

    def validate_epoch(self, epoch: str | None) -> None:
        """Take the epoch of the system."""
        self._epoch = epoch

    def validate_duration(self, duration: float) -> None:
        """Read the file and look whether it covers the run."""
        if self._played:
            super().validate_duration(duration)
            return
        body = self._read_body()
        first = self._first(body, self._epoch)
        for t in (0.0, last_step(self.rate, duration)):
            self._attitude(body, first + t)

    def bind(self, environment: Environment) -> None:
        """Read the file."""
        if self._played:
            super().bind(environment)
            return
        Component.bind(self, environment)
        self._body = self._read_body()

    def _read_body(self) -> BodyAttitude:
        path: Path = self.setting("result_file")
        look = float(self.setting("look"))
        if np.isinf(look):
            raise ConfigurationError(
                f"'{self.name}' reads the attitude of an antenna from '{path.name}', and is not "
                f"told how it is mounted\n  set {self.name}.look, as that of the radar"
            )
        try:
            return read_body_attitude(path, look)
        except (OSError, ValueError, ImportError) as error:
            raise ConfigurationError(
                f"'{self.name}' cannot read its attitude: {error}\n"
                f"  set {self.name}.result_file and {self.name}.look, or TERRAFIX_DATA to the "
                "folder with the data"
            ) from error

    def _first(self, body: BodyAttitude, epoch: str | None) -> float:
        """Time of t = 0 since the first state of the orbit [s]."""
        return _time_at_start(self, epoch, body.orbit.since_first)

    def _attitude(self, body: BodyAttitude, t: float) -> FloatArray:
        try:
            return body.at(t)
        except ValueError as error:
            path: Path = self.setting("result_file")
            raise ConfigurationError(
                f"'{self.name}' cannot play '{path.name}': {error}\n"
                f"  fly within that (--duration), or set {self.name}.start"
            ) from error

    def _initialize_impl(self) -> None:
        if self._body is None:
            super()._initialize_impl()
            return
        self._begin = self._first(self._body, self.environment.epoch)
        self.q_be = self._attitude(self._body, self._begin)
        self.delta_v_b = self.delta_theta_b = 0.0

    def _step_impl(self, t: float, dt: float) -> None:
        if self._body is None:
            super()._step_impl(t, dt)
            return
        now = self._begin + t
        last, q = (self._attitude(self._body, at) for at in (max(now - dt, self._begin), now))
        turn = np.array([0.0, 0.0, np.sin(_EARTH_RATE * dt / 2), np.cos(_EARTH_RATE * dt / 2)])
        moved = product_array(product_array(q, turn), inverse_array(last))
        self.q_be, self.delta_theta_b = q, rotation_vector_array(moved)
        self.delta_v_b = 0.0
