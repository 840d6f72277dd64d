"""Operations on rows, compiled and not, against their formulas in double precision."""

import warnings

import numpy as np
import pytest

from terrafix.components.sensors import compiled
from terrafix.models.radar.spectra import ARRAY_ROWS, ArrayRows, Columns, CompiledRows, kernels

N, M = 5, 700


@pytest.fixture(params=["arrays", "compiled"])
def operations(request):
    if request.param == "arrays":
        return ARRAY_ROWS
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = compiled.row_operations()
    if not isinstance(found, CompiledRows):
        pytest.skip("no C compiler serves")
    return found


def rows(seed=1, n=N, m=M):
    pairs = np.random.default_rng(seed).standard_normal((n, 2 * m), np.float32)
    return pairs.view(np.complex64)


def close(found, expected, atol):
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


def test_rows_are_straightened_by_the_phase_of_a_root(operations):
    """Some 1e5 cycles of it: double precision keeps them to 1e-11, single precision the rest."""
    own, factor = rows(), rows(2, 1)[0]
    f = np.linspace(-16e6, 16e6, M)
    squared, rest = (5.3e9 + f) ** 2, 1.001 * f
    transverse, subtracted = np.linspace(0, 4e15, N), np.linspace(5.29e9, 5.3e9, N)
    scale = 6.6e-3
    cycles = scale * (np.sqrt(squared - transverse[:, None]) - subtracted[:, None] - rest)
    assert np.abs(cycles).max() > 1e4
    expected = own * factor * np.exp(2j * np.pi * cycles)
    operations.straighten(own, Columns(factor, squared, rest, scale), transverse, subtracted)
    close(own, expected, 1e-5 * np.abs(expected).max())


def test_rows_are_turned_and_weighed(operations):
    own, weights = rows(), np.linspace(0, 2, N).astype(np.float32)
    steep, along = np.linspace(-0.7, 0.3, N), np.linspace(9.8e5, 9.9e5, M)
    constant = np.linspace(-3e3, 4e3, N)
    cycles = np.outer(steep, along) + constant[:, None]
    expected = weights[:, None] * own * np.exp(2j * np.pi * cycles)
    operations.turn(own, steep, along, constant, weights)
    close(own, expected, 2e-5)


def test_rows_are_turned_by_cycles(operations):
    own, cycles = rows(), 1e5 * np.random.default_rng(3).standard_normal((N, M))
    expected = own * np.exp(2j * np.pi * cycles)
    operations.turn_by(own, cycles)
    close(own, expected, 1e-5)


@pytest.mark.parametrize("steepest", [0.0, 5e-4, 0.01])
def test_rows_are_stretched(operations, steepest):
    """Tones move to their places: 16 cells hold 0.35 cycles per cell to one percent."""
    j, origin = np.arange(M), 250.5
    tone = np.array([-0.35, -0.2, 0.0, 0.15, 0.35])[:, None]
    own = np.exp(2j * np.pi * tone * j).astype(np.complex64)
    stretch = steepest * np.linspace(-1, 1, N)
    place = j + stretch[:, None] * (j - origin)
    whole = ((place > 8) & (place < M - 9)).all(axis=0)
    assert whole.sum() > 0.9 * M
    found = operations.stretched(own, origin, stretch)[:, whole]
    # places are held to 1/2048 cell, with arrays to 0.01
    off = 0.01 if isinstance(operations, ArrayRows) else 1 / 2048
    close(found, np.exp(2j * np.pi * tone * place)[:, whole], 0.01 + 2 * np.pi * 0.35 * off)


def test_kernels_are_those_of_least_squares():
    """rms of tones over a band: 0.25 % to 0.35 cycles per cell, 4.4 % to 0.466 (lstsq by hand)."""
    m, f = np.arange(-7, 9), np.linspace(0, 0.466, 200)
    place = np.linspace(0, 1, 33)
    w = kernels()[np.rint(place * (len(kernels()) - 1)).astype(int)]
    errors = np.exp(2j * np.pi * np.outer(f, m)) @ w.T - np.exp(2j * np.pi * np.outer(f, place))
    power = (np.abs(errors) ** 2).mean(axis=1)
    assert np.sqrt(power[f < 0.35].mean()) < 0.003
    assert np.sqrt(power.mean()) < 0.046
    np.testing.assert_allclose(w[0], m == 0, rtol=0, atol=2e-4)


def test_a_view_of_longer_rows_is_stretched_alike(operations):
    long = rows(m=M + 33)
    stretch = np.linspace(-1e-3, 1e-3, N)
    whole = operations.stretched(np.ascontiguousarray(long[:, :M]), 100.0, stretch)
    assert operations.stretched(long[:, :M], 100.0, stretch).tobytes() == whole.tobytes()


def test_without_a_compiler_numpy_serves_and_says_so(monkeypatch):
    monkeypatch.setenv("TERRAFIX_KERNEL", "vm")
    compiled.row_operations.cache_clear()
    try:
        with pytest.warns(UserWarning, match="images are formed with NumPy, two times slower"):
            assert compiled.row_operations() is ARRAY_ROWS
    finally:
        compiled.row_operations.cache_clear()


def test_rows_that_the_compiled_operations_would_misread_are_refused(operations):
    if isinstance(operations, ArrayRows):
        pytest.skip("NumPy broadcasts by itself")
    with pytest.raises(ValueError, match="not complex64 and whole"):
        operations.turn_by(rows().astype(np.complex128), np.zeros((N, M)))
    with pytest.raises(ValueError, match=r"cycles of shape \(3, 4\)"):
        operations.turn_by(rows(), np.zeros((3, 4)))
    with pytest.raises(ValueError, match="an array of shape"):
        operations.turn(
            *(rows(), np.zeros(N), np.zeros(M), np.zeros(N + 1), np.zeros(N, np.float32))
        )
