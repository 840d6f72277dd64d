"""The air that a satellite flies through, by MSIS."""

from __future__ import annotations

import numpy as np

from terrafix.components.dated import Dated, read_epoch
from terrafix.components.fields import AIR, XYZ
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, EpochError
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import BundleOutput, Input
from terrafix.models.motion.air import air_about
from terrafix.models.motion.epochs import utc_tag


class Atmosphere(Dated):
    """Density about a satellite by MSIS 2.1, from the indices of solar and geomagnetic activity.

    Between publications its reader takes the logarithm of the density to be linear in radius and
    direction. Indices are given, never looked up: no run depends on what a server had that day.
    """

    default_rate = Rate("10")

    f107 = Parameter(positive=True, doc="solar flux at 10.7 cm of the day before [1e-22 W/m^2/Hz]")
    f107a = Parameter(positive=True, doc="its mean over 81 days [1e-22 W/m^2/Hz]")
    ap = Parameter(minimum=0.0, doc="daily index of geomagnetic activity")

    r_e = Input((3,), unit="m", frame="e", labels=XYZ, doc="position")
    air = BundleOutput(AIR, doc="density about it")

    def validate_epoch(self, epoch: str | None) -> None:
        """Look whether the date is known, and MSIS installed."""
        self._start = read_epoch(self, epoch)
        try:
            air_about([7e6, 0, 0], utc_tag(self._start), 100.0, 100.0, 4.0)
        except ValueError as error:
            raise EpochError(f"'{self.name}': {error}") from error
        except ImportError as error:
            raise ConfigurationError(f"'{self.name}': {error}") from error

    def _publish(self, t: float) -> None:
        now = utc_tag(self._now(t))
        density, gradient = air_about(self.r_e, now, self.f107, self.f107a, self.ap)
        self.air.r_e[:] = self.r_e
        self.air.log_density[:] = density
        self.air.gradient[:] = gradient
        self.fail(~np.isfinite(density), "MSIS has no density there")
