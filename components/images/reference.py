"""Geocoded references: of an earlier pass over a scene, of a recording, or from a file.

A reference is one for all members, published by reference before the image that it serves.
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from terrafix.components.fields import AMPLITUDE, GRID, HEIGHT, PLACES, RADAR, SURFACE, TIES
from terrafix.components.ground import OnGround
from terrafix.components.sensors.aperture import MARK
from terrafix.components.sensors.compiled import row_operations
from terrafix.components.sensors.echo import RecordedEcho
from terrafix.components.sensors.files import (
    file_of_step,
    near_range,
    read_lines,
    recorded_files,
    require_files,
)
from terrafix.components.shared import common, generator, lasting_seed, require_common
from terrafix.components.truth.terrain import scene_from
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Count, FilePath, Flag, Parameter, Text
from terrafix.cosim.declare.ports import Input, MessageInput, SharedInput, SharedOutput
from terrafix.models.core.arrays import Single
from terrafix.models.geometry.geolocation import track_axes
from terrafix.models.images.reference import Reference, earlier_pass, geocoded, read_reference
from terrafix.models.images.rendered_reference import rendered
from terrafix.models.maps.dem import Dem, dem_from
from terrafix.models.motion.arc import OrbitArc
from terrafix.models.motion.sampled import SampledArc
from terrafix.models.radar.boresight import boresight_on_terrain
from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.doppler import unwrapped_centroid
from terrafix.models.radar.footprint import Footprint
from terrafix.models.radar.imaging import Imager
from terrafix.models.radar.scene import CoverMap, Scene
from terrafix.models.sensors.aperture import LOOKS, side_of
from terrafix.models.sensors.effective_velocity import effective_velocity_array

_TRACK_STEP = 0.02
"""Between places of an earlier flight [s]."""


class _Reference(Component):
    """Base of references: their ports."""

    default_rate = Rate("8.2", offset="8.2")

    amplitude = SharedOutput(**AMPLITUDE, doc="of the reference")
    tie_rows = SharedOutput(**TIES, doc="rows of its tie points")
    tie_columns = SharedOutput(**TIES, doc="columns of its tie points")
    places = SharedOutput(**PLACES, doc="latitude, longitude, height of its tie points")

    def _initialize_impl(self) -> None:
        require_common(self)

    def _publish(self, reference: Reference) -> None:
        self.amplitude = np.ascontiguousarray(reference.amplitude, np.float32)
        self.tie_rows = np.asarray(reference.rows, np.float64)
        self.tie_columns = np.asarray(reference.columns, np.float64)
        self.places = np.stack([reference.latitude, reference.longitude, reference.height], axis=-1)


class OnReference(Component):
    """Base of matchers: the reference and the heights that they read."""

    amplitude = SharedInput(**AMPLITUDE, doc="of the reference")
    tie_rows = SharedInput(**TIES, doc="rows of the reference's tie points")
    tie_columns = SharedInput(**TIES, doc="columns of the reference's tie points")
    places = SharedInput(**PLACES, doc="latitude, longitude, height of the tie points")
    height = SharedInput(**HEIGHT, doc="heights of the terrain, as they are known")
    grid = SharedInput(**GRID, doc="first point and spacing of the heights")

    def _reference(self) -> Reference:
        try:
            return reference_from(self.amplitude, self.tie_rows, self.tie_columns, self.places)
        except ValueError as error:
            raise ConfigurationError(f"'{self.name}' cannot use its reference: {error}") from error

    def _dem(self) -> Dem:
        return dem_from(self.height, self.grid)


def reference_from(
    amplitude: Single, rows: FloatArray, columns: FloatArray, places: FloatArray
) -> Reference:
    """Reference of the ports that publish one."""
    return Reference(amplitude, rows, columns, *np.moveaxis(places, -1, 0))


class EarlierPass(_Reference):
    """Reference of an earlier pass over an artificial scene, with speckle of its own.

    What an ideal processor makes of the scatterers, and not formed from echo; its orbit is that
    of the truth, displaced. It is centered where the nominal boresight meets the ground.
    """

    look = Parameter(
        unit="rad", doc="off-nadir angle of the nominal boresight, positive to the right"
    )
    squint = Parameter(0.0, unit="rad", doc="forward angle of the nominal boresight")
    displacement = Parameter(
        [0.0, 300.0, 150.0],
        shape=(3,),
        unit="m",
        frame="track",
        doc="of the earlier orbit: along the track, to the right, up",
    )
    n_lines = Count(4800, minimum=200, doc="lines of the reference, before averaging")
    n_cells = Count(1500, minimum=200, doc="range cells of the reference, before averaging")
    azimuth_looks = Count(2, minimum=1, doc="lines averaged in a pixel")
    range_looks = Count(1, minimum=1, doc="cells averaged in a pixel")
    snr = Parameter(10.0, doc="mean clutter over thermal noise [dB]")

    radar = SharedInput(**RADAR, doc="what the radar sends and how its echo is sampled")
    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude, Earth-fixed to body")
    height = SharedInput(**HEIGHT, doc="heights of the terrain")
    grid = SharedInput(**GRID, doc="first point and spacing of the heights")
    surface = SharedInput(**SURFACE, doc="texture and points of the surface")

    def _step_impl(self, t: float, dt: float) -> None:
        radar = Radar(*map(float, self.radar))
        r, v, q_be, look, squint, displacement, snr = (
            common(self, name)
            for name in ("r_e", "v_e", "q_be", "look", "squint", "displacement", "snr")
        )
        r = r + displacement @ track_axes(r, v)
        reach = self.n_lines / radar.prf
        aligned = np.array([0.0, 0.0, 0.0, 1.0])
        scene = scene_from(self.height, self.grid, self.surface)
        looks = self.azimuth_looks, self.range_looks
        try:
            beam = boresight_on_terrain(r, v, q_be, aligned, float(look), float(squint), scene.dem)
            footprint = Footprint(
                OrbitArc(r, v, 0.0, reach, reach),
                radar,
                -(self.n_lines - 1) / 2 / radar.prf,
                self.n_lines,
                beam.slant_range - (self.n_cells - 1) / 2 * radar.range_spacing,
                self.n_cells,
                beam.doppler(radar.wavelength),
                side=beam.side,
            )
            reference = self._seen(scene, footprint, looks, float(snr))
        except ValueError as error:
            raise ConfigurationError(f"'{self.name}' cannot see its scene: {error}") from error
        self._publish(reference)

    def _seen(
        self, scene: Scene, footprint: Footprint, looks: tuple[int, int], snr_db: float
    ) -> Reference:
        return earlier_pass(scene, footprint, looks, generator(self), snr_db)


class RenderedReference(EarlierPass):
    """Reference that needs no earlier pass: rendered from known heights and a map of land cover.

    It shows what amplitude is expected, without speckle, of the classes of the cover and of how
    steep the known terrain faces the radar, for an orbit that is known beforehand: that of the
    truth, displaced. The brightness of each class is off by an error that stays, and all of a
    reference lies beside its place by another that is its own.
    """

    displacement = Parameter(
        [1000.0, 1000.0, 500.0],
        shape=(3,),
        unit="m",
        frame="track",
        doc="of the orbit that was expected: along the track, to the right, up",
    )
    snr = Parameter(10.0, doc="mean clutter over thermal noise that is expected [dB]")
    classes = Flag(True, doc="show land cover; false: relief alone")
    class_sigma = Parameter(1.5, minimum=0.0, doc="error of each class's brightness [dB]")
    placing_sigma = Parameter(
        3.0, unit="m", minimum=0.0, doc="error of where map and heights lie, to the north and east"
    )

    height = SharedInput(**HEIGHT, doc="heights of the terrain, as they are known")
    surface = SharedInput(**SURFACE, doc="what covers the ground")

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect."""
        return super().takes(name) and (name != "class_sigma" or bool(self.setting("classes")))

    def _seen(
        self, scene: Scene, footprint: Footprint, looks: tuple[int, int], snr_db: float
    ) -> Reference:
        cover = CoverMap(
            **{f.name: getattr(scene, f.name) for f in fields(Scene)},
            class_sigma=float(common(self, "class_sigma")),
            map_seed=lasting_seed(self),
        )
        if not self.classes:
            cover = replace(cover, cover="texture", class_sigma=0.0)
        north, east = float(common(self, "placing_sigma")) * generator(self).standard_normal(2)
        return rendered(cover, footprint, looks, snr_db, displaced=(north, east))


