"""Effective velocity against the curvature of the true distance, and against known figures."""

import casadi as ca
import numpy as np
import pytest

from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import earth_fixed_from_inertial_array
from terrafix.models.motion.attitude import lvlh_quaternion_array
from terrafix.models.motion.orbit import orbit_model
from terrafix.models.motion.start import ALOS, boresight_point, boresight_start
from terrafix.models.sensors.effective_velocity import effective_velocity, effective_velocity_array

LOOK = np.radians(34.3)


@pytest.fixture(scope="module")
def geometry():
    """The nominal pass: inertial state, Earth-fixed state and the point at the boresight."""
    r_i, v_i = boresight_start(ALOS, np.radians(29.76), np.radians(-95.37), LOOK)
    r_e, v_e = earth_fixed_from_inertial_array(r_i, v_i, 0.0, EARTH.rotation_rate)
    assert lvlh_quaternion_array(r_e, v_e).shape == (4,)
    return r_i, v_i, r_e, v_e, boresight_point(r_i, v_i, LOOK, 0.0)


def test_the_nominal_pass_has_the_known_figures(geometry):
    """7188.5 m/s against a speed of 7599.2 m/s at the first fix; 0.1 m/s of it in 8 s."""
    _, _, r_e, v_e, p = geometry
    assert np.linalg.norm(v_e) == pytest.approx(7599.3, abs=0.1)
    assert effective_velocity_array(r_e, v_e, p) == pytest.approx(7188.5, abs=0.6)


def test_it_is_the_curvature_of_the_true_distance(geometry):
    """Distances along the integrated orbit, +-1 s about closest approach: an independent answer.

    The fourth-order term of R^2 over 1 s changes its second difference by 1e-7 of itself.
    """
    r_i, v_i, r_e, v_e, p = geometry
    model = orbit_model("j2")
    squares = []
    for dt in (-1.0, 0.0, 1.0):
        _, state = model.advance(
            r_i=r_i, v_i=v_i, mu=EARTH.mu, radius=EARTH.radius, j2=EARTH.j2, step=dt
        )
        moved, _ = earth_fixed_from_inertial_array(
            state["r_i"], state["v_i"], EARTH.rotation_rate * dt, EARTH.rotation_rate
        )
        squares.append(((moved - p) ** 2).sum())
    curvature = (squares[0] - 2 * squares[1] + squares[2]) / 2
    assert effective_velocity_array(r_e, v_e, p) == pytest.approx(np.sqrt(curvature), abs=2e-3)


def test_its_derivatives_have_the_known_sizes(geometry):
    """Derivatives against closed form and differences.

    The published 1.057 is |v| / V, at fixed acceleration; Coriolis acceleration grows with v too.
    """
    _, _, r_e, v_e, p = geometry
    r, v = ca.SX.sym("r", 3), ca.SX.sym("v", 3)
    constants = (EARTH.mu, EARTH.radius, EARTH.j2, EARTH.rotation_rate)
    value = effective_velocity(r, v, ca.SX(ca.DM(p)), *constants)
    slopes = ca.Function("slopes", [r, v], [ca.jacobian(value, r), ca.jacobian(value, v)])
    by_r, by_v = (np.asarray(m).ravel() for m in slopes(r_e, v_e))
    along = by_v @ v_e / np.linalg.norm(v_e)
    speed, V = np.linalg.norm(v_e), effective_velocity_array(r_e, v_e, p)
    assert speed / V == pytest.approx(1.057, abs=5e-4)
    coriolis = -2 * EARTH.rotation_rate * np.cross([0, 0, 1], v_e / speed)
    assert along == pytest.approx((speed + (r_e - p) @ coriolis / 2) / V, rel=1e-12)
    for k in range(3):  # against central differences
        step = np.zeros(3)
        step[k] = 1.0
        ahead, behind = (effective_velocity_array(r_e, v_e + s * step, p) for s in (1, -1))
        assert by_v[k] == pytest.approx((ahead - behind) / 2, abs=1e-7)
        ahead, behind = (effective_velocity_array(r_e + 100 * s * step, v_e, p) for s in (1, -1))
        assert by_r[k] == pytest.approx((ahead - behind) / 200, abs=1e-9)
