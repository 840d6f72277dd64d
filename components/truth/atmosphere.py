"""The air that a satellite flies through, by MSIS."""

from __future__ import annotations

from typing import Any

import numpy as np

from terrafix.components.fields import AIR, XYZ
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter, Text
from terrafix.cosim.declare.ports import BundleOutput, Input
from terrafix.models.motion.air import air_about


class Atmosphere(Component):
    """Density about a satellite by MSIS 2.1, from the indices of solar and geomagnetic activity.

    Between publications its reader takes the logarithm of the density to be linear in radius and
    direction. Indices are given, never looked up: no run depends on what a server had that day.
    """

    default_rate = Rate("10")

    epoch = Text(doc='UTC at t = 0: "2022-09-18T07:49:21 UTC"')
    f107 = Parameter(positive=True, doc="solar flux at 10.7 cm of the day before [1e-22 W/m^2/Hz]")
    f107a = Parameter(positive=True, doc="its mean over 81 days [1e-22 W/m^2/Hz]")
    ap = Parameter(minimum=0.0, doc="daily index of geomagnetic activity")

    r_e = Input((3,), unit="m", frame="e", labels=XYZ, doc="position")
    air = BundleOutput(AIR, doc="density about it")

    def validate(self) -> None:
        """Read the epoch, and look whether MSIS is installed."""
        self._start()
        try:
            air_about([7e6, 0, 0], self._start(), 100.0, 100.0, 4.0)
        except ImportError as error:
            raise ConfigurationError(f"'{self.name}': {error}") from error

    def _start(self) -> np.datetime64:
        text = str(self.setting("epoch"))
        words = text.split()
        start: np.datetime64[Any]
        try:
            start = np.datetime64(words[0].removesuffix("Z"), "ns")
        except (ValueError, IndexError):
            start = np.datetime64("NaT", "ns")
        if np.isnat(start) or words[1:] not in ([], ["UTC"]):
            raise ConfigurationError(
                f"'{self.name}.epoch' is '{text}', which is no date in UTC\n"
                '  write it as "2022-09-18T07:49:21 UTC"'
            )
        return start

    def _initialize_impl(self) -> None:
        self._publish(0.0)

    def _step_impl(self, t: float, dt: float) -> None:
        self._publish(t)

    def _publish(self, t: float) -> None:
        now = self._start() + np.timedelta64(round(t * 1e9), "ns")
        density, gradient = air_about(self.r_e, now, self.f107, self.f107a, self.ap)
        self.air.r_e[:] = self.r_e
        self.air.log_density[:] = density
        self.air.gradient[:] = gradient
        self.fail(~np.isfinite(density), "MSIS has no density there")
