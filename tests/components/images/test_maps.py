"""Parts of maps as components: where the beam looks, in any system; bad ones get one error."""

import numpy as np
import pytest

pytest.importorskip("rasterio", reason="of the extra 'sar'")
pyproj = pytest.importorskip("pyproj", reason="of the extra 'sar'")
import rasterio  # noqa: E402
from rasterio.transform import Affine  # noqa: E402

import terrafix as tf  # noqa: E402
from terrafix.components.images.maps import ElevationMap, ReferenceMap  # noqa: E402
from terrafix.components.truth.terrain import Terrain  # noqa: E402
from terrafix.cosim.basics.errors import TerrafixError  # noqa: E402
from terrafix.cosim.declare.component import Component  # noqa: E402
from terrafix.cosim.declare.ports import Output  # noqa: E402
from terrafix.cosim.engine.simulation import Simulation  # noqa: E402
from terrafix.models.geometry.geodesy import ecef, geodetic  # noqa: E402
from terrafix.models.images.reference import Reference  # noqa: E402
from terrafix.models.maps.dem import dem_from, flat_dem, read_jacksboro  # noqa: E402
from terrafix.models.maps.geoid import harmonic_undulation  # noqa: E402
from terrafix.models.motion.arc import OrbitArc, seen_at  # noqa: E402
from terrafix.models.motion.attitude import lvlh_quaternion_array  # noqa: E402
from terrafix.models.radar.boresight import boresight_on_terrain  # noqa: E402

R_E = np.array([-1104646.3, -6096830.4, 3395727.4])  # [m], an orbit of 700 km
V_E = np.array([-1004.7, 3648.9, 6498.0])  # [m/s]
Q_BE = lvlh_quaternion_array(R_E, V_E)
LOOK = np.radians(34.3)
UTM = "EPSG:32615"


class Pass(Component):
    """A satellite that stands still in the air, at any distance of members from each other."""

    default_rate = tf.Rate("1")
    apart = tf.Parameter(0.0, unit="m", doc="of members")
    r_e = Output((3,), unit="m", frame="e")
    v_e = Output((3,), unit="m/s", frame="e")
    q_be = Output((4,), unit="1", frame="b")

    def _initialize_impl(self):
        self.r_e = R_E + np.arange(self.n_members)[:, None] * self.apart[:, None]
        self.v_e, self.q_be = V_E + 0 * self.r_e, np.tile(Q_BE, (self.n_members, 1))

    def _step_impl(self, t, dt):
        pass


def beam(height=0.0):
    """Latitude and longitude [deg], and UTM [m], of where it looks."""
    aligned = np.array([0.0, 0.0, 0.0, 1.0])
    found = boresight_on_terrain(R_E, V_E, Q_BE, aligned, LOOK, 0.0, flat_dem(height))
    latitude, longitude = np.degrees(geodetic(found.point)[:2])
    to_utm = pyproj.Transformer.from_crs(4326, 32615, always_xy=True)
    return (latitude, longitude), to_utm.transform(longitude, latitude)


def write(path, values, transform, crs=UTM, **options):
    values = np.asarray(values)
    profile = {
        "driver": "GTiff",
        "count": 1,
        "height": values.shape[0],
        "width": values.shape[1],
        "dtype": values.dtype,
        "crs": crs,
        "transform": transform,
    }
    with rasterio.open(path, "w", **(profile | options)) as dataset:
        dataset.write(values, 1)
    return path


def centered(n, spacing, angle=0.0):
    """A turned grid of n x n whose middle lies where the beam looks."""
    _, middle = beam()
    return (
        Affine.translation(*middle)
        @ Affine.rotation(angle)
        @ Affine.scale(spacing, -spacing)
        @ Affine.translation(-n / 2, -n / 2)
    )


