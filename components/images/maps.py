"""Parts of large maps, read where an image will be: a reference, and heights.

A part is one for all members, about where the beam looks from where the satellite truly is, as
echo is: what a member's estimate is off by only decides where on it the matcher searches. It has to
reach as far as the estimate can err (three of its sigmas) and an image beyond.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from terrafix.components.fields import GRID, HEIGHT
from terrafix.components.images.reference import ReferenceSource
from terrafix.components.shared import common, require_common
from terrafix.components.truth.terrain import Terrain, referred
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Count, FilePath, OptionalFilePath, Parameter
from terrafix.cosim.declare.ports import Input, SharedInput, SharedOutput
from terrafix.models.geometry.geodesy import geodetic
from terrafix.models.images.mapped import Beam, Map, RasterMap, Sentinel1Map, as_seen
from terrafix.models.maps.dem import Dem, dem_from, flat_dem
from terrafix.models.maps.elevation import elevations_about
from terrafix.models.maps.raster import Raster, open_raster
from terrafix.models.maps.sentinel1 import read_sentinel1
from terrafix.models.radar.boresight import boresight_on_terrain

_ALIGNED = np.array([0.0, 0.0, 0.0, 1.0])
_ROUNDS, _CLOSE = 20, 1.0
"""Of the search for the ground's height under the boresight, and how close it comes [m]."""
_DIAGONAL = 1.45
"""Of a square that is turned, and spare."""
_OF_ANNOTATION = ("first_line", "first_sample")
Height = Callable[[float, float], float]


class InView(Component):
    """Base of what is read about where the nominal boresight meets the ground."""

    default_rate = Rate("8.2", offset="8.2")

    look = Parameter(unit="rad", doc="off-nadir angle of the nominal boresight, to the right")
    squint = Parameter(0.0, unit="rad", doc="forward angle of the nominal boresight")
    reach = Parameter(
        unit="m",
        positive=True,
        doc="half of the side of what is read: three sigma of the estimate, and half an image",
    )

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    q_be = Input((4,), unit="1", frame="b", doc="true attitude, Earth-fixed to body")

    def _beam(self, height: Height) -> tuple[Beam, tuple[float, float]]:
        """The beam, and latitude and longitude [rad] where it meets the ground, to some meters."""
        r, v, q_be, look, squint = (
            common(self, name) for name in ("r_e", "v_e", "q_be", "look", "squint")
        )
        h = 0.0
        for _ in range(_ROUNDS):
            ground = flat_dem(h)
            beam = boresight_on_terrain(r, v, q_be, _ALIGNED, float(look), float(squint), ground)
            latitude, longitude, _ = (float(a) for a in geodetic(beam.point))
            rise = height(latitude, longitude) - h
            if not abs(rise) > _CLOSE:  # nor where it is not known
                break
            h += 0.7 * rise
        return Beam(r, v, beam.point), (latitude, longitude)


