"""Rasters: where pixels lie, what is known of them, what is no map; checked by PROJ and by hand."""

import importlib.util
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rasterio", reason="of the extra 'sar'")
pyproj = pytest.importorskip("pyproj", reason="of the extra 'sar'")
import rasterio  # noqa: E402
from rasterio.transform import Affine  # noqa: E402

from terrafix.models.maps.raster import knots, open_raster  # noqa: E402

_SPEC = importlib.util.spec_from_file_location("rasters", Path(__file__).with_name("rasters.py"))
rasters = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(rasters)
write, turned = rasters.write, rasters.turned
RAMP = np.arange(600, dtype=np.float32).reshape(20, 30)


@pytest.mark.parametrize("angle", [0.0, 45.0, 104.0, 180.0])
def test_pixels_of_a_turned_map_lie_where_its_transform_puts_their_centers(tmp_path, angle):
    raster = open_raster(write(tmp_path / "m.tif", RAMP, turned(10.0, angle)))
    latitude, longitude = raster.places(3, 5)
    # 55 m along the turned columns, 35 m down the turned rows, by hand
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    x, y = 500_000 + 55 * c - 35 * s, 4_000_000 - 55 * s - 35 * c
    wanted = pyproj.Transformer.from_crs(32617, 4326, always_xy=True).transform(x, y)
    assert np.degrees(longitude) == pytest.approx(wanted[0], abs=1e-11)
    assert np.degrees(latitude) == pytest.approx(wanted[1], abs=1e-11)
    assert np.allclose(raster.pixels(latitude, longitude), (3, 5), atol=1e-6)
    assert raster.north_up is False
    assert raster.pixel_size(10, 10) == pytest.approx(10.0, rel=4e-3)  # of a sphere


def test_a_point_raster_is_half_a_pixel_elsewhere(tmp_path):
    """RasterPixelIsPoint: the tie point is the middle of the first pixel, not its corner."""
    area, point = (
        open_raster(
            write(
                tmp_path / f"{kind}.tif",
                RAMP,
                Affine(0.1, 0, 10.0, 0, -0.1, 50.0),
                "EPSG:4326",
                tags={"AREA_OR_POINT": kind},
            )
        )
        for kind in ("Area", "Point")
    )
    # GDAL writes the tie point so that the file says the same place either way
    assert np.degrees(area.places(0, 0)) == pytest.approx([49.95, 10.05])
    assert np.degrees(point.places(0, 0)) == pytest.approx([49.95, 10.05])


def test_nodata_masks_and_scale_are_those_of_the_file(tmp_path):
    values = RAMP.copy()
    values[2, 3] = -1
    mask = np.full(RAMP.shape, 255, np.uint8)
    mask[4, 5] = 0
    place = turned(10.0, 0.0)
    by_nodata = open_raster(write(tmp_path / "n.tif", values, place, nodata=-1))
    by_mask = open_raster(write(tmp_path / "k.tif", RAMP, place, mask=mask))
    whole = slice(0, 20), slice(0, 30)
    for raster, hole in ((by_nodata, (2, 3)), (by_mask, (4, 5))):
        found, known = raster.read(*whole)
        assert np.argwhere(~known).tolist() == [list(hole)]
        assert found[hole] == 0
        assert (found[known] == RAMP[known]).all()
    alpha = np.stack([RAMP, mask.astype(np.float32)])
    path = write(tmp_path / "a.tif", alpha, place, photometric="MINISBLACK", alpha="YES")
    assert np.argwhere(~open_raster(path).read(*whole)[1]).tolist() == [[4, 5]]
    with rasterio.open(tmp_path / "s.tif", "w", **_profile(np.int16, place)) as dataset:
        dataset.write(RAMP.astype(np.int16), 1)
        dataset.scales, dataset.offsets = (0.1,), (-5.0,)
    found, _ = open_raster(tmp_path / "s.tif").read(*whole)
    assert found == pytest.approx(0.1 * RAMP - 5, abs=1e-5)


def _profile(dtype, transform):
    return {
        "driver": "GTiff",
        "count": 1,
        "height": 20,
        "width": 30,
        "dtype": dtype,
        "crs": rasters.UTM,
        "transform": transform,
    }


def test_blocks_have_the_root_of_the_mean_square_of_what_is_known(tmp_path):
    values = np.array([[3, 4, -1, -1, 9], [0, 5, 7, -1, 9], [1, 1, 1, 1, 9]], np.float32)
    raster = open_raster(write(tmp_path / "m.tif", values, turned(1.0, 0.0), nodata=-1))
    found, known = raster.read(slice(0, 3), slice(0, 5), 2)
    assert found.shape == (1, 2)  # what is left of a block is dropped
    assert found[0, 0] == pytest.approx(np.sqrt(50 / 4))
    assert known.tolist() == [[True, False]]  # of the second block one in four is known


