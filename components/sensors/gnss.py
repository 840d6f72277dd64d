"""GNSS receiver: position and velocity, until nothing is received, or something false."""

from __future__ import annotations

from terrafix.components.fields import GNSS_FIX, XYZ
from terrafix.components.noisy import NoisyComponent
from terrafix.components.rows import Rows
from terrafix.components.shared import require_earth
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import Choice, Flag, Parameter
from terrafix.cosim.declare.ports import Input, MessageOutput, Output
from terrafix.models.core.model import Model
from terrafix.models.motion.strapdown import EARTHS
from terrafix.models.sensors.gnss import TOLD, gnss_model

NED = ("north", "east", "down")
_OUTAGE = {
    "start": Parameter(unit="s", minimum=0.0),
    "stop": Parameter(unit="s", positive=True),
}


class Gnss(NoisyComponent):
    """GNSS receiver: position and velocity with errors that last, outages, and a spoofer.

    No fix comes in an outage. A spoofer leads the receiver away from a time on: the offset grows
    at its velocity, which the measured velocity has too, and the covariance told stays.
    """

    default_rate = Rate("1", offset="1")

    earth = Choice(EARTHS, "wgs84", doc="that of the motion")
    outages = Rows(_OUTAGE, ("start", "stop"), doc="from when to when nothing is received")
    told = Choice(TOLD, "all", doc="covariance of all errors, or of the white noise alone")
    spoofed = Flag(False, doc="whether there is a spoofer")
    position_sigma = Parameter(
        [1.0, 1.0, 2.0], shape=(3,), unit="m", minimum=0.0, doc="white noise north, east, down"
    )
    bias_sigma = Parameter(
        [1.5, 1.5, 3.0], shape=(3,), unit="m", minimum=0.0, doc="of what lasts: north, east, down"
    )
    bias_time = Parameter(300.0, unit="s", positive=True, doc="correlation of what lasts")
    velocity_sigma = Parameter(
        [0.05, 0.05, 0.1], shape=(3,), unit="m/s", minimum=0.0, doc="white noise north, east, down"
    )
    spoof_from = Parameter(0.0, unit="s", doc="when the spoofer takes over")
    spoof_velocity_n = Parameter(
        [0.0] * 3, shape=(3,), unit="m/s", frame="n", doc="at which it leads away"
    )

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    fix = MessageOutput(fields=GNSS_FIX, doc="position and velocity")
    bias = Output((3,), unit="m", frame="e", labels=XYZ, doc="true error that lasts")
    offset = Output((3,), unit="m", frame="n", labels=NED, doc="what the spoofer adds")

    def validate(self) -> None:
        """Check that a spoofer leads somewhere."""
        super().validate()
        if self.setting("spoofed") and not self.setting("spoof_velocity_n").any():
            raise ConfigurationError(
                f"'{self.name}' is spoofed, but led nowhere\n"
                f"  set {self.name}.spoof_velocity_n, [2, 0, 0] m/s say"
            )

    def validate_duration(self, duration: float) -> None:
        """Look whether outages and the spoofer begin within the run."""
        begins = [(f"outage {k}", row["start"]) for k, row in enumerate(self._outages, 1)]
        if self.setting("spoofed"):
            begins.append(("the spoofer", float(self.setting("spoof_from"))))
        for what, begin in begins:
            if begin >= duration:
                raise ConfigurationError(
                    f"{what} of '{self.name}' begins at {begin:g} s, but the run ends at "
                    f"{duration:g} s\n  fly longer (--duration), or take it out"
                )

    @property
    def _outages(self) -> tuple[dict[str, float], ...]:
        rows: tuple[dict[str, float], ...] = self.setting("outages")
        return rows

    def _initialize_impl(self) -> None:
        require_earth(self, self.setting("earth"), self.r_e)
        super()._initialize_impl()

    def build_model(self) -> Model:
        """Build the model for the chosen Earth, outages and spoofer."""
        outages = [(row["start"], row["stop"]) for row in self._outages]
        earth, spoofed, told = (self.setting(name) for name in ("earth", "spoofed", "told"))
        return gnss_model(earth, outages, spoofed, told)
