"""Correlation of amplitudes: known shifts, and what chance gives."""

import numpy as np
import pytest
from scipy.ndimage import fourier_shift, gaussian_filter

from terrafix.models.radar.correlation import contrast, shift_between


def pair(shift, noise, seed=0, reach=(12, 10)):
    """Image of 120 x 140 pixels that lies `shift` farther on a smooth random field."""
    rng = np.random.default_rng(seed)
    field = gaussian_filter(rng.standard_normal((200, 220)), 1.5, mode="wrap")
    field /= field.std()
    moved = np.fft.ifft2(fourier_shift(np.fft.fft2(field), shift)).real
    rows, columns = slice(40, 160), slice(40, 180)
    wide = slice(40 - reach[0], 160 + reach[0]), slice(40 - reach[1], 180 + reach[1])
    image = moved[rows, columns] + noise * rng.standard_normal((120, 140))
    return image.astype(np.float32), field[wide].astype(np.float32), reach


@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.4, -2.7), (-8.25, 6.5)])
def test_a_shift_is_found_to_a_fraction_of_a_pixel(shift):
    """0.02 pixel: what a parabola errs by where peaks are three pixels wide."""
    found = shift_between(*pair(shift, 0.0))
    assert found.inside
    np.testing.assert_allclose(found.pixels, shift, atol=0.02)


def test_the_surface_claims_the_error_that_noise_makes():
    """Over 60 draws, in which noise makes the surface: claims within a third of the scatter."""
    found = [shift_between(*pair((2.3, -1.6), 10.0, seed)) for seed in range(60)]
    errors = np.array([f.pixels for f in found]) - (2.3, -1.6)
    claimed = np.sqrt(np.mean([np.diag(f.covariance) for f in found], axis=0))
    assert (errors.std(axis=0) > 0.02).all()
    np.testing.assert_allclose(claimed, errors.std(axis=0), rtol=0.35)


def test_what_shares_nothing_has_no_peak_that_stands_out():
    """The largest of some hundred independent values is 3 to 4 times their rms."""
    for seed in range(10):
        image, _, reach = pair((0, 0), 0.0, seed)
        _, other, _ = pair((0, 0), 0.0, seed + 100)
        assert shift_between(image, other, reach).quality < 5.0


def test_a_peak_on_the_border_is_said_to_be():
    assert not shift_between(*pair((14.0, 0.0), 0.0)).inside


def test_contrast_knows_nothing_of_brightness():
    rng = np.random.default_rng(2)
    image = rng.rayleigh(size=(90, 90)).astype(np.float32)
    slope = np.linspace(1, 1.02, 90, dtype=np.float32)
    np.testing.assert_allclose(contrast(5 * image), contrast(image), atol=1e-5)
    np.testing.assert_allclose(contrast(slope * image), contrast(image), atol=0.05)
    dark = image.copy()
    dark[:40] = 0
    assert np.all(contrast(dark)[:40] == 0)
    assert abs(contrast(dark)[40:].mean()) < 0.05


def test_images_that_do_not_fit_are_refused():
    image, other, reach = pair((0, 0), 0.0)
    with pytest.raises(ValueError, match=r"sought on \(144, 160\) pixels, got \(143, 160\)"):
        shift_between(image, other[1:], reach)
    narrow = other[8:-8, 6:-6]
    with pytest.raises(ValueError, match="no wider than a peak"):
        shift_between(image, narrow, (4, 4))