def test_a_window_across_the_date_line_of_a_map_of_the_earth(tmp_path):
    columns = np.tile(np.arange(3600, dtype=np.float32), (10, 1))
    earth = open_raster(
        write(tmp_path / "m.tif", columns, Affine(0.1, 0, -180, 0, -0.1, 0.5), "EPSG:4326")
    )
    assert earth.turn == 3600
    rows, part = earth.window(np.zeros(2), np.radians([179.95, 180.05]), margin=1)
    found, known = earth.read(rows, part)
    assert found[0].tolist() == [3598, 3599, 0, 1]
    assert known.all()
    assert np.degrees(earth.places(4, [3599, 3600])[1]) == pytest.approx([179.95, 180.05])


def test_a_map_that_goes_on_beyond_180_degrees(tmp_path):
    path = write(tmp_path / "m.tif", RAMP, Affine(0.01, 0, 179.85, 0, -0.01, 10), "EPSG:4326")
    raster = open_raster(path)
    for longitude in (-179.945, 180.055):
        row, column = raster.pixels(np.radians(9.945), np.radians(longitude))
        assert (row, column) == pytest.approx((5, 20), abs=1e-6)
    utm = open_raster(write(tmp_path / "u.tif", RAMP, turned(1e3, 0.0, (800e3, 1e6)), "EPSG:32660"))
    latitude, longitude = utm.places(0, [0, 29])
    assert np.ptp(np.degrees(longitude)) == pytest.approx(0.264, abs=1e-3)  # 29 km, not a turn
    assert utm.pixels(latitude, longitude)[1] == pytest.approx([0, 29], abs=1e-6)


def test_a_polar_map_at_84_degrees(tmp_path):
    """Latitude 84 N, 45 W is straight down from the pole in NSIDC's stereographic map."""
    polar = pyproj.Transformer.from_crs(4326, 3413, always_xy=True)
    x, y = polar.transform(-45.0, 84.0)
    path = write(tmp_path / "m.tif", RAMP, Affine(100, 0, x - 50, 0, -100, y + 50), "EPSG:3413")
    assert np.degrees(open_raster(path).places(0, 0)) == pytest.approx([84.0, -45.0], abs=1e-9)


def test_knots_are_as_dense_as_the_error_wants():
    """A parabola of curvature 2 is off by h^2 / 4 in the middle between knots h apart."""

    def place(row, column):
        return row**2 + 0 * column, 0 * row + column

    rows, columns, values = knots(place, (0.0, 16.0), (0.0, 16.0), np.array([1.0, 1.0]))
    assert np.diff(rows) == pytest.approx(2.0)  # 1 = 2^2 / 4
    assert values[..., 0] == pytest.approx(np.broadcast_to(rows[:, None] ** 2, values.shape[:2]))
    assert values[..., 1] == pytest.approx(np.broadcast_to(columns, values.shape[:2]))
    with pytest.raises(ValueError, match="about a pole"):
        knots(lambda i, j: (np.sign(i - 3.3) + 0 * j, j + 0 * i), (0, 9), (0, 9), np.ones(2) / 9)


ENGINEERING = 'LOCAL_CS["a shop floor",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"crs": None}, "has no georeference: nothing says where its pixels lie"),
        ({"values": np.stack([RAMP] * 3)}, r"has 3 bands .*\n  write one .* gdal_translate -b 1"),
        ({"values": RAMP.astype(np.complex64)}, "is complex, in the geometry of its radar"),
        ({"crs": ENGINEERING}, "is in 'a shop floor', which is no place on Earth"),
        ({"transform": Affine(1, 1, 0, 1, 1, 0)}, "all pixels on a line"),
        ({"crs": "EPSG:32617+6360"}, "is in .us survey foot., not in meters"),
        ({"crs": "EPSG:4267", "transform": Affine(0.01, 0, -96, 0, -0.01, 40)}, "projsync --file"),
    ],
)
def test_what_is_no_map_is_refused_and_named(tmp_path, options, message):
    options = {"values": RAMP, "transform": turned(1.0, 0.0)} | options
    with pytest.raises(ValueError, match=message):
        open_raster(write(tmp_path / "m.tif", **options)).places(0, 0)