class EarlierFlight(_Reference, OnGround):
    """Reference of an earlier flight over an artificial scene, with speckle of its own.

    As `EarlierPass`, of a straight piece of a track, displaced, about where the given one is when
    it steps. Let another flight than the one that navigates tell it where it was. The places of its
    pixels are found with the heights that were known then.
    """

    default_rate = Rate("1", offset="0.5")

    looks = Choice(LOOKS, "right", doc="side that apertures look to")
    displacement = Parameter(
        [0.0, 30.0, 20.0],
        shape=(3,),
        unit="m",
        frame="track",
        doc="of the earlier track: along, to the right, up",
    )
    length = Parameter(400.0, unit="m", positive=True, doc="of the track that a reference is of")
    near_range = Parameter(unit="m", positive=True, doc="slant range of the first cell")
    n_cells = Count(520, minimum=64, doc="range cells of the reference")
    azimuth_looks = Count(3, minimum=1, doc="lines averaged in a pixel")
    resolution = Parameter(0.35, unit="m", positive=True, doc="along the track")
    snr = Parameter(10.0, doc="mean clutter over thermal noise [dB]")

    radar = SharedInput(**RADAR, doc="what the radar sends and how its echo is sampled")
    r_e = Input((3,), unit="m", frame="e", doc="true position of the flight")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    center = MessageInput(fields=MARK, doc="now is the center of an aperture")
    height = SharedInput(**HEIGHT, doc="true heights of the terrain")
    grid = SharedInput(**GRID, doc="where they lie")
    surface = SharedInput(**SURFACE, doc="texture and points of the surface")
    known_height = SharedInput(**HEIGHT, doc="heights that its places are found with")
    known_grid = SharedInput(**GRID, doc="where those lie")

    def _step_impl(self, t: float, dt: float) -> None:
        fresh = self.center.fresh
        if not fresh.any():
            return
        side = side_of(self.looks, int(self.center.index[np.argmax(fresh)]))
        r, v, displacement, near, length, resolution, snr = (
            common(self, name)
            for name in (
                *("r_e", "v_e", "displacement", "near_range", "length", "resolution", "snr"),
            )
        )
        self._require_earth(self.r_e)
        speed, ground = float(np.linalg.norm(v)), self._ground
        ahead, down = v / speed, ground.axes(r)[2]
        right = np.cross(down, ahead)
        right /= np.linalg.norm(right)
        r = r + displacement @ np.stack([ahead, right, np.cross(right, ahead)])
        radar = replace(Radar(*map(float, self.radar)), doppler_bandwidth=float(speed / resolution))
        reach = float(length) / speed
        s = np.arange(-reach, reach + _TRACK_STEP, _TRACK_STEP)
        n_lines = int(reach * radar.prf)
        scene = scene_from(self.height, self.grid, self.surface)
        try:
            footprint = Footprint(
                SampledArc(s, r + np.outer(s, v)),
                radar,
                -(n_lines - 1) / 2 / radar.prf,
                n_lines,
                float(near),
                self.n_cells,
                0.0,
                ground,
                side,
            )
            reference = earlier_pass(
                scene,
                footprint,
                (self.azimuth_looks, 1),
                generator(self),
                float(snr),
                terrain=dem_from(self.known_height, self.known_grid).at,
            )
        except ValueError as error:
            raise ConfigurationError(f"'{self.name}' cannot see its scene: {error}") from error
        self._publish(reference)


