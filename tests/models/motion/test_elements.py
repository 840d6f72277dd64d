"""Orbits of the thesis from their elements: its table of states, to their rounding."""

from dataclasses import astuple, replace

import casadi as ca
import numpy as np
import pytest

from terrafix.models.core.batch import over_members
from terrafix.models.motion.elements import (
    LOW_ORBIT,
    MOLNIYA_ORBIT,
    check_orbit,
    perifocal_axes,
    state_of_elements,
)

MU = 3.986e14  # of the thesis, its unit put right [m^3/s^2]
ORBITS = {"low": LOW_ORBIT, "molniya": MOLNIYA_ORBIT}
STATES = {  # of a correct implementation: [km], [km/min]
    "low": ((-4732.5, 786.2, 5067.8), (-298.24, 140.82, -300.35)),
    "molniya": ((17281.0, -13906.9, 39527.8), (80.94, 50.03, -17.78)),
}
PRINTED = {  # Table 3.2
    "low": ((-4710, 780, 5080), (-300, 139, -299)),
    "molniya": ((17100, -13900, 39600), (81.2, 50.0, -17.3)),
}
axes_array = over_members(perifocal_axes, (), (), ())
state_array = over_members(state_of_elements, (6,), ())


@pytest.mark.parametrize("name", ORBITS)
def test_states_at_apogee(name):
    """Those of a correct implementation, within 0.1 km and twice their last digit of a speed."""
    r, v = state_array(astuple(ORBITS[name]), MU)
    np.testing.assert_allclose(r / 1e3, STATES[name][0], atol=0.1)
    np.testing.assert_allclose(v * 60e-3, STATES[name][1], atol=0.02)


@pytest.mark.parametrize("name", ORBITS)
def test_states_are_the_printed_ones_to_the_rounding_of_the_elements(name):
    """Three digits of elements: half a percent of position, 0.7 percent of speed."""
    r, v = state_array(astuple(ORBITS[name]), MU)
    for value, printed, share in ((r / 1e3, 0, 0.005), (v * 60e-3, 1, 0.007)):
        table = np.array(PRINTED[name][printed])
        assert np.linalg.norm(value - table) < share * np.linalg.norm(table)


@pytest.mark.parametrize("name", ORBITS)
def test_the_symbolic_state_is_the_numeric_one(name):
    r, v = state_array(astuple(ORBITS[name]), MU)
    other = ORBITS[name].state(MU)
    np.testing.assert_allclose(r, other[0], rtol=1e-13, atol=1e-6)
    np.testing.assert_allclose(v, other[1], rtol=1e-13, atol=1e-9)


@pytest.mark.parametrize("name", ORBITS)
def test_perifocal_axes_are_a_rotation_and_the_printed_ones_are_not(name):
    """Determinant 1; with the printed sign 1.022 and 0.756."""
    _, _, i, node, w, _ = astuple(ORBITS[name])
    C = axes_array(i, node, w)
    assert np.linalg.det(C) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=1e-14)
    printed = C.copy()
    printed[1, 0] = np.sin(node) * np.cos(w) - np.cos(node) * np.sin(w) * np.cos(i)
    expected = {"low": 1.022, "molniya": 0.756}[name]
    assert np.linalg.det(printed) == pytest.approx(expected, abs=1e-3)


def test_periods_and_apogees():
    """1.5365 h and 600.3 km; 11.993 h and 38 948 km, above 6378 km."""
    for orbit, hours, height in ((LOW_ORBIT, 1.5365, 600.3), (MOLNIYA_ORBIT, 11.993, 38948)):
        assert orbit.period(MU) / 3600 == pytest.approx(hours, rel=1e-4)
        assert np.linalg.norm(orbit.state(MU)[0]) / 1e3 - 6378 == pytest.approx(height, abs=0.5)


def test_it_is_differentiable():
    x = ca.SX.sym("x", 6)
    r, _ = state_of_elements(x, MU)
    J = ca.Function("J", [x], [ca.jacobian(r, x)])(list(astuple(LOW_ORBIT))).full()
    step = 1e-6
    for k in range(1, 6):
        off = [np.array(astuple(LOW_ORBIT)) + s * step * np.eye(6)[k] for s in (1, -1)]
        slope = (state_array(off[0], MU)[0] - state_array(off[1], MU)[0]) / (2 * step)
        np.testing.assert_allclose(J[:, k], slope, rtol=1e-6, atol=1.0)


def test_an_orbit_that_meets_the_earth_is_refused():
    check_orbit(LOW_ORBIT, 6.378e6)  # 164 km
    low = replace(LOW_ORBIT, eccentricity=0.06)
    with pytest.raises(ValueError, match=r"meets the Earth: its perigee lies -24 km"):
        check_orbit(low, 6.378e6)
