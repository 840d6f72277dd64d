"""Error states: retraction and difference are inverse, covariances follow the estimate."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from terrafix.models.filters.error_state import (
    SIDES,
    Block,
    ErrorState,
    clone,
    considered,
    rotation,
    vector,
)
from terrafix.models.geometry.quaternion import rotation_matrix_array

AIRCRAFT = ErrorState(
    vector("p", unit="m", frame="e"),
    vector("v", unit="m/s", frame="e"),
    rotation("q", side="left", frame="b"),
    vector("accel_bias", unit="m/s^2", frame="b"),
    vector("gyro_bias", unit="rad/s", frame="b"),
    considered(vector("altimeter_bias", 1, unit="m")),
    vector("image_bias", 2, unit="m", labels=("range", "cross_range")),
    clone(vector("p", unit="m", frame="e"), "p_at_center"),
)


def evaluate(expression, *arguments):
    """Values of expressions of symbols, given pairs of symbol and number."""
    function = ca.Function("f", [a for a, _ in arguments], [expression])
    return np.array(function(*(v for _, v in arguments)).full())


def random_values(state, rng):
    values = {}
    for block in state:
        x = rng.normal(size=block.value_size)
        values[block.name] = x / np.linalg.norm(x) if block.is_rotation else x
    return values


def test_places_labels_and_units_follow_from_the_blocks():
    assert AIRCRAFT.size == 21
    assert AIRCRAFT.places["altimeter_bias"] == slice(15, 16)
    assert AIRCRAFT.labels[6:9] == ("q x", "q y", "q z")
    assert AIRCRAFT.labels[15:17] == ("altimeter_bias", "image_bias range")
    assert AIRCRAFT.units[8:10] == ("rad", "m/s^2")
    assert AIRCRAFT.shapes["q"] == (4, 1)
    assert AIRCRAFT.shapes["P"] == (21, 21)
    assert AIRCRAFT.kept == (15,)


def test_difference_undoes_retraction():
    rng = np.random.default_rng(1)
    x, e = AIRCRAFT.symbols("x"), ca.SX.sym("e", AIRCRAFT.size)
    back = AIRCRAFT.difference(AIRCRAFT.retract(x, e), x)
    error = rng.normal(size=AIRCRAFT.size)
    values = random_values(AIRCRAFT, rng)
    given = [(x[name], value) for name, value in values.items()]
    found = evaluate(back, *given, (e, error))[:, 0]
    np.testing.assert_allclose(found, error, atol=1e-14)


@pytest.mark.parametrize("side", SIDES)
def test_a_rotation_s_error_is_in_the_axes_of_its_side(side):
    """Against SciPy: T(q) takes components to the new axes, the transpose of SciPy's matrix."""
    block = rotation("q", side=side)
    rng = np.random.default_rng(2)
    q, theta = rng.normal(size=4), 0.3 * rng.normal(size=3)
    q /= np.linalg.norm(q)
    value, error = ca.SX.sym("q", 4), ca.SX.sym("e", 3)
    turned = evaluate(block.plus(value, error), (value, q), (error, theta))[:, 0]
    T, step = rotation_matrix_array(q), Rotation.from_rotvec(theta).as_matrix().T
    expected = step @ T if side == "left" else T @ step
    np.testing.assert_allclose(rotation_matrix_array(turned), expected, atol=1e-14)


@pytest.mark.parametrize("side", SIDES)
def test_a_covariance_follows_the_corrected_estimate(side):
    """The derivative of the new error by the old, by differences at a large correction."""
    state = ErrorState(vector("a", 1), rotation("q", side=side))
    rng = np.random.default_rng(3)
    x, e, c = state.symbols("x"), ca.SX.sym("e", 4), ca.SX.sym("c", 4)
    moved = state.retract(x, c)
    about = state.difference(state.retract(x, e), moved)
    values = random_values(state, rng)
    given = [(x[name], value) for name, value in values.items()]
    correction = np.array([2.0, 0.3, -0.4, 0.5])
    J = evaluate(state.recentering(c), (c, correction))
    h = 1e-5
    for k in range(4):
        step = h * np.eye(4)[k]
        ahead, behind = (
            evaluate(about, *given, (e, correction + s), (c, correction))[:, 0]
            for s in (step, -step)
        )
        np.testing.assert_allclose(J[:, k], (ahead - behind) / (2 * h), atol=1e-9)
    assert np.abs(J - np.eye(4)).max() > 0.1


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: ErrorState(), "one block or more"),
        (lambda: ErrorState(vector("a"), vector("a")), "two things .* are called 'a'"),
        (lambda: ErrorState(vector("P")), "called 'P'"),
        (lambda: rotation("q", side=""), "has no side; it is on the left .* or on the right"),
        (lambda: vector("1st"), "'1st' cannot name a block"),
        (lambda: vector("a", 0), "has size 0"),
        (lambda: vector("a", 2, labels=("x",)), "1 labels for 2 elements"),
        (
            lambda: ErrorState(vector("a"), clone(vector("b"), "c")),
            "'b_at_c' is a clone of 'b', which is no block like it; the blocks are a, b_at_c",
        ),
        (lambda: ErrorState(vector("a", 2), Block("c", 3, clone_of="a")), "a clone of 'a'"),
    ],
)
def test_what_is_no_error_state_is_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
