"""Elevation models: interpolation, orientation, voids, borders, files."""

import os
from pathlib import Path

import numpy as np
import pytest

from terrafix.models.maps.dem import (
    Dem,
    flat_dem,
    read_dem,
    read_hgt,
    read_jacksboro,
    rolling_dem,
    roughened,
    write_dem,
)

DATA = Path(os.environ.get("TERRAFIX_DATA", Path(__file__).parents[4] / "shared" / "data"))


def plane(n=20, step=1e-3, rise_north=3.0, rise_east=-2.0, **options):
    i, j = np.mgrid[:n, :n]
    height = (100 + rise_north * i + rise_east * j).astype(np.float32)
    return Dem(height, 0.6, -1.4, step, step, "a plane", **options)


def test_a_plane_is_interpolated_exactly():
    dem = plane()
    rng = np.random.default_rng(0)
    u, w = rng.uniform(0, 19, (2, 200))
    height = dem.at(0.6 + 1e-3 * u, -1.4 + 1e-3 * w)
    assert height == pytest.approx(100 + 3 * u - 2 * w, abs=1e-4)  # single precision


def test_longitudes_may_be_turns_away():
    dem = plane()
    assert dem.at(0.605, -1.395 + 2 * np.pi) == pytest.approx(
        float(dem.at(0.605, -1.395)), abs=1e-4
    )


def test_slopes_of_a_plane():
    north, east = plane(step=1e-5).slopes(0.6 + 5e-5, -1.4 + 7e-5)
    assert north == pytest.approx(3 / (6371e3 * 1e-5), rel=1e-3)
    assert east == pytest.approx(-2 / (6371e3 * 1e-5 * np.cos(0.6)), rel=1e-3)


def test_slopes_at_the_border_are_one_sided():
    north, east = plane(step=1e-5).slopes(0.6, -1.4 + 19e-5)
    assert north == pytest.approx(3 / (6371e3 * 1e-5), rel=1e-3)
    assert east == pytest.approx(-2 / (6371e3 * 1e-5 * np.cos(0.6)), rel=1e-3)


def test_outside_is_refused_with_both_sides():
    with pytest.raises(ValueError, match=r"a plane does not cover latitude 40\.1070") as raised:
        plane().at(0.7, -1.4)
    assert "it covers latitude 34.377 to 35.466, longitude -80.214 to -79.125 deg" in str(
        raised.value
    )
    assert not plane().covers(0.7, -1.4)
    assert plane().covers(0.61, -1.39)


def test_voids_are_refused_and_can_be_filled():
    dem = plane()
    dem.height[5:8, 5:9] = np.nan
    with pytest.raises(
        ValueError, match=r"a plane is void at latitude .* and in 12 of its 400 points"
    ):
        dem.at(0.6 + 6e-3, -1.4 + 6e-3)
    assert dem.filled().height == pytest.approx(plane().height, abs=1e-3)
    assert np.isnan(dem.height).sum() == 12  # what was given is left alone
    dem.height[...] = np.nan
    with pytest.raises(ValueError, match="nothing but voids"):
        dem.filled()


def test_mirror_images_are_continuous_and_symmetric():
    rng = np.random.default_rng(1)
    dem = Dem(rng.uniform(0, 500, (12, 15)).astype(np.float32), 0.5, 1.0, 1e-4, 1e-4).tiled()
    north, east = 0.5 + 11e-4, 1.0 + 14e-4
    d = rng.uniform(0, 10e-4, 50)
    assert dem.at(north + d, 1.0 + 5e-4) == pytest.approx(dem.at(north - d, 1.0 + 5e-4), abs=1e-3)
    assert dem.at(0.5 + 4e-4, east + d) == pytest.approx(dem.at(0.5 + 4e-4, east - d), abs=1e-3)
    period = 2 * 11e-4
    assert dem.at(0.5 + d + 7 * period, 1.0 - 3e-4) == pytest.approx(
        dem.at(0.5 + d, 1.0 + 3e-4), abs=1e-2
    )
    assert dem.covers(-1.0, 3.0)


def test_flat_ground_is_flat_everywhere():
    assert flat_dem(7.0).at([-1.5, 0.3], [3.0, -2.0]) == pytest.approx([7.0, 7.0])


