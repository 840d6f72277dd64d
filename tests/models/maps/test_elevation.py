"""Elevation models from rasters: the places of heights, voids, what heights refer to."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rasterio", reason="of the extra 'sar'")
pyproj = pytest.importorskip("pyproj", reason="of the extra 'sar'")
from rasterio.transform import Affine  # noqa: E402

from terrafix.models.maps.dem import read_dem, read_hgt, write_dem  # noqa: E402
from terrafix.models.maps.elevation import elevations_about, read_elevations  # noqa: E402
from terrafix.models.maps.raster import open_raster  # noqa: E402

_SPEC = importlib.util.spec_from_file_location("rasters", Path(__file__).with_name("rasters.py"))
rasters = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(rasters)
write, turned = rasters.write, rasters.turned
DEGREES = Affine(0.01, 0, 10.0, 0, -0.01, 50.0)


def plane(n=60, east=0.5, north=-0.25, spacing=30.0, angle=0.0):
    """Heights 200 + east (x - x0) / 100 + north (y - y0) / 100 on a turned grid in UTM."""
    transform = turned(spacing, angle)
    column, row = np.meshgrid(np.arange(n) + 0.5, np.arange(n) + 0.5)
    a, b, c, d, e, f = transform[:6]
    x, y = a * column + b * row + c, d * column + e * row + f
    height = 200 + (east * (x - 500_000) + north * (y - 4_000_000)) / 100
    return height.astype(np.float32), transform


@pytest.mark.parametrize("angle", [0.0, 45.0])
def test_a_plane_in_utm_is_one_wherever_it_is_asked_for(tmp_path, angle):
    height, transform = plane(angle=angle)
    dem = read_elevations(write(tmp_path / "m.tif", height, transform))
    to_utm = pyproj.Transformer.from_crs(4326, 32617, always_xy=True)
    rng = np.random.default_rng(0)
    row, column = rng.uniform(5, 54, (2, 50))
    latitude, longitude = open_raster(tmp_path / "m.tif").places(row, column)
    x, y = to_utm.transform(np.degrees(longitude), np.degrees(latitude))
    wanted = 200 + (0.5 * (x - 500_000) - 0.25 * (y - 4_000_000)) / 100
    found = dem.at(latitude, longitude)
    assert found == pytest.approx(wanted, abs=0.02)  # 0.02 pixels of 0.17 m, and single precision
    assert dem.datum == ""


def test_north_up_degrees_are_taken_as_they_are(tmp_path):
    rows = np.arange(12, dtype=np.float32).reshape(3, 4)
    for name, transform in (
        ("down", DEGREES),
        ("up", Affine(0.01, 0, 10.0, 0, 0.01, 49.97)),
    ):
        values = rows if name == "down" else rows[::-1]
        dem = read_elevations(write(tmp_path / f"{name}.tif", values, transform, "EPSG:4326"))
        assert (dem.height == rows[::-1]).all()
        assert np.degrees(dem.latitude0) == pytest.approx(49.975)
        assert np.degrees(dem.longitude0) == pytest.approx(10.005)
        assert np.degrees(dem.latitude_step) == pytest.approx(0.01)


@pytest.mark.parametrize("angle", [0.0, 30.0])
@pytest.mark.parametrize("nodata", [-9999.0, -1e30, None])
def test_nothing_is_interpolated_with_what_is_not_known(tmp_path, angle, nodata):
    """A void of 4 x 4 in 200 m: what is left is 200 m, to the last bit of a bilinear mean."""
    height = np.full((60, 60), 200, np.float32)
    height[20:24, 30:34] = -9999.0 if nodata is None else nodata
    options = {} if nodata is None else {"nodata": nodata}
    dem = read_elevations(write(tmp_path / "m.tif", height, turned(30.0, angle), **options))
    inside = np.isfinite(dem.height)
    assert dem.height[inside] == pytest.approx(200, abs=1e-4)
    raster = open_raster(tmp_path / "m.tif")
    known = dem.known_at(*raster.places([19.2, 21.5, 23.5, 10.0], [31.5, 31.5, 31.5, 31.5]))
    assert np.isnan(known).tolist() == [True, True, True, False]


@pytest.mark.parametrize("height", [1e9, 9_500.0, -13_000.0])
def test_heights_that_the_earth_does_not_have_are_refused(tmp_path, height):
    values = np.full((4, 4), 10.0, np.float32)
    values[1, 2] = height
    path = write(tmp_path / "m.tif", values, DEGREES, "EPSG:4326")
    with pytest.raises(
        ValueError, match=re.escape(f"the first is {height:g} m in row 1, column 2")
    ):
        read_elevations(path)


def test_a_tile_of_voids_and_one_that_lies_elsewhere_are_refused(tmp_path):
    void = write(tmp_path / "v.tif", np.full((9, 9), -9999, np.int16), DEGREES, "EPSG:4326")
    with pytest.raises(ValueError, match="holds nothing but voids where it is read"):
        read_elevations(void)
    tile = open_raster(write(tmp_path / "t.tif", np.ones((9, 9)), DEGREES, "EPSG:4326"))
    with pytest.raises(ValueError, match=r"'t\.tif' does not cover latitude 40\.000, longitude 10"):
        elevations_about(tile, np.radians(40), np.radians(10), 1e3)


def test_a_part_of_a_map_is_what_the_whole_says_there(tmp_path):
    height, transform = plane(n=200, angle=20.0)
    raster = open_raster(write(tmp_path / "m.tif", height, transform))
    latitude, longitude = (float(a) for a in raster.places(100, 120))
    part = elevations_about(raster, latitude, longitude, 600.0)
    assert max(part.height.shape) < 50
    whole = read_elevations(tmp_path / "m.tif")
    around = latitude + np.linspace(-5e-5, 5e-5, 7)
    assert part.at(around, longitude) == pytest.approx(whole.at(around, longitude), abs=0.02)


def test_an_elevation_model_across_the_date_line(tmp_path):
    """Of a map of the whole Earth, ten columns on each side of 180 degrees."""
    columns = np.tile(np.arange(3600, dtype=np.float32), (20, 1))
    path = write(tmp_path / "m.tif", columns, Affine(0.1, 0, -180, 0, -0.1, 1.0), "EPSG:4326")
    dem = elevations_about(open_raster(path), 0.0, np.radians(180.0), 60e3)
    assert dem.at(0.0, np.radians([179.95, -179.95])) == pytest.approx([3599, 0], abs=1e-3)
    assert dem.at(0.0, np.radians([179.85, -179.85])) == pytest.approx([3598, 1], abs=1e-3)


@pytest.mark.parametrize(
    ("crs", "datum"),
    [("EPSG:4326+5773", "EGM96"), ("EPSG:4326+3855", "EGM2008"), ("EPSG:4326+5703", "EPSG:5703")],
)
def test_a_geotiff_says_what_its_heights_refer_to(tmp_path, crs, datum):
    dem = read_elevations(write(tmp_path / "m.tif", np.ones((4, 4)), DEGREES, crs))
    assert dem.datum == datum
    write_dem(dem, tmp_path / "m.npz")
    assert read_dem(tmp_path / "m.npz").datum == datum


def dted(path, datum=b"E96", accuracy=b"0016"):
    """DTED of level 0 with heights of -3 to 117 m, as GDAL writes it but for its header."""
    height = np.tile(np.arange(121, dtype=np.int16) - 3, (121, 1))
    place = Affine(1 / 120, 0, 10 - 1 / 240, 0, -1 / 120, 46 + 1 / 240)
    write(path, height, place, "EPSG:4326", driver="DTED")
    raw = bytearray(path.read_bytes())
    raw[80 + 141 : 80 + 144] = datum
    raw[80 + 648 + 7 : 80 + 648 + 11] = accuracy
    path.write_bytes(raw)
    return path


def test_dted_says_what_its_heights_refer_to_and_how_exact_they_are(tmp_path):
    dem = read_elevations(dted(tmp_path / "n45.dt0"))
    assert dem.datum == "EGM96"
    assert dem.sigma == pytest.approx(16 / 1.6449)  # nine in ten are within 16 m
    assert np.degrees([dem.latitude0, dem.longitude0]) == pytest.approx([45, 10])
    assert dem.at(np.radians(45.5), np.radians(10 + 7 / 120)) == pytest.approx(4)
    unsaid = read_elevations(dted(tmp_path / "m.dt0", b"MSL", b"NA  "))
    assert unsaid.datum == ""  # a mean sea level is no geoid by name
    assert np.isnan(unsaid.sigma)


def test_a_tile_of_srtm_as_geotiff_is_the_tile(tmp_path, data_folder):
    """GDAL reads .hgt, too: its own driver, and ours, agree in every point and place."""
    import rasterio

    path = data_folder / "dem" / "N44W072.hgt"
    if not path.is_file():
        pytest.skip(f"no data: {path} is absent")
    with rasterio.open(path) as tile:
        write(tmp_path / "m.tif", tile.read(1), tile.transform, tile.crs, nodata=tile.nodata)
    ours, other = read_hgt(path), read_elevations(tmp_path / "m.tif")
    assert (ours.height == other.height).all()
    for name in ("latitude0", "longitude0", "latitude_step", "longitude_step"):
        assert getattr(ours, name) == pytest.approx(getattr(other, name), rel=1e-12)


def test_mark_twain_lake_has_the_heights_and_places_of_its_tags(data_folder):
    """Pixels as OpenCV reads them; tie point and scale of its tags, by hand."""
    import cv2

    path = data_folder / "dem" / "mark_twain_srtm_dem.tif"
    if not path.is_file():
        pytest.skip(f"no data: {path} is absent")
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    dem = read_elevations(path)
    scale = 0.0002694945852358564
    row, column = np.array([3, 700]), np.array([1100, 5])
    latitude = 39.5891579922956 - scale * (row + 0.5)
    longitude = -91.94709507643658 + scale * (column + 0.5)
    found = dem.at(np.radians(latitude), np.radians(longitude))
    assert found == pytest.approx(pixels[row, column], abs=1e-3)
    assert dem.datum == ""
