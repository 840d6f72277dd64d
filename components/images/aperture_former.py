"""The image former of an aircraft: each member's echo, formed with that member's own track."""

from __future__ import annotations

import numpy as np

from terrafix.components.fields import APERTURE_IMAGE, GRID, HEIGHT, MOTION, PULSES, RADAR, XYZ
from terrafix.components.ground import OnGround, height_in_swath
from terrafix.components.sensors.aircraft_radar import part_about
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import Flag, Parameter
from terrafix.cosim.declare.ports import (
    BundleInput,
    MessageInput,
    MessageOutput,
    Output,
    SharedInput,
    SharedOutput,
    WindowInput,
)
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.arrays import Single
from terrafix.models.core.model import Model
from terrafix.models.filters.aperture_fix import estimated_track_model
from terrafix.models.maps.dem import Dem, dem_from
from terrafix.models.radar.aperture import Antenna, flown_aperture
from terrafix.models.radar.aperture_image import (
    ApertureEcho,
    ApertureImage,
    aperture_echo,
    aperture_image,
)
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.compensation import straight_line
from terrafix.models.radar.map_drift import MapDrift, map_drift

_NARROW = 1e-6
"""Width of a beam that is not asked for: only its center is [rad]."""
_GRID = ("first_time", "row_time", "near_range", "spacing", "velocity", "side")


class EstimatedTrack(SymbolicComponent):
    """Position and attitude of the navigator's estimate, at the rate of its IMU."""

    default_rate = Rate(hz=100)

    prior = BundleInput(MOTION, doc="estimate before any fix of this instant")
    r_e = Output((3,), unit="m", frame="e", labels=XYZ, doc="position")
    q_be = Output((4,), unit="1", frame="b", doc="attitude, e to body")

    def build_model(self) -> Model:
        """Build the model."""
        return estimated_track_model()


class ApertureFormer(OnGround):
    """Compensates, focuses and detects the image of an aperture.

    With the track that the member's navigator believes it has flown, and the heights that it knows.
    Where map drift refuses, the image is focused with the speed of that track.
    """

    default_rate = Rate("1", offset="1")

    compensated = Flag(True, doc="whether deviations from a straight line are compensated")
    autofocused = Flag(True, doc="whether map drift focuses the image")
    largest_drift = Parameter(
        4.0, unit="m/s", positive=True, doc="largest error of speed that map drift looks for"
    )
    show_unfocused = Flag(False, doc="publish the first member's image before map drift, too")

    radar = SharedInput(**RADAR, doc="what the radar sends and how its echo is sampled")
    echoes = SharedInput(
        (None, None, None), dtype=np.complex64, doc="of members: pulses, range cells"
    )
    received = MessageInput(fields=PULSES, doc="which echo is a member's, and how it came")
    r_e = WindowInput((3,), unit="m", frame="e", doc="estimated position")
    q_be = WindowInput((4,), unit="1", frame="b", doc="estimated attitude, e to body")
    height = SharedInput(**HEIGHT, doc="heights of the terrain, as they are known")
    grid = SharedInput(**GRID, doc="where they lie")

    images = SharedOutput((None, None, None), dtype=np.float32, doc="amplitudes of members' images")
    unfocused = SharedOutput(
        (None, None), dtype=np.float32, doc="the first member's, as its estimate alone forms it"
    )
    image = MessageOutput(fields=APERTURE_IMAGE, doc="which image is a member's, where it lies")

    def _step_impl(self, t: float, dt: float) -> None:
        fresh = self.received.fresh & self.environment.active
        if not fresh.any():
            return
        self._require_earth(self.r_e.samples[:, -1])
        dem = dem_from(self.height, self.grid)
        chips: list[Single] = []
        values = {n: np.zeros((self.n_members, *f.fixed_shape)) for n, f in APERTURE_IMAGE.items()}
        valid = np.zeros(self.n_members, np.bool_)
        broken: dict[int, ValueError] = {}
        for m in map(int, np.flatnonzero(fresh)):
            try:
                seen = self._echo(m, dem)
                drift = self._drift(m, seen)
                image = aperture_image(seen, drift.velocity)
                if self.show_unfocused and not chips:
                    self.unfocused = aperture_image(seen).amplitude()
            except ValueError as error:
                broken[m] = error
                continue
            valid[m] = True
            values["index"][m] = len(chips)
            chips.append(image.amplitude())
            self._note(values, m, image, drift, chips[-1].shape)
        if self.step_index <= 1 and not valid.any():
            first = next(iter(broken.values()))
            raise ConfigurationError(f"'{self.name}' forms no image: {first}") from first
        for m, why in broken.items():
            self.fail(np.arange(self.n_members) == m, f"no image can be formed: {why}")
        if not valid.any():
            return
        self.images = _stacked(chips)
        self.image.publish(self.received.t, valid=valid, **values)

    def _echo(self, m: int, dem: Dem) -> ApertureEcho:
        radar, got = Radar(*map(float, self.radar)), self.received
        side, near = int(got.side[m]), float(got.near_range[m])
        echo = self.echoes[int(got.index[m])]
        part = part_about(self.r_e.times, float(got.t[m]), float(got.length[m]))
        own = flown_aperture(
            radar,
            Antenna(_NARROW, side, float(np.arcsin(-side * got.axis_b[m, 1]))),
            self.r_e.times[part],
            self.r_e.samples[m, part],
            self.q_be.samples[m, part],
            near_range=near,
            n_cells=echo.shape[1],
        )
        line, ground = straight_line(own.t, own.r), self._ground
        height = height_in_swath(ground, line, float(own.slant_range.mean()), dem, side)
        return aperture_echo(
            echo,
            radar,
            near,
            own.t,
            own.r,
            own.axis,
            ground,
            height,
            side=side,
            terrain=dem.at,
            compensate=self.compensated,
        )

    def _drift(self, m: int, seen: ApertureEcho) -> MapDrift:
        if not self.autofocused:
            return MapDrift(seen.speed, np.inf, 0.0, 0, False)
        return map_drift(seen.domain, seen.speed, largest=float(self.largest_drift[m]))

    def _note(
        self,
        values: dict[str, np.ndarray],
        m: int,
        image: ApertureImage,
        drift: MapDrift,
        shape: tuple[int, ...],
    ) -> None:
        for name in _GRID:
            values[name][m] = getattr(image.grid, name)
        values["rows"][m], values["columns"][m] = shape
        values["r_e"][m], values["v_e"][m] = image.line.r, image.line.v
        values["focused"][m] = drift.accepted
        if drift.accepted:
            values["drift"][m] = drift.velocity - image.line.speed
            values["drift_sigma"][m] = drift.sigma


def _stacked(chips: list[Single]) -> Single:
    """Images in one array, zero beyond each."""
    rows, columns = (max(c.shape[k] for c in chips) for k in (0, 1))
    out = np.zeros((len(chips), rows, columns), np.float32)
    for k, chip in enumerate(chips):
        out[k, : chip.shape[0], : chip.shape[1]] = chip
    return out
