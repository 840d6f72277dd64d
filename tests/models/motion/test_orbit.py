"""The orbit against closed forms, conserved quantities and an independent integrator."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import earth_fixed_from_inertial_array
from terrafix.models.motion.gravity import drag_acceleration, gravity_acceleration, j2_acceleration
from terrafix.models.motion.kepler import KeplerianElements, circular_orbit, elements_of_state
from terrafix.models.motion.orbit import orbit_model


def propagate(model, constants, start, dt, n_steps):
    """State (6,) after many steps of the model, run inside CasADi."""
    following = ca.vertcat(*(model.step_outputs[f"next:{k}"] for k in ("r_i", "v_i")))
    known = {**model.parameters, "step": model.step}
    values = {**dict.fromkeys(known, 0.0), **constants, "step": dt}
    symbols = [s for k, s in known.items() if s.numel() == 1]
    numbers = [ca.SX(values[k]) for k, s in known.items() if s.numel() == 1]
    (following,) = ca.substitute([following], symbols, numbers)
    state = ca.vertcat(model.states["r_i"], model.states["v_i"])
    step = ca.Function("step", [state], [following], {"cse": True})
    return step.fold(n_steps)(np.concatenate(start)).full().ravel()


def energy(state, j2=0.0):
    r, v = state[:3], state[3:]
    rho = np.linalg.norm(r)
    oblate = j2 * (EARTH.radius / rho) ** 2 * (1.5 * (r[2] / rho) ** 2 - 0.5)
    return v @ v / 2 - EARTH.mu / rho * (1 - oblate)


def test_j2_acceleration_is_the_gradient_of_its_potential():
    """Legendre's P2: an independent form of the field; derivatives good to some roundings."""
    r = ca.SX.sym("r", 3)
    rho = ca.norm_2(r)
    legendre = 1.5 * (r[2] / rho) ** 2 - 0.5
    potential = EARTH.mu / rho * (1 - EARTH.j2 * (EARTH.radius / rho) ** 2 * legendre)
    ours = j2_acceleration(r, EARTH.mu, EARTH.radius, EARTH.j2)
    f = ca.Function("f", [r], [ours, ca.gradient(potential, r)])
    for point in ([7e6, 0, 0], [0, 0, 7e6], [-1.1e6, -6.1e6, 3.4e6]):
        ours, theirs = (x.full().ravel() for x in f(point))
        np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("e", [0.0, 0.00118, 0.3])
def test_kepler_orbit_returns_after_one_period(e):
    """Two-body truth closes on itself: the analytic answer, to integrator error."""
    orbit = KeplerianElements(9.5e6, e, 1.7, 0.4, 1.1, 0.3)
    start = np.concatenate(orbit.state(EARTH.mu))
    n = 10_000
    dt = orbit.period(EARTH.mu) / n
    end = propagate(orbit_model("two-body"), {"mu": EARTH.mu}, (start[:3], start[3:]), dt, n)
    # RK4 at 0.9 s; rounding of the state, amplified along the track, stays below 1e-5 m
    np.testing.assert_allclose(end[:3], start[:3], atol=1e-4)
    np.testing.assert_allclose(end[3:], start[3:], atol=1e-7)


def test_two_body_conserves_energy_and_angular_momentum(constants, start_i):
    start = np.concatenate(start_i)
    end = propagate(orbit_model("two-body"), constants, start_i, 1.0, 6000)
    # relative rounding of some thousand steps
    assert energy(end) == pytest.approx(energy(start), rel=1e-12)
    momentum = np.cross(start[:3], start[3:])
    np.testing.assert_allclose(np.cross(end[:3], end[3:]), momentum, rtol=1e-12)


def test_j2_conserves_energy_and_polar_angular_momentum(constants, start_i):
    start = np.concatenate(start_i)
    end = propagate(orbit_model("j2"), constants, start_i, 1.0, 6000)
    assert energy(end, EARTH.j2) == pytest.approx(energy(start, EARTH.j2), rel=1e-12)
    before, after = np.cross(start[:3], start[3:]), np.cross(end[:3], end[3:])
    assert after[2] == pytest.approx(before[2], rel=1e-11)
    assert np.abs(after - before)[:2].max() > 1e-4 * np.linalg.norm(before)  # the plane turns


def test_node_regresses_at_the_secular_rate(constants, start_i):
    """First-order perturbation theory, whose relative error is of order J2: 1e-3."""
    elements = elements_of_state(*start_i, EARTH.mu)
    n_steps = round(elements.period(EARTH.mu)) * 5
    end = propagate(orbit_model("j2"), constants, start_i, 1.0, n_steps)
    node = elements_of_state(end[:3], end[3:], EARTH.mu).node
    p = elements.semi_major_axis * (1 - elements.eccentricity**2)
    motion = 2 * np.pi / elements.period(EARTH.mu)
    rate = -1.5 * EARTH.j2 * (EARTH.radius / p) ** 2 * motion * np.cos(elements.inclination)
    assert (node - elements.node) / n_steps == pytest.approx(rate, rel=0.01)


