"""Radar echo: simulated from the truth, or recorded, on the same ports.

An echo is one for all members of an ensemble, published by reference; so the truth must be one for
all of them. The beam's center passes its middle at the time of the step: half of the aperture lies
ahead of that time, and is taken from the orbit that the truth will follow. (A flight system would
apply the fix that much later; this delay is not modeled.)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from terrafix.components.fields import ACQUISITION, ECHO, GRID, HEIGHT, RADAR, SURFACE
from terrafix.components.sensors.compiled import row_operations
from terrafix.components.sensors.files import (
    file_of_step,
    near_range,
    read_lines,
    recorded_files,
    require_files,
    sent_by,
    settled,
)
from terrafix.components.shared import common, generator, require_common, shared_setting
from terrafix.components.truth.terrain import scene_from
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.machine import require_memory
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Count, FilePath, Parameter, Text
from terrafix.cosim.declare.ports import Input, MessageOutput, SharedInput, SharedOutput
from terrafix.models.core.arrays import ComplexArray
from terrafix.models.maps.dem import dem_from
from terrafix.models.motion.arc import OrbitArc
from terrafix.models.radar.boresight import Boresight, boresight_on_terrain
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.echo import Acquisition, simulated_echo
from terrafix.models.radar.recordings.recording import Recording, Sent

_BEYOND = 5.0
"""Arc beyond all apertures [s]: the corners of the surface that is looked up are seen that late."""


class SendsChirps(Component):
    """Base of radars: what they send, and how their echo is sampled."""

    carrier = Parameter(unit="Hz", positive=True, doc="carrier frequency")
    prf = Parameter(unit="Hz", positive=True, doc="pulse repetition frequency")
    sample_rate = Parameter(unit="Hz", positive=True, doc="complex samples of a line")
    chirp_rate = Parameter(unit="Hz/s", doc="sweep of the pulse, negative downward")
    pulse_length = Parameter(unit="s", positive=True, doc="of the pulse")
    doppler_bandwidth = Parameter(unit="Hz", positive=True, doc="processed, at most the prf")

    radar = SharedOutput(**RADAR, doc="what the radar sends and how its echo is sampled")

    def _radar(self) -> Radar:
        values = [self._sends(name) for name in Radar.__dataclass_fields__]
        try:
            return Radar(*values)
        except ValueError as error:
            raise ConfigurationError(f"the radar of '{self.name}' cannot be: {error}") from error

    def _sends(self, name: str) -> float:
        """One of the numbers of the radar."""
        return float(shared_setting(self, name))

    def _initialize_impl(self) -> None:
        require_common(self)
        radar = self._radar()
        self.radar = np.array([getattr(radar, name) for name in Radar.__dataclass_fields__])


class _Echo(SendsChirps):
    """Base of a satellite's radars: where they look, and their ports."""

    default_rate = Rate("8.2", offset="8.2")

    look = Parameter(
        unit="rad", doc="off-nadir angle of the nominal boresight, positive to the right"
    )
    squint = Parameter(0.0, unit="rad", doc="forward angle of the nominal boresight")

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude, Earth-fixed to body")
    q_mu = Input((4,), unit="1", frame="s", doc="true misalignment")
    height = SharedInput(**HEIGHT, doc="heights of the terrain")
    grid = SharedInput(**GRID, doc="first point and spacing of the heights")

    echo = SharedOutput(**ECHO, doc="raw echo, lines first")
    acquired = MessageOutput(fields=ACQUISITION, doc="when and where the echo was received")

    def validate(self) -> None:
        """Build the radar."""
        self._radar()

    def _boresight(self) -> Boresight:
        """Where the true boresight meets the terrain now."""
        r, v, q_be, q_mu, look, squint = (
            common(self, name) for name in ("r_e", "v_e", "q_be", "q_mu", "look", "squint")
        )
        try:
            dem = dem_from(self.height, self.grid)
            return boresight_on_terrain(r, v, q_be, q_mu, float(look), float(squint), dem)
        except ValueError as error:
            raise ConfigurationError(
                f"'{self.name}' cannot tell where its boresight meets the ground: {error}"
            ) from error

    def _publish(self, t: float, echo: ComplexArray, first_time: float, near: float) -> None:
        beam = self._boresight()
        radar = self._radar()
        reach = near + (echo.shape[1] - 1) * radar.range_spacing
        if not near <= beam.slant_range <= reach:
            raise ConfigurationError(
                f"the boresight of '{self.name}' meets the ground at a slant range of "
                f"{beam.slant_range:.0f} m, but echo was received from {near:.0f} to "
                f"{reach:.0f} m\n"
                f"  look at the same place: set {self.name}.look, or the orbit"
            )
        self.echo = echo
        self.acquired.publish(
            t,
            first_time=first_time - t,
            near_range=near,
            beam_range=beam.slant_range,
            beam_doppler=beam.doppler(radar.wavelength),
            time_sigma=0.0,
            side=beam.side,
        )


