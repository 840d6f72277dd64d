"""Recorded phase history of a spotlight radar, and a navigator's wrong belief of its track."""

from __future__ import annotations

from terrafix.components.fields import PHASE, TRACK_ERROR
from terrafix.components.sensors.files import recorded_files
from terrafix.components.shared import require_common, shared_setting
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import FilePath, Parameter, Text
from terrafix.cosim.declare.ports import MessageOutput, SharedOutput
from terrafix.models.radar.phase_files import read_phase_history
from terrafix.models.radar.phase_history import PhaseHistory


class RecordedSpotlight(Component):
    """Plays the phase history of some degrees of aspect, told once at t = 0.

    Files are those of the AFRL "Gotcha" set, which hold no times: the speed is assumed; or one of
    CPHD (FX domain), which has them.
    """

    default_rate = Rate(times=["0"])

    folder = FilePath(doc="where the files are")
    files = Text(doc="names of the files (.mat) in order of flight, parted by blanks, or one .cphd")
    channel = Text("", doc="which, where the file has several (.cphd)")
    speed = Parameter(100.0, unit="m/s", positive=True, doc="assumed: it was not recorded (.mat)")

    phase = SharedOutput(**PHASE, doc="pulses, frequencies")
    frequency = SharedOutput((None,), unit="Hz", doc="of its columns")
    r = SharedOutput((None, 3), unit="m", frame="scene", doc="true places of the antenna")
    reference = SharedOutput((None,), unit="m", doc="ranges to which pulses were compensated")
    times = SharedOutput((None,), unit="s", doc="of its pulses, from their mean")

    def validate(self) -> None:
        """Read the files."""
        if self._read().t is not None and not self.is_default("speed"):
            raise ConfigurationError(
                f"'{self.name}.speed' is {self.setting('speed'):g} m/s, but its file has the times "
                "of its pulses\n  leave it out"
            )

    def _read(self) -> PhaseHistory:
        try:
            return read_phase_history(recorded_files(self), self.setting("channel"))
        except (OSError, ValueError, ImportError) as error:
            raise ConfigurationError(
                f"'{self.name}' cannot read its phase history: {error}\n"
                f"  set {self.name}.folder and {self.name}.files, or TERRAFIX_DATA to the folder "
                "with the data"
            ) from error

    def _initialize_impl(self) -> None:
        require_common(self)
        history = self._read()
        self.phase, self.frequency, self.r = history.phase, history.frequency, history.r
        self.reference = history.reference
        self.times = history.times(float(shared_setting(self, "speed")))

    def _step_impl(self, t: float, dt: float) -> None:
        """Say nothing more."""


class TrackError(Component):
    """What a navigator's track is off by: a position and a velocity, drawn at every step."""

    default_rate = Rate("1", offset="1")

    position_sigma = Parameter(0.5, shape=(3,), unit="m", minimum=0.0, doc="each axis")
    velocity_sigma = Parameter(0.1, shape=(3,), unit="m/s", minimum=0.0, doc="each axis")

    error = MessageOutput(fields=TRACK_ERROR, doc="believed less true")

    def _step_impl(self, t: float, dt: float) -> None:
        drawn = {name: self.normals(name, 3) for name in TRACK_ERROR}
        self.error.publish(
            t,
            position=self.position_sigma * drawn["position"],
            velocity=self.velocity_sigma * drawn["velocity"],
        )
