"""Images of one echo for many; detection, references, recordings."""

import numpy as np
import pytest

from terrafix.models.geometry.geodesy import ecef
from terrafix.models.geometry.geolocation import ground_point
from terrafix.models.images.reference import (
    Reference,
    earlier_pass,
    geocoded,
    read_reference,
    write_reference,
)
from terrafix.models.maps.dem import flat_dem
from terrafix.models.motion.arc import OrbitArc
from terrafix.models.radar.doppler import centroid_candidates
from terrafix.models.radar.focusing import azimuth_compressed, range_doppler
from terrafix.models.radar.footprint import Footprint
from terrafix.models.radar.imaging import Imager, chip_slices
from terrafix.models.radar.multilook import detected, full_index, multilook_index
from terrafix.models.radar.recordings.files import read_recording
from terrafix.models.radar.scene import Scene

V, NEAR = 7062.0, 988647.0


def test_averaging_in_power_keeps_power_and_calms_speckle():
    rng = np.random.default_rng(0)
    image = (rng.standard_normal((400, 400, 2)) @ [1, 1j]).astype(np.complex64)
    amplitude = detected(image, (4, 2))
    assert amplitude.shape == (100, 200)
    assert np.mean(amplitude**2) == pytest.approx(np.mean(np.abs(image) ** 2), rel=1e-5)
    power = amplitude.astype(float) ** 2
    assert power.var() / power.mean() ** 2 == pytest.approx(1 / 8, rel=0.05)


def test_pixels_of_several_looks_are_centered():
    image = np.zeros((12, 12), np.complex64)
    image[8:10, 3:6] = 1  # pixel (4, 1) of 2 x 3 looks
    i, j = np.unravel_index(detected(image, (2, 3)).argmax(), (6, 4))
    assert (i, j) == (4, 1)
    assert full_index(i, 2) == pytest.approx(8.5)
    assert full_index(j, 3) == pytest.approx(4.0)
    assert multilook_index(full_index(3.3, 4), 4) == pytest.approx(3.3)


def test_impossible_looks_are_refused():
    with pytest.raises(ValueError, match="there must be one at least along each axis"):
        detected(np.zeros((4, 4), np.complex64), (0, 1))
    with pytest.raises(ValueError, match=r"an image of \(4, 4\) pixels has no pixel of \(5, 1\)"):
        detected(np.zeros((4, 4), np.complex64), (5, 1))


def test_candidates_of_the_centroid_are_those_that_geometry_allows():
    assert centroid_candidates(100.0, 1000.0, 150.0, 50.0) == [100.0]
    assert centroid_candidates(100.0, 1000.0, 700.0, 250.0) == [1100.0, 100.0]
    assert centroid_candidates(-400.0, 1000.0, 80.0, 1.0) == [-400.0]  # never empty
    # 3.5 sigma either way: 1400 Hz about 600 Hz hold three, 1607 Hz a fourth
    assert centroid_candidates(0.0, 1000.0, 600.0, 400.0) == [1000.0, 0.0, 2000.0]
    assert centroid_candidates(0.0, 1000.0, 600.0, 459.0) == [1000.0, 0.0, 2000.0, -1000.0]


@pytest.fixture(scope="module")
def squinted(points):
    """Echo of points about a squinted beam, whose centroid is five repetition frequencies off."""
    centroid = -5.55 * points.RADARSAT.prf
    tan = centroid * points.RADARSAT.wavelength / (2 * V)
    rng = np.random.default_rng(2)
    closest = NEAR + 1500.0 + rng.uniform(0, 1500, 6)
    passed = 0.5 + rng.uniform(-0.08, 0.08, 6) + tan * closest / V
    shape = (1300, 2048)
    echo = points.point_echo(
        points.RADARSAT, NEAR, V, centroid, shape, zip(closest, passed, strict=True)
    )
    noise = rng.standard_normal((*shape, 2)) @ [0.05, 0.05j]
    return (echo + noise).astype(np.complex64), centroid, closest, passed


