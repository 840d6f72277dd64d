"""Images of Sentinel-1: times, ranges and places of pixels, against ESA's own grid; bursts; GRD.

No GRD was at hand: its annotation is written here, after the product specification.
"""

import numpy as np
import pytest

rasterio = pytest.importorskip("rasterio", reason="of the extra 'sar'")

from terrafix.models.geometry.geodesy import ecef, geodetic  # noqa: E402
from terrafix.models.geometry.geolocation import ground_point  # noqa: E402
from terrafix.models.images.mapped import Beam, Sentinel1Map, as_seen  # noqa: E402
from terrafix.models.maps.dem import flat_dem  # noqa: E402
from terrafix.models.maps.sentinel1 import SPEED_OF_LIGHT, read_sentinel1  # noqa: E402
from terrafix.models.motion.ephemeris import read_eof  # noqa: E402

CUT = (9799, 10999)  # "hight9800_10400_width11000...", counted from 1
FLAT = flat_dem(0.0).at


@pytest.fixture(scope="module")
def real(data_folder):
    folder = data_folder / "sentinel1"
    if not folder.is_dir():
        pytest.skip(f"no data: {folder} is absent")
    (pixels,), (annotation,) = folder.glob("*.tiff"), folder.glob("*.xml")
    return read_sentinel1(pixels, annotation, CUT)


def test_esas_places_are_where_our_geometry_puts_them(real):
    """210 points over 250 x 85 km; orbit, time and range alone. Measured: 14 mm at most."""
    assert real.misclosure().shape == (210,)
    assert real.misclosure().max() < 0.02


def test_places_between_them_are_those_of_a_spline_through_esas_where_it_is_flat(real):
    """Cubic in its own time and range, over the first 150 km, which are sea: within centimeters.

    Where two of its points lie on an island, 300 m high, the sea between is 200 m off by it.
    """
    from scipy.interpolate import RectBivariateSpline

    t, R, latitude, longitude, _ = real.grid.T
    lines = (t - R / SPEED_OF_LIGHT).reshape(10, 21).mean(axis=1)
    cells = R.reshape(10, 21)[0]

    def off(line, sample, n):
        seen, ranges = real.seen_at(line, sample)
        at = seen - ranges / SPEED_OF_LIGHT, ranges
        spline = (
            RectBivariateSpline(lines[:n], cells, a.reshape(10, 21)[:n])(*at, grid=False)
            for a in (latitude, longitude)
        )
        p = ground_point(*real.orbit.at(seen), ranges, 0.0, 0.0)
        return np.linalg.norm(p - ecef(*spline, 0.0), axis=-1)

    assert off([1000.0, 4000.0, 6000.0], [3000.0, 11_000.0, 24_000.0], 6).max() < 0.05
    assert off([8764.0, 9364.0], [11_000.0, 12_400.0], 10) == pytest.approx([205, 239], abs=5)


def test_its_points_are_at_its_lines_and_samples(real):
    """First lines of bursts are some 1341 lines of the sequence apart, not 1514."""
    _, _, latitude, longitude, height = real.grid.T
    line, sample = real.pixels(ecef(latitude, longitude, height))
    assert np.abs(line - np.rint(line)).max() < 0.02
    assert np.diff(line[::21])[:8] == pytest.approx(1341, abs=6)
    assert sample.reshape(10, 21) == pytest.approx(
        np.tile([*range(0, 23010, 1211), 24202], (10, 1)), abs=0.01
    )


def test_its_orbit_is_the_restituted_one(real, data_folder):
    (path,) = (data_folder / "sentinel1").glob("*.EOF")
    restituted = read_eof(path)
    t = (real.orbit.tags - restituted.tags[0]) / np.timedelta64(1, "s")
    assert np.abs(restituted.at(t)[0] - real.orbit.r_e).max() < 0.05


def test_a_part_of_it_becomes_a_reference_of_square_pixels(real):
    r, v = real.orbit.at(real.seen_at(9064, 11_700)[0])
    p = ground_point(r, v, real.seen_at(9064, 11_700)[1], 0.0)
    latitude, longitude, _ = (float(a) for a in geodetic(p))
    reference = Sentinel1Map(real).about(latitude, longitude, 1700.0, 0.0, FLAT).reference()
    # 13.9 m along the track, four samples of 2.33 m over the sine of incidence across it
    assert reference.amplitude.shape == pytest.approx((298, 295), abs=3)
    row, column, inside = reference.pixel(latitude, longitude)
    assert inside
    assert (row, column) == pytest.approx((149, 147), abs=5)
    with rasterio.open(real.path) as dataset:
        pixels = dataset.read(1)
    first = 9064 - round(float(row)), 11_700 - round(4 * float(column))
    assert 0 <= first[0] - 8764 < 601
    power = np.abs(pixels[first[0] - 8764 :][:298]).astype(float) ** 2
    whole = np.sqrt(power.mean())
    assert np.sqrt((reference.amplitude.astype(float) ** 2).mean()) == pytest.approx(
        whole, rel=0.05
    )


