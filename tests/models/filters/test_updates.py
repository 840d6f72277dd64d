"""Updates of a measurement with an angle: half a turn is nowhere special."""

import casadi as ca
import numpy as np
import pytest

from terrafix.models.filters.updates import UPDATES, Measurement, update_rule

P = np.array([[4.0, 1.0], [1.0, 9.0]])  # [m^2]
PLACE = np.array([-50.0, 20.0])  # [m], of the prior, seen from the origin
SIGMA = np.array([0.02, 0.5])  # [rad], [m]


def turned(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def updated(rule, turn, miss, whole_turns=0):
    """Bearing and range of a place; the bearing counted from an axis turned by an angle."""
    C = turned(turn)
    x, error = C @ PLACE, ca.SX.sym("error", 2)
    at = ca.mtimes(ca.DM(C), PLACE + error)
    y = ca.vertcat(ca.atan2(at[1], at[0]), ca.sqrt(ca.dot(at, at)))
    bearing = np.arctan2(x[1], x[0]) + miss
    measured = [np.angle(np.exp(1j * bearing)) + 2 * np.pi * whole_turns, np.hypot(*PLACE) + 0.3]
    measurement = Measurement(
        ca.DM(measured),
        lambda e: ca.substitute(y, error, e),
        lambda e: ca.substitute(ca.jacobian(y, error), error, e),
        lambda _: ca.diag(ca.DM(SIGMA**2)),
        ca.DM([1.0, 1.0]),
        angles=(0,),
    )
    done = update_rule(rule)(ca.SX(ca.DM(P)), measurement, 0.0)
    values = ca.Function("f", [], [done.correction, done.P, done.residual, done.nis])()
    correction, after, residual, nis = (np.asarray(v) for v in values.values())
    return correction.ravel(), after, residual.ravel(), nis.item()


@pytest.mark.parametrize("rule", UPDATES)
@pytest.mark.parametrize("miss", [0.03, -0.03])
def test_a_bearing_across_half_a_turn_is_like_any_other(rule, miss):
    """Counted so that prior and measurement lie on either side of 180 deg, or far from it."""
    far = updated(rule, 0.0, miss)
    half = np.pi - np.arctan2(PLACE[1], PLACE[0]) - miss / 2
    assert far[2][0] == pytest.approx(miss, abs=5e-3)  # the unscented mean is of second order
    for turn, whole in ((half, 0), (half, 1), (0.0, -1)):
        for one, other in zip(far, updated(rule, turn, miss, whole), strict=True):
            np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-12)


def test_the_first_residual_and_nis_are_those_of_the_textbook():
    """NIS = r' S^-1 r with S = H P H' + R; H of a bearing is (-y, x) / rho^2."""
    miss = 0.03
    _, _, residual, nis = updated("ekf", np.pi - np.arctan2(20.0, -50.0) - 0.01, miss)
    x, y = PLACE
    rho = np.hypot(x, y)
    H = np.array([[-y / rho**2, x / rho**2], [x / rho, y / rho]])
    S = H @ P @ H.T + np.diag(SIGMA**2)
    expected = np.array([miss, 0.3])
    np.testing.assert_allclose(residual, expected, atol=1e-12)
    assert nis == pytest.approx(expected @ np.linalg.solve(S, expected), rel=1e-10)


def test_five_iterations_are_made_towards_the_most_probable_state():
    """Against Gauss-Newton in numbers: the fifth step's state, not that of the second.

    The prior is five times as uncertain as above, so that a step is worth a factor of ten or so.
    """
    P0, R = 25 * P, np.diag(SIGMA**2)

    def h(e):
        at = PLACE + e
        return np.array([np.arctan2(at[1], at[0]), np.hypot(*at)])

    def jacobian(e):
        a, b = PLACE + e
        rho = np.hypot(a, b)
        return np.array([[-b / rho**2, a / rho**2], [a / rho, b / rho]])

    y = h(np.zeros(2)) + np.array([0.25, 3.0])
    e, steps = np.zeros(2), []
    for _ in range(60):
        H = jacobian(e)
        K = P0 @ H.T @ np.linalg.inv(H @ P0 @ H.T + R)
        e = K @ (y - h(e) + H @ e)
        steps.append(e)
    error = ca.SX.sym("error", 2)
    at = PLACE + error
    predicted = ca.vertcat(ca.atan2(at[1], at[0]), ca.sqrt(ca.dot(at, at)))
    measurement = Measurement(
        ca.DM(y),
        lambda value: ca.substitute(predicted, error, value),
        lambda value: ca.substitute(ca.jacobian(predicted, error), error, value),
        lambda _: ca.DM(R),
        ca.DM([1.0, 1.0]),
        angles=(0,),
    )
    done = update_rule("iterated")(ca.SX(ca.DM(P0)), measurement, 0.0)
    values = ca.Function("f", [], [done.correction, done.P])()
    np.testing.assert_allclose(np.asarray(values["o0"]).ravel(), steps[4], rtol=0, atol=1e-10)
    assert np.linalg.norm(steps[1] - steps[4]) > 1e-2  # what two iterations would leave [m]
    assert np.linalg.norm(steps[3] - steps[4]) > 1e-9  # and four
    assert np.linalg.norm(steps[4] - e) < 1e-5
    H = jacobian(steps[4])
    K = P0 @ H.T @ np.linalg.inv(H @ P0 @ H.T + R)
    after = (np.eye(2) - K @ H) @ P0
    np.testing.assert_allclose(np.asarray(values["o1"]), after, rtol=1e-8)
