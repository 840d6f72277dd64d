"""The airborne radar: echo of one aperture after the other, pulse by pulse from the true track."""

from __future__ import annotations

import numpy as np

from terrafix.components.fields import GRID, HEIGHT, PULSES, SURFACE
from terrafix.components.ground import OnGround, height_in_swath
from terrafix.components.sensors.aperture import MARK
from terrafix.components.sensors.compiled import pulse_sums
from terrafix.components.sensors.echo import SendsChirps
from terrafix.components.shared import generator, shared_setting
from terrafix.components.truth.terrain import scene_from
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.machine import require_memory
from terrafix.cosim.declare.parameters import Choice, Count, Flag, Parameter
from terrafix.cosim.declare.ports import (
    MessageInput,
    MessageOutput,
    Output,
    SharedInput,
    SharedOutput,
    WindowInput,
)
from terrafix.models.core.arrays import ComplexArray
from terrafix.models.radar.aperture import Antenna, Aperture, flown_aperture, require_lit
from terrafix.models.radar.compensation import straight_line
from terrafix.models.radar.lit_ground import FEWEST, LitGround
from terrafix.models.radar.pulse_echo import pulse_echo
from terrafix.models.radar.scene import Scene
from terrafix.models.sensors.aperture import LOOKS, side_of

_CLOSE = 1e-6
_LOST = 1, 2
"""What `lost` says of an aperture without an echo: the beam was off the swath; it cannot be."""


