"""References from maps: places between tie points, anywhere on Earth, against those of PROJ."""

import numpy as np
import pytest

pyproj = pytest.importorskip("pyproj", reason="of the extra 'sar'")
rasterio = pytest.importorskip("rasterio", reason="of the extra 'sar'")
from rasterio.transform import Affine  # noqa: E402

from terrafix.models.images.mapped import RasterMap  # noqa: E402
from terrafix.models.maps.dem import flat_dem  # noqa: E402
from terrafix.models.maps.raster import open_raster  # noqa: E402

FLAT = flat_dem(12.0).at


def sparse(path, crs, transform, n):
    """A map of n x n pixels that takes no room, all of them 1 but where it is not written."""
    profile = {"driver": "GTiff", "count": 1, "height": n, "width": n, "dtype": np.uint8}
    tiles = {"tiled": True, "SPARSE_OK": "TRUE", "compress": "deflate"}
    with rasterio.open(path, "w", crs=crs, transform=transform, **profile, **tiles) as dataset:
        rows = np.random.default_rng(0).integers(1, 255, (n, 512), dtype=np.uint8)
        for first in range(0, n, 512):
            window = rasterio.windows.Window(first, 0, min(512, n - first), n)
            dataset.write(rows[:, : window.width], 1, window=window)
    return path


def about(crs, longitude, latitude, spacing, angle=0.0, n=1500):
    """Transform of a map about a place."""
    x, y = pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(longitude, latitude)
    turned = Affine.rotation(angle) @ Affine.scale(spacing, -spacing)
    return Affine.translation(x, y) @ turned @ Affine.translation(-n / 2, -n / 2)


@pytest.mark.parametrize(
    ("crs", "longitude", "latitude", "spacing", "angle"),
    [
        ("EPSG:32617", -84.0, 36.0, 15.0, 0.0),
        ("EPSG:32759", 169.4, -19.5, 15.0, 104.0),
        ("EPSG:3413", -45.0, 84.0, 15.0, 45.0),
        ("EPSG:3031", 130.0, -84.0, 15.0, 10.0),
        ("EPSG:4326", 180.0, 5.0, 1.35e-4, 0.0),
        ("EPSG:32660", 179.99, 60.0, 15.0, 30.0),
        ("EPSG:3857", 10.0, 47.0, 22.0, 0.0),
        ("EPSG:2056", 8.0, 46.8, 15.0, 0.0),
    ],
)
def test_places_between_tie_points_are_projs(tmp_path, crs, longitude, latitude, spacing, angle):
    """Within 0.02 pixels per axis, over 15 km, at 300 random pixels."""
    path = sparse(tmp_path / "m.tif", crs, about(crs, longitude, latitude, spacing, angle), 1500)
    raster = open_raster(path)
    place = np.radians(latitude), np.radians(longitude)
    reference = RasterMap(raster).about(*place, 7000.0, 0.0, FLAT).reference()
    n = reference.amplitude.shape
    rng = np.random.default_rng(1)
    row, column = (rng.uniform(0, k - 1, 300) for k in n)
    found = reference.place(row, column)
    rows, columns = raster.window(*_square(*place, 7000.0))
    wanted = raster.places(rows.start + row, columns.start + column)
    turn = 2 * np.pi
    off = (found[1] - wanted[1] + np.pi) % turn - np.pi
    meters = 6.371e6 * np.abs([found[0] - wanted[0], off * np.cos(found[0])])
    size = raster.pixel_size(700, 700)
    assert size == pytest.approx(15.0, rel=0.03)
    assert meters.max() < 0.025 * size
    assert reference.height == pytest.approx(12.0)
    assert max(reference.latitude.shape) <= 33
    inside = reference.pixel(found[0][:20], found[1][:20])
    assert inside[2].all()
    assert inside[0] == pytest.approx(row[:20], abs=0.01)


def _square(*about):
    from terrafix.models.maps.elevation import square_about

    return square_about(*about)


def test_ties_on_both_sides_of_the_date_line_are_neighbors(tmp_path):
    """179.95 E and 179.95 W are 11 km apart on the equator, not 40,000."""
    crs = "EPSG:4326"
    path = sparse(tmp_path / "m.tif", crs, about(crs, 180.0, 0.0, 1.35e-4), 1500)
    raster = open_raster(path)
    for side in (1, -1):  # asked for from either side
        reference = RasterMap(raster).about(0.0, side * np.pi, 6000.0, 0.0, FLAT).reference()
        assert np.abs(np.diff(reference.longitude, axis=1)).max() < np.radians(0.15)
        for longitude in (179.95, -179.95, 180.05):
            _, column, inside = reference.pixel(0.0, np.radians(longitude))
            assert inside
            off = (longitude - 180.0 + 180) % 360 - 180
            middle = reference.pixel(0.0, np.pi)[1]
            assert column - middle == pytest.approx(off / 1.35e-4, abs=0.02)


def test_a_map_about_a_pole_says_so(tmp_path):
    path = sparse(tmp_path / "m.tif", "EPSG:3413", about("EPSG:3413", 0.0, 90.0, 15.0), 500)
    with pytest.raises(ValueError, match="about a pole"):
        RasterMap(open_raster(path)).about(np.radians(89.99), 0.0, 3000.0, 0.0, FLAT).reference()


def test_of_a_map_of_10000_by_10000_only_a_part_is_taken(tmp_path):
    n = 10_000
    profile = {"driver": "GTiff", "count": 1, "height": n, "width": n, "dtype": np.float32}
    with rasterio.open(
        tmp_path / "m.tif",
        "w",
        crs="EPSG:32617",
        transform=about("EPSG:32617", -84.0, 36.0, 3.0, 20.0, n),
        **profile,
        tiled=True,
        SPARSE_OK="TRUE",
    ) as dataset:
        window = rasterio.windows.Window(4096, 4096, 1536, 1536)
        dataset.write(np.ones((1536, 1536), np.float32), 1, window=window)
    place = np.radians(36.0), np.radians(-84.0)
    reference = (
        RasterMap(open_raster(tmp_path / "m.tif")).about(*place, 1500.0, 10.0, FLAT).reference()
    )
    assert reference.amplitude.shape == pytest.approx((429, 429), abs=12)
    assert (reference.amplitude > 0).mean() > 0.9