class RecordedReference(_Reference):
    """Reference formed from recorded echo, of a part of its Doppler band, and geocoded.

    The velocity that focuses it is found by autofocus, once, for all. It is geocoded with the
    true orbit, displaced in time with the recording, and the heights of the terrain.
    """

    folder = RecordedEcho.folder
    files = RecordedEcho.files
    range0 = RecordedEcho.range0
    start_line = RecordedEcho.start_line
    band = Parameter(
        [0.0, 1.0], shape=(2,), minimum=0.0, maximum=1.0, doc="part of the Doppler band shown"
    )
    look = Parameter(
        unit="rad", doc="off-nadir angle of the nominal boresight, positive to the right"
    )
    squint = Parameter(0.0, unit="rad", doc="forward angle of the nominal boresight")
    exposure = Parameter(
        1.0, positive=True, maximum=1.0, doc="share of a pulse received where columns are used"
    )
    velocity_step = Parameter(1.0, unit="m/s", positive=True, doc="grid of autofocus")
    azimuth_looks = Count(1, minimum=1, doc="lines averaged in a pixel")
    range_looks = Count(1, minimum=1, doc="cells averaged in a pixel")

    radar = SharedInput(**RADAR, doc="what the radar sends and how its echo is sampled")
    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude, Earth-fixed to body")
    height = SharedInput(**HEIGHT, doc="heights of the terrain")
    grid = SharedInput(**GRID, doc="first point and spacing of the heights")

    def validate(self) -> None:
        """Read the files."""
        for path in recorded_files(self):
            read_lines(self, path)

    def validate_duration(self, duration: float) -> None:
        """Look whether there is a file for every step."""
        require_files(self, duration)

    def _step_impl(self, t: float, dt: float) -> None:
        path = file_of_step(self)
        lines = read_lines(self, path, report=True)
        radar = Radar(*map(float, self.radar))
        first_time = (lines.first_line - float(common(self, "start_line"))) / radar.prf - t
        near = near_range(self, lines, radar.sample_rate)
        r, v, q_be, look, squint, band, step, exposure = (
            common(self, name)
            for name in (
                *("r_e", "v_e", "q_be", "look", "squint"),
                *("band", "velocity_step", "exposure"),
            )
        )
        dem = dem_from(self.height, self.grid)
        aligned = np.array([0.0, 0.0, 0.0, 1.0])
        duration = lines.n_lines / radar.prf
        try:
            beam = boresight_on_terrain(r, v, q_be, aligned, float(look), float(squint), dem)
            imager = Imager(
                lines.read(),
                radar,
                near,
                first_time,
                step=float(step),
                band=(float(band[0]), float(band[1])),
                exposure=float(exposure),
                operations=row_operations(),
            )
            centroid = unwrapped_centroid(
                imager.fraction, radar.prf, beam.doppler(radar.wavelength)
            )
            velocity = float(effective_velocity_array(r, v, beam.point))
            processing = imager.processing(centroid, velocity, 0.0)
            _, focus = imager.focus([processing], velocity)
            image = imager.image(processing, focus.velocity if focus.accepted else velocity)
            reach = abs(first_time) + 3 * duration
            arc = OrbitArc(r, v, 0.0, reach, reach)
            looks = self.azimuth_looks, self.range_looks
            reference = geocoded(image, arc, dem.at, looks, side=beam.side)
        except ValueError as error:
            raise ConfigurationError(
                f"'{self.name}' cannot make a reference of '{path.name}': {error}"
            ) from error
        self._publish(reference)


class ReferenceFile(_Reference):
    """References from files, as `terrafix.models.images.reference.write_reference` writes them."""

    folder = FilePath(doc="where the files are")
    files = Text(doc="names of the files (.npz), one for each step, separated by blanks")

    def validate(self) -> None:
        """Read the files."""
        for path in recorded_files(self):
            self._read(path)

    def validate_duration(self, duration: float) -> None:
        """Look whether there is a file for every step."""
        require_files(self, duration)

    def _read(self, path: Path) -> Reference:
        try:
            return read_reference(path)
        except (OSError, ValueError) as error:
            raise ConfigurationError(
                f"'{self.name}' cannot read its reference: {error}\n"
                f"  set {self.name}.folder and {self.name}.files"
            ) from error

    def _step_impl(self, t: float, dt: float) -> None:
        self._publish(self._read(file_of_step(self)))
