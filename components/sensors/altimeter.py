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
from terrafix.models.maps.charts import ORIGIN, geodetic_of
from terrafix.models.maps.dem import Dem, dem_from
from terrafix.models.motion.strapdown import EARTHS
from terrafix.models.sensors.altimeter import altimeter_model

_POLE = np.pi / 2


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


class RadarAltimeter(Component):
    """Radar altimeter: how far the ground of an elevation model is below, with white noise.

    Heights of the model count from where those of the flight do: the ellipsoid, or the ground of a
    flat Earth.
    """

    default_rate = Rate("1", offset="1")

    on = Flag(True, doc="whether it measures")
    earth = Choice(EARTHS, "wgs84", doc="that of the motion")
    sigma = Parameter(5.0, unit="m", positive=True, doc="white noise")
    latitude0 = Parameter(0.0, unit="rad", minimum=-_POLE, maximum=_POLE, doc="origin (flat)")
    longitude0 = Parameter(
        0.0, unit="rad", minimum=-2 * np.pi, maximum=2 * np.pi, doc="origin (flat)"
    )

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    height = SharedInput(**HEIGHT, doc="heights of the ground")
    grid = SharedInput(**GRID, doc="where they lie")
    fix = MessageOutput(fields=CLEARANCE_FIX, doc="measured clearance")

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect: an origin has on a flat Earth alone."""
        return super().takes(name) and (name not in ORIGIN or self.setting("earth") == "flat")

    def _initialize_impl(self) -> None:
        require_earth(self, self.setting("earth"), self.r_e)
        if self.on:
            self._clearance("at t = 0")

    def _step_impl(self, t: float, dt: float) -> None:
        if not self.on:
            return
        clearance = self._clearance(f"at t = {t:g} s")
        y = np.nan_to_num(clearance) + self.sigma * self.normals("noise", 1)[:, 0]
        self.fix.publish(
            t, y=y[:, None], R=(self.sigma**2)[:, None, None], present=np.ones((self.n_members, 1))
        )

    def _clearance(self, when: str) -> FloatArray:
        """True clearance (n_members,) [m]; members that are off the map, or below it, fail."""
        where = geodetic_of(self.r_e, self.setting("earth"), (self.latitude0, self.longitude0))
        dem = dem_from(self.height, self.grid)
        clearance = np.asarray(where[2] - dem.known_at(*where[:2]))
        self._check_track(clearance, where, dem, when)
        return clearance

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
