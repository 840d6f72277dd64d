"""Terrain: an elevation model, and for simulated echo what the ground looks like to a radar."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from terrafix.components.fields import GRID, HEIGHT, SURFACE
from terrafix.components.shared import require_common, shared_setting
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Count, Flag, OptionalFilePath, Parameter
from terrafix.cosim.declare.ports import SharedOutput
from terrafix.models.core.arrays import Single
from terrafix.models.maps.dem import (
    DATUMS,
    ELLIPSOID,
    HIGHEST,
    LOWEST,
    Dem,
    dem_from,
    flat_dem,
    read_jacksboro,
    rolling_dem,
    roughened,
)
from terrafix.models.maps.elevation import read_elevations
from terrafix.models.maps.geoid import GEOIDS, on_ellipsoid
from terrafix.models.radar.cover import COVERS
from terrafix.models.radar.scene import Scene

_log = logging.getLogger(__name__)
SOURCES = ("file", "jacksboro", "flat", "hills")
AS_IN_FILE = "as in the file"
_OF_FILES = ("dem_file", "vertical_datum", "geoid")
_UNREAD = {
    "texture": ("parcels", "point_density", "point_brightness"),
    "urban": ("point_density",),
}
"""What a cover has no use for."""
_OF_HILLS = ("relief", "relief_length", "relief_seed")
_OF_ERRORS = ("error_length", "error_seed")


class Terrain(Component):
    """Elevation model and surface, told once at t = 0 to all who need them.

    Heights are told above the ellipsoid. Those of a file that count from a geoid are turned to it;
    a file that does not say what its heights refer to is refused unless `vertical_datum` does.
    """

    default_rate = Rate(times=["0"])

    source = Choice(
        SOURCES,
        "file",
        doc="file; jacksboro: the real one that comes with matplotlib; flat: one height; hills",
    )
    dem_file = OptionalFilePath(doc="tile of SRTM (.hgt), GeoTIFF or DTED (.dt2), arrays (.npz)")
    vertical_datum = Choice(
        (AS_IN_FILE, *DATUMS), AS_IN_FILE, doc="what heights of the file refer to (file)"
    )
    geoid = Choice(
        GEOIDS, GEOIDS[0], doc="where a geoid comes from: its grid, or shipped harmonics (file)"
    )
    flat_height = Parameter(
        0.0, unit="m", minimum=LOWEST, maximum=HIGHEST, doc="height everywhere (flat); 0 is the sea"
    )
    relief = Parameter(10.0, unit="m", minimum=0.0, doc="rms height (hills)")
    relief_length = Parameter(150.0, unit="m", positive=True, doc="its correlation (hills)")
    relief_seed = Count(0, maximum=2**32, doc="of the heights (hills)")
    error = Parameter(
        0.0, unit="m", minimum=0.0, doc="rms by which these are not the true heights (not flat)"
    )
    error_length = Parameter(150.0, unit="m", positive=True, doc="correlation of the error")
    error_seed = Count(1, maximum=2**32, doc="of the error")
    mirrored = Flag(False, doc="go on for ever in mirror images: artificial, without borders")
    fill_voids = Flag(False, doc="interpolate voids, and say so, instead of refusing them")
    surface_seed = Count(0, maximum=2**53, doc="of texture and bright points")
    detail = Count(1, minimum=1, doc="how fine texture is: 1 from orbit, 10 from an aircraft")
    cover = Choice(
        COVERS,
        "parcels",
        doc="of the ground: parcels; texture, without borders and points; urban; coast; causeway, "
        "in the sea; fields",
    )
    parcels = Parameter(2.5, minimum=0.0, doc="texture with sharp borders, standard deviation [dB]")
    smooth = Parameter(1.5, minimum=0.0, doc="smooth texture, standard deviation [dB]")
    fine = Parameter(1.5, minimum=0.0, doc="fine texture, standard deviation [dB]")
    point_density = Parameter(3.0, minimum=0.0, doc="bright points per square kilometer")
    point_brightness = Parameter(25.0, doc="of a bright point, median, above a mean cell [dB]")

    height = SharedOutput(**HEIGHT, doc="heights, southernmost row first")
    grid = SharedOutput(**GRID, doc="first point and spacing; whether mirrored")
    surface = SharedOutput(**SURFACE, doc="seed, strength, points, detail, cover of the ground")

    def validate(self) -> None:
        """Read the elevation model."""
        self._read()

    def _read(self) -> Dem:
        source, path = self.setting("source"), self.setting("dem_file")
        self._n_filled = 0
        if source == "flat":
            return flat_dem(float(shared_setting(self, "flat_height")))
        if source == "hills":
            return self._hills()
        if source == "file" and path is None:
            raise ConfigurationError(
                f"'{self.name}' needs an elevation model\n"
                f"  set {self.name}.dem_file, or {self.name}.source to jacksboro or flat"
            )
        try:
            dem = (
                read_jacksboro() if source == "jacksboro" else referred(self, read_elevations(path))
            )
            if self.setting("fill_voids"):
                self._n_filled = dem.n_void
            dem = dem.filled() if self._n_filled else dem
        except (OSError, ValueError, ImportError) as error:
            raise ConfigurationError(
                f"'{self.name}' cannot read its elevation model: {error}\n"
                f"  set {self.name}.dem_file to another"
            ) from error
        if dem.n_void and self.setting("mirrored"):
            raise ConfigurationError(
                f"'{self.name}' is to mirror '{dem.name}', of which {dem.n_void} points are void\n"
                f"  set {self.name}.fill_voids = true, or use another"
            )
        dem = dem.tiled() if self.setting("mirrored") else dem
        return self._with_errors(dem)

    def _with_errors(self, dem: Dem) -> Dem:
        """What is known of the heights, where they are to be known with errors."""
        rms, length = (float(shared_setting(self, name)) for name in ("error", "error_length"))
        if not rms:
            return dem
        try:
            return roughened(dem, rms, length, self.setting("error_seed"))
        except ValueError as error:
            raise ConfigurationError(
                f"'{self.name}' cannot err: {error}\n  set {self.name}.error_length"
            ) from error

    def _hills(self) -> Dem:
        """Artificial heights, and an error of them where one is asked for."""
        true = self._rolling("relief")
        if not float(shared_setting(self, "error")):
            return true
        return replace(true, height=true.height + self._rolling("error").height)

    def _rolling(self, what: str) -> Dem:
        rms, length = (float(shared_setting(self, f"{what}{k}")) for k in ("", "_length"))
        try:
            return rolling_dem(rms, length, self.setting(f"{what}_seed"))
        except ValueError as error:
            raise ConfigurationError(
                f"'{self.name}' cannot make its hills: {error}\n  set {self.name}.{what}_length"
            ) from error

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect: heights of hills have where there are hills."""
        if name in _UNREAD.get(self.setting("cover"), ()):
            return False
        hills = bool(self.setting("source") == "hills")
        if name in _OF_HILLS:
            return hills
        if name == "error":
            return bool(self.setting("source") != "flat")
        if name in _OF_ERRORS:
            return self.takes("error") and bool(float(self.setting("error")) > 0)
        if name in _OF_FILES:
            stated = name == "geoid" and self.setting("vertical_datum") == ELLIPSOID
            return self.setting("source") == "file" and not stated
        return super().takes(name) and not (hills and name in ("mirrored", "fill_voids"))

    def _initialize_impl(self) -> None:
        require_common(self)
        dem = self._read()
        if self._n_filled:
            _log.warning(
                "'%s' filled %d void points of the %d of '%s' by interpolation from their rims",
                *(self.name, self._n_filled, dem.height.size, dem.name),
            )
        self.height = dem.height
        self.grid = np.array(
            [
                dem.latitude0,
                dem.longitude0,
                dem.latitude_step,
                dem.longitude_step,
                float(dem.mirrored),
            ]
        )
        strengths = (
            self.parcels,
            self.smooth,
            self.fine,
            self.point_density,
            self.point_brightness,
        )
        self.surface = np.array(
            [
                float(self.surface_seed),
                *(float(s[0]) for s in strengths),
                float(self.detail),
                float(COVERS.index(self.cover)),
            ]
        )

    def _step_impl(self, t: float, dt: float) -> None:
        """Say nothing more."""