def test_jacksboro_is_where_it_is():
    """Cross Mountain, the summit of the Cumberlands in Tennessee, is at 36.198 N, 84.231 W.

    The ridges of the Valley and Ridge province, low and parallel, lie in the model's southeast;
    the Cumberland Mountains, high, in its northwest.
    """
    dem = read_jacksboro()
    assert dem.height.shape == (344, 403)
    assert dem.height.min() == 236
    assert dem.height.max() == 1076
    row, column = np.unravel_index(np.argmax(dem.height), dem.height.shape)
    latitude = np.degrees(dem.latitude0 + row * dem.latitude_step)
    longitude = np.degrees(dem.longitude0 + column * dem.longitude_step)
    assert latitude == pytest.approx(36.1983, abs=1e-3)
    assert longitude == pytest.approx(-84.2306, abs=1e-3)
    n_lat, n_lon = dem.height.shape
    northwest = dem.height[n_lat // 2 :, : n_lon // 2].mean()
    southeast = dem.height[: n_lat // 2, n_lon // 2 :].mean()
    assert northwest > southeast + 100


def hgt(folder, name="N44W072.hgt", n=1201, values=None):
    raw = np.full((n, n), 300, ">i2") if values is None else values.astype(">i2")
    path = folder / name
    raw.tofile(path)
    return path


def test_a_tile_is_read_with_its_orientation_and_voids(tmp_path):
    values = np.zeros((1201, 1201), np.int16)
    values[0, 0] = 1000  # northwest
    values[1200, 1200] = 2000  # southeast
    values[600, 600] = -32768
    dem = read_dem(hgt(tmp_path, values=values))
    place = np.radians
    assert dem.at(place(45.0), place(-72.0)) == pytest.approx(1000)
    assert dem.at(place(44.0), place(-71.0)) == pytest.approx(2000)
    assert dem.n_void == 1


def test_southern_and_western_tiles(tmp_path):
    dem = read_hgt(hgt(tmp_path, "S13E170.hgt"))
    assert np.degrees([dem.latitude0, dem.longitude0]) == pytest.approx([-13, 170])


def test_the_highest_mountain_is_where_it_is():
    path = DATA / "dem" / "N44W072.hgt"
    if not path.is_file():
        pytest.skip(f"no real data: {path} is absent (set TERRAFIX_DATA)")
    dem = read_hgt(path)
    i, j = np.unravel_index(np.nanargmax(dem.height), dem.height.shape)
    latitude = np.degrees(dem.latitude0 + i * dem.latitude_step)
    longitude = np.degrees(dem.longitude0 + j * dem.longitude_step)
    assert (latitude, longitude) == pytest.approx((44.2706, -71.3033), abs=2e-3)  # Mt. Washington
    assert dem.height[i, j] == pytest.approx(1917, abs=30)  # its summit, smoothed by the radar


def test_a_file_of_ours_is_read_back(tmp_path):
    path = tmp_path / "plane.npz"
    write_dem(plane(), path)
    dem = read_dem(path)
    assert dem.height.tobytes() == plane().height.tobytes()
    assert dem.latitude0 == pytest.approx(0.6, abs=1e-15)


def test_bad_files_are_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"N44W072\.hgt' is not there"):
        read_dem(tmp_path / "N44W072.hgt")
    short = tmp_path / "N44W072.hgt"
    short.write_bytes(b"\0" * 1000)
    with pytest.raises(ValueError, match="has 1000 bytes; a tile of SRTM has 2884802 or 25934402"):
        read_dem(short)
    with pytest.raises(ValueError, match=r"its name must give the southwestern corner, as N44W072"):
        read_dem(hgt(tmp_path, "tile.hgt"))
    other = tmp_path / "map.grd"
    other.write_bytes(b"II*\0")
    with pytest.raises(ValueError, match=r"no elevation model: a tile of SRTM \(\.hgt\), arrays"):
        read_dem(other)
    np.savez(tmp_path / "map.npz", heights=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="it has no 'height_m'; it holds heights"):
        read_dem(tmp_path / "map.npz")
    (tmp_path / "torn.npz").write_bytes((tmp_path / "map.npz").read_bytes()[:100])
    with pytest.raises(ValueError, match=r"torn\.npz' is not an elevation model: it is damaged"):
        read_dem(tmp_path / "torn.npz")


@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_slopes_do_not_depend_on_the_turn(turns):
    """A model across 180 degrees rises by 90 m a cell to the east; asked from either side."""
    step = np.radians(1e-3)
    height = np.broadcast_to(90.0 * np.arange(21), (21, 21)).astype(np.float32)
    dem = Dem(height, 0.0, np.radians(180.0) - 10 * step, step, step)
    longitude = np.radians(180.0) + np.array([-3.0, 0.0, 3.0]) * step + 2 * np.pi * turns
    north, east = dem.slopes(np.full(3, 10 * step), longitude)
    np.testing.assert_allclose(east, 90.0 / (6371e3 * step * np.cos(10 * step)), rtol=1e-6)
    np.testing.assert_allclose(north, 0.0, atol=1e-9)


@pytest.mark.parametrize("void", [-9999.0, -32768.0, -32767.0, np.nan])
def test_what_files_write_for_a_void_is_one(tmp_path, void):
    """Never a height to interpolate with: halfway to -9999 m would be some -4,900 m."""
    grid = np.full((4, 4), 200.0, np.float32)
    grid[1, 1] = void
    write_dem(Dem(grid, 0.0, 0.0, 0.01, 0.01), tmp_path / "holes.npz")
    dem = read_dem(tmp_path / "holes.npz")
    assert dem.n_void == 1
    with pytest.raises(ValueError, match=r"is void at latitude .* in 1 of its 16 points"):
        dem.at(0.005, 0.005)
    np.testing.assert_array_equal(dem.filled().height, 200.0)


@pytest.mark.parametrize("void", [-9999, -32767])
def test_a_tile_may_write_other_voids(tmp_path, void):
    raw = np.full((1201, 1201), 100, ">i2")
    raw[0, 0] = void
    raw.tofile(tmp_path / "N10E010.hgt")
    assert read_dem(tmp_path / "N10E010.hgt").n_void == 1


@pytest.mark.parametrize("height", [1e9, 9100.0, -13_000.0, 3.4e38, -np.inf])
def test_what_is_no_height_of_the_earth_is_refused(tmp_path, height):
    grid = np.full((3, 3), 200.0, np.float32)
    grid[2, 1] = height
    write_dem(Dem(grid, 0.0, 0.0, 0.01, 0.01), tmp_path / "high.npz")
    with pytest.raises(ValueError, match=r"1 of its 9 heights are beyond .* in row 2, column 1"):
        read_dem(tmp_path / "high.npz")


def test_rolling_hills_are_as_high_and_as_long_as_asked_for():
    """Rms 10 m; heights a distance d apart correlate by exp(-(d / L)^2).

    Some 5120^2 / 150^2 = 1,200 independent hills: a correlation is uncertain by 0.03.
    """
    dem = rolling_dem(10.0, 150.0, 4)
    h = dem.height.astype(float)
    assert h.std() == pytest.approx(10.0, rel=1e-5)
    assert h.mean() == pytest.approx(0.0, abs=1e-4)
    for steps in (5, 15, 30):  # of 10 m
        expected = np.exp(-((10 * steps / 150) ** 2))
        for axis in (0, 1):
            found = np.mean(h * np.roll(h, steps, axis)) / 100
            assert found == pytest.approx(expected, abs=0.1)
    assert dem.covers(1.0, 2.0)
    assert not np.array_equal(h, rolling_dem(10.0, 150.0, 5).height)
    with pytest.raises(ValueError, match="hills are 30 to 2560 m long, not 20 m"):
        rolling_dem(10.0, 20.0, 4)


def test_errors_of_heights_are_as_large_and_as_long_as_asked_for():
    """5 m rms to float32; a distance L apart they correlate by 1/e, 3 L apart by chance."""
    step = np.radians(1.0) / 3600  # 31 m at the equator
    plain = Dem(np.full((400, 400), 1000.0, np.float32), 0.0, 0.0, step, step).tiled()
    errors = np.asarray(roughened(plain, 5.0, 309.0, 2).height - plain.height, np.float64)
    assert errors.std() == pytest.approx(5.0, rel=1e-4)

    def correlation(k):
        return np.mean(errors[:, k:] * errors[:, : 400 - k]) / errors.var()

    assert correlation(10) == pytest.approx(np.exp(-1.0), abs=0.1)
    assert abs(correlation(30)) < 0.15
    with pytest.raises(ValueError, match="10000 m long do not fit"):
        roughened(plain, 5.0, 10e3, 2)
