"""Altimeters: height by air pressure, and the clearance that a radar measures over the ground."""

from __future__ import annotations

import numpy as np

from terrafix.components.fields import CLEARANCE_FIX, GRID, HEIGHT, HEIGHT_FIX
from terrafix.components.noisy import NoisyComponent
from terrafix.components.shared import require_earth
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Flag, Parameter
from terrafix.cosim.declare.ports import Input, MessageOutput, Output, SharedInput
from terrafix.models.core.model import Model
from terrafix.models.geometry.quaternion import rotation_matrix_array
from terrafix.models.maps.charts import ORIGIN, geodetic_of, level_axes_of
from terrafix.models.maps.dem import Dem, dem_from
from terrafix.models.motion.strapdown import EARTHS
from terrafix.models.sensors.altimeter import altimeter_model
from terrafix.models.sensors.barometer import SEA_LEVEL, barometer_model
from terrafix.models.sensors.radar_altimeter import WIDEST, nearest_return

_POLE = np.pi / 2
POINTINGS = ("vertical", "body")
"""Whether the axis of a beam is held vertical, or turns with the body."""


class Altimeter(NoisyComponent):
    """Barometric altimeter: height with a bias that wanders, and white noise."""

    default_rate = Rate("1", offset="1")

    earth = Choice(EARTHS, "wgs84", doc="that of the motion; heights above its ellipsoid or ground")
    sigma = Parameter(1.0, unit="m", minimum=0.0, doc="white noise")
    bias_sigma = Parameter(0.8, unit="m", minimum=0.0, doc="of the bias")
    bias_time = Parameter(100.0, unit="s", positive=True, doc="correlation of the bias")

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    fix = MessageOutput(fields=HEIGHT_FIX, doc="measured height")
    bias = Output((1,), unit="m", doc="true bias")

    def _initialize_impl(self) -> None:
        require_earth(self, self.setting("earth"), self.r_e)
        super()._initialize_impl()

    def build_model(self) -> Model:
        """Build the model for the chosen Earth."""
        return altimeter_model(self.setting("earth"))


class Barometer(NoisyComponent):
    """Barometer: the air's pressure on a day of its own, and the height that it means.

    Height is that of the standard atmosphere for the pressure read, as an altimeter set to
    1013.25 hPa tells it: the day's pressure and temperature are in it as errors that last, which
    the variance of a fix does not hold.
    """

    default_rate = Rate("1", offset="1")

    earth = Choice(EARTHS, "wgs84", doc="that of the motion; heights above its ellipsoid or ground")
    sea_level_pressure = Parameter(SEA_LEVEL[0], unit="Pa", positive=True, doc="of the day")
    temperature_offset = Parameter(
        0.0, unit="K", minimum=-60.0, maximum=60.0, doc="of the day, to the standard atmosphere"
    )
    sigma = Parameter(5.0, unit="Pa", minimum=0.0, doc="white noise")
    bias_sigma = Parameter(0.0, unit="Pa", minimum=0.0, doc="of the bias, drawn at the start")
    scale_sigma = Parameter(0.0, minimum=0.0, doc="of the scale factor error, drawn at the start")
    drift = Parameter(0.0, unit="Pa/s^0.5", minimum=0.0, doc="random walk of sensor and weather")

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    pressure = Output((), unit="Pa", doc="measured")
    fix = MessageOutput(fields=HEIGHT_FIX, doc="height of the standard atmosphere")

    def _initialize_impl(self) -> None:
        require_earth(self, self.setting("earth"), self.r_e)
        super()._initialize_impl()

    def build_model(self) -> Model:
        """Build the model for the chosen Earth."""
        return barometer_model(self.setting("earth"))