def system(part, members_apart=0.0, ground=None):
    with tf.System("s", duration="1", seed=1) as built:
        flight = built.add(Pass(apart=members_apart), "flight")
        part = built.add(part, "part")
        for name in ("r_e", "v_e", "q_be"):
            built.connect(flight[name], part[name])
        if isinstance(part, ReferenceMap):
            ground = built.add(ground or Terrain(source="flat", flat_height=50.0), "terrain")
            if isinstance(ground, ElevationMap):
                for name in ("r_e", "v_e", "q_be"):
                    built.connect(flight[name], ground[name])
            for name in ("height", "grid"):
                built.connect(ground[name], part[name])
    return built


def run(part, members=1, **options):
    built = system(part, **options)
    simulation = Simulation(built, members=members)
    simulation.run_until("1")
    return built.nodes["part"]


def reference_map(path, **settings):
    settings = {"look": LOOK, "reach": 2000.0} | settings
    return ReferenceMap(map_file=path, rate=tf.Rate(times=["1"]), **settings)


def elevation_map(path, **settings):
    settings = {"look": LOOK, "reach": 2000.0} | settings
    return ElevationMap(dem_file=path, rate=tf.Rate(times=["1"]), **settings)


def failure(make, **options):
    with pytest.raises(TerrafixError) as raised:
        run(make(), **options)
    return str(raised.value)


def speckle(n):
    return np.random.default_rng(0).rayleigh(40.0, (n, n)).astype(np.uint8) + 1


TO_UTM = pyproj.Transformer.from_crs(4326, 32615, always_xy=True)


def waves(x, y):
    """Amplitude of an artificial ground: it changes by 0.1 in a meter at most."""
    return 100 + 40 * np.sin(x / 400) * np.cos(y / 500)


def wavy(n, spacing, angle):
    transform = centered(n, spacing, angle)
    column, row = np.meshgrid(np.arange(n) + 0.5, np.arange(n) + 0.5)
    a, b, c, d, e, f = transform[:6]
    return waves(a * column + b * row + c, d * column + e * row + f).astype(np.float32), transform


def reference_of(part):
    places = np.moveaxis(part.places, -1, 0)
    return Reference(part.amplitude, part.tie_rows, part.tie_columns, *places)


@pytest.mark.parametrize("ground", ["flat", "jacksboro"])
@pytest.mark.parametrize("angle", [0.0, 70.0])
def test_a_reference_shows_what_the_map_does_where_its_pixels_lie(tmp_path, angle, ground):
    """Waves of a map in UTM, turned, seen in time and range: by PROJ at each tie point's place."""
    path = write(tmp_path / "m.tif", *wavy(900, 12.0, angle))
    terrain = {"flat": {"flat_height": 50.0}, "jacksboro": {"mirrored": True}}[ground]
    part = run(reference_map(path), ground=Terrain(source=ground, **terrain))
    assert part.amplitude.shape == pytest.approx((333, 333), abs=2)  # of 4 km by 12 m
    reference = reference_of(part)
    row, column = (np.rint(a).astype(int) for a in np.meshgrid(part.tie_rows, part.tie_columns))
    latitude, longitude, _ = reference.place(row, column)
    wanted = waves(*TO_UTM.transform(np.degrees(longitude), np.degrees(latitude)))
    off = np.abs(part.amplitude[row, column] - wanted)
    # interpolated twice, and drawn between tie points 50 m apart, which relief bends by meters
    assert np.quantile(off, 0.99) < {"flat": 0.1, "jacksboro": 0.5}[ground]
    relief = np.ptp(reference.height)
    assert relief == pytest.approx(0) if ground == "flat" else relief > 100