def test_pictures_and_other_files_are_named_for_what_they_are(tmp_path):
    path = tmp_path / "m.tif"
    with rasterio.open(path, "w", **_profile(np.uint8, turned(1.0, 0.0))) as dataset:
        dataset.write(RAMP.astype(np.uint8), 1)
        dataset.write_colormap(1, {0: (0, 0, 0), 1: (255, 0, 0)})
    with pytest.raises(ValueError, match="is a picture: its pixels are numbers of colors"):
        open_raster(path)
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(ValueError, match=r"cannot be read as GTiff: it is HDF5"):
        open_raster(path)
    with pytest.raises(FileNotFoundError, match="is not there"):
        open_raster(tmp_path / "none.tif")
    with pytest.raises(ValueError, match=r"is no raster that is read \(\.tif, \.tiff, \.dt0"):
        open_raster(path.rename(tmp_path / "m.h5"))


def test_a_damaged_file_says_so(tmp_path):
    path = write(tmp_path / "m.tif", RAMP, turned(1.0, 0.0), compress="deflate")
    whole = path.read_bytes()
    raster = open_raster(path)
    path.write_bytes(whole[: whole.index(b"\x78") + 8] + bytes(40) + whole[-400:])
    with pytest.raises(ValueError, match=r"damaged|cannot be read"):
        raster.read(slice(0, 20), slice(0, 30))


def test_a_place_elsewhere_and_a_window_too_large_are_refused(tmp_path):
    raster = open_raster(write(tmp_path / "m.tif", RAMP, turned(10.0, 0.0)))
    with pytest.raises(
        ValueError, match=r"does not cover latitude 37\.000, longitude -80\.000"
    ) as e:
        raster.window(np.radians([37.0]), np.radians([-80.0]))
    assert "it covers latitude 36.143 to 36.145, longitude -81.000 to -80.997 deg" in str(e.value)
    with pytest.raises(ValueError, match=r"10000 x 10000 pixels is too large; 64 million"):
        raster.read(slice(0, 10_000), slice(0, 10_000))


def test_a_window_of_a_large_map_takes_the_memory_of_the_window(tmp_path):
    """20,000 x 20,000 pixels, sparse: 400 MB whole; a window of 1,000 x 1,000 is 4 MB of it."""
    profile = _profile(np.uint8, turned(3.0, 20.0)) | {"height": 20_000, "width": 20_000}
    tiles = {"tiled": True, "blockxsize": 512, "blockysize": 512, "SPARSE_OK": "TRUE"}
    with rasterio.open(tmp_path / "m.tif", "w", **profile, **tiles) as dataset:
        window = rasterio.windows.Window(10_240, 10_240, 512, 512)
        dataset.write(np.full((512, 512), 7, np.uint8), 1, window=window)
    tracemalloc.start()
    raster = open_raster(tmp_path / "m.tif")
    found, known = raster.read(slice(10_000, 11_000), slice(10_000, 11_000))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert known.all()
    assert (found == 7).sum() == 512 * 512
    assert peak < 20e6  # 5 MB of it are what is kept


def test_umbra_lies_where_its_tags_say(data_folder):
    """The matrix of tag 34264 by hand, and PROJ from UTM 59 south."""
    from PIL import Image

    path = data_folder / "umbra_mount_yasur" / "umbra_mount_yasur.tiff"
    if not path.is_file():
        pytest.skip(f"no data: {path} is absent")
    with Image.open(path) as image:
        matrix = np.array(image.tag_v2[34264]).reshape(4, 4)
    row, column = np.array([0.0, 7.0, 1999.0]), np.array([0.0, 1500.0, 1999.0])
    x, y = matrix[:2, :2] @ [column + 0.5, row + 0.5] + matrix[:2, 3:]
    wanted = pyproj.Transformer.from_crs(32759, 4326, always_xy=True).transform(x, y)
    latitude, longitude = open_raster(path).places(row, column)
    assert np.degrees(longitude) == pytest.approx(wanted[0], abs=1e-11)
    assert np.degrees(latitude) == pytest.approx(wanted[1], abs=1e-11)


def test_landsat_lies_where_pillow_and_our_own_projection_put_it(data_folder):
    from terrafix.models.maps.geotiff import read_geotiff

    path = data_folder / "landsat8" / "LC08_L1TP_224077_20200518_20200518_01_RT_B4.TIF"
    if not path.is_file():
        pytest.skip(f"no data: {path} is absent")
    image, raster = read_geotiff(path), open_raster(path)
    latitude, longitude = raster.places([0, 1500], [0, 2000])
    column, row = image.pixel(latitude, longitude)
    assert row == pytest.approx([0, 1500], abs=1e-3)  # of 30 m
    assert column == pytest.approx([0, 2000], abs=1e-3)
    found, _ = raster.read(slice(700, 703), slice(900, 904))
    assert (found == image.pixels[700:703, 900:904]).all()