def test_the_sharpest_candidate_is_the_true_centroid(points, squinted):
    """Geometry allows three; migration that is not removed blurs the wrong ones."""
    echo, centroid, *_ = squinted
    imager = Imager(echo, points.RADARSAT, NEAR, 0.0, step=2.0)
    candidates = centroid_candidates(imager.fraction, points.RADARSAT.prf, centroid + 600.0, 600.0)
    assert len(candidates) > 2
    assert candidates[0] == pytest.approx(centroid, abs=60) or candidates[1] == pytest.approx(
        centroid, abs=60
    )
    wrong_first = sorted(candidates, key=lambda f: -abs(f - centroid))
    processing, focus = imager.focus([imager.processing(f, V, 0.0) for f in wrong_first], V + 4.0)
    assert processing.centroid == pytest.approx(centroid, abs=60)
    assert focus.velocity == pytest.approx(V, abs=4.0)


def test_a_pixel_and_when_it_was_seen_are_inverse(points, squinted):
    echo, centroid, *_ = squinted
    domain = range_doppler(
        echo, points.RADARSAT, near_range=NEAR, centroid=centroid, velocity=V, velocity_slope=5e-5
    )
    image = azimuth_compressed(domain, V + 3.0)
    t, R = image.seen_at(np.array([500.2, 700.9]), np.array([30.0, 555.5]), image.doppler)
    row, column = image.pixel(t, R, image.doppler)
    assert row == pytest.approx([500.2, 700.9], abs=1e-6)
    assert column == pytest.approx([30.0, 555.5], abs=1e-6)


def test_lines_of_a_deskewed_image_are_what_the_beam_passes_together(points, squinted):
    """Whatever its range, in the line of the time at which it was seen; skewed, 300 lines apart."""
    echo, centroid, closest, passed = squinted
    domain = range_doppler(echo, points.RADARSAT, near_range=NEAR, centroid=centroid, velocity=V)
    straight = azimuth_compressed(domain, V, deskewed=True)
    skewed = azimuth_compressed(domain, V)
    t, R = straight.seen_at(400.0, np.array([50.0, 700.0]), centroid)
    assert np.ptp(t) == pytest.approx(0.0, abs=1e-12)
    rows, _ = skewed.pixel(t, R, centroid)
    sine = centroid * points.RADARSAT.wavelength / (2 * V)
    lag = sine / np.sqrt(1 - sine**2) / V * np.diff(straight.slant_range[[50, 700]])[0]
    assert np.diff(rows)[0] == pytest.approx(lag * points.RADARSAT.prf, rel=1e-6)
    # and no line is lost to the lag
    assert straight.rows.stop - straight.rows.start > skewed.rows.stop - skewed.rows.start
    sine = centroid * points.RADARSAT.wavelength / (2 * V)
    seen = passed - closest * sine / np.sqrt(1 - sine**2) / V
    for at, R in zip(seen, closest / np.sqrt(1 - sine**2), strict=True):
        row, column = straight.pixel(at, R, centroid)
        assert row == pytest.approx((at - straight.t[0]) * points.RADARSAT.prf, abs=1e-6)
        i, j = round(float(row)), round(float(column))
        part = np.abs(straight.data[i - 8 : i + 9, j - 8 : j + 9])
        found = np.array(np.unravel_index(part.argmax(), part.shape)) - 8
        assert found == pytest.approx([row - i, column - j], abs=0.7)


def test_when_a_point_is_seen_does_not_depend_on_the_velocity_of_compression(points, squinted):
    """What an image measures is the passage of the beam, whatever blur there is."""
    echo, centroid, closest, passed = squinted
    domain = range_doppler(echo, points.RADARSAT, near_range=NEAR, centroid=centroid, velocity=V)
    sine = centroid * points.RADARSAT.wavelength / (2 * V)
    seen = passed[0] - closest[0] * sine / np.sqrt(1 - sine**2) / V
    for error in (0.0, 4.0):
        image = azimuth_compressed(domain, V + error)
        row, column = image.pixel(seen, closest[0] / np.sqrt(1 - sine**2), centroid)
        i, j = round(float(row)), round(float(column))
        part = np.abs(image.data[i - 12 : i + 13, j - 12 : j + 13])
        found = np.unravel_index(part.argmax(), part.shape)
        assert np.array(found) - 12 == pytest.approx([row - i, column - j], abs=1.5)


