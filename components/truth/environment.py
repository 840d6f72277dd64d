"""The environment of a satellite that everybody shares: how the Earth turns, Sun and Moon."""

from __future__ import annotations

from typing import ClassVar

from terrafix.components.dated import Dated, read_epoch
from terrafix.components.fields import ENVIRONMENT
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import EpochError
from terrafix.cosim.declare.ports import BundleOutput, Capabilities
from terrafix.models.core.timescales import Instant
from terrafix.models.motion.bodies import environment_at


class SpaceEnvironment(Dated):
    """How the Earth turns, and where the Sun and the Moon are, at the epoch of the system.

    By the full chain of the IAU and the tables of the IERS, alike for all members. It changes so
    slowly that it is published now and then, and turned by its readers: with s the time since
    `time`, a vector to the Sun is exp(-[omega x] s) (sun_e + s sun_rate_e). Turned over 10 s the
    axes err by 7e-14 rad, Sun and Moon by 0.30 and 0.15 m; over 60 s by 8e-13 rad, 11 and 5 m.
    """

    capabilities: ClassVar[Capabilities] = Capabilities(given=True)
    default_rate = Rate("10")

    surroundings = BundleOutput(ENVIRONMENT, doc="rotation of the Earth, Sun and Moon")

    def validate_epoch(self, epoch: str | None) -> None:
        """Look whether the tables know the epoch."""
        self._start = None
        start = read_epoch(self, epoch)
        self._look_up(start)
        self._start = start

    def validate_duration(self, duration: float) -> None:
        """Look whether the tables reach to the end of the run."""
        if self._start is not None:
            self._look_up(self._start.plus(duration))

    def _look_up(self, instant: Instant) -> None:
        try:
            environment_at(instant)
        except (ImportError, ValueError) as error:
            raise EpochError(
                f"'{self.name}' does not know the world of the run: {error}"
            ) from error

    def _publish(self, t: float) -> None:
        self.surroundings.time = t
        for name, value in environment_at(self._now(t)).items():
            setattr(self.surroundings, name, value)