class AircraftRadar(SendsChirps, OnGround):
    """Echo of an aperture, compressed in range, from the track of each member's own truth.

    It steps at the ends of apertures and takes what was flown about their centers. Clutter is a new
    draw for every aperture and member. While a bank holds the beam off the swath there is no echo;
    that it is off it at the first aperture is an error.
    """

    default_rate = Rate("1", offset="1")

    on = Flag(True, doc="whether it sends")
    looks = Choice(LOOKS, "right", doc="side that apertures look to")
    length = Parameter(0.98, unit="s", positive=True, doc="of an aperture")
    near_range = Parameter(unit="m", positive=True, doc="slant range of the first cell")
    n_cells = Count(320, minimum=64, doc="range cells of a line")
    beamwidth = Parameter(unit="rad", positive=True, doc="at half power, one way, along the track")
    squint = Parameter(0.0, unit="rad", doc="of the beam, forward of the wing")
    depression = Parameter(
        float(np.radians(40.0)), unit="rad", positive=True, doc="of the beam, below the wings"
    )
    elevation_beamwidth = Parameter(
        float(np.radians(30.0)), unit="rad", positive=True, doc="from its near to its far edge"
    )
    snr = Parameter(10.0, doc="mean clutter over thermal noise in an image [dB]")
    scatterers = Parameter(8.0, positive=True, doc="in a resolution cell")

    r_e = WindowInput((3,), unit="m", frame="e", doc="true position")
    q_be = WindowInput((4,), unit="1", frame="b", doc="true attitude, e to body")
    center = MessageInput(fields=MARK, doc="when an aperture had its center")
    height = SharedInput(**HEIGHT, doc="true heights of the terrain")
    grid = SharedInput(**GRID, doc="where they lie")
    surface = SharedInput(**SURFACE, doc="texture and points of the surface")

    echoes = SharedOutput(
        (None, None, None), dtype=np.complex64, doc="of members: pulses, range cells"
    )
    received = MessageOutput(fields=PULSES, doc="which echo is a member's, and how it came")
    lost = Output(doc="why the last aperture gave no echo: 0 it did, 1 beam off the swath, 2 else")

    def validate(self) -> None:
        """Look whether such a radar can be, and have echo of its apertures."""
        self._radar()
        per_cell, length = (float(shared_setting(self, n)) for n in ("scatterers", "length"))
        if per_cell < FEWEST:
            raise ConfigurationError(
                f"'{self.name}' strews {per_cell:g} scatterers in a resolution cell: the echo "
                "would have a texture of its own, which a radar does not see\n"
                f"  set {self.name}.scatterers to {FEWEST:g} at least; 8 are usual"
            )
        period = self.rate.period if self.rate is not None else None
        if period is not None and length >= period:
            raise ConfigurationError(
                f"'{self.name}' has apertures of {length:g} s, and makes one every "
                f"{float(period):g} s\n  set {self.name}.length to less, or a longer period"
            )

    def _initialize_impl(self) -> None:
        super()._initialize_impl()
        self.lost = 0.0
        pulses = float(self.length[0]) * float(self.prf[0])
        require_memory(
            self.name,
            8 * pulses * self.n_cells * (self.n_members + 8),
            f"echoes of {self.n_members} members, {pulses:.0f} pulses of {self.n_cells} cells each",
            f"fly fewer members, or set {self.name}.n_cells to less",
        )

    def _antenna(self, side: int) -> Antenna:
        values = (self.squint, self.depression, self.elevation_beamwidth)
        return Antenna(float(self.beamwidth[0]), side, *(float(v[0]) for v in values))

    def _step_impl(self, t: float, dt: float) -> None:
        fresh = self.center.fresh & self.environment.active
        if not (self.on and fresh.any()):
            return
        self._require_earth(self.r_e.samples[:, -1])
        scene = scene_from(self.height, self.grid, self.surface)
        echoes: list[ComplexArray] = []
        values = {n: np.zeros((self.n_members, *f.fixed_shape)) for n, f in PULSES.items()}
        valid = np.zeros(self.n_members, np.bool_)
        refused: dict[int, ValueError] = {}
        for m in map(int, np.flatnonzero(fresh)):
            try:
                antenna = self._antenna(side_of(self.looks, int(self.center.index[m])))
                echo = self._echo(m, antenna, scene)
            except ValueError as error:
                refused[m] = error
                continue
            self.lost[m], valid[m] = 0, True
            values["index"][m] = len(echoes)
            values["side"][m], values["axis_b"][m] = antenna.side, antenna.axis
            echoes.append(echo)
        if self.step_index <= 1 and not valid.any():
            first = next(iter(refused.values()))
            raise ConfigurationError(f"'{self.name}' receives no echo: {first}") from first
        for m, why in refused.items():
            off = isinstance(why, _OffSwathError)
            self.lost[m] = _LOST[0 if off else 1]
            if not off:
                self.fail(np.arange(self.n_members) == m, f"no echo can be simulated: {why}")
        if not valid.any():
            return
        values["near_range"], values["length"] = self.near_range, self.length
        self.echoes = np.stack(echoes)
        self.received.publish(self.center.t, valid=valid, **values)

    def _echo(self, m: int, antenna: Antenna, scene: Scene) -> ComplexArray:
        middle, length = float(self.center.t[m]), float(self.length[0])
        times = self.r_e.times
        part = part_about(times, middle, length)
        r, q = self.r_e.samples[m, part], self.q_be.samples[m, part]
        own = flown_aperture(
            self._radar(),
            antenna,
            times[part],
            r,
            q,
            near_range=float(self.near_range[0]),
            n_cells=self.n_cells,
        )
        lit = LitGround(scene, self._ground, own)
        self._require_lit(antenna, own, scene, q[len(q) // 2])
        rng = generator(self, m)
        parts = [lit.clutter(rng, float(self.scatterers[0])), lit.points()]
        return pulse_echo(parts, own, pulse_sums(), rng, snr_db=float(self.snr[0]))

    def _require_lit(self, antenna: Antenna, own: Aperture, scene: Scene, q: FloatArray) -> None:
        line = straight_line(own.t, own.r)
        middle = float(own.slant_range.mean())
        height = height_in_swath(self._ground, line, middle, scene.dem, own.side)
        try:
            require_lit(antenna, own, self._ground, height, q)
        except ValueError as error:
            raise _OffSwathError(str(error)) from error


class _OffSwathError(ValueError):
    """The beam does not light the swath."""


def part_about(times: FloatArray, middle: float, length: float) -> slice:
    """Samples of an aperture, symmetric about its middle.

    Raises
    ------
    ValueError
        If they do not reach from its begin to its end.
    """
    own = np.flatnonzero(np.abs(times - middle) <= length / 2 + _CLOSE)
    part = slice(int(own[0]), int(own[-1]) + 1) if len(own) else slice(0)
    t = times[part]
    if len(t) < 6 or abs(t[-1] - t[0] - length) > _CLOSE or abs(t[0] + t[-1] - 2 * middle) > _CLOSE:
        span = f"{t[0]:.3f} to {t[-1]:.3f} s" if len(t) else "at no time"
        raise ValueError(
            f"an aperture of {length:g} s about {middle:.3f} s needs the motion at its begin and "
            f"its end, and is told it for {span}\n"
            "  let apertures be shorter than their interval by two samples of the motion, and a "
            "whole number of them long"
        )
    return part