def test_drawn_as_another_radar_sees_it_what_is_bright_lies_where_it_lies(real):
    """The brightest pixel of a part, found again by its place on an image 600 m off the orbit."""
    t, R = real.seen_at(9064, 11_700)
    r, v = real.orbit.at(t)
    p = ground_point(r, v, R, 0.0, 0.0)
    latitude, longitude, _ = (float(a) for a in geodetic(p))
    part = Sentinel1Map(real).about(latitude, longitude, 2500.0, 0.0, FLAT)
    beam = Beam(r + 600 * p / np.linalg.norm(p), v, p)
    reference = as_seen(part, beam, 1500.0, 12.0, FLAT)
    assert reference.amplitude.shape == (250, 250)
    own = part.reference()
    middle = [round(float(a)) for a in own.pixel(latitude, longitude)[:2]]
    near = own.amplitude[middle[0] - 80 : middle[0] + 80, middle[1] - 80 : middle[1] + 80]
    i, j = np.unravel_index(near.argmax(), near.shape)
    north, east, _ = own.place(middle[0] - 80 + i, middle[1] - 80 + j)
    row, column, inside = reference.pixel(north, east)
    assert inside
    i, j = round(float(row)), round(float(column))
    about = reference.amplitude[i - 12 : i + 13, j - 12 : j + 13]
    found = np.unravel_index(about.argmax(), about.shape)
    assert np.hypot(found[0] - 12, found[1] - 12) < 1.6


# ------------------------------------------------------------------------- written here


def orbit_xml():
    """An Earth-fixed circle over the poles, 7,070 km, every 10 s."""
    lines, rate = [], 7500 / 7.07e6
    for k in range(12):
        a = rate * (10 * k - 50)
        x = 7.07e6 * np.array([np.cos(a), 0, np.sin(a)])
        v = 7500 * np.array([-np.sin(a), 0, np.cos(a)])
        position, velocity = (
            "".join(f"<{n}>{float(w)!r}</{n}>" for n, w in zip("xyz", u, strict=True))
            for u in (x, v)
        )
        lines.append(
            f"<orbit><time>{moment(10 * k - 50)}</time><frame>Earth Fixed</frame>"
            f"<position>{position}</position><velocity>{velocity}</velocity></orbit>"
        )
    return f"<orbitList>{''.join(lines)}</orbitList>"


def moment(seconds):
    """Seconds after noon."""
    return str(
        np.datetime64("2022-09-18T12:00:00", "us") + np.timedelta64(round(seconds * 1e6), "us")
    )


NEAR, FS, LINE = 850e3, 40e6, 0.002
GRSR = (850e3, 0.6, 1e-7)  # slant range by ground range [m]


