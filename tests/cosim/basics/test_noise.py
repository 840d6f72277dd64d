"""Counter-based normals: known answers, distribution, and independence of everything else."""

import itertools
import math
import statistics

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from terrafix.cosim.basics.noise import (
    NormalBlocks,
    NormalStream,
    _log,
    normal_quantile,
    philox4x32,
    stream_key,
)

ULP = np.finfo(float).eps

KNOWN_ANSWERS = [  # counter, key, answer: "philox4x32 10" of Random123 1.14, tests/kat_vectors
    ("00000000 00000000 00000000 00000000", "00000000 00000000",
     "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff",
     "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0",
     "d16cfe09 94fdcceb 5001e420 24126ea1"),
]  # fmt: skip

STORED = [
    ["-0x1.19ad117786f7ap+0", "0x1.45194c95dcdf7p+0", "-0x1.c3a823369fd5ap-1"],
    ["-0x1.12076188912bcp+0", "0x1.092b02d55d7f0p+0", "-0x1.59835b872f5b4p+0"],
]


def words(text: str) -> list[int]:
    return [int(word, 16) for word in text.split()]


def scalar_draw(key: int, member: int, step: int, index: int) -> float:
    """The module's docstring, word for word, in Python integers and the library's AS 241."""
    c = [index // 2, member, step % 2**32, (step >> 32) % 2**32]
    k = [key % 2**32, key >> 32]
    for _ in range(10):
        p0, p1 = 0xD2511F53 * c[0], 0xCD9E8D57 * c[2]
        c = [p1 >> 32 ^ c[1] ^ k[0], p1 % 2**32, p0 >> 32 ^ c[3] ^ k[1], p0 % 2**32]
        k = [(k[0] + 0x9E3779B9) % 2**32, (k[1] + 0xBB67AE85) % 2**32]
    low, high = c[2 * (index % 2) : 2 * (index % 2) + 2]
    x = low + (high << 32)
    return statistics.NormalDist().inv_cdf((2 * (x >> 12) + 1) / 2**53)


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN_ANSWERS)
def test_philox_gives_the_known_answers(counter, key, answer):
    assert philox4x32(words(counter), words(key)).tolist() == words(answer)


def test_philox_encrypts_arrays_of_counters():
    counters = np.arange(24, dtype=np.uint32).reshape(2, 3, 4)
    together = philox4x32(counters, [5, 6])
    for i, j in itertools.product(range(2), range(3)):
        assert (together[i, j] == philox4x32(counters[i, j], [5, 6])).all()


@settings(deadline=None)  # the first call of a process is slow
@given(
    seed=st.integers(),
    path=st.text(max_size=9),
    stream=st.text(max_size=9),
    member=st.integers(0, 2**32 - 1),
    step=st.integers(-(2**63), 2**63 - 1),
    index=st.integers(0, 40),
)
def test_a_draw_is_the_documented_function(seed, path, stream, member, step, index):
    drawn = NormalStream(seed, path, stream, [member]).draw(step, index + 1)[0, index]
    expected = scalar_draw(stream_key(seed, path, stream), member, step, index)
    # both are AS 241; the logarithm and the order of one product differ: a few units of rounding
    assert drawn == pytest.approx(expected, rel=8 * ULP)


def test_the_numbers_never_change():
    """Stored draws: results of earlier versions must stay reproducible."""
    drawn = NormalStream(2024, "imu", "gyro", [0, 41]).draw(7, 3)
    assert [[value.hex() for value in row] for row in drawn.tolist()] == STORED


def test_logarithm_is_accurate_to_two_units_in_the_last_place():
    rng = np.random.default_rng(1)
    x = np.concatenate([np.exp(rng.uniform(-37, -0.1, 20_000)), [2.0**-53, 0.075, 0.5]])
    exact = np.log(x.astype(np.longdouble))
    if np.finfo(np.longdouble).nmant <= 52:
        pytest.skip("no number format wider than float64 on this machine")
    assert np.max(np.abs(_log(x) - exact) / np.spacing(np.abs(exact.astype(float)))) < 2


def test_quantile_agrees_with_an_independent_implementation():
    """Cephes' ndtri, center, both tails and far tails; each is good to a few units of rounding."""
    tails = 10.0 ** -np.arange(1.0, 16)
    u = np.concatenate([np.linspace(0.001, 0.999, 4001), tails, [2.0**-53], 1 - tails, [0.075]])
    np.testing.assert_allclose(normal_quantile(u), stats.norm.ppf(u), rtol=2e-15, atol=1e-16)


def test_quantile_is_odd_about_one_half_and_increasing():
    inner = np.arange(1, 2**20, 2) / 2**20
    for u in (inner, 2.0 ** -np.arange(53.0, 1, -1)):  # exact, and so is 1 - u
        assert (normal_quantile(u) == -normal_quantile(1 - u)).all()
        assert (np.diff(normal_quantile(u)) > 0).all()
    assert normal_quantile(0.5) == 0
    assert normal_quantile(2.0**-53) == pytest.approx(-8.2095, abs=1e-4)


def test_uniform_numbers_are_exact_odd_multiples():
    """u = (2k + 1) / 2**53: never 0 or 1, and 1 - u is exact and of the same form."""
    u = NormalStream(1, "a", "b", np.arange(50)).uniform(3, 101)
    scaled = u * 2.0**53
    assert u.shape == (50, 101)
    assert (scaled == np.floor(scaled)).all()
    assert (scaled % 2 == 1).all()
    assert (((1 - u) + u) == 1).all()
    assert (normal_quantile(u) == NormalStream(1, "a", "b", np.arange(50)).draw(3, 101)).all()


N_DRAWS = 1_000_000


