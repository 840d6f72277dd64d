"""Orbits and attitudes where they cannot go on: the cause is named, and others fly on."""

import numpy as np
import pytest

from terrafix.components.truth.attitude import LvlhAttitude
from terrafix.components.truth.orbit import OrbitTruth
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Output
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


def test_one_number_is_no_position():
    with pytest.raises(ConfigurationError, match=r"'r0_i' is one number; .*\n.* of frame 'i'"):
        OrbitTruth(r0_i="7070 km")
    system = System("list", duration=1)
    system.add(OrbitTruth(r0_i="[7070, 0, 0] km", v0_i="[0, 0, 7.5] km/s"), "orbit")
    system.disperse(Dispersion("start", ("orbit.r0_i",), ["7070 km", "7080 km"], "list"))
    with pytest.raises(SystemCheckError, match="values of dispersion 'start' is one number"):
        simulate(system)
    system.dispersions.clear()
    system.disperse(Dispersion("start", ("orbit.r0_i",), "1 km"))  # a sigma per axis is one
    flown = simulate(system, members=9).dataset["parameter:orbit.r0_i"].values
    assert np.ptp(flown, axis=0).min() > 100.0


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


class Flight(Component):
    """A position on the x axis, and for each member and step the velocities it is given."""

    r_e = Output((3,), unit="m", frame="e")
    v_e = Output((3,), unit="m/s", frame="e")
    velocities: np.ndarray  # (members, steps, 3)

    def _initialize_impl(self):
        self.r_e = R0
        self.v_e = self.velocities[:, 0]

    def _step_impl(self, t, dt):
        self.v_e = self.velocities[:, min(self.step_index, self.velocities.shape[1] - 1)]


def attitudes(velocities, **options):
    """Attitude of each member, which fly along their velocities, one a second."""
    system = System("flight")
    flight = system.add(Flight(rate=Rate("1")), "flight")
    flight.velocities = np.array(velocities, float)
    attitude = system.add(LvlhAttitude(rate=Rate("1"), **options), "attitude")
    system.connect(flight["r_e"], attitude["r_e"])
    system.connect(flight["v_e"], attitude["v_e"])
    system.record("q", [attitude["q_be"], attitude["delta_theta_b"]], period="1 s")
    return simulate(system, members=len(velocities), duration="3")


EAST, NORTH, UP = [0.0, 7e3, 0.0], [0.0, 0.0, 7e3], [7e3, 0.0, 0.0]
LEVEL = "level axes are undefined: the velocity is zero or vertical"
HALF = "it turned by half a turn in a step: its sign and rate are undefined"


@pytest.mark.parametrize(
    ("second", "reason"),
    [
        ([0.0, 0.0, 0.0], LEVEL),
        (UP, LEVEL),
        ([-7e3, 0.0, 0.0], LEVEL),
        ([7e3, 1e-9, 0.0], LEVEL),
        ([0.0, -7e3, 0.0], HALF),
        ([0.0, -7e3, 1e-9], HALF),
    ],
)
def test_an_attitude_that_is_undefined_fails_its_member_alone(second, reason):
    result = attitudes([[EAST, EAST, second, EAST], [EAST, NORTH, NORTH, EAST]])
    (failure,) = result.excluded
    assert (failure["member"], failure["component"], failure["t_s"]) == (0, "attitude", 2.0)
    assert failure["reason"] == reason
    q = result.dataset["attitude.q_be"].to_numpy()
    assert np.isnan(q[2:, 0]).all()
    np.testing.assert_allclose(np.linalg.norm(q[:, 1], axis=-1), 1.0, rtol=1e-14)


def test_an_attitude_that_is_undefined_at_the_start_says_so():
    result = attitudes([[UP, EAST], [EAST, EAST]])
    (failure,) = result.excluded
    assert (failure["member"], failure["t_s"], failure["reason"]) == (0, 0.0, LEVEL)


def test_inertial_level_axes_follow_the_inertial_velocity():
    """Hanging above a place of the Earth has no Earth-fixed velocity, but an inertial one."""
    rest, against = [0.0] * 3, [0.0, -EARTH.rotation_rate * R0[0], 0.0]
    assert not attitudes([[rest, rest, rest]], velocity="inertial").excluded
    with pytest.raises(RunError, match=LEVEL):
        attitudes([[rest, rest, against]], velocity="inertial")


def test_a_turn_just_short_of_half_is_told():
    """179.9 deg to the left, about the axis down: -179.9 deg about z, less the Earth's turn."""
    angle = np.radians(179.9)
    turned = [0.0, 7e3 * np.cos(angle), 7e3 * np.sin(angle)]
    found = attitudes([[EAST, turned]], rotation_rate=0.0).dataset["attitude.delta_theta_b"]
    np.testing.assert_allclose(found.to_numpy()[1, 0], [0.0, 0.0, -angle], atol=1e-12)
