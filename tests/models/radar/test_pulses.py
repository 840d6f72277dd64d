"""Sums over pulses, compiled and not, against the formula in double precision."""

import warnings

import numpy as np
import pytest

from terrafix.components.sensors import compiled
from terrafix.models.radar.pulses import ArraySums, CompiledSums, Impulses, Profiles, Pulses

WAVELENGTH, SPACING, NULL, CUT = 0.0312, 0.15, 0.0985, 0.66


def case(n=3000, n_pulses=5):
    rng = np.random.default_rng(4)
    line = np.stack(
        [np.sort(rng.uniform(-150, 150, n)), rng.uniform(1100, 1300, n), rng.normal(1000, 10, n)]
    )
    R = np.linalg.norm(line, axis=0)
    way = np.outer(np.linspace(-35, 35, n_pulses), [1.0, 0.02, -0.01])
    axis = np.array([1.0, 0.01, 0.0]) + 0.002 * rng.standard_normal((n_pulses, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    reflection = (rng.normal(size=n) + 1j * rng.normal(size=n)).astype(np.complex64)
    cells = int((R.max() - R.min()) / SPACING) + 200
    first = R.min() - 50 * SPACING
    impulses = Impulses(
        line.astype(np.float32),
        R.astype(np.float32),
        ((R - first) / SPACING).astype(np.float32),
        reflection,
    )
    whole = np.zeros(n_pulses, np.int64), np.full(n_pulses, n, np.int64)
    pulses = Pulses(way, axis, *whole, WAVELENGTH, SPACING, NULL, CUT, cells)
    return impulses, pulses, line, R, first


def summed(sums, impulses, pulses):
    out = np.zeros((len(pulses.way), pulses.n_cells), np.complex64)
    sums.add_impulses(out, impulses, pulses)
    return out


@pytest.fixture(params=["arrays", "compiled"])
def sums(request):
    if request.param == "arrays":
        return ArraySums()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = compiled.pulse_sums()
    if not isinstance(found, CompiledSums):
        pytest.skip("no C compiler serves")
    return found


def test_impulses_are_the_sum_in_double_precision(sums):
    """What is left of the range errs by 1e-6 m, 4e-4 rad; places by 1e-3 cell."""
    impulses, pulses, line, R0, first = case()
    found = summed(sums, impulses, pulses)
    for p, (way, axis) in enumerate(zip(pulses.way, pulses.axis, strict=True)):
        away = line - way[:, None]
        R = np.linalg.norm(away, axis=0)
        sine = axis @ away / R / NULL
        seen = np.where(np.abs(sine) < CUT, (1 - sine**2) ** 3, 0.0) * impulses.reflection
        seen = seen * np.exp(-4j * np.pi / WAVELENGTH * (R - R0))
        cell = (R - first) / SPACING
        k = cell.astype(int)
        expected = np.zeros(pulses.n_cells, complex)
        np.add.at(expected, k, seen * (1 - cell + k))
        np.add.at(expected, k + 1, seen * (cell - k))
        rms = np.sqrt(np.mean(np.abs(expected) ** 2))
        assert np.abs(found[p] - expected).max() < 0.02 * rms


def test_back_projection_is_the_sum_in_double_precision(sums):
    rng = np.random.default_rng(5)
    r = np.array([7000.0, 0.0, 7000.0]) + np.outer(np.arange(6) - 2.5, [0.0, 1.0, 0.0])
    echo = (rng.normal(size=(6, 200)) + 1j * rng.normal(size=(6, 200))).astype(np.complex64)
    reference = np.linalg.norm(r, axis=1)
    profiles = Profiles(echo, r, reference, -20.0, 0.2, WAVELENGTH)
    p = rng.uniform(-10, 10, (700, 3)) * [1, 1, 0]
    p[0] = [200.0, 0.0, 0.0]  # nobody hears it
    expected = np.zeros(len(p), complex)
    for line, place, base in zip(echo, r, reference, strict=True):
        beyond = np.linalg.norm(p - place, axis=1) - base
        cell = (beyond + 20.0) / 0.2
        value = np.interp(cell, np.arange(200), line, 0, 0)
        expected += value * np.exp(4j * np.pi / WAVELENGTH * beyond)
    found = sums.back_projected(profiles, p)
    assert found[0] == 0
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_without_a_compiler_numpy_sums_and_says_so(monkeypatch):
    monkeypatch.setenv("TERRAFIX_KERNEL", "vm")
    compiled.pulse_sums.cache_clear()
    try:
        with pytest.warns(UserWarning, match="summed with NumPy, ten times slower"):
            assert isinstance(compiled.pulse_sums(), ArraySums)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            compiled.pulse_sums()  # said once
    finally:
        compiled.pulse_sums.cache_clear()


def test_lines_of_another_shape_are_refused(sums):
    if isinstance(sums, ArraySums):
        pytest.skip("NumPy broadcasts by itself")
    impulses, pulses, *_ = case()
    with pytest.raises(ValueError, match="are not those of the pulses"):
        sums.add_impulses(np.zeros((2, 3), np.complex64), impulses, pulses)
