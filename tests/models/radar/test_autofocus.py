"""Autofocus on scenes whose velocity is known, on speckle that has none, and on real echo."""

import os
from pathlib import Path

import numpy as np
import pytest

from terrafix.models.radar.autofocus import (
    Focus,
    SharpnessCurve,
    autofocus,
    depth_of_focus,
    normalized_variance,
)
from terrafix.models.radar.chirp import range_compressed, unit_phasor
from terrafix.models.radar.doppler import fractional_centroid, unwrapped_centroid
from terrafix.models.radar.focusing import RangeDoppler, migration_factor, range_doppler

VELOCITY, RANGE = 7188.5, 861013.0  # of the PALSAR-like geometry [m/s], [m]
DATA = Path(os.environ.get("TERRAFIX_DATA", Path(__file__).parents[4] / "shared" / "data"))
CHUNKS = DATA / "radarsat1_vancouver"
PUBLISHED = 7062.0  # effective velocity of the RADARSAT-1 data [m/s], not an independent truth


def seen(points, scene, velocity=VELOCITY):
    """Echo of a scene (n_lines, n_cells) in the range-Doppler domain: azimuth phase exact."""
    radar, (n_lines, n_cells) = points.PALSAR, scene.shape
    frequency = np.fft.fftfreq(n_lines, 1 / radar.prf)
    slant_range = RANGE + radar.range_spacing * np.arange(n_cells)
    d = migration_factor(frequency, velocity, radar.wavelength)
    phase = unit_phasor((2 / radar.wavelength) * np.outer(1 - d, slant_range))
    band = np.abs(frequency) <= radar.doppler_bandwidth / 2
    spectrum = np.fft.fft(scene, axis=0).astype(np.complex64) * phase * band[:, None]
    return RangeDoppler(
        spectrum, frequency, slant_range, 0.0, n_lines, 0.0, velocity, slice(0, n_cells), radar
    )


def speckle(rng, shape):
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def textured(rng, shape=(8192, 128)):
    """Speckle on a texture of 4 dB some 20 pixels wide, and a bright point in 5000 pixels."""
    from scipy.ndimage import gaussian_filter

    texture = gaussian_filter(rng.standard_normal(shape), 8, mode="wrap")
    texture *= 4 / 10 * np.log(10) / 2 / texture.std()
    scene = np.exp(texture) * speckle(rng, shape)
    bright = rng.random(shape) < 2e-4
    scene[bright] += 15 * np.exp(2j * np.pi * rng.random(bright.sum()))
    return scene


@pytest.fixture(scope="module")
def texture_runs(points):
    """25 starts N(0, 10 m/s) on each of 6 scenes."""
    runs = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        curve = SharpnessCurve(seen(points, textured(rng)))
        runs.append([autofocus(curve, VELOCITY + x) for x in rng.normal(0, 10, 25)])
    return runs


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


def test_textured_scenes_are_focused_and_the_errors_are_small(texture_runs):
    """At least 98 % within 1.5 m/s, sigma at most 0.4 m/s, at a step of 1 m/s; all accepted."""
    errors = np.array([[f.velocity - VELOCITY for f in run] for run in texture_runs])
    assert np.mean(np.abs(errors) < 1.5) >= 0.98
    assert np.sqrt(np.mean(errors**2)) <= 0.4
    assert all(f.accepted for run in texture_runs for f in run)


def test_the_standard_error_is_of_the_size_of_the_error(texture_runs):
    """Jackknife of 16 blocks, 6 scenes: within a factor of 3 of the rms error."""
    error = np.sqrt(np.mean([(run[0].velocity - VELOCITY) ** 2 for run in texture_runs]))
    sigma = np.sqrt(np.mean([run[0].sigma ** 2 for run in texture_runs]))
    assert error / 3 < sigma < 10 * error


def test_featureless_speckle_is_refused(points):
    """60 starts on 10 scenes: at least 95 % refused."""
    refused = []
    for seed in range(10):
        rng = np.random.default_rng(100 + seed)
        curve = SharpnessCurve(seen(points, speckle(rng, (8192, 64))))
        refused += [not autofocus(curve, VELOCITY + x).accepted for x in rng.normal(0, 10, 6)]
    assert np.mean(refused) >= 0.95


def test_values_are_computed_once(points):
    curve = SharpnessCurve(seen(points, textured(np.random.default_rng(7), (8192, 64))))
    first = autofocus(curve, VELOCITY + 4)
    count = curve.n_images
    assert autofocus(curve, VELOCITY + 4) == first
    assert curve.n_images == count


def test_a_start_too_far_away_is_refused(points):
    curve = SharpnessCurve(seen(points, textured(np.random.default_rng(8), (8192, 64))))
    found = autofocus(curve, VELOCITY + 8, max_change=3.0)
    assert isinstance(found, Focus)
    assert (found.accepted, found.reason) == (False, "no peak near the start")


def test_impossible_curves_are_refused(points):
    domain = seen(points, np.ones((8192, 16)))
    with pytest.raises(ValueError, match="a step of 0 m/s is not positive"):
        SharpnessCurve(domain, 0)
    with pytest.raises(ValueError, match="is too small to be judged: 32 x 32 at least"):
        SharpnessCurve(domain)


@pytest.mark.parametrize(
    "chunk",
    [
        "ubc",
        *(
            pytest.param(name, marks=pytest.mark.campaign)
            for name in ("airport", "english_bay_1", "stanley_park", "english_bay_2")
        ),
    ],
)
def test_real_echo_is_focused_from_far_away(points, chunk):
    """100 starts within +-50 m/s: at least 90 % accepted, all of them within 10 m/s.

    Migration is removed with a velocity that is as wrong as the starts.
    """
    file = CHUNKS / f"{chunk}.npz"
    if not file.is_file():
        pytest.skip(f"no real data: {file} is absent (set TERRAFIX_DATA)")
    radar, rng = points.RADARSAT, np.random.default_rng(len(chunk))
    with np.load(file) as stored:
        gain = 10 ** (stored["agc_db"].astype(np.float32) / 20)
        echo = (stored["i"] + 1j * stored["q"]).astype(np.complex64) * gain[:, None]
        near = 988647.462 + (int(stored["first_rg_cell"]) - 1) * radar.range_spacing
    fraction, _ = fractional_centroid(range_compressed(echo, radar), radar.prf)
    domain = range_doppler(
        echo,
        radar,
        near_range=near,
        centroid=unwrapped_centroid(fraction, radar.prf, -6900.0),
        velocity=PUBLISHED + rng.uniform(-50, 50),
    )
    curve = SharpnessCurve(domain, step=2.0)
    found = [autofocus(curve, PUBLISHED + x) for x in rng.uniform(-50, 50, 100)]
    accepted = [f.velocity for f in found if f.accepted]
    assert len(accepted) >= 90
    assert max(abs(v - PUBLISHED) for v in accepted) < 10
