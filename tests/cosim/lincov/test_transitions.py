"""Products of transitions against one multiplication after the other."""

import numpy as np
import pytest

from terrafix.cosim.lincov.transitions import Chain, chained, reached, repeated


@pytest.fixture
def steps():
    """Three transitions of five elements; noise enters at element 2, which drives 1 and 3."""
    rng = np.random.default_rng(1)
    f = np.tile(np.eye(5), (3, 1, 1)) + 0.1 * rng.standard_normal((3, 5, 5)) * (
        np.array(
            [
                [1, 0, 0, 0, 1],
                [1, 1, 1, 0, 1],
                [1, 0, 1, 0, 0],
                [0, 1, 1, 1, 0],
                [0, 0, 0, 0, 1],
            ]
        )
    )
    g = np.zeros((3, 5, 2))
    g[:, 2] = rng.standard_normal((3, 2))
    return f, g


def test_noise_reaches_what_depends_on_what_it_drives(steps):
    f, g = steps
    assert reached(f, [g]).tolist() == [1, 2, 3]
    assert reached(f, []).tolist() == []


@pytest.mark.parametrize("times", [0, 1, 2, 7, 17])
def test_repetition_and_chain_are_products_and_sums(steps, times):
    """To rounding: a few hundred operations on numbers of order one."""
    f, g = steps
    reach = reached(f, [g])
    q = (g @ g.swapaxes(1, 2))[:, None, reach][..., reach]
    chain = chained(repeated(f, q, reach, times), reach)
    phi, covariance = np.eye(5), np.zeros((5, 5))
    for transition, noise in zip(f, g, strict=True):
        for _ in range(times):
            phi = transition @ phi
            covariance = transition @ covariance @ transition.T + noise @ noise.T
    np.testing.assert_allclose(chain.product, phi, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(chain.added[0], covariance[np.ix_(reach, reach)], rtol=1e-12)
    rest = np.setdiff1d(np.arange(5), reach)
    assert not covariance[rest].any()


def test_nothing_at_all_is_the_identity():
    parts = Chain(np.zeros((0, 4, 4)), np.zeros((0, 0, 0, 0)))
    chain = chained(parts, np.zeros(0, dtype=np.intp))
    np.testing.assert_array_equal(chain.product, np.eye(4))
