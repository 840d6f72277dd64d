"""Focusing: point targets of exact geometry must appear where geometry puts them, and as sharp."""

import numpy as np
import pytest

from terrafix.models.radar.focusing import azimuth_compressed, azimuth_looks, range_doppler

VELOCITY = 7188.5  # effective, of the PALSAR-like geometry [m/s]
RANGE = 861013.0  # closest range of its targets [m]


class Scene:
    """One target, seen and focused."""

    def __init__(self, points, radar, velocity, closest, centroid, shape, off=0.0):
        passed = shape[0] / 2 / radar.prf
        # a squinted radar sees the target before it passes; keep its echo in the middle
        lag = -centroid * radar.wavelength * closest / (2 * velocity**2)
        self.passed = passed - lag
        seen_at = np.hypot(closest, velocity * lag)
        self.near = seen_at - 0.1 * shape[1] * radar.range_spacing  # whole pulses are received
        echo = points.point_echo(
            radar, self.near, velocity, centroid, shape, [(closest, self.passed)]
        )
        self.domain = range_doppler(
            echo, radar, near_range=self.near, centroid=centroid, velocity=velocity + off
        )
        self.radar, self.closest, self.velocity = radar, closest, velocity

    def image(self, velocity=None):
        return azimuth_compressed(self.domain, velocity or self.velocity)

    def expected(self, image):
        row = (self.passed - image.t[0]) * self.radar.prf
        column = (self.closest - image.slant_range[0]) / np.diff(image.slant_range[:2])[0]
        return row, column


@pytest.fixture(scope="module")
def palsar(points):
    return Scene(points, points.PALSAR, VELOCITY, RANGE, 0.0, (8192, 700))


@pytest.fixture(scope="module")
def squinted(points):
    return Scene(points, points.RADARSAT, 7062.0, 993000.0, -6900.0, (1536, 1700))


@pytest.mark.parametrize("name", ["palsar", "squinted"])
def test_a_point_peaks_where_geometry_puts_it(name, request, points):
    """Within 0.1 pixel, asked of the processor; 0.02 is what 32-fold interpolation resolves."""
    scene = request.getfixturevalue(name)
    image = scene.image()
    peak, (row, column) = points.Peak(image.data), scene.expected(image)
    assert peak.row == pytest.approx(row, abs=0.03)
    assert peak.column == pytest.approx(column, abs=0.03)


@pytest.mark.parametrize("name", ["palsar", "squinted"])
def test_a_point_is_as_sharp_as_its_bandwidth_allows(name, request, points):
    """-3 dB width of a rectangular spectrum: 0.886 over the bandwidth, within 10 %."""
    scene = request.getfixturevalue(name)
    radar, peak = scene.radar, points.Peak(scene.image().data)
    assert peak.width_azimuth == pytest.approx(0.886 * radar.prf / radar.doppler_bandwidth, rel=0.1)
    assert peak.width_range == pytest.approx(0.886 * radar.sample_rate / radar.bandwidth, rel=0.1)


def test_a_velocity_error_of_ten_meters_per_second_blurs(palsar, points):
    """Peak ratio 0.34 +- 0.05: 9.8 rad of quadratic phase at the edges of the aperture."""
    ratio = (
        points.Peak(palsar.image(VELOCITY + 10).data).height
        / points.Peak(palsar.image().data).height
    )
    assert ratio == pytest.approx(0.34, abs=0.05)


def test_migration_may_be_removed_with_a_wrong_velocity(palsar, points):
    """10 m/s costs less than 1 % of the peak if only migration uses it, and does not move it."""
    wrong = Scene(points, points.PALSAR, VELOCITY, RANGE, 0.0, (8192, 700), off=10.0)
    image = wrong.image()
    peak, right = points.Peak(image.data), points.Peak(palsar.image().data)
    assert peak.height > 0.99 * right.height
    assert peak.row == pytest.approx(wrong.expected(image)[0], abs=0.1)


def phase_at(image, row, column):
    """Phase [cycles] of a point of an image, and its height.

    The band of a squinted image lies about its Doppler centroid along the lines, and along the
    cells about what the carrier is there of the reference, 2 (D - 1) / wavelength per meter.
    """
    half = 16
    i, j = round(row), round(column)
    chip = image.data[i - half : i + half, j - half : j + half].astype(complex)
    y, x = np.arange(i - half, i + half) - row, np.arange(j - half, j + half) - column
    sine = image.radar.wavelength * image.centroid / (2 * image.velocity)
    along = image.centroid / image.radar.prf
    across = 2 / image.radar.wavelength * (np.sqrt(1 - sine**2) - 1) * np.diff(image.slant_range)[0]
    weights = [
        np.sinc(a) * np.i0(4 * np.sqrt(1 - (a / (half + 1)) ** 2)) / np.i0(4) for a in (y, x)
    ]
    turned = chip * np.exp(-2j * np.pi * (along * y[:, None] + across * x))
    value = weights[0] @ turned @ weights[1]
    return np.angle(value) / (2 * np.pi), abs(value)


