"""Playback: a recorded orbit, attitude or IMU in the place of a simulated one, on the same ports."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from terrafix.components.attitude import LvlhAttitude
from terrafix.components.imu import Imu
from terrafix.components.orbit import OrbitTruth
from terrafix.cosim.clock import Rate
from terrafix.cosim.component import Component, Environment
from terrafix.cosim.errors import ConfigurationError, nearest
from terrafix.cosim.parameters import FilePath, Parameter, Text
from terrafix.cosim.ports import Output
from terrafix.models.earth import EARTH
from terrafix.models.ephemeris import Ephemeris, read_eof
from terrafix.models.frames import inertial_from_earth_fixed_array

FloatArray = NDArray[np.float64]


class RecordedOrbit(Component):
    """A satellite's real orbit from a Sentinel-1 orbit file (.EOF), on the ports of `orbit`.

    States every 10 s are interpolated by cubic Hermite polynomials. The file says nothing of
    non-gravitational forces: `delta_v_e` is zero. Inertial axes are the Earth-fixed ones of
    t = 0 turned by `earth_angle0`.
    """

    default_rate = Rate(hz=100)

    orbit_file = FilePath(doc="Sentinel-1 restituted or precise orbit file (.EOF)")
    start = Parameter(0.0, unit="s", minimum=0.0, doc="t = 0, after the file's first state")
    rotation_rate = Parameter(EARTH.rotation_rate, unit="rad/s", doc="Earth rotation")
    earth_angle0 = Parameter(0.0, unit="rad", doc="inertial to Earth-fixed x axis at t = 0")

    r_i = OrbitTruth.r_i
    v_i = OrbitTruth.v_i
    r_e = OrbitTruth.r_e
    v_e = OrbitTruth.v_e
    delta_v_e = OrbitTruth.delta_v_e

    def validate(self) -> None:
        """Read the file."""
        self._ephemeris()

    def _ephemeris(self) -> Ephemeris:
        path: Path = self.setting("orbit_file")
        try:
            ephemeris = read_eof(path)
        except FileNotFoundError:
            raise ConfigurationError(
                f"'{self.name}' needs the orbit file '{path}', which is not there\n"
                f"  set {self.name}.orbit_file, or TERRAFIX_DATA to the folder with the data"
            ) from None
        except (OSError, ValueError) as error:
            raise ConfigurationError(
                f"'{self.name}' cannot read its orbit file: {error}"
            ) from error
        start = float(self.setting("start"))
        if start >= ephemeris.t[-1]:
            raise ConfigurationError(
                f"'{self.name}.start' is {start:g} s, but '{path.name}' covers "
                f"{ephemeris.t[-1]:g} s from {ephemeris.utc[0]} UTC"
            )
        return ephemeris

    def bind(self, environment: Environment) -> None:
        """Read the file."""
        super().bind(environment)
        self._orbit = self._ephemeris()
        # interpolate once for all members unless they differ in the time or angle they start at
        alike = all(np.ptp(p) == 0.0 for p in (self.start, self.earth_angle0, self.rotation_rate))
        self._who = slice(0, 1) if alike else slice(None)

    def _initialize_impl(self) -> None:
        self._publish(0.0)

    def _step_impl(self, t: float, dt: float) -> None:  # noqa: ARG002 - the instant alone counts
        self._publish(t)

    def _publish(self, t: float) -> None:
        rate = self.rotation_rate[self._who]
        r_e, v_e = self._orbit.at(self.start[self._who] + t)
        angle = self.earth_angle0[self._who] + rate * t
        r_i, v_i = inertial_from_earth_fixed_array(r_e, v_e, angle, rate)
        self.r_e, self.v_e, self.r_i, self.v_i = r_e, v_e, r_i, v_i
        self.delta_v_e = 0.0


class _Recording(Component):
    """Base of playbacks of terrafix results: publishes recorded outputs at their recorded times."""

    result_file = FilePath(doc="result of an earlier run (.nc)")
    source = Text(doc="path of the component in that run whose outputs are played")
    recorded: ClassVar[tuple[str, ...]] = ()

    def validate(self) -> None:
        """Read the file and find what is needed in it."""
        self._load(None)

    def _load(self, members: NDArray[np.int64] | None) -> tuple[FloatArray, dict[str, Any]]:
        from terrafix.cosim.results import read_result

        path, source = self.setting("result_file"), self.setting("source")
        dataset = read_result(path)
        arrays, times = {}, np.empty(0)
        for name in self.recorded:
            key = f"{source}.{name}"
            if key not in dataset:
                found = [str(v) for v in dataset.data_vars]
                raise ConfigurationError(
                    f"'{self.name}' needs '{key}', which '{path}' does not hold\n"
                    f"  {nearest(key, found, what='it holds')}"
                )
            variable = dataset[key]
            shape = self.ports[name].single.fixed_shape
            if variable.shape[2:] != shape:
                raise ConfigurationError(
                    f"'{self.name}': '{key}' has shape {variable.shape[2:]} in '{path}', "
                    f"the port has {shape}"
                )
            times = dataset[str(variable.dims[0])].to_numpy()
            values = variable.to_numpy()
            if members is not None and values.shape[1] > 1:
                numbers = dataset["member"].to_numpy()
                missing = sorted(set(members.tolist()) - set(numbers.tolist()))
                if missing:
                    raise ConfigurationError(
                        f"'{self.name}': '{path}' does not hold member {missing[0]}\n"
                        "  record one member (it serves all), or every member that is flown"
                    )
                values = values[:, np.searchsorted(numbers, members)]
            arrays[name] = values
        return times, arrays

    def bind(self, environment: Environment) -> None:
        """Read the recording of the members that are flown."""
        super().bind(environment)
        self._times, self._arrays = self._load(environment.members)

    def _initialize_impl(self) -> None:
        self._publish(0.0)

    def _step_impl(self, t: float, dt: float) -> None:  # noqa: ARG002 - the instant alone counts
        self._publish(t)

    def _publish(self, t: float) -> None:
        k = int(np.searchsorted(self._times, t - 1e-9))
        if k == len(self._times) or abs(self._times[k] - t) > 1e-9:
            raise ConfigurationError(
                f"the recording has no sample at {t:g} s\n"
                "  record the original whenever it steps, and play it at the same rate"
            )
        for name, values in self._arrays.items():
            self._views[name][...] = values[k]


class RecordedAttitude(_Recording):
    """A recorded attitude, on the ports of `lvlh_attitude`."""

    default_rate = Rate(hz=100)
    recorded = ("q_be", "delta_v_b", "delta_theta_b")

    q_be = LvlhAttitude.q_be
    delta_v_b = LvlhAttitude.delta_v_b
    delta_theta_b = LvlhAttitude.delta_theta_b


class RecordedImu(_Recording):
    """Recorded increments of an inertial sensor, on the ports of `imu`."""

    default_rate = Rate(hz=100)
    recorded = ("delta_v_b", "delta_theta_b")

    delta_v_b: Output = Imu.delta_v_b
    delta_theta_b: Output = Imu.delta_theta_b
