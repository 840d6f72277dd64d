"""Orbits and attitudes where they cannot go on: the cause is named, and others fly on."""

import numpy as np
import pytest

from terrafix.components.truth.orbit import OrbitTruth
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import SystemCheckError
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System
from terrafix.models.geometry.earth import EARTH

R0, V0 = [7.0e6, 0.0, 0.0], [0.0, 7.5e3, 0.0]


def orbit_system(r0=R0, v0=V0, rate="0.1", **options):
    system = System("orbit")
    orbit = system.add(OrbitTruth(r0_i=r0, v0_i=v0, rate=Rate(rate), **options), "orbit")
    system.record("r", [orbit["r_i"]], period="1 s")
    return system


@pytest.mark.parametrize(
    "r0",
    [
        [3.0e6, 0.0, 0.0],
        [7070.0, 0.0, 0.0],  # kilometers without a unit
        [0.0, 0.0, 0.0],
        [0.0, 0.0, EARTH.polar_radius - 1.0],
        [EARTH.radius - 1.0, 0.0, 0.0],
    ],
)
def test_a_start_inside_the_earth_is_refused(r0):
    with pytest.raises(SystemCheckError, match=r"'orbit.r0_i' lies inside the Earth: "):
        simulate(orbit_system(r0), duration="1")


@pytest.mark.parametrize("r0", [[0.0, 0.0, EARTH.polar_radius + 1.0], [EARTH.radius + 1.0, 0, 0]])
def test_a_start_just_above_the_ellipsoid_flies(r0):
    """The pole is 21.4 km nearer to the center than the equator."""
    up = 100.0 * np.array(r0) / np.linalg.norm(r0)
    simulate(orbit_system(r0, v0=up, gravity="two-body"), duration="1")


@pytest.mark.parametrize(("drag", "gravity"), [(False, "j2"), (True, "two-body")])
def test_a_member_that_reaches_the_earth_fails_with_the_time(drag, gravity):
    """Free fall from rest: half g t^2 over a height of 5 km takes 32 s; others go on."""
    height = 5000.0
    r0 = EARTH.radius + height
    system = orbit_system([r0, 0.0, 0.0], [0.0, 0.0, 0.0], drag=drag, gravity=gravity)
    start = Dispersion(
        "start", ("orbit.v0_i",), np.array([[0.0, 0.0, 0.0], [0.0, 7905.0, 0.0]]), kind="list"
    )
    system.disperse(start)
    result = simulate(system, members=4, duration="60")
    assert [e["member"] for e in result.excluded] == [0, 2]
    g = EARTH.mu / r0**2 * (1.0 if gravity == "two-body" else 1.0 + 1.5 * EARTH.j2)
    for failure in result.excluded:
        assert failure["component"] == "orbit"
        assert failure["reason"] == "the orbit is inside the Earth"
        # g grows by 0.16 % on the way down; it fails at the first step below
        assert failure["t_s"] == pytest.approx(np.sqrt(2 * height / g), abs=0.11)
    r = result.dataset["orbit.r_i"].to_numpy()
    assert np.isfinite(r[:, 1]).all()
    assert np.isnan(r[-1, 0]).all()


def test_a_member_that_starts_inside_the_earth_fails_at_once():
    system = orbit_system()
    start = np.array([R0, [3.0e6, 0.0, 0.0]])
    system.disperse(Dispersion("start", ("orbit.r0_i",), start, kind="list"))
    result = simulate(system, members=2, duration="1")
    (failure,) = result.excluded
    assert (failure["member"], failure["t_s"]) == (1, 0.0)
    assert failure["reason"] == "the orbit is inside the Earth"


def test_an_orbit_that_overflows_is_not_said_to_be_in_the_earth():
    with pytest.raises(RunError, match="result is not finite"):
        simulate(orbit_system(j2=1e300), duration="10")