@pytest.mark.parametrize(("duration", "tolerance"), [(600, 1e-4), (86_400, 1e-3)])
def test_j2_orbit_agrees_with_an_independent_integrator(constants, start_i, duration, tolerance):
    """Dormand-Prince of order eight, at tolerances that leave it 1e-5 m in 24 hours."""
    mu, radius, j2 = EARTH.mu, EARTH.radius, EARTH.j2

    def derivative(_, y):
        rho = np.linalg.norm(y[:3])
        s = 5 * (y[2] / rho) ** 2
        oblate = 1.5 * j2 * (radius / rho) ** 2
        factors = 1 + oblate * (np.array([1, 1, 3]) - s)
        return np.concatenate([y[3:], -mu / rho**3 * factors * y[:3]])

    start = np.concatenate(start_i)
    reference = solve_ivp(
        derivative, (0, duration), start, method="DOP853", rtol=1e-13, atol=1e-9
    ).y[:, -1]
    ours = propagate(orbit_model("j2"), constants, start_i, 1.0, duration)
    assert np.linalg.norm(ours[:3] - reference[:3]) < tolerance


def test_rates_that_matter_agree(constants, start_i):
    """RK4 at 0.2 s and at 0.01 s after 600 s: the spacing of steps is no error source."""
    coarse = propagate(orbit_model(), constants, start_i, 0.2, 3000)
    fine = propagate(orbit_model(), constants, start_i, 0.01, 60_000)
    assert np.linalg.norm((coarse - fine)[:3]) < 1e-5


def test_order_of_integration_is_four(constants, start_i):
    """Slope of the error over three halvings, where rounding is far below."""
    steps = np.array([120.0, 60.0, 30.0])
    reference = propagate(orbit_model(), constants, start_i, 1.0, 3600)
    errors = [
        np.linalg.norm(
            (propagate(orbit_model(), constants, start_i, h, round(3600 / h)) - reference)[:3]
        )
        for h in steps
    ]
    slopes = np.diff(np.log(errors)) / np.diff(np.log(steps))
    assert np.all((slopes > 3.7) & (slopes < 4.6))


def test_start_and_outputs(constants, start_i):
    """At the start the outputs are the initial state, turned by the Earth's angle."""
    model = orbit_model()
    start = model.initial_function()
    arguments = {"r0_i": start_i[0], "v0_i": start_i[1], "earth_angle0": 0.7, **constants}
    result = start(**arguments)
    r_e, v_e = earth_fixed_from_inertial_array(*start_i, 0.7, EARTH.rotation_rate)
    np.testing.assert_allclose(result["r_e_"].full().ravel(), r_e, atol=2e-9)
    np.testing.assert_allclose(result["v_e_"].full().ravel(), v_e, atol=2e-12)
    np.testing.assert_array_equal(result["delta_v_e_"].full(), np.zeros((3, 1)))
    outputs, states = model.advance(
        r_i=start_i[0], v_i=start_i[1], earth_angle0=0.7, step=0.5, time=100.5, **constants
    )
    angle = 0.7 + EARTH.rotation_rate * 100.5
    expected = earth_fixed_from_inertial_array(
        states["r_i"], states["v_i"], angle, EARTH.rotation_rate
    )
    np.testing.assert_allclose(outputs["r_e"], expected[0], atol=2e-9)
    np.testing.assert_allclose(outputs["v_e"], expected[1], atol=2e-12)


def test_drag_is_felt_against_the_wind(constants, start_i):
    """The increment is the integral of drag alone, in the Earth-fixed axes of the step's end."""
    r, v = start_i
    air = {"density": 1e-12, "ballistic_coefficient": 0.02}
    dt, time = 0.1, 50.0
    outputs, states = orbit_model(drag=True).advance(
        r_i=r, v_i=v, sensed_v_i=[1, 2, 3], step=dt, time=time, **constants, **air
    )
    relative = v - np.cross([0, 0, EARTH.rotation_rate], r)
    expected_i = -0.5 * 1e-12 * 0.02 * np.linalg.norm(relative) * relative * dt
    expected_e, _ = earth_fixed_from_inertial_array(
        expected_i, np.zeros(3), EARTH.rotation_rate * time, 0.0
    )
    # the velocity turns by 1e-4 rad in the step; the accumulated sum of 3 m/s rounds at 4e-16
    np.testing.assert_allclose(outputs["delta_v_e"], expected_e, rtol=2e-4, atol=2e-15)
    assert states["sensed_v_before_i"].tolist() == [1, 2, 3]
    coasting, _ = orbit_model().advance(r_i=r, v_i=v, step=dt, time=time, **constants)
    np.testing.assert_allclose(outputs["v_i"] - coasting["v_i"], expected_i, rtol=2e-4, atol=2e-12)


def test_drag_at_rest_in_the_air_is_zero_and_has_a_derivative():
    v = ca.SX.sym("v", 3)
    drag = drag_acceleration(ca.SX([7e6, 0, 0]), v, 1e-12, 0.02, 1e-4)
    f = ca.Function("f", [v], [drag, ca.jacobian(drag, v)])
    value, derivative = (x.full() for x in f([0, 700, 0]))
    assert np.all(np.abs(value) < 1e-300)
    assert np.isfinite(derivative).all()


def test_circular_orbit_has_the_circular_speed():
    r, v = circular_orbit(7e6, EARTH.mu, 0.5)
    assert np.linalg.norm(v) == pytest.approx(np.sqrt(EARTH.mu / 7e6), rel=1e-15)
    assert r @ v == 0


def test_unknown_gravity_is_refused():
    with pytest.raises(ValueError, match=r"gravity must be one of .*got 'j3'"):
        orbit_model("j3")
    with pytest.raises(ValueError, match="gravity"):
        gravity_acceleration("")