def annotation(path, kind, n_lines, n_samples, bursts=(), valid=None):
    """Of an image whose grid of places is that of its own geometry, 88 us late as ESA's is."""
    slant = kind == "Complex"
    n = n_lines // max(1, len(bursts))
    starts = bursts or (0.0,)
    points = []
    for line in range(0, n_lines, max(1, n_lines // 4)):
        b = min(line // n, len(starts) - 1)
        for sample in np.linspace(0, n_samples - 1, 5).astype(int):
            d = 10.0 * sample
            R = NEAR + sample * SPEED_OF_LIGHT / 2 / FS if slant else np.polyval(GRSR[::-1], d)
            t = starts[b] + (line - b * n) * LINE + 1e-4
            points.append(
                f"<geolocationGridPoint><azimuthTime>{moment(t)}</azimuthTime><slantRangeTime>"
                f"{float(2 * R / SPEED_OF_LIGHT)!r}</slantRangeTime><line>{line}</line>"
                f"<pixel>{sample}</pixel><latitude>0</latitude><longitude>0</longitude><height>0</height>"
                "</geolocationGridPoint>"
            )
    burst = "".join(
        f"<burst><azimuthTime>{moment(t)}</azimuthTime><firstValidSample>"
        f"{' '.join(map(str, valid))}</firstValidSample></burst>"
        for t in bursts
    )
    conversion = "".join(
        f"<coordinateConversion><azimuthTime>{moment(t)}</azimuthTime><gr0>0</gr0>"
        f"<grsrCoefficients count='3'>{' '.join(map(repr, GRSR))}</grsrCoefficients>"
        "</coordinateConversion>"
        for t in (-5.0, 5.0)
    )
    path.write_text(
        "<?xml version='1.0'?><product><generalAnnotation><productInformation><projection>"
        f"{'Slant' if slant else 'Ground'} Range</projection><rangeSamplingRate>{FS}"
        f"</rangeSamplingRate></productInformation>{orbit_xml()}</generalAnnotation>"
        "<imageAnnotation><imageInformation><productFirstLineUtcTime>"
        f"{moment(0.0)}</productFirstLineUtcTime><slantRangeTime>{2 * NEAR / SPEED_OF_LIGHT!r}"
        f"</slantRangeTime><pixelValue>{kind}</pixelValue><rangePixelSpacing>10</rangePixelSpacing>"
        f"<azimuthTimeInterval>{LINE}</azimuthTimeInterval><numberOfSamples>{n_samples}"
        f"</numberOfSamples><numberOfLines>{n_lines}</numberOfLines></imageInformation>"
        f"</imageAnnotation><swathTiming><linesPerBurst>{n}</linesPerBurst><burstList>{burst}"
        "</burstList></swathTiming><geolocationGrid><geolocationGridPointList>"
        f"{''.join(points)}</geolocationGridPointList></geolocationGrid><coordinateConversion>"
        f"<coordinateConversionList>{'' if slant else conversion}</coordinateConversionList>"
        "</coordinateConversion></product>"
    )
    return path


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def image(path, values):
    kind = "complex_int16" if np.iscomplexobj(values) else values.dtype
    n = values.shape
    with rasterio.open(
        path, "w", driver="GTiff", count=1, height=n[0], width=n[1], dtype=kind
    ) as dataset:
        dataset.write(values, 1)
    return path


pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_ground_range_is_slant_range_by_its_polynomial(tmp_path):
    values = np.arange(200 * 300, dtype=np.uint16).reshape(200, 300)
    grd = read_sentinel1(
        image(tmp_path / "g.tiff", values), annotation(tmp_path / "g.xml", "Detected", 200, 300)
    )
    t, R = grd.seen_at([10, 10], [0, 200])
    assert list(R) == pytest.approx([850e3, 850e3 + 0.6 * 2000 + 1e-7 * 2000**2])
    assert t - 50 == pytest.approx(10 * LINE + 1e-4, abs=2e-6)  # tags of microseconds
    r, v = grd.orbit.at(t)
    line, sample = grd.pixels(ground_point(r, v, R, 0.0, 100.0))
    assert line == pytest.approx([10, 10], abs=1e-4)
    assert sample == pytest.approx([0, 200], abs=1e-4)
    assert (grd.read(slice(3, 6), slice(7, 9)).real == values[3:6, 7:9]).all()
    beyond = grd.pixels(np.array([6.4e6, -1e5, 0.0]))  # to the left: it flies north, east is right
    assert np.isnan(beyond).all()


def test_lines_of_bursts_are_put_in_one_sequence(tmp_path):
    """Two of 40 lines, 30 lines apart; 3 at each end are void: lines 33 to 36 are shared."""
    values = np.repeat(np.arange(80)[:, None], 120, axis=1).astype(np.complex64)
    valid = [-1] * 3 + [0] * 34 + [-1] * 3
    slc = read_sentinel1(
        image(tmp_path / "s.tiff", values),
        annotation(tmp_path / "s.xml", "Complex", 80, 120, (0.0, 30 * LINE), valid),
    )
    assert slc.shape == (70, 120)
    # the first burst to the middle of what both have, (36 + 33) / 2; then line 5 of the second
    assert slc.file_lines.tolist() == [*range(35), *range(45, 80)]
    assert slc.read(slice(33, 37), slice(0, 2))[:, 0].real.tolist() == [33, 34, 45, 46]
    t, _ = slc.seen_at([0, 35, 69], 0)
    assert np.diff(t) == pytest.approx([35 * LINE, 34 * LINE])


def test_a_file_that_was_cut_begins_where_it_is_said_to(tmp_path):
    xml = annotation(tmp_path / "s.xml", "Complex", 80, 120)
    values = (np.arange(20)[:, None] + 1j * np.arange(30)).astype(np.complex64)
    cut = read_sentinel1(image(tmp_path / "s.tiff", values), xml, (50, 60))
    found = cut.read(slice(49, 53), slice(58, 63))
    assert found[:, 3].tolist() == [0, 1j, 1 + 1j, 2 + 1j]  # nothing is held before
    with pytest.raises(ValueError, match=r"20 lines of 30 samples from 70, 60 on; .* 80 of 120"):
        read_sentinel1(tmp_path / "s.tiff", xml, (70, 60))


def test_what_does_not_belong_together_is_refused(tmp_path):
    xml = annotation(tmp_path / "s.xml", "Detected", 80, 120)
    path = image(tmp_path / "s.tiff", np.ones((80, 120), np.complex64))
    with pytest.raises(ValueError, match=r"bands of complex_int16, its annotation says Detected"):
        read_sentinel1(path, xml)
    other = tmp_path / "o.xml"
    other.write_text("<?xml version='1.0'?><product/>")
    with pytest.raises(ValueError, match="is no annotation of an image of Sentinel-1 that is read"):
        read_sentinel1(path, other)
    other.write_text("<?xml version='1.0'?><product>")
    with pytest.raises(ValueError, match="is damaged"):
        read_sentinel1(path, other)
    with pytest.raises(ValueError, match=r"is no annotation of Sentinel-1 \(\.xml\)"):
        read_sentinel1(path, path)
    with pytest.raises(FileNotFoundError, match="is not there"):
        read_sentinel1(path, tmp_path / "none.xml")