def test_its_rows_are_times_and_its_columns_ranges(tmp_path):
    """Each tie point is seen in the beam's plane, at ranges that grow evenly, on the terrain."""
    path = write(tmp_path / "m.tif", *wavy(900, 12.0, 0.0))
    part = run(reference_map(path), ground=Terrain(source="jacksboro", mirrored=True))
    p = ecef(*np.moveaxis(part.places, -1, 0))
    aligned = np.array([0.0, 0.0, 0.0, 1.0])
    doppler = boresight_on_terrain(R_E, V_E, Q_BE, aligned, LOOK, 0.0, flat_dem(0)).doppler(0.23)
    t, R = seen_at(OrbitArc(R_E, V_E, 0.0, 5.0, 5.0), p, doppler, 0.23)
    assert np.ptp(np.diff(R, axis=1)) < 0.02 * np.diff(R, axis=1).mean()
    assert np.ptp(t, axis=1).max() < 2e-4  # 1.4 m; of a beam that is 30 m lower
    dem = read_jacksboro().tiled()
    rise = dem.at(part.places[..., 0], part.places[..., 1]) - part.places[..., 2]
    assert np.quantile(np.abs(rise), 0.99) < 0.1  # but where slopes are laid over
    speed = np.diff(t[:, 0]).mean() / np.diff(part.tie_rows).mean()
    assert 12.0 / speed == pytest.approx(6800, rel=0.02)  # over the ground [m/s]


def test_finer_pixels_are_averaged_and_unknown_ones_are_not_seen(tmp_path):
    values = speckle(1800)
    values[:, 950:] = 0  # nodata, which is right of the middle
    path = write(tmp_path / "m.tif", values, centered(1800, 5.0), nodata=0)
    part = run(reference_map(path, spacing=20.0))
    assert part.amplitude.shape == (200, 200)
    seen = part.amplitude[part.amplitude > 0].astype(float)
    assert 0.5 < len(seen) / part.amplitude.size < 0.6
    # of Rayleigh's 40 sqrt(2): power is kept, and 16 looks and interpolation leave little speckle
    assert np.sqrt(np.mean(seen**2)) == pytest.approx(40 * np.sqrt(2), rel=0.03)
    assert seen.std() / seen.mean() < 0.523 / 4


def test_heights_of_a_large_model_are_read_about_the_beam(tmp_path):
    """A plane that falls by 1 m every 100 m to the north, above the ellipsoid as is stated."""
    _, (_, north) = beam()
    transform = centered(900, 30.0, 10.0)
    column, row = np.meshgrid(np.arange(900) + 0.5, np.arange(900) + 0.5)
    y = transform[3] * column + transform[4] * row + transform[5]
    path = write(tmp_path / "d.tif", (300 - (y - north) / 100).astype(np.float32), transform)
    part = run(elevation_map(path, vertical_datum="ellipsoid", reach=3000.0))
    assert max(part.height.shape) < 300
    (latitude, longitude), _ = beam(300.0)
    dem = dem_from(part.height, part.grid)
    to_utm = pyproj.Transformer.from_crs(4326, 32615, always_xy=True)
    at = np.array([longitude] * 3), latitude + np.array([-0.02, 0.0, 0.02])
    _, y = to_utm.transform(*at)
    found = dem.at(np.radians(at[1]), np.radians(longitude))
    assert found == pytest.approx(300 - (y - north) / 100, abs=0.02)
    with_both = run(
        reference_map(write(tmp_path / "m.tif", speckle(900), centered(900, 20.0))),
        ground=elevation_map(path, vertical_datum="ellipsoid", reach=3000.0),
    )
    assert np.ptp(with_both.places[..., 2]) == pytest.approx(45.0, abs=5)  # of 4 km, turned


def test_heights_above_a_geoid_are_turned_to_the_ellipsoid(tmp_path):
    crs = UTM + "+5773"
    path = write(tmp_path / "d.tif", np.full((900, 900), 100.0), centered(900, 30.0), crs)
    part = run(elevation_map(path, geoid="degree 70"))
    (latitude, longitude), _ = beam(100.0)
    rise = harmonic_undulation(np.radians(latitude), np.radians(longitude))
    assert np.abs(rise) > 20
    assert np.median(part.height) == pytest.approx(100 + rise, abs=0.05)
    text = failure(lambda: elevation_map(path, vertical_datum="ellipsoid"))
    assert "vertical_datum is ellipsoid, but 'd.tif' says that its heights refer to EGM96" in text


def flat_model(path, **options):
    values = options.pop("values", np.full((900, 900), 100.0, np.float32))
    return write(path, values, options.pop("transform", centered(900, 30.0)), **options)


