"""Autofocus on scenes whose velocity is known, on speckle that has none, and on real echo."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from terrafix.components.sensors.compiled import row_operations
from terrafix.models.radar import autofocus as module
from terrafix.models.radar.autofocus import (
    REASONS,
    Focus,
    SharpnessCurve,
    autofocus,
    depth_of_focus,
    normalized_variance,
    point_sharpness,
)
from terrafix.models.radar.chirp import unit_phasor
from terrafix.models.radar.doppler import fractional_centroid, unwrapped_centroid
from terrafix.models.radar.focusing import (
    RangeDoppler,
    azimuth_compressed,
    migration_factor,
    range_doppler,
)
from terrafix.models.radar.recordings.files import read_recording

VELOCITY, RANGE = 7188.5, 861013.0  # of the PALSAR-like geometry [m/s], [m]
SHAPE = (1024, 128)
DATA = Path(os.environ.get("TERRAFIX_DATA", Path(__file__).parents[4] / "shared" / "data"))
CHUNKS = DATA / "radarsat1_vancouver"
TIMES = {  # of the middle lines of the chunks [s]
    "airport": 4.42,
    "ubc": 5.65,
    "stanley_park": 6.09,
    "english_bay_1": 6.18,
    "english_bay_2": 7.40,
}
SLOPE, RATE = -1.7e-4, -0.056  # of the effective velocity on RADARSAT-1's orbit [1/s], [m/s^2]


def speckle(rng, shape=SHAPE):
    pairs = rng.standard_normal((*shape, 2), np.float32) @ np.array([1, 1j], np.complex64)
    return pairs * np.float32(np.sqrt(0.5))


def targets(rng, n, db, off=lambda: 0.0, rows=(0, SHAPE[0])):
    """Row, column, amplitude and velocity of bright points."""
    phase = lambda: np.exp(2j * np.pi * rng.random())  # noqa: E731
    return [
        (rng.uniform(*rows), int(rng.integers(SHAPE[1])), 10 ** (db / 20) * phase(), off())
        for _ in range(n)
    ]


def seen(points, scene, bright=()):
    """Echo of a scene, and of points that have velocities, as range-Doppler domain: exact."""
    radar, (n_lines, n_cells) = points.PALSAR, scene.shape
    frequency = np.fft.fftfreq(n_lines, 1 / radar.prf)
    slant_range = RANGE + radar.range_spacing * np.arange(n_cells)
    scale = 2 / radar.wavelength
    d = migration_factor(frequency, VELOCITY, radar.wavelength)
    spectrum = np.fft.fft(scene, axis=0) * unit_phasor(scale * np.outer(1 - d, slant_range))
    for row, column, amplitude, off in bright:
        d = migration_factor(frequency, VELOCITY + off, radar.wavelength)
        cycles = scale * (1 - d) * slant_range[column] - frequency * row / radar.prf
        spectrum[:, column] += amplitude * unit_phasor(cycles)
    spectrum[np.abs(frequency) > radar.doppler_bandwidth / 2] = 0
    columns = slice(0, n_cells)
    return RangeDoppler(
        *(spectrum.astype(np.complex64), frequency, slant_range),
        *(0.0, n_lines, 0.0, VELOCITY, columns, radar),
    )


def curve_of(points, scene, bright=(), step=1.0):
    rows, columns = (slice(0, n) for n in scene.shape)
    return SharpnessCurve(seen(points, scene, bright), step, rows, columns)


def test_normalized_variance_of_known_distributions():
    """1 for the exponential intensity of speckle, 0 for a constant, NaN for nothing."""
    rng = np.random.default_rng(1)
    # standard error of the variance of 1e6 exponential values: sqrt(8e-6) = 0.003
    assert normalized_variance(rng.exponential(size=10**6)) == pytest.approx(1.0, abs=0.012)
    assert normalized_variance(np.full(10, 3.0)) == 0.0
    assert np.isnan(normalized_variance(np.zeros(4)))


def test_depth_of_focus_of_the_nominal_radar(points):
    """1 m/s is 0.98 rad at the edges of the band: 3 rad are 3.06 m/s."""
    domain = seen(points, np.ones((256, 16)))
    assert depth_of_focus(domain, VELOCITY) == pytest.approx(3 / 0.98, rel=0.01)


def test_the_sharpness_of_a_point_out_of_focus(points):
    """Its closed form against the image of one point, of a third of the band that is sampled."""
    domain = seen(points, np.zeros(SHAPE), [(544.0, 60, 1.0, 0.0)])
    domain = replace(domain, radar=replace(points.PALSAR, doppler_bandwidth=720.0))
    depth = depth_of_focus(domain, VELOCITY)
    x = np.array([0.0, 0.5, -1.0, 2.0])
    images = [azimuth_compressed(domain, VELOCITY + k * depth).data[:, 60] for k in x]
    found = np.array([np.sum(np.abs(i) ** 4) / np.sum(np.abs(i) ** 2) ** 2 for i in images])
    assert found / found[0] == pytest.approx(point_sharpness(x), abs=0.01)


def test_speckle_makes_the_slopes_and_curvatures_that_theory_says(points):
    """256 blocks of two scenes: a standard deviation of the sample is known to 3 %."""
    slopes, curvatures = [], []
    for seed in range(2):
        curve = curve_of(points, speckle(np.random.default_rng([3, seed])))
        depth = depth_of_focus(curve.domain, VELOCITY)
        values = [curve.blocks(VELOCITY + x * depth) for x in module._OFFSETS]
        slope, curvature = module._PARABOLA @ values
        slopes.append(slope)
        curvatures.append(curvature)
    theory = np.sqrt(4 / curve.cells.mean() * module._NOISE)
    # the squared mean of few samples and their own variance make the logarithm a little wider
    assert np.std(slopes) == pytest.approx(theory[0], rel=0.12)
    assert np.std(curvatures) == pytest.approx(theory[1], rel=0.12)


def test_the_error_is_of_the_size_of_the_standard_error(points):
    """12 scenes of restless targets in clutter: rms of error over sigma is 1 +- 0.2."""
    ratios = []
    for seed in range(12):
        rng = np.random.default_rng([4, seed])
        bright = targets(rng, 50, 25.0, lambda rng=rng: 0.25 * rng.standard_t(2))
        found = autofocus(curve_of(points, speckle(rng), bright), VELOCITY + rng.normal(0, 8))
        assert found.accepted
        ratios.append((found.velocity - VELOCITY) / found.sigma)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.5


@pytest.mark.parametrize("step", [1.0, 0.7, 2.0])
def test_the_grid_of_the_climb_moves_no_estimate(points, step):
    """Points without clutter, whose velocity lies between grid points."""
    rng = np.random.default_rng(5)
    curve = curve_of(points, 0.1 * speckle(rng), targets(rng, 60, 20.0), step)
    assert autofocus(curve, VELOCITY + 6.0).velocity == pytest.approx(VELOCITY, abs=0.01)


def test_ships_count_for_no_more_than_what_rests(points):
    """One target in five moves, all at 1.6 m/s: the mean is off by 0.32 m/s, Huber's by 0.07."""
    errors = []
    for seed in range(3):
        rng = np.random.default_rng([6, seed])
        bright = targets(rng, 60, 22.0) + targets(rng, 15, 25.0, lambda: 1.6)
        found = autofocus(curve_of(points, speckle(rng), bright), VELOCITY)
        assert found.accepted
        errors.append(found.velocity - VELOCITY)
    assert abs(np.mean(errors)) < 0.15