@pytest.fixture(scope="module")
def draws():
    """Draws of 100 members, 1,000 steps, 10 numbers."""
    return NormalStream(123, "truth.orbit", "drag", np.arange(100)).block(0, 1000, 10)


def test_moments(draws):
    """The first four, within 4.5 standard errors (chance of a false alarm 3e-5, seed fixed)."""
    for power, moment, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        error = np.mean(draws**power) - moment
        assert abs(error) < 4.5 * math.sqrt(variance / N_DRAWS), power


def test_distribution(draws):
    """Kolmogorov-Smirnov at a fixed seed: a correct generator fails in 1 of 1,000 seeds."""
    assert stats.kstest(draws.ravel(), "norm").pvalue > 1e-3


def test_tails_are_populated_as_they_should(draws):
    """Counts beyond 2, 3, 4 sigma are Poisson to good approximation: within 4.5 deviations."""
    for sigma in (2, 3, 4):
        expected = 2 * stats.norm.sf(sigma) * N_DRAWS
        assert abs(np.sum(np.abs(draws) > sigma) - expected) < 4.5 * math.sqrt(expected)


def test_nothing_is_correlated(draws):
    """Neighbors along steps, members and indices; the standard error is 1 / sqrt(draws)."""
    for axis in range(3):
        a = np.moveaxis(draws, axis, 0)
        assert abs(np.mean(a[1:] * a[:-1])) < 4.5 / math.sqrt(a[1:].size)
    for other in (
        NormalStream(124, "truth.orbit", "drag", np.arange(100)),
        NormalStream(123, "truth.orbi", "tdrag", np.arange(100)),
        NormalStream(123, "truth.orbit", "thrust", np.arange(100)),
        NormalStream(123, "truth.orbit", "drag", np.arange(100, 200)),
    ):
        assert abs(np.mean(draws[:100] * other.block(0, 100, 10))) < 4.5 / math.sqrt(100_000)


def test_uniform_words_fill_every_cell():
    """Chi-square of the leading byte of pairs of uniforms, at a fixed seed."""
    u = NormalStream(5, "x", "y", np.arange(64)).uniform_at(range(500), 16)
    cells = (np.floor(u * 16)).astype(int)
    pairs = (cells[..., 0::2] * 16 + cells[..., 1::2]).ravel()
    assert stats.chisquare(np.bincount(pairs, minlength=256)).pvalue > 1e-3


@settings(deadline=None)
@given(split=st.integers(1, 99), step=st.integers(0, 2**40), n=st.integers(1, 7))
def test_members_do_not_depend_on_how_the_ensemble_is_split(split, step, n):
    everyone = np.arange(100)
    whole = NormalStream(9, "imu", "gyro", everyone).draw(step, n)
    for members in (everyone[:split], everyone[split:], everyone[::-1], [41]):
        part = NormalStream(9, "imu", "gyro", members).draw(step, n)
        assert part.tobytes() == whole[members].tobytes()


def test_draws_depend_neither_on_the_count_nor_on_the_order_of_calls():
    stream = NormalStream(9, "imu", "gyro", np.arange(7))
    late, long = stream.draw(1000, 3), stream.draw(5, 50)
    assert stream.draw(5, 3).tobytes() == long[:, :3].tobytes()
    assert stream.draw(1000, 3).tobytes() == late.tobytes()
    assert stream.block(995, 10, 3)[5].tobytes() == late.tobytes()
    assert stream.draw_at([1000, 5, 1000], 3)[2].tobytes() == late.tobytes()


def test_large_blocks_are_cut_where_nobody_sees_it():
    """More numbers than are enciphered at once: the same as one step at a time."""
    stream = NormalStream(9, "imu", "gyro", np.arange(33))
    block = stream.block(0, 100, 5)
    assert block.shape == (100, 33, 5)
    for step in range(100):
        assert block[step].tobytes() == stream.draw(step, 5).tobytes()


def test_steps_beyond_32_bits_and_negative_ones_are_different():
    stream = NormalStream(9, "imu", "gyro", [0])
    steps = [0, 1, 2**32, 2**32 + 1, 2**33, 2**62, -1, -(2**32)]
    assert len(set(stream.draw_at(steps, 1).ravel().tolist())) == len(steps)


def test_keys_are_different_where_anything_is():
    keys = [
        stream_key(seed, path, stream)
        for seed in (0, 1, -1, 2**64, 2**64 + 1, -(10**400))
        for path, stream in (("a", "bc"), ("ab", "c"), ("", "abc"), ("a\0b", "c"), ("a", "b\0c"))
    ]
    assert len(set(keys)) == len(keys)
    assert all(0 <= key < 2**64 for key in keys)
    assert stream_key(np.int64(3), "a", "b") == stream_key(3, "a", "b")


def test_a_seed_is_an_integer():
    with pytest.raises(TypeError):
        stream_key(1.5, "a", "b")


@pytest.mark.parametrize("member", [-1, 2**32])
def test_members_are_32_bit_numbers(member):
    with pytest.raises(ValueError, match=f"from 0 to 4294967295, got {member}"):
        NormalStream(0, "a", "b", [3, member])


@pytest.mark.parametrize("n_members", [1, 7, 100])
def test_blocks_give_the_draws_of_the_stream_in_any_order_of_steps(n_members):
    stream = NormalStream(9, "imu", "gyro", np.arange(n_members))
    blocks = NormalBlocks(stream, 3)
    regular, sparse = range(3000), range(2**33, 2**33 + 4100, 820)
    irregular = [5, 4, 3, 4, 4, 10, 0, 2**40]
    for step in itertools.chain(irregular, itertools.islice(regular, 0, None, 37), sparse):
        assert blocks.draw(step).tobytes() == stream.draw(step, 3).tobytes()