def referred(component: Component, dem: Dem) -> Dem:
    """Heights of a file above the ellipsoid, by a component's settings.

    Raises
    ------
    ValueError
        If nothing says what they refer to, file and setting contradict each other, or a geoid is
        not to be had.
    """
    stated = component.setting("vertical_datum")
    if stated != AS_IN_FILE:
        if dem.datum not in ("", stated):
            raise ValueError(
                f"{component.name}.vertical_datum is {stated}, but '{dem.name}' says that its "
                f"heights refer to {dem.datum}\n  leave it out"
            )
        dem = replace(dem, datum=stated)
    if not dem.datum:
        raise ValueError(
            f"'{dem.name}' does not say what its heights refer to: a geoid is up to 107 m off the "
            f"ellipsoid\n  set {component.name}.vertical_datum to {', '.join(DATUMS)}"
        )
    return on_ellipsoid(dem, component.setting("geoid"))


def scene_from(height: Single, grid: FloatArray, surface: FloatArray) -> Scene:
    """What the ground looks like to a radar, from the ports of a terrain."""
    seed, parcels, smooth, fine, density, brightness, detail, cover = (float(s) for s in surface)
    return Scene(
        dem_from(height, grid),
        int(seed),
        *(parcels, smooth, fine, density, brightness),
        detail=int(detail),
        cover=COVERS[int(cover)],
    )
