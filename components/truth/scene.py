"""A scene: an image of the ground about a target, told once at t = 0 to all who need it."""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path

import numpy as np

from terrafix.components.fields import SCENE, SCENE_GRID, SCENE_PLACE
from terrafix.components.shared import require_common, shared_setting
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Count, OptionalFilePath, Parameter
from terrafix.cosim.declare.ports import SharedOutput
from terrafix.models.core.arrays import Single
from terrafix.models.images.frames import textured_scene
from terrafix.models.maps.geotiff import GeoImage, read_geotiff, read_texture

_log = logging.getLogger(__name__)
SOURCES = ("synthetic", "map", "texture")
_OF = {
    "synthetic": ("seed", "size", "spacing"),
    "map": ("file", "latitude", "longitude"),
    "texture": ("file", "spacing"),
}
_DARK, _BRIGHT = 26.0, 230.0
"""Codes of the 2nd and the 98th percentile of a file's pixels: of 8 bits, with room to either side.
"""


class GroundScene(Component):
    """An image of the ground about a target: a map with a georeference, or a texture.

    A file is stretched to codes of 8 bits; its pixels of code zero are taken for missing, and
    have the median of the others.
    """

    default_rate = Rate(times=["0"])

    source = Choice(
        SOURCES,
        "synthetic",
        doc="synthetic: drawn; map: a file that knows where it lies; texture: a file that need not",
    )
    file = OptionalFilePath(doc="image of one band (.tif)")
    latitude = Parameter(0.0, unit="rad", doc="of the target, geodetic (map)")
    longitude = Parameter(0.0, unit="rad", doc="of the target (map)")
    seed = Count(1, maximum=2**31, doc="of what is drawn (synthetic)")
    size = Count(1536, minimum=256, maximum=8192, doc="rows and columns (synthetic)")
    spacing = Parameter(50.0, unit="m", positive=True, doc="of its pixels (synthetic, texture)")

    scene = SharedOutput(**SCENE, doc="codes of 8 bits, north up")
    place = SharedOutput(**SCENE_PLACE, doc="of the target; its middle, but of a map")
    grid = SharedOutput(**SCENE_GRID, doc="how the scene lies")

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect: those of its source have."""
        return name == "source" or name in _OF[self.setting("source")]

    def validate(self) -> None:
        """Read the file."""
        self._made()

    def _initialize_impl(self) -> None:
        require_common(self)
        self.scene, self.place, self.grid = self._made()

    def _step_impl(self, t: float, dt: float) -> None:
        """Say nothing more."""

    def _made(self) -> tuple[Single, FloatArray, FloatArray]:
        source, path = self.setting("source"), self.setting("file")
        if source == "synthetic":
            pixels = _drawn(self.setting("size"), self.setting("seed"))
            return pixels, *self._in_its_middle(pixels)
        if path is None:
            raise ConfigurationError(
                f"'{self.name}' needs an image of the ground\n"
                f"  set {self.name}.file, or {self.name}.source to synthetic"
            )
        try:
            stamp = _stamp(path)
            pixels = _stretched(path, stamp, source)
            if source == "texture":
                return pixels, *self._in_its_middle(pixels)
            return pixels, *self._on_the_map(_read(path, stamp))
        except (OSError, ValueError) as error:
            told = getattr(error, "strerror", None)
            reason = f"'{path}': {told.lower()}" if told else str(error)
            if isinstance(error, FileNotFoundError):
                reason += f"\n  set {self.name}.file, or TERRAFIX_DATA to the folder with the data"
            raise ConfigurationError(f"'{self.name}' cannot read its image: {reason}") from error

    def _in_its_middle(self, pixels: Single) -> tuple[FloatArray, FloatArray]:
        rows, columns = pixels.shape
        spacing = float(shared_setting(self, "spacing"))
        grid = np.array([[0.0, 1.0], [-1.0, 0.0]]) / spacing
        return np.array([(columns - 1) / 2, (rows - 1) / 2]), grid

    def _on_the_map(self, image: GeoImage) -> tuple[FloatArray, FloatArray]:
        latitude, longitude = (
            float(shared_setting(self, name)) for name in ("latitude", "longitude")
        )
        column, row = (float(x) for x in image.pixel(latitude, longitude))
        rows, columns = image.pixels.shape
        if not (0 <= column <= columns - 1 and 0 <= row <= rows - 1):
            raise ConfigurationError(
                f"the target of '{self.name}', latitude {np.degrees(latitude):.4f}, longitude "
                f"{np.degrees(longitude):.4f} deg, lies beyond the map '{image.name}'\n"
                f"  its pixel would be row {row:.0f}, column {column:.0f} of {rows} x {columns}"
            )
        return np.array([column, row]), image.grid(latitude, longitude)


def _stamp(path: Path) -> tuple[int, int]:
    """Time and size of a file, by which it is read again where it has changed."""
    stat = path.stat()
    return stat.st_mtime_ns, stat.st_size


@lru_cache(maxsize=2)
def _drawn(size: int, seed: int) -> Single:
    return textured_scene(size, seed)


@lru_cache(maxsize=2)
def _read(path: Path, _: tuple[int, int]) -> GeoImage:
    return read_geotiff(path)


@lru_cache(maxsize=2)
def _stretched(path: Path, stamp: tuple[int, int], source: str) -> Single:
    """Codes of the pixels of a file."""
    pixels = read_texture(path) if source == "texture" else _read(path, stamp).pixels
    there = pixels != 0
    low, middle, high = np.percentile(pixels[there], [2, 50, 98]) if there.any() else (0, 0, 0)
    if not high > low:
        raise ValueError(f"'{path}' is the same everywhere: it has no texture")
    missing = int((~there).sum())
    if missing:
        _log.info("'%s': %d pixels of code zero have the median of the others", path, missing)
    codes = _DARK + (np.where(there, pixels, middle) - low) * ((_BRIGHT - _DARK) / (high - low))
    return np.asarray(np.clip(codes, 0.0, 255.0), np.float32)