def test_images_are_shared_by_those_who_agree(points, squinted):
    echo, centroid, *_ = squinted
    imager = Imager(echo, points.RADARSAT, NEAR, 0.0, step=2.0)
    one, other = imager.processing(centroid, V, 1e-6), imager.processing(centroid, V - 9.0, -1e-6)
    assert one == other
    assert imager.image(one, V) is imager.image(other, V)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"step": 0.0}, "must be positive"),
        ({"band": (0.5, 0.5)}, "is not a part of the whole"),
    ],
)
def test_impossible_imagers_are_refused(points, settings, message):
    with pytest.raises(ValueError, match=message):
        Imager(np.ones((10, 10), np.complex64), points.RADARSAT, NEAR, 0.0, **settings)


def test_a_chip_stays_inside_what_is_focused():
    inside = slice(100, 400), slice(0, 300)
    assert chip_slices((250.0, 150.0), (100, 100), inside) == (slice(200, 300), slice(100, 200))
    assert chip_slices((105.0, 298.0), (100, 100), inside) == (slice(100, 200), slice(200, 300))
    with pytest.raises(ValueError, match="300 rows of the image are focused, and 301 are wanted"):
        chip_slices((250.0, 150.0), (301, 100), inside)
    with pytest.raises(ValueError, match="center is at column 320, outside what is focused"):
        chip_slices((250.0, 320.0), (100, 100), inside)


def flat_reference(n=200):
    rows, columns = np.array([0.0, n - 1.0]), np.array([0.0, n - 1.0])
    latitude = np.array([[0.5, 0.5], [0.501, 0.501]])
    longitude = np.array([[1.0, 1.002], [1.0, 1.002]])
    amplitude = np.random.default_rng(0).random((n, n)).astype(np.float32)
    return Reference(amplitude, rows, columns, latitude, longitude, np.zeros((2, 2)))


def test_places_are_interpolated_between_tie_points():
    latitude, longitude, height = flat_reference().place(99.5, 49.75)
    assert latitude == pytest.approx(0.5005, abs=1e-12)
    assert longitude == pytest.approx(1.0005, abs=1e-12)
    assert height == 0


def test_a_reference_is_read_back_from_its_file(tmp_path):
    write_reference(flat_reference(), tmp_path / "r.npz")
    found = read_reference(tmp_path / "r.npz")
    assert found.amplitude.tobytes() == flat_reference().amplitude.tobytes()
    assert found.latitude == pytest.approx(flat_reference().latitude, abs=1e-15)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"amplitude": np.zeros(5)}, "a reference is an image, got shape"),
        ({"rows": np.array([5.0])}, "needs two rows and columns of tie points"),
        ({"latitude": np.zeros((3, 2))}, r"latitude of a reference has shape \(3, 2\)"),
        ({"height": np.full((2, 2), np.nan)}, "height of a reference is not finite"),
        (
            {"columns": np.array([9.0, 2.0])},
            "columns of the tie points of a reference do not",
        ),
    ],
)
def test_what_is_no_reference_is_refused(change, message):
    good = flat_reference()
    values = {f: getattr(good, f) for f in good.__dataclass_fields__} | change
    with pytest.raises(ValueError, match=message):
        Reference(**values)


def test_a_pixel_outside_the_tie_points_is_refused():
    with pytest.raises(ValueError, match=r"row 250\.0 to 250\.0 of a reference is outside"):
        flat_reference().place(250.0, 3.0)


def test_bad_reference_files_are_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"r\.npz' is not there"):
        read_reference(tmp_path / "r.npz")
    np.savez(tmp_path / "r.npz", amplitude=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="a reference: it has no 'rows'; it holds amplitude"):
        read_reference(tmp_path / "r.npz")
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(ValueError, match="it is one array of NumPy"):
        read_reference(tmp_path / "one.npy")


