"""What follows from a model's declaration."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from terrafix.models.core.model import Model, rk4


def oscillator():
    x, k, dt = ca.SX.sym("x", 2), ca.SX.sym("k"), ca.SX.sym("dt")
    return Model(
        "oscillator",
        states={"x": x},
        parameters={"k": k},
        derivatives={"x": ca.vertcat(x[1], -k * x[0])},
        initial={"x": ca.vertcat(k, 0)},
        outputs={"energy": k * x[0] ** 2 / 2 + x[1] ** 2 / 2},
        step=dt,
    )


def test_outputs_are_those_of_the_end_of_the_step():
    model = oscillator()
    outputs, states = model.advance(x=[1.0, 0.0], k=4.0, step=0.1)
    x = states["x"]
    assert outputs["energy"] == 2 * x[0] ** 2 + x[1] ** 2 / 2
    np.testing.assert_allclose(x, [np.cos(0.2), -2 * np.sin(0.2)], atol=1e-5)  # 0.2^5 / 120


def test_runge_kutta_has_order_four():
    steps = np.array([0.4, 0.2, 0.1, 0.05])
    errors = []
    for h in steps:
        x = np.array([1.0, 0.0])
        for _ in range(round(2 / h)):
            x = rk4(lambda _, x: np.array([x[1], -x[0]]), x, h)
        errors.append(np.linalg.norm(x - [np.cos(2), -np.sin(2)]))
    slopes = np.diff(np.log(errors)) / np.diff(np.log(steps))
    np.testing.assert_allclose(slopes, 4, atol=0.2)


def test_time_in_a_derivative_runs_through_the_step():
    """x' = cos t, x(10) = sin 10: the error falls with the fourth power of the step.

    Frozen at the end of the step, time would leave 0.1 at 10 Hz: order one.
    """
    x, t, dt = ca.SX.sym("x"), ca.SX.sym("t"), ca.SX.sym("dt")
    model = Model("clock", states={"x": x}, derivatives={"x": ca.cos(t)}, step=dt, time=t)
    steps, errors = [1.0, 0.5, 0.25, 0.125], []
    for h in steps:
        value = 0.0
        for k in range(round(10 / h)):
            value = model.advance(x=value, step=h, time=(k + 1) * h)[1]["x"]
        errors.append(abs(float(value[0]) - np.sin(10)))
    slopes = np.diff(np.log(errors)) / np.diff(np.log(steps))
    np.testing.assert_allclose(slopes, 4, atol=0.05)


def test_an_integrator_of_its_own_takes_the_place_of_runge_kutta():
    """Leapfrog of an oscillator, by its matrix; outputs, derivatives and errors as ever."""
    x, h, k = ca.SX.sym("x", 2), ca.SX.sym("h"), ca.SX.sym("k")
    half = x[1] - h / 2 * k * x[0]
    there = x[0] + h * half
    flow = ca.vertcat(there, half - h / 2 * k * there)
    own = Model(
        "leapfrog",
        states={"x": x},
        parameters={"k": k},
        derivatives={"x": ca.vertcat(x[1], -k * x[0])},
        flow={"x": flow},
        step=h,
    )
    _, states = own.advance(x=[1.0, 0.0], k=4.0, step=0.1)
    # cos of the step's angle is 1 - k h^2 / 2
    np.testing.assert_allclose(states["x"], [0.98, -0.4 + 0.4 * 0.01], rtol=1e-14)
    rate = own.rate_function()(x=[1.0, 0.5], k=4.0)["der_x_"].full().ravel()
    assert rate.tolist() == [0.5, -4.0]
    assert own.uses("k")
    with pytest.raises(ValueError, match=r"flow integrates \['x'\], and derivatives are those of"):
        replace(own, derivatives={})
    with pytest.raises(ValueError, match="flow names 'y', which is no state"):
        replace(own, flow={"y": flow})


def test_start_evaluates_the_outputs_at_the_initial_states():
    start = oscillator().initial_function()(k=3.0)
    assert start["next_x_"].full().ravel().tolist() == [3.0, 0.0]
    assert start["energy_"] == 3 * 9 / 2


def test_matrices_are_row_major_and_sparse_expressions_are_filled():
    A, S, x = ca.SX.sym("A", 2, 3), ca.SX.sym("S", 2, 2), ca.SX.sym("x", 3)
    model = Model(
        "matrices",
        inputs={"msg.A": A, "x": x},
        states={"S": S},
        next={"S": ca.diag(ca.mtimes(A, x))},
        initial={"S": ca.SX.eye(2)},
        outputs={"msg.S": S, "y": ca.mtimes(A, x), "A.T": A.T},
    )
    matrix, vector = np.arange(6.0).reshape(2, 3), [1.0, 10.0, 100.0]
    outputs, states = model.advance(msg_A=matrix, x=vector)
    np.testing.assert_array_equal(outputs["y"], matrix @ vector)
    np.testing.assert_array_equal(outputs["A.T"], matrix.T)
    np.testing.assert_array_equal(states["S"], np.diag(matrix @ vector))
    np.testing.assert_array_equal(outputs["msg.S"], states["S"])
    start = model.initial_function()()
    np.testing.assert_array_equal(start["msg_S_"].full().ravel(), [1, 0, 0, 1])
    derivative = model.jacobian("y", "msg.A", x=vector)
    np.testing.assert_array_equal(derivative, np.kron(np.eye(2), vector))
    assert model.shape("msg.A") == (2, 3)
    assert model.shape("x") == (3,)


def test_undeclared_symbols_and_wrong_shapes_are_refused():
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y")
    with pytest.raises(ValueError, match=r"outputs\['z'\] depends on 'y', which is not declared"):
        Model("m", inputs={"x": x}, outputs={"z": x * y})
    with pytest.raises(ValueError, match=r"next\['x'\] has shape \(3, 1\), the state has \(2, 1\)"):
        Model("m", states={"x": x}, next={"x": ca.SX.zeros(3)})
    with pytest.raises(ValueError, match="next names 'v', which is no state"):
        Model("m", states={"x": x}, next={"v": x})
    with pytest.raises(ValueError, match="either discrete or continuous"):
        Model("m", states={"x": x}, next={"x": x}, derivatives={"x": x})
    with pytest.raises(ValueError, match=r"has no \['w'\]"):
        oscillator()(w=1.0)
