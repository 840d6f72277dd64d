"""Doppler centroid: known centroids of simulated noise, and the closed form of the geometry."""

import numpy as np
import pytest

from terrafix.models.radar.doppler import (
    fractional_centroid,
    geometric_centroid,
    unwrapped_centroid,
)


@pytest.mark.parametrize("centroid", [-900.0, 0.0, 312.5, 1000.0])
def test_the_centroid_of_colored_noise_is_found(centroid):
    """Noise shaped by a beam of 1200 Hz about the centroid: 4096 x 64 samples, a few Hz."""
    prf, rng = 2160.0, np.random.default_rng(1)
    noise = rng.standard_normal((4096, 64)) + 1j * rng.standard_normal((4096, 64))
    f = np.fft.fftfreq(4096, 1 / prf)
    away = (f - centroid + prf / 2) % prf - prf / 2
    echo = np.fft.ifft(noise * np.exp(-((away / 600) ** 2))[:, None], axis=0)
    found, coherence = fractional_centroid(echo.astype(np.complex64), prf)
    assert found == pytest.approx(centroid, abs=5.0)
    assert 0 < coherence < 1


def test_white_noise_is_not_coherent():
    rng = np.random.default_rng(2)
    echo = rng.standard_normal((512, 512)) + 1j * rng.standard_normal((512, 512))
    # one over the square root of the number of samples is 0.002
    assert fractional_centroid(echo.astype(np.complex64), 1000.0)[1] < 0.01


def test_geometry_gives_the_closed_form():
    """Flying along x at v, a point ahead at 30 deg off broadside: 2 v sin(30 deg) / wavelength."""
    p = 1000.0 * np.array([np.sin(np.pi / 6), np.cos(np.pi / 6), 0.0])
    doppler = geometric_centroid(np.zeros(3), [100.0, 0, 0], p, 0.05)
    assert doppler == pytest.approx(2 * 100 * 0.5 / 0.05, rel=1e-12)


def test_the_nearest_congruent_frequency_is_taken():
    assert unwrapped_centroid(600.0, 1256.98, -6900.0) == pytest.approx(600.0 - 6 * 1256.98)


def test_an_echo_without_signal_is_refused():
    with pytest.raises(ValueError, match="the echo is zero or not finite"):
        fractional_centroid(np.zeros((4, 4), np.complex64), 1000.0)
    with pytest.raises(ValueError, match="two lines at least"):
        fractional_centroid(np.zeros((1, 4), np.complex64), 1000.0)