class SceneEcho(_Echo):
    """Echo of an artificial scene on a terrain, from the exact geometry of the true orbit.

    Its receive window is centered on the true boresight.
    """

    antenna_length = Parameter(8.9, unit="m", positive=True, doc="along the track")
    n_lines = Count(7452, minimum=2, doc="lines of an echo")
    n_cells = Count(1072, minimum=2, doc="range cells of a line")
    snr = Parameter(10.0, doc="mean clutter over thermal noise [dB]")

    surface = SharedInput(**SURFACE, doc="texture and points of the surface")

    def validate(self) -> None:
        """Look whether echo of this size can be made."""
        radar = self._radar()
        n_lines, n_cells = self.setting("n_lines"), self.setting("n_cells")
        if n_cells < radar.n_pulse + 64:
            raise ConfigurationError(
                f"'{self.name}' has lines of {n_cells} cells, and a pulse is {radar.n_pulse} "
                f"cells long: too few are left\n  set {self.name}.n_cells to some more"
            )
        # an aperture of the grid is added at both ends; two layers, their sum, and transforms
        pixels = 2.0 * n_lines * (n_cells + radar.n_pulse + 32)
        require_memory(
            self.name,
            40 * pixels,
            f"an echo of {n_lines} lines of {n_cells} cells",
            f"set {self.name}.n_lines or {self.name}.n_cells to less",
        )

    def _step_impl(self, t: float, dt: float) -> None:
        radar, beam = self._radar(), self._boresight()
        n_lines, n_cells = self.n_lines, self.n_cells
        first_time = t - (n_lines - 1) / 2 / radar.prf
        near = beam.slant_range - (n_cells - radar.n_pulse) / 2 * radar.range_spacing
        r_e, v_e = common(self, "r_e"), common(self, "v_e")
        speed2 = float(v_e @ v_e)
        aperture = radar.prf * radar.wavelength * beam.slant_range / (2 * speed2)
        reach = n_lines / radar.prf + aperture + _BEYOND
        arc = OrbitArc(r_e, v_e, t, reach, reach)
        try:
            acquisition = Acquisition(
                radar,
                first_time,
                n_lines,
                n_cells,
                near,
                beam.doppler(radar.wavelength),
                float(common(self, "antenna_length")),
                side=beam.side,
            )
            scene = scene_from(self.height, self.grid, self.surface)
            snr = float(common(self, "snr"))
            echo = simulated_echo(
                *(scene, arc, acquisition, generator(self)),
                snr_db=snr,
                operations=row_operations(),
            )
        except ValueError as error:
            raise ConfigurationError(f"'{self.name}' cannot simulate its echo: {error}") from error
        self._publish(t, echo, first_time, near)


class RecordedEcho(_Echo):
    """Echo that a real radar recorded: one file for each step.

    Lines of the recording are numbered; `start_line` is the one received at t = 0. The radar's
    parameters are those of the recording, and `range0` its slant range of cell 1: set where the
    files do not say them (.npz), and left out, or the same, where they do (NISAR L0B).
    """

    carrier = Parameter(
        np.inf, unit="Hz", positive=True, infinite=True, doc="carrier frequency; inf: the files'"
    )
    prf = Parameter(
        np.inf, unit="Hz", positive=True, infinite=True, doc="pulse repetition; inf: the files'"
    )
    sample_rate = Parameter(
        np.inf, unit="Hz", positive=True, infinite=True, doc="complex samples; inf: the files'"
    )
    chirp_rate = Parameter(
        np.inf, unit="Hz/s", infinite=True, doc="sweep, negative downward; inf: the files'"
    )
    pulse_length = Parameter(
        np.inf, unit="s", positive=True, infinite=True, doc="of the pulse; inf: the files'"
    )
    folder = FilePath(doc="where the files are")
    files = Text(doc="names of the files (.npz, .h5), one for each step, separated by blanks")
    range0 = Parameter(
        np.inf,
        unit="m",
        positive=True,
        infinite=True,
        doc="slant range of cell 1 of the recording; inf: the files'",
    )
    start_line = Parameter(1.0, doc="line of the recording, fractional, at t = 0")

    def validate(self) -> None:
        """Read the files."""
        self._radar()
        for path in recorded_files(self):
            self._near_range(read_lines(self, path))

    def validate_duration(self, duration: float) -> None:
        """Look whether there is a file for every step, and one that was received then."""
        for t, path in require_files(self, duration):
            self._check_time(read_lines(self, path), path, t)

    def _sends(self, name: str) -> float:
        value = super()._sends(name)
        if name not in Sent.__dataclass_fields__:
            return value
        told, declared = sent_by(self), self.settings()[name]
        assert isinstance(declared, Parameter)
        known = None if told is None else float(getattr(told, name))
        return settled(self, name, value, known, declared.unit_text())

    def _near_range(self, lines: Recording) -> float:
        return near_range(self, lines, self._sends("sample_rate"))

    def _first_time(self, lines: Recording) -> float:
        start = float(shared_setting(self, "start_line"))
        return (lines.first_line - start) / self._sends("prf")

    def _check_time(self, lines: Recording, path: Path, t: float) -> None:
        first = self._first_time(lines)
        last = first + (lines.n_lines - 1) / self._sends("prf")
        if not first <= t <= last:
            raise ConfigurationError(
                f"'{self.name}' is to publish '{path.name}' at {t:g} s, but its lines were "
                f"received from {first:.3f} to {last:.3f} s\n"
                f"  list times within it, or set {self.name}.start_line"
            )

    def _step_impl(self, t: float, dt: float) -> None:
        path = file_of_step(self)
        lines = read_lines(self, path, report=True)
        self._check_time(lines, path, t)
        self._publish(t, lines.read(), self._first_time(lines), self._near_range(lines))