@pytest.mark.parametrize(("squint", "beyond"), [(0, 1500.0), (2, -800.0), (5, -800.0), (5, 1500.0)])
def test_squint_keeps_place_width_and_phase(points, squint, beyond):
    """Off the middle of the swath, too: 0.03 pixel, 2 %, and the phase of the closest range.

    That is -2 R / wavelength cycles; one eighth less is the spectrum of the azimuth chirp.
    """
    radar, velocity, middle, shape = points.RADARSAT, 7062.0, 993000.0, (1536, 3400)
    sine = np.sin(np.radians(squint))
    centroid, lag = 2 * velocity * sine / radar.wavelength, -middle * np.tan(np.radians(squint))
    closest, passed = middle + beyond, shape[0] / 2 / radar.prf
    passed -= lag / velocity * closest / middle
    near = np.hypot(middle, lag) - 1020 * radar.range_spacing
    echo = points.point_echo(radar, near, velocity, centroid, shape, [(closest, passed)])
    domain = range_doppler(echo, radar, near_range=near, centroid=centroid, velocity=velocity)
    image = azimuth_compressed(domain, velocity)
    peak = points.Peak(image.data, half=16)
    row = (passed - image.t[0]) * radar.prf
    column = (closest - image.slant_range[0]) / np.diff(image.slant_range[:2])[0]
    assert peak.row == pytest.approx(row, abs=0.03)
    assert peak.column == pytest.approx(column, abs=0.03)
    ideal = 0.886 * np.array([radar.prf / radar.doppler_bandwidth, radar.sample_rate / 30.116e6])
    assert [peak.width_azimuth, peak.width_range] == pytest.approx(ideal, rel=0.02)
    phase, height = phase_at(image, row, column)
    off = phase + 2 * closest / radar.wavelength + 0.125
    assert off - round(off) == pytest.approx(0.0, abs=5 / 360)
    assert height == pytest.approx(peak.height, rel=0.03)


def test_looks_are_disjoint_and_on_one_grid(squinted, points):
    whole = squinted.image()
    looks = azimuth_looks(squinted.domain, squinted.velocity, 2)
    assert looks[0].band[1] == looks[1].band[0]
    row, column = squinted.expected(whole)
    for look in looks:
        np.testing.assert_array_equal(look.t, whole.t)
        peak = points.Peak(look.data)
        assert peak.row == pytest.approx(row, abs=0.06)
        assert peak.column == pytest.approx(column, abs=0.06)
        assert peak.width_azimuth == pytest.approx(
            2 * points.Peak(whole.data).width_azimuth, rel=0.1
        )
    # what looks add up to is the image: the band was cut, not shared
    total = looks[0].data + looks[1].data
    # ifft is linear and each look keeps its rows: equal to float32 rounding of the peak
    assert np.abs(total - whole.data).max() < 1e-4 * np.abs(whole.data).max()


def test_the_target_is_inside_what_is_called_focused(palsar):
    image = palsar.image()
    row, column = palsar.expected(image)
    assert image.rows.start < row < image.rows.stop
    assert image.columns.start <= column < image.columns.stop
    assert image.valid.shape == (
        image.rows.stop - image.rows.start,
        image.columns.stop - image.columns.start,
    )


def test_scenes_that_cannot_be_focused_are_refused(points):
    def focus(shape, **changes):
        options = {"near_range": RANGE, "centroid": 0.0, "velocity": VELOCITY} | changes
        domain = range_doppler(np.ones(shape, np.complex64), points.PALSAR, **options)
        return azimuth_compressed(domain, VELOCITY)

    with pytest.raises(ValueError, match="lines of 100 cells are shorter than a pulse of 432"):
        focus((64, 100))
    # 1513 Hz at 508 Hz/s are 2.98 s, the length of 6433 lines
    with pytest.raises(
        ValueError, match="the beam sees a point for as long as lines were received"
    ):
        focus((6433, 600))
    with pytest.raises(ValueError, match=r"exposure must be in \(0, 1\]"):
        focus((64, 600), exposure=0.0)
    broken = np.ones((64, 600), np.complex64)
    broken[5, 7] = np.nan
    with pytest.raises(ValueError, match="line 5 of the echo is not finite"):
        range_doppler(broken, points.PALSAR, near_range=RANGE, centroid=0.0, velocity=VELOCITY)