def test_what_outshines_all_is_not_what_most_blocks_show(points):
    """Ships 7 dB above all else draw the peak of the parts to them, 2.5 m/s away."""
    rng = np.random.default_rng(6)
    bright = targets(rng, 60, 22.0) + targets(rng, 15, 29.0, lambda: 2.5)
    curve = curve_of(points, speckle(rng), bright)
    assert max(range(7180, 7200), key=curve.at) >= 7190
    found = autofocus(curve, VELOCITY)
    assert found.accepted
    assert abs(found.velocity - VELOCITY) < 0.15


def test_the_change_of_velocity_along_the_track_is_taken_off(points):
    """Bright points in the last quarter of the image, whose velocity grows by 1 m/s^2."""
    rng = np.random.default_rng(7)
    clutter, n = speckle(rng), SHAPE[0]
    # spectra that are sampled at n frequencies show a scene again after n rows
    start = azimuth_compressed(seen(points, clutter), VELOCITY).t[0] * points.PALSAR.prf
    bright = [
        ((start + row) % n, column, amplitude, (row - n / 2) / points.PALSAR.prf)
        for row, column, amplitude, _ in targets(rng, 60, 25.0, rows=(0.75 * n, 0.97 * n))
    ]
    late = np.mean([off for *_, off in bright])  # 0.17 s
    curve = curve_of(points, clutter, bright)
    assert autofocus(curve, VELOCITY).velocity - VELOCITY == pytest.approx(late, abs=0.05)
    found = autofocus(curve, VELOCITY, velocity_rate=1.0)
    assert found.velocity - VELOCITY == pytest.approx(0.0, abs=0.05)


def test_featureless_speckle_is_refused(points):
    """Four scenes, wherever one starts."""
    for seed in range(4):
        rng = np.random.default_rng([8, seed])
        curve = curve_of(points, speckle(rng))
        found = [autofocus(curve, VELOCITY + x, max_change=20.0) for x in rng.normal(0, 10, 4)]
        assert {f.reason for f in found} <= {REASONS[1], REASONS[2]}


