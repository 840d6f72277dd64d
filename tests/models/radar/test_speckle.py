"""Speckle from random bits: its distribution, and the same compiled as with arrays."""

import types
import warnings

import numpy as np
import pytest

from terrafix.components.sensors import compiled
from terrafix.models.radar.footprint import TerrainGrid
from terrafix.models.radar.speckle import (
    ARRAY_SPECKLE,
    CompiledSpeckle,
    add_noise,
    random_bits,
    scattered,
)

N, M = 70, 523


@pytest.fixture(params=["arrays", "compiled"])
def speckle(request):
    if request.param == "arrays":
        return ARRAY_SPECKLE
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = compiled.speckle_of_bits()
    if not isinstance(found, CompiledSpeckle):
        pytest.skip("no C compiler serves")
    return found


@pytest.fixture(scope="module")
def terrain():
    """Seventy lines over a texture whose rows lie apart, up to both of its ends."""
    own = types.SimpleNamespace(footprint=types.SimpleNamespace(n_lines=N, n_cells=M))
    rng = np.random.default_rng(1)
    own.texture = rng.uniform(-6, 6, (60, 400)).astype(np.float32)[:, 3:-7]
    i, j = np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 132), indexing="ij")
    own.coarse = np.array(
        [59 * i, 389 * j, 4 * i - 3 * j, 100 + 50 * rng.random(i.shape)], np.float32
    )
    own._layers, own.folded = [], False  # no layover
    own._interpolated = lambda *a: TerrainGrid._interpolated(own, *a)
    own.pixels = lambda *a: TerrainGrid.pixels(own, *a)
    return own


def test_noise_is_normal_and_as_strong_as_asked_for(speckle):
    """A million of them: moments within five standard errors, both parts independent."""
    image = np.zeros((1000, 1000), np.complex64)
    add_noise(image, 3.0, np.random.default_rng(2), speckle)
    n = image.size
    for part in (image.real, image.imag):
        assert part.mean() == pytest.approx(0.0, abs=5 * 3.0 / np.sqrt(n))
        assert np.mean(part**2) == pytest.approx(9.0, rel=5 * np.sqrt(2 / n))
        assert np.mean(part**4) == pytest.approx(3 * 81.0, rel=5 * np.sqrt(32 / 3 / n))
        # two-sided tail beyond four standard deviations: 6.33e-5
        assert np.mean(np.abs(part) > 12.0) == pytest.approx(6.33e-5, abs=5 * np.sqrt(6.33e-5 / n))
    assert np.mean(image.real * image.imag) == pytest.approx(0.0, abs=5 * 9.0 / np.sqrt(n))
    along = np.mean(image[:, 1:] * image[:, :-1].conj())
    assert abs(along) < 5 * 18.0 / np.sqrt(n)


def test_the_ends_of_what_is_drawn_are_finite(speckle):
    bits = np.array([[0, 2**64 - 1, 2**63, 2**31]], np.uint64)
    image = np.zeros(bits.shape, np.complex64)
    speckle.add_noise(image, bits, float(np.sqrt(0.5)))
    expected = np.sqrt(
        -np.log((np.arange(4) * 0 + [0.5, 2**24 - 0.5, 2**23 + 0.5, 0.5]) * 2.0**-24)
    )
    np.testing.assert_allclose(np.abs(image[0]), expected, rtol=1e-5, atol=3e-4)


def test_scatterers_are_as_bright_as_the_terrain(speckle, terrain):
    """Amplitude is the terrain's between its points, the upper layer's share its height's."""
    bits = random_bits(np.random.default_rng(3), (N, M))
    low, high, whole = (np.empty((N, M), np.complex64) for _ in range(3))
    speckle.scatter(terrain, (0, 0), bits, (90.0, 190.0), low, high)
    speckle.scatter(terrain, (0, 0), bits, (90.0, 190.0), whole, None)
    np.testing.assert_allclose(low + high, whole, atol=1e-5)
    unit = np.zeros((N, M), np.complex64)
    ARRAY_SPECKLE.add_noise(unit, bits, float(np.sqrt(0.5)))
    amplitude, height = TerrainGrid.pixels(terrain, 0, N)
    # places in the texture are held to 1/32 cell, with arrays
    np.testing.assert_allclose(whole / unit, amplitude, rtol=0.03, atol=1e-3)
    np.testing.assert_allclose(high / unit, (height - 90) / 100 * amplitude, rtol=0.03, atol=1e-3)


def test_some_lines_are_the_same_as_of_all(speckle, terrain):
    layers = scattered(terrain, (90.0, 190.0), np.random.default_rng(4), speckle)
    again = scattered(terrain, (90.0, 190.0), np.random.default_rng(4), speckle)
    stream = np.random.default_rng(4).spawn(2)[1]
    bits = random_bits(stream, (N - 64, M))
    low, high = (np.empty(bits.shape, np.complex64) for _ in range(2))
    speckle.scatter(terrain, (64, 0), bits, (90.0, 190.0), low, high)
    for own, other, part in zip(layers, again, (low, high), strict=True):
        assert own.tobytes() == other.tobytes()
        assert own[64:].tobytes() == part.tobytes()


def test_some_columns_are_as_bright_as_among_all(speckle, terrain):
    bits = random_bits(np.random.default_rng(5), (N, M))
    whole, part = np.empty((N, M), np.complex64), np.empty((N, 100), np.complex64)
    speckle.scatter(terrain, (0, 0), bits, (0.0, 1.0), whole, None)
    own = np.ascontiguousarray(bits[:, 200:300])
    speckle.scatter(terrain, (0, 200), own, (0.0, 1.0), part, None)
    np.testing.assert_allclose(part, whole[:, 200:300], rtol=1e-5)


def test_what_is_not_whole_is_refused(terrain):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = compiled.speckle_of_bits()
    if not isinstance(found, CompiledSpeckle):
        pytest.skip("no C compiler serves")
    bits, rows = np.zeros((4, 8), np.uint64), np.zeros((4, 16), np.complex64)
    with pytest.raises(ValueError, match="where whole rows of complex64"):
        found.add_noise(rows[:, ::2], bits, 1.0)
    with pytest.raises(ValueError, match=r"cells \(90, 0\) to \(93, 7\) are not of the terrain"):
        found.scatter(terrain, (90, 0), bits, (0.0, 1.0), rows[:, :8].copy(), None)
