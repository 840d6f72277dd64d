"""Symbolic functions on arrays with member axes."""

import casadi as ca
import numpy as np
import pytest

from terrafix.models.core.batch import over_members
from terrafix.models.geometry.quaternion import product_array

times_vector = over_members(lambda A, x: ca.mtimes(A, x), (2, 3), (3,))
pair = over_members(lambda x, s: (ca.norm_2(x), s * x), (3,), ())


def test_matrices_keep_their_rows():
    A = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(times_vector(A, [1.0, 10.0, 100.0]), [210.0, 543.0])


def test_leading_axes_broadcast_and_scalars_have_no_axis():
    x = np.arange(24.0).reshape(4, 2, 3)
    length, scaled = pair(x, 2.0)
    assert length.shape == (4, 2)
    np.testing.assert_array_equal(scaled, 2 * x)
    np.testing.assert_allclose(length, np.linalg.norm(x, axis=-1), rtol=1e-15)  # one rounding


@pytest.mark.parametrize("n", [1, 7, 100])
def test_a_member_does_not_depend_on_the_others(n):
    rng = np.random.default_rng(1)
    p, q = rng.normal(size=(2, 100, 4))
    together = product_array(p, q)[:n]
    alone = np.stack([product_array(p[i], q[i]) for i in range(n)])
    assert product_array(p[:n], q[:n]).tobytes() == together.tobytes() == alone.tobytes()


def test_no_members_give_no_results():
    assert product_array(np.zeros((0, 4)), np.zeros(4)).shape == (0, 4)


def test_wrong_trailing_axes_are_refused():
    with pytest.raises(ValueError, match=r"product: an argument of shape \(3,\) does not end in"):
        product_array(np.zeros(3), np.zeros(4))
    with pytest.raises(ValueError, match="product takes 2 arrays, got 1"):
        product_array(np.zeros(4))


def test_functions_that_come_and_go_keep_to_themselves():
    """A cache by address gave the result of a function that was gone: 7 of 200 in a loop."""
    x = np.arange(10.0)
    for k in range(200):
        scaled = over_members(lambda a, k=k: k * a, ())
        scaled(x)
        assert scaled(x).tolist() == (k * x).tolist()