def test_few_targets_are_known_to_be_few(points):
    """Two bright points are no common velocity."""
    rng = np.random.default_rng(9)
    curve = curve_of(points, speckle(rng), targets(rng, 2, 35.0))
    assert autofocus(curve, VELOCITY, thorough=False).reason == REASONS[3]


def test_values_are_computed_once_and_starts_share_them(points):
    rng = np.random.default_rng(10)
    curve = curve_of(points, speckle(rng), targets(rng, 40, 25.0))
    first = autofocus(curve, VELOCITY + 4)
    count = curve.n_images
    assert autofocus(curve, VELOCITY + 4) == first
    assert curve.n_images == count
    other = autofocus(curve, VELOCITY - 5)
    assert other.velocity == pytest.approx(first.velocity, abs=0.1 * first.sigma)


def test_a_start_too_far_away_is_refused(points):
    rng = np.random.default_rng(11)
    curve = curve_of(points, speckle(rng), targets(rng, 40, 25.0))
    found = autofocus(curve, VELOCITY + 8, max_change=3.0)
    assert isinstance(found, Focus)
    assert (found.accepted, found.reason) == (False, "no peak near the start")


def test_a_climb_that_ends_on_no_peak_is_followed_by_a_look_at_all(points, monkeypatch):
    """Climbed in single steps, a ripple of speckle twenty depths of focus away is the end."""
    monkeypatch.setattr(module, "STRIDE", 0.1)
    rng = np.random.default_rng(12)
    curve = curve_of(points, speckle(rng), targets(rng, 40, 25.0))
    assert not autofocus(curve, VELOCITY + 60, max_change=70.0, thorough=False).accepted
    found = autofocus(curve, VELOCITY + 60, max_change=70.0)
    assert found.accepted
    assert found.velocity == pytest.approx(VELOCITY, abs=5 * found.sigma)


def test_impossible_curves_are_refused(points):
    domain = seen(points, np.ones((8192, 16)))
    with pytest.raises(ValueError, match="a step of 0 m/s is not positive"):
        SharpnessCurve(domain, 0)
    with pytest.raises(ValueError, match="is too small to be judged: 32 x 32 at least"):
        SharpnessCurve(domain)


def recorded(points, name, velocity=7067.0):
    file = CHUNKS / f"{name}.npz"
    if not file.is_file():
        pytest.skip(f"no real data: {file} is absent (set TERRAFIX_DATA)")
    lines = read_recording(file)
    echo, radar = lines.read(), points.RADARSAT
    fraction, _ = fractional_centroid(echo, radar.prf)
    domain = range_doppler(
        echo,
        radar,
        near_range=988647.462 + (lines.first_cell - 1) * radar.range_spacing,
        centroid=unwrapped_centroid(fraction, radar.prf, -6900.0),
        velocity=velocity,
        velocity_slope=SLOPE,
        operations=row_operations(),
    )
    return SharpnessCurve(domain.cropped(), step=2.0)


def test_recorded_scenes_agree_on_the_velocity(points):
    """Five scenes up to 5 km and 3 s apart: chi-square of 4 degrees below its 99 % point, 13.3."""
    found = []
    for name, t in TIMES.items():
        curve = recorded(points, name)
        focus = autofocus(curve, 7062.0, velocity_rate=RATE)
        assert focus.accepted
        middle = curve.domain.slant_range.mean()
        there = focus.velocity - SLOPE * (middle - 995e3) - RATE * (t - 6.0)
        found.append((there, focus.sigma))
    V, sigma = np.array(found).T
    assert sigma.max() < 0.9
    mean = np.average(V, weights=sigma**-2)
    assert np.sum(((V - mean) / sigma) ** 2) < 13.3
    assert mean == pytest.approx(7067.4, abs=0.5)


@pytest.mark.campaign
@pytest.mark.parametrize("name", TIMES)
def test_recorded_echo_is_focused_from_far_away(points, name):
    """100 starts within +-150 m/s: at least 95 % accepted, all of them where one near it ends.

    Migration is removed with a velocity that is 50 m/s wrong.
    """
    curve, rng = recorded(points, name, 7017.0), np.random.default_rng(len(name))
    right = autofocus(curve, 7062.0)
    starts = 7062 + rng.uniform(-150, 150, 100)
    found = [autofocus(curve, x, max_change=200.0) for x in starts]
    accepted = [f.velocity for f in found if f.accepted]
    assert len(accepted) >= 95
    assert max(abs(v - right.velocity) for v in accepted) < right.sigma
