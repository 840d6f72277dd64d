"""Dryden's turbulence: exact in variance, correlation and spectrum, and the military's scales."""

import casadi as ca
import numpy as np
import pytest

from terrafix.models.core.batch import over_members
from terrafix.models.motion.dryden import N_STATES, blown, gusts, military_scales, started

SIGMA, LENGTH, SPEED = np.array([1.5, 1.2, 0.7]), np.array([300.0, 300.0, 150.0]), 70.0


def linear(dt):
    """Matrices of a step: start, transition, noise, output."""
    x, n = ca.SX.sym("x", N_STATES), ca.SX.sym("n", N_STATES)
    after = blown(x, SIGMA, n, LENGTH / SPEED, dt)
    parts = [
        ca.jacobian(started(SIGMA, n), n),
        ca.jacobian(after, x),
        ca.jacobian(after, n),
        ca.jacobian(gusts(x), x),
    ]
    return [ca.DM(ca.evalf(p)).full() for p in parts]


@pytest.mark.parametrize("dt", [1e-3, 0.01, 0.3, 5.0])
def test_variance_is_sigma_squared_and_stays(dt):
    """The filters' covariance of the start is that of every step."""
    S, F, G, C = linear(dt)
    P = S @ S.T
    np.testing.assert_allclose(np.diag(C @ P @ C.T), SIGMA**2, rtol=1e-14)
    np.testing.assert_allclose(F @ P @ F.T + G @ G.T, P, atol=1e-14)


@pytest.mark.parametrize("dt", [0.01, 0.3])
def test_correlation_is_the_closed_form(dt):
    """exp(-t/T) along; exp(-t/T) (1 - t/2T) across and vertical: MIL-F-8785C, transformed."""
    S, F, _, C = linear(dt)
    P = S @ S.T
    T = LENGTH / SPEED
    for k in (1, 10, 100):
        t = k * dt
        found = np.diag(C @ np.linalg.matrix_power(F, k) @ P @ C.T)
        shape = np.exp(-t / T) * np.array([1.0, *(1 - t / (2 * T[1:]))])
        np.testing.assert_allclose(found, SIGMA**2 * shape, atol=1e-13)


def test_spectrum_is_drydens():
    """Of the sampled filters, at frequencies far below that of the samples: MIL-F-8785C, 3.7."""
    dt = 1e-3
    _, F, G, C = linear(dt)
    T = LENGTH / SPEED
    for frequency in (0.02, 0.5, 3.0):  # [Hz]
        w = 2 * np.pi * frequency
        H = C @ np.linalg.solve(np.exp(1j * w * dt) * np.eye(N_STATES) - F, G)
        found = dt * np.real(np.diag(H @ H.conj().T))  # two-sided, per hertz
        a = (w * T) ** 2
        shape = np.array([2 / (1 + a[0]), *((1 + 3 * a[1:]) / (1 + a[1:]) ** 2)])
        np.testing.assert_allclose(found, SIGMA**2 * T * shape, rtol=2e-4)


@pytest.mark.parametrize(
    ("feet", "sigmas", "lengths"),
    [
        # h = 500 ft, 30 kn: (0.177 + 0.4115)^0.4 = 0.8089, ^1.2 = 0.5293
        (500.0, (3.709, 3.709, 3.0), (944.7, 944.7, 500.0)),
        # 10 ft, and below: (0.177 + 0.00823)^0.4 = 0.5093, ^1.2 = 0.1322
        (10.0, (5.890, 5.890, 3.0), (75.64, 75.64, 10.0)),
        (2.0, (5.890, 5.890, 3.0), (75.64, 75.64, 10.0)),
        (1000.0, (3.0, 3.0, 3.0), (1000.0, 1000.0, 1000.0)),
        (1500.0, (3.0, 3.0, 3.0), (1375.0, 1375.0, 1375.0)),
        (3000.0, (3.0, 3.0, 3.0), (1750.0, 1750.0, 1750.0)),
    ],
)
def test_scales_are_the_militarys(feet, sigmas, lengths):
    """In knots and feet, as the specification has them; at 1000 ft the two ranges meet."""
    knot = 1852 / 3600
    found = over_members(military_scales, (), ())(feet * 0.3048, 30 * knot)
    np.testing.assert_allclose(found[0] / knot, sigmas, rtol=2e-4)
    np.testing.assert_allclose(found[1] / 0.3048, lengths, rtol=2e-4)