def test_an_image_is_geocoded_where_the_orbit_saw_it(start_e, points):
    """Against the range-Doppler equations at the pixel itself, between the tie points."""
    arc = OrbitArc(start_e[0], start_e[1], 0.0, 6.0, 6.0)
    rng = np.random.default_rng(0)
    echo = (rng.standard_normal((1300, 1700, 2)) @ [1, 1j]).astype(np.complex64)
    radar = points.RADARSAT
    domain = range_doppler(echo, radar, near_range=855e3, centroid=-600.0, velocity=7188.0)
    image = azimuth_compressed(domain, 7188.0)
    reference = geocoded(image, arc, flat_dem(250.0).at, (2, 1))
    row, column = 123.4, 87.6
    latitude, longitude, height = reference.place(row, column)
    at = image.rows.start + full_index(row, 2), image.columns.start + full_index(column, 1)
    t, R = image.seen_at(*at, image.doppler)
    v = arc.velocity(t)
    sine = radar.wavelength * image.doppler / (2 * np.linalg.norm(v))
    p = ground_point(arc.position(t), v, R, sine, 250.0)
    assert ecef(latitude, longitude, height) == pytest.approx(p, abs=0.05)


def test_an_earlier_pass_knows_the_places_of_its_pixels(start_e, points):
    arc = OrbitArc(start_e[0], start_e[1], 0.0, 3.0, 3.0)
    grid = Footprint(arc, points.PALSAR, -0.2, 864, 860e3, 300, 0.0)
    scene = Scene(flat_dem(100.0), seed=1)
    reference = earlier_pass(scene, grid, (2, 1), np.random.default_rng(0))
    assert reference.amplitude.shape == (432, 300)
    latitude, longitude, height = reference.place(200.0, 150.0)
    line, cell = grid.place(ecef(latitude, longitude, height)[None])
    assert (line[0], cell[0]) == pytest.approx((400.5, 150.0), abs=0.01)


def recording(folder, **change):
    rng = np.random.default_rng(0)
    arrays = {
        "i": rng.integers(-15, 16, (64, 40)).astype(np.int8) | 1,
        "q": rng.integers(-15, 16, (64, 40)).astype(np.int8) | 1,
        "first_rg_line": np.array(5),
        "first_rg_cell": np.array(7),
    } | change
    np.savez(folder / "echo.npz", **{k: v for k, v in arrays.items() if v is not None})
    return folder / "echo.npz"


def test_recorded_lines_are_read_with_their_gain(tmp_path):
    plain = read_recording(recording(tmp_path))
    assert (plain.first_line, plain.first_cell) == (5, 7)
    gained = read_recording(recording(tmp_path, agc_db=np.r_[np.zeros(32), np.full(32, 6.0)]))
    assert np.abs(gained.read()[32:]) == pytest.approx(
        np.abs(plain.read()[32:]) * 10**0.3, rel=1e-5
    )
    assert gained.read()[:32].tobytes() == plain.read()[:32].tobytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"first_rg_line": None}, "it has no 'first_rg_line'; it holds i, q, first_rg_cell"),
        ({"i": None}, "it has neither 'echo' nor 'i' and 'q'"),
        ({"q": np.zeros((64, 39), np.int8)}, r"'i' has shape \(64, 40\), 'q' has \(64, 39\)"),
        ({"echo": np.zeros(5)}, r"it has shape \(5,\), not lines and cells"),
        ({"echo": np.full((4, 4), np.nan)}, "line 1 of its 4 is not finite"),
        ({"agc_db": np.zeros(3)}, "an echo of 64 lines wants as many finite attenuations"),
        ({"first_rg_cell": np.array(0)}, "'first_rg_cell' is 0, not a number counted from 1"),
    ],
)
def test_bad_recordings_are_refused_by_name(tmp_path, change, message):
    with pytest.raises(ValueError, match=message) as raised:
        read_recording(recording(tmp_path, **change))
    assert "echo.npz' is not recorded echo" in str(raised.value)


def test_missing_lines_are_counted(tmp_path):
    i = np.ones((64, 40), np.int8)
    i[[10, 20, 21]] = 0
    with pytest.raises(ValueError, match=r"3 of its 64 lines are missing .* the first is line 11"):
        read_recording(recording(tmp_path, i=i, q=i))


def test_a_torn_recording_is_refused(tmp_path):
    path = recording(tmp_path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"echo\.npz' is not recorded echo: it is damaged"):
        read_recording(path)