class ReferenceMap(InView, ReferenceSource):
    """Reference that is a part of a map: a GeoTIFF of amplitudes, or an image of Sentinel-1.

    It is drawn as the radar will see it: on relief a map and an image differ by more than a shift,
    and what is matched all the same is tens of meters off. Heights are those of the terrain, which
    has to cover it: a square that is turned takes half as much again as `reach`. What the map does
    not know is not matched.
    """

    map_file = FilePath(doc="GeoTIFF of one band, any system, turned or not; .tiff of Sentinel-1")
    annotation = OptionalFilePath(doc="annotation (.xml) of Sentinel-1's image")
    first_line = Count(0, doc="line of Sentinel-1's product with which a cut file begins")
    first_sample = Count(0, doc="sample with which it begins")
    spacing = Parameter(
        0.0, unit="m", minimum=0.0, doc="of the image's pixels: finer ones are averaged; 0: as is"
    )

    height = SharedInput(**HEIGHT, doc="heights of the terrain, as they are known")
    grid = SharedInput(**GRID, doc="first point and spacing of the heights")

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect: where a product was cut has with an annotation."""
        if name in _OF_ANNOTATION and self.setting("annotation") is None:
            return False
        return super().takes(name)

    def validate(self) -> None:
        """Open the map."""
        self._map()

    def _map(self) -> Map:
        path, annotation = self.setting("map_file"), self.setting("annotation")
        try:
            if annotation is None:
                return RasterMap(open_raster(path))
            offset = self.setting("first_line"), self.setting("first_sample")
            return Sentinel1Map(read_sentinel1(path, annotation, offset))
        except (OSError, ValueError, ImportError) as error:
            raise ConfigurationError(
                f"'{self.name}' cannot read its map: {error}\n  set {self.name}.map_file"
            ) from error

    def _step_impl(self, t: float, dt: float) -> None:
        dem, reach, spacing = (
            dem_from(self.height, self.grid),
            float(common(self, "reach")),
            float(common(self, "spacing")),
        )
        source = self._map()
        try:
            beam, place = self._beam(lambda *at: float(dem.known_at(*at)))
            part = source.about(*place, _DIAGONAL * reach, spacing, dem.at)
            reference = as_seen(part, beam, reach, spacing, dem.at)
        except ValueError as error:
            raise ConfigurationError(
                f"'{self.name}' has no reference where the beam looks: {error}"
            ) from error
        self._publish(reference)


class ElevationMap(InView):
    """Heights of a part of a large elevation model, in a GeoTIFF, DTED, or a mosaic (VRT).

    As `Terrain` with a file, but only what is needed is read, anew at each step.
    """

    dem_file = FilePath(doc="GeoTIFF, DTED (.dt2), or a mosaic (.vrt) of heights")
    vertical_datum = Terrain.vertical_datum
    geoid = Terrain.geoid

    height = SharedOutput(**HEIGHT, doc="heights, southernmost row first")
    grid = SharedOutput(**GRID, doc="first point and spacing; whether mirrored")

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect: a geoid has where heights count from one."""
        if name == "geoid" and self.setting("vertical_datum") == "ellipsoid":
            return False
        return super().takes(name)

    def validate(self) -> None:
        """Open the elevation model, and look whether it says what its heights refer to."""
        raster = self._raster()
        try:
            referred(self, self._sample(raster))
        except ValueError as error:
            raise self._refused(error) from error

    def _initialize_impl(self) -> None:
        require_common(self)

    def _raster(self) -> Raster:
        try:
            return open_raster(self.setting("dem_file"))
        except (OSError, ValueError, ImportError) as error:
            raise self._refused(error) from error

    def _refused(self, error: Exception) -> ConfigurationError:
        return ConfigurationError(
            f"'{self.name}' cannot read its elevation model: {error}\n  set {self.name}.dem_file"
        )

    def _sample(self, raster: Raster) -> Dem:
        """A model of four points where the raster's middle is, with what its heights refer to."""
        latitude, longitude = (float(a) for a in raster.places(*(n // 2 for n in raster.shape)))
        return Dem(
            *(np.zeros((2, 2), np.float32), latitude, longitude, 1e-4, 1e-4, raster.path.name),
            datum=raster.vertical,
        )

    def _step_impl(self, t: float, dt: float) -> None:
        raster, reach = self._raster(), float(common(self, "reach"))

        def height(latitude: float, longitude: float) -> float:
            size = raster.pixel_size(*(n / 2 for n in raster.shape))
            near = elevations_about(raster, latitude, longitude, 2 * size)
            return float(near.known_at(latitude, longitude))

        try:
            _, place = self._beam(height)
            dem = referred(self, elevations_about(raster, *place, reach))
        except ValueError as error:
            raise ConfigurationError(
                f"'{self.name}' has no heights where the beam looks: {error}"
            ) from error
        self.height = dem.height
        self.grid = np.array(
            [dem.latitude0, dem.longitude0, dem.latitude_step, dem.longitude_step, 0.0]
        )