def void_about_the_middle():
    values = np.full((900, 900), 100.0, np.float32)
    values[300:600, 300:600] = -9999.0
    return values


BAD_HEIGHTS = {
    "nothing said": ({}, {}, "does not say what its heights refer to: a geoid is up to 107 m off"),
    "elsewhere": (
        {"transform": Affine(30, 0, 3e5, 0, -30, 1e6)},
        {"vertical_datum": "ellipsoid"},
        "'part' has no heights where the beam looks: 'd.tif' does not cover latitude 29.7",
    ),
    "void": (
        {"values": void_about_the_middle()},
        {"vertical_datum": "ellipsoid"},
        "holds nothing but voids where it is read",
    ),
    "of another planet": (
        {"values": np.full((900, 900), 1e9, np.float32)},
        {"vertical_datum": "ellipsoid"},
        "are beyond -12000 to 9000 m, the first is 1e+09 m",
    ),
}


@pytest.mark.parametrize("case", BAD_HEIGHTS)
def test_bad_elevation_models_get_one_error(tmp_path, case):
    options, settings, message = BAD_HEIGHTS[case]
    path = flat_model(tmp_path / "d.tif", **options)
    assert message in failure(lambda: elevation_map(path, **settings))


BAD_MAPS = {
    "elsewhere": (
        {"transform": Affine(20, 0, 3e5, 0, -20, 1e6)},
        {},
        "does not cover latitude 29.7",
    ),
    "empty there": ({"values": np.zeros((900, 900), np.uint8)}, {}, "knows 0 % of what is asked"),
    "its edge": (
        {"transform": centered(900, 20.0) @ Affine.translation(500, 0)},
        {"reach": 6e3},
        "knows 4",
    ),
    "decibels": ({"values": np.full((900, 900), -12.0)}, {}, "write 10^(dB / 20)"),
    "too coarse": ({"transform": centered(900, 90.0)}, {}, "is too small: 96 rows"),
    "too much": ({"transform": centered(20_000, 2.0)}, {"reach": 15e3}, "million are held at most"),
    "of two bands": ({"count": 2}, {}, "has 2 bands"),
    "complex": ({"values": np.ones((900, 900), np.complex64)}, {}, "name its annotation"),
    "without a place": ({"crs": None}, {}, "has no georeference"),
    "not there": (None, {}, "'/nowhere/m.tif' is not there"),
}


@pytest.mark.parametrize("case", BAD_MAPS)
def test_bad_maps_get_one_error(tmp_path, case):
    options, settings, message = BAD_MAPS[case]
    if options is None:
        path = "/nowhere/m.tif"
    elif case == "too much":  # sparse
        path = tmp_path / "m.tif"
        profile = {"driver": "GTiff", "count": 1, "height": 20_000, "width": 20_000}
        profile |= {"dtype": np.uint8, "crs": UTM, "tiled": True, "SPARSE_OK": "TRUE"}
        with rasterio.open(path, "w", **profile, **options):
            pass
    else:
        base = {"values": speckle(900), "transform": centered(900, 20.0)}
        path = write(tmp_path / "m.tif", **(base | options))
    assert message in failure(lambda: reference_map(path, **settings))


def test_a_part_is_one_for_all_members(tmp_path):
    path = write(tmp_path / "m.tif", speckle(900), centered(900, 20.0))
    assert run(reference_map(path), members=3).amplitude.ndim == 2
    text = failure(lambda: reference_map(path), members=2, members_apart=5.0)
    assert "'part.r_e' differs between members, but its output is one for all" in text


def test_settings_that_would_do_nothing_are_refused(tmp_path):
    path = write(tmp_path / "m.tif", speckle(900), centered(900, 20.0))
    assert not reference_map(path).takes("first_line")
    assert not elevation_map(path, vertical_datum="ellipsoid").takes("geoid")
    assert elevation_map(path).takes("geoid")
    assert not Terrain(source="jacksboro").takes("vertical_datum")