class RadarAltimeter(Component):
    """Radar altimeter: how far the ground of an elevation model is below, with white noise.

    With a beam of some half-angle, the distance to the nearest ground in it, straight below or
    about an axis of the body; without one, the clearance. No fix comes where the beam meets no
    ground.

    Heights of the model count from where those of the flight do: the ellipsoid, or the ground of a
    flat Earth.
    """

    default_rate = Rate("1", offset="1")

    on = Flag(True, doc="whether it measures")
    earth = Choice(EARTHS, "wgs84", doc="that of the motion")
    sigma = Parameter(5.0, unit="m", positive=True, doc="white noise")
    half_angle = Parameter(
        0.0, unit="rad", minimum=0.0, maximum=WIDEST, doc="of the beam; 0: straight down alone"
    )
    pointing = Choice(POINTINGS, "vertical", doc="axis of the beam: held vertical, or body z")
    latitude0 = Parameter(0.0, unit="rad", minimum=-_POLE, maximum=_POLE, doc="origin (flat)")
    longitude0 = Parameter(
        0.0, unit="rad", minimum=-2 * np.pi, maximum=2 * np.pi, doc="origin (flat)"
    )

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude, e to body (body)")
    height = SharedInput(**HEIGHT, doc="heights of the ground")
    grid = SharedInput(**GRID, doc="where they lie")
    fix = MessageOutput(fields=CLEARANCE_FIX, doc="measured clearance")

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect: an origin has on a flat Earth alone."""
        return super().takes(name) and (name not in ORIGIN or self.setting("earth") == "flat")

    def prepare(self) -> None:
        """Keep the attitude among the inputs where the beam is fixed to the body."""
        if self.setting("pointing") != "body":
            self.ports = {n: p for n, p in self.ports.items() if n != "q_be"}

    def validate(self) -> None:
        """Check that a beam that is fixed to the body has a width."""
        if self.setting("pointing") == "body" and not float(self.setting("half_angle")) > 0.0:
            raise ConfigurationError(
                f"'{self.name}' points with the body, but its beam has no width\n"
                f"  set {self.name}.half_angle, or {self.name}.pointing = vertical"
            )

    def _initialize_impl(self) -> None:
        require_earth(self, self.setting("earth"), self.r_e)
        if self.on:
            self._clearance("at t = 0")

    def _step_impl(self, t: float, dt: float) -> None:
        if not self.on:
            return
        clearance = self._clearance(f"at t = {t:g} s")
        seen = ~np.isinf(clearance)
        y = np.nan_to_num(clearance, posinf=0.0) + self.sigma * self.normals("noise", 1)[:, 0]
        self.fix.publish(
            t,
            valid=seen,
            y=y[:, None],
            R=(self.sigma**2)[:, None, None],
            present=np.ones((self.n_members, 1)),
        )

    def _clearance(self, when: str) -> FloatArray:
        """True clearance (n_members,) [m]; members that are off the map, or below it, fail."""
        where = geodetic_of(self.r_e, self.setting("earth"), (self.latitude0, self.longitude0))
        dem = dem_from(self.height, self.grid)
        below = np.asarray(where[2] - dem.known_at(*where[:2]))
        if not self.half_angle.any():
            self._check_track(below, where, dem, when)
            return below
        flat = self.setting("earth") == "flat"
        nearest = nearest_return(dem, where, self.half_angle, self._axis_n(), flat=flat)
        self._check_track(np.where(np.isnan(nearest), np.nan, below), where, dem, when)
        return nearest

    def _axis_n(self) -> FloatArray:
        """Axis of the beam: north, east, down, (n_members, 3)."""
        down = np.zeros((self.n_members, 3))
        down[:, 2] = 1.0
        if self.setting("pointing") == "vertical":
            return down
        axis_e = np.einsum("kji,kj->ki", rotation_matrix_array(self.q_be), down)
        level = level_axes_of(self.r_e, self.setting("earth"))
        return np.asarray(np.einsum("kij,kj->ki", level, axis_e))

    def _check_track(
        self, clearance: FloatArray, where: tuple[FloatArray, ...], dem: Dem, when: str
    ) -> None:
        """Fail members that are where no ground is known, or below it: the run, if all are."""
        active = self.environment.active
        latitude, longitude, height = where
        for wrong, told in (
            (np.isnan(clearance), f"where no ground is known: it is {dem.described()}"),
            (clearance < 0.0, "below the ground"),
        ):
            wrong &= active
            if not wrong.any():
                continue
            k = int(np.argmax(wrong))
            place = f"{np.degrees(latitude[k]):.4f}, {np.degrees(longitude[k]):.4f} deg"
            ground = "" if np.isnan(clearance[k]) else f" of {height[k] - clearance[k]:.0f} m"
            text = (
                f"'{self.name}' is {when} at {place} (latitude, longitude) and {height[k]:.0f} m, "
                f"{told}{ground}"
            )
            if wrong[active].all():
                raise ConfigurationError(
                    f"{text}\n  use an elevation model of the track, or fly elsewhere; heights of "
                    "both count from one datum"
                )
            self.fail(wrong, text)
