"""Sensors, fixes and what the filter is told at the start, flown as components in small systems."""

import numpy as np
import pytest
from scipy.stats import chi2

from terrafix.components.fields import FIX, KNOWN_STATE, MEASURED
from terrafix.components.filters.known_state import LastKnownState
from terrafix.components.filters.mekf import MekfCorrect, MekfPredict
from terrafix.components.sensors.imu import Imu
from terrafix.components.sensors.sar import AntennaMount, SyntheticSarFix
from terrafix.components.truth.attitude import AttitudeSensor, LvlhAttitude
from terrafix.components.truth.orbit import OrbitTruth
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import MessageOutput, Output
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System
from terrafix.models.filters.measurement import REASONS
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.quaternion import inverse_array, product_array, rotation_vector_array

R0_I = [-1104646.3356338572, -6096830.387203118, 3395727.381187697]  # [m]
V0_I = [-560.0980743545368, 3729.5871618791953, 6497.9362610432145]  # [m/s]
SECOND = Rate("1")
LOOK = np.radians(34.3)
FAR = 5.0  # normal quantile whose two tails hold 6e-7: never crossed by chance in this file


def truth(system: System) -> tuple[OrbitTruth, LvlhAttitude]:
    """Orbit and level attitude, stepped every second."""
    orbit = system.add(OrbitTruth(r0_i=R0_I, v0_i=V0_I, rate=SECOND), "orbit")
    attitude = system.add(LvlhAttitude(rate=SECOND), "attitude")
    for name in ("r_e", "v_e", "delta_v_e"):
        system.connect(orbit[name], attitude[name])
    return orbit, attitude


def fly(system: System, ports, *, members: int, duration: str):
    system.record("all", ports, period="1 s")
    return simulate(system, members=members, duration=duration)


def assert_sigma(samples, sigma, *, mean=0.0):
    """Mean and scatter of normal samples, each within 5 sigma of its own sampling error."""
    n = samples.size
    assert abs(samples.mean() - mean) < FAR * sigma / np.sqrt(n)
    low, high = chi2.ppf([3e-7, 1 - 3e-7], n)
    assert low < np.sum((samples - mean) ** 2) / sigma**2 < high


# ------------------------------------------------------------------------- attitude


def attitude_errors(members, duration, **parameters):
    """Rotation from true to measured attitude, (n_times, n_members, 3) [rad]."""
    system = System("attitude")
    _, attitude = truth(system)
    sensor = system.add(AttitudeSensor(rate=SECOND, **parameters), "sensor")
    system.connect(attitude["q_be"], sensor["q_be_true"])
    found = fly(
        system, [attitude["q_be"], sensor["q_be"]], members=members, duration=duration
    ).dataset
    measured, true = found["sensor.q_be"].to_numpy(), found["attitude.q_be"].to_numpy()
    return rotation_vector_array(product_array(measured, inverse_array(true)))


def test_attitude_noise_is_white_and_of_its_sigma():
    sigma = 1e-4
    error = attitude_errors(100, "40", noise_sigma=sigma)
    assert_sigma(error, sigma)
    # neighbors in time are independent: their product has mean 0 and sigma sigma^2
    lagged = (error[1:] * error[:-1]) / sigma**2
    assert abs(lagged.mean()) < FAR / np.sqrt(lagged.size)


def test_attitude_bias_is_constant_and_drawn_for_each_member():
    sigma = 1e-3
    error = attitude_errors(1000, "3", bias_sigma=sigma)
    assert_sigma(error[0], sigma)
    # constant: what is left is the rounding of quaternions near one, a few 1e-16
    np.testing.assert_allclose(error - error[:1], 0.0, atol=2e-15)


def test_an_attitude_sensor_without_errors_tells_the_truth():
    np.testing.assert_array_equal(attitude_errors(2, "3"), 0.0)


# ------------------------------------------------------------------------- inertial sensor


class Shaken(Component):
    """Increments that are no zero: a constant specific force and rate."""

    default_rate = SECOND
    force, turn = np.array([0.3, -0.2, 9.8]), np.array([1e-3, -2e-3, 3e-3])
    delta_v_b = Output((3,), unit="m/s", frame="b")
    delta_theta_b = Output((3,), unit="rad", frame="b")

    def _initialize_impl(self):
        self.delta_v_b, self.delta_theta_b = 0.0, 0.0

    def _step_impl(self, t, dt):
        self.delta_v_b, self.delta_theta_b = self.force * dt, self.turn * dt


def shaken_imu(**parameters):
    system = System("imu")
    shaken = system.add(Shaken(), "shaken")
    imu = system.add(Imu(rate=SECOND, **parameters), "imu")
    system.connect(shaken["delta_v_b"], imu["delta_v_b_true"])
    system.connect(shaken["delta_theta_b"], imu["delta_theta_b_true"])
    return system, imu


def increments(members, duration, **parameters):
    system, imu = shaken_imu(**parameters)
    return fly(system, [imu[n] for n in imu.outputs()], members=members, duration=duration).dataset


def test_an_inertial_sensor_without_errors_passes_the_truth():
    found = increments(2, "5")
    np.testing.assert_array_equal(
        found["imu.delta_v_b"][1:], np.broadcast_to(Shaken.force, (5, 2, 3))
    )
    np.testing.assert_array_equal(
        found["imu.delta_theta_b"][1:], np.broadcast_to(Shaken.turn, (5, 2, 3))
    )
    assert not found["imu.delta_v_b"][0].any()


def test_inertial_errors_are_of_their_parameters():
    """Scale factors multiply, biases add, and the white noise is what is left, of its sigma."""
    n, s0, scale = 2e-3, 1e-2, 1e-3
    found = increments(
        400,
        "20",
        velocity_random_walk=n,
        accel_bias_sigma0=s0,
        accel_scale_factor=scale,
        angle_random_walk=n / 10,
        gyro_bias_sigma0=s0 / 10,
        gyro_scale_factor=-scale,
    )
    for what, true, bias, factor in (
        ("imu.delta_v_b", Shaken.force, "imu.accel_bias_b", 1.0),
        ("imu.delta_theta_b", Shaken.turn, "imu.gyro_bias_b", 0.1),
    ):
        drawn = found[bias].to_numpy()
        assert_sigma(drawn[0], factor * s0)
        assert (drawn == drawn[0]).all()
        signed = scale if factor == 1.0 else -scale
        rest = found[what].to_numpy()[1:] - (1.0 + signed) * true - drawn[1:]
        assert_sigma(rest, factor * n)


def test_a_wandering_bias_grows_with_the_square_root_of_time():
    walk, duration = 1e-4, 25
    found = increments(1000, str(duration), accel_bias_walk=walk)
    bias = found["imu.accel_bias_b"].to_numpy()
    assert not bias[0].any()
    assert_sigma(bias[-1], walk * np.sqrt(duration))
    assert_sigma(bias[9], walk * 3.0)


def test_a_gauss_markov_bias_keeps_its_sigma_and_forgets():
    """Variance sigma0^2 at all times, correlation e^(-T / tau): a first-order Markov process.

    (IEEE Std 952-1997, annex B.4.3.) Without a drive it would end at e^-3 of its sigma.
    """
    sigma, tau, n = 1e-3, 10.0, 2000
    found = increments(
        n,
        "30",
        bias="gauss-markov",
        accel_bias_sigma0=sigma,
        accel_bias_time=tau,
        gyro_bias_sigma0=sigma / 10,
        gyro_bias_time=tau / 2,
    )
    for name, own, time in (("accel", sigma, tau), ("gyro", sigma / 10, tau / 2)):
        bias = found[f"imu.{name}_bias_b"].to_numpy()
        assert_sigma(bias[0], own)
        assert_sigma(bias[30], own)
        # innovation of a first-order process: bias - e^(-T / tau) bias before
        decay = np.exp(-4 / time)
        assert_sigma(bias[30] - decay * bias[26], own * np.sqrt(1 - decay**2))


def streams(component):
    return {a.name for a in component._kept[2].noise}


def test_an_inertial_sensor_draws_only_what_its_sigmas_let_through():
    white, drive = {"accel_white", "gyro_white"}, {"accel_bias_noise", "gyro_bias_noise"}
    for parameters, drawn in (
        ({}, set()),
        ({"velocity_random_walk": 1e-3}, {"accel_white"}),
        ({"angle_random_walk": 1e-3, "gyro_bias_walk": 1e-4}, {"gyro_white", "gyro_bias_noise"}),
        ({"bias": "gauss-markov", "accel_bias_sigma0": 1e-4}, {"accel_bias_noise"}),
    ):
        system, imu = shaken_imu(**parameters)
        simulate(system, members=2, duration="1")
        assert streams(imu) == drawn
        assert set(imu.model.noise) == white | drive  # what an FMU is made of: all of it


def test_a_sigma_that_is_zero_for_some_members_alone_is_drawn_for_all():
    """A member's numbers are those it has when flown alone, with zero as with another sigma."""
    system, imu = shaken_imu(accel_bias_sigma0=1e-3)
    system.disperse(
        Dispersion("grade", ("imu.velocity_random_walk",), np.array([0.0, 2e-3]), kind="list")
    )
    system.record("all", [imu[n] for n in imu.outputs()], period="1 s")
    both = simulate(system, members=2, duration="4").dataset
    assert "accel_white" in streams(imu)
    for member, drawn in ((0, set()), (1, {"accel_white"})):
        alone = simulate(system, members=[member], duration="4").dataset
        assert streams(imu) & {"accel_white"} == drawn
        for name in ("imu.delta_v_b", "imu.delta_theta_b", "imu.accel_bias_b"):
            np.testing.assert_array_equal(alone[name][:, 0], both[name][:, member])


def test_a_perfect_attitude_sensor_and_a_fixed_antenna_draw_nothing():
    system = System("quiet")
    _, attitude = truth(system)
    sensor = system.add(AttitudeSensor(rate=SECOND), "sensor")
    system.connect(attitude["q_be"], sensor["q_be_true"])
    mount = system.add(AntennaMount(rate=SECOND), "mount")
    found = fly(system, [attitude["q_be"], sensor["q_be"]], members=2, duration="2").dataset
    assert streams(sensor) == streams(mount) == set()
    np.testing.assert_array_equal(found["sensor.q_be"], found["attitude.q_be"])


# ------------------------------------------------------------------------- antenna


def mount_angles(**parameters):
    system = System("mount")
    mount = system.add(AntennaMount(rate=SECOND, **parameters), "mount")
    found = fly(system, [mount["q_mu"]], members=1000, duration="16")
    return rotation_vector_array(found.dataset["mount.q_mu"].to_numpy())


def test_a_misalignment_is_drawn_once_and_walks():
    """The walk adds variance: sigma0^2 at first, sigma0^2 + 16 w^2 after 16 steps of a second."""
    sigma0, walk = 1e-3, 2e-4
    fixed = mount_angles(misalignment_sigma0=sigma0)
    assert_sigma(fixed[0], sigma0)
    np.testing.assert_allclose(fixed - fixed[:1], 0.0, atol=1e-15)  # rounding of normalization
    walking = mount_angles(misalignment_sigma0=sigma0, misalignment_walk=walk)
    np.testing.assert_array_equal(walking[0], fixed[0])
    assert_sigma(walking[16], np.sqrt(sigma0**2 + 16 * walk**2))


# ------------------------------------------------------------------------- synthetic fix


def fixes(members=3, duration="4", look=LOOK, **parameters):
    system = System("fix")
    orbit, attitude = truth(system)
    mount = system.add(AntennaMount(rate=SECOND, misalignment_sigma0=1e-3), "mount")
    parameters = {"range_sigma": 0.0, "speed_sigma": 0.0} | parameters
    sar = system.add(SyntheticSarFix(rate=SECOND, look=look, **parameters), "sar")
    for name in ("r_e", "v_e"):
        system.connect(orbit[name], sar[name])
    system.connect(attitude["q_be"], sar["q_be"])
    system.connect(mount["q_mu"], sar["q_mu"])
    ports = [orbit["r_e"], orbit["v_e"], sar["fix"]]
    return fly(system, ports, members=members, duration=duration).dataset


def above_ellipsoid(r_e):
    """Height of a point over the surface [m], by the level of the quadric over its gradient."""
    axes = EARTH.radius * np.array([1.0, 1.0, 1.0 - EARTH.flattening])
    level = np.sum((r_e / axes) ** 2, axis=-1) - 1.0
    return level / np.linalg.norm(2.0 * r_e / axes**2, axis=-1)


def test_a_fix_lies_on_the_ellipsoid():
    """1e-6 m: coordinates of 7e6 m are rounded to 1e-9 m, roots of the quadric a little worse."""
    found = fixes(geolocation_sigma=1e-12)
    pixel = found["sar.fix.r_f_e"].to_numpy()
    assert np.abs(above_ellipsoid(pixel)).max() < 1e-6
    line = np.linalg.norm(pixel - found["orbit.r_e"].to_numpy(), axis=-1)
    np.testing.assert_allclose(found["sar.fix.y"][..., 2], line, rtol=1e-14)
    speed = np.linalg.norm(found["orbit.v_e"].to_numpy(), axis=-1)
    np.testing.assert_allclose(found["sar.fix.y"][..., 3], speed, rtol=1e-14)
    assert not found["sar.fix.y"][..., :2].any()


def test_errors_of_a_fix_are_of_their_parameters():
    """And the covariances in the fix say so; a bias of geolocation they do not mention."""
    sigma, bias = np.array([8.0, 5.0, 2.0]), np.array([1.0, -2.0, 3.0])
    common = {"members": 300, "duration": "9"}
    clean = fixes(**common, geolocation_sigma=1e-12)
    noisy = fixes(
        **common, range_sigma=1.0, speed_sigma=0.5, geolocation_sigma=sigma, geolocation_bias=bias
    )
    error = (noisy["sar.fix.r_f_e"] - clean["sar.fix.r_f_e"]).to_numpy()
    for axis in range(3):
        assert_sigma(error[..., axis], sigma[axis], mean=bias[axis])
    y = (noisy["sar.fix.y"] - clean["sar.fix.y"]).to_numpy()
    assert_sigma(y[..., 2], 1.0)
    assert_sigma(y[..., 3], 0.5)
    np.testing.assert_array_equal(noisy["sar.fix.R"][0, 0], np.diag([0.0, 0.0, 1.0, 0.25]))
    np.testing.assert_array_equal(noisy["sar.fix.D"][0, 0], np.diag(sigma**2))


def test_no_fix_appears_where_the_antenna_looks_past_the_earth():
    """The Earth's edge is 64 degrees off nadir from 700 km: 80 misses it, and nobody fails."""
    found = fixes(look=np.radians(80.0))
    assert np.isnan(found["sar.fix.y"]).all()
    assert np.isfinite(found["orbit.r_e"]).all()


# ------------------------------------------------------------------------- start of the filter


def test_the_last_known_state_has_the_errors_it_admits():
    system = System("start")
    orbit, _ = truth(system)
    known = system.add(LastKnownState(position_sigma=[100.0, 200.0, 300.0]), "known")
    for name in ("r_e", "v_e"):
        system.connect(orbit[name], known[name])
    ports = [orbit["r_e"], orbit["v_e"], known["state"]]
    found = fly(system, ports, members=1000, duration="2").dataset
    sigma = np.array([100.0, 200.0, 300.0, 10.0, 10.0, 10.0])
    P = found["known.state.P"][0].to_numpy()
    np.testing.assert_array_equal(P, np.broadcast_to(np.diag(sigma**2), (1000, 6, 6)))
    error = np.concatenate(
        [found[f"known.state.{n}"][0] - found[f"orbit.{n}"][0] for n in ("r_e", "v_e")], axis=1
    )
    for axis in range(6):
        assert_sigma(error[:, axis], sigma[axis])
    correlation = np.corrcoef(error.T) - np.eye(6)
    assert np.abs(correlation).max() < FAR / np.sqrt(1000)
    # told once, at the start
    assert np.isnan(found["known.state.r_e"][1:]).all()


class Told(Component):
    """A state known at the start, to the members with even numbers alone."""

    default_rate = SECOND
    state = MessageOutput(fields=KNOWN_STATE)
    delta_v_b = Output((3,), unit="m/s", frame="b")
    q_be = Output((4,), unit="1", frame="b")

    def _initialize_impl(self):
        self.delta_v_b, self.q_be = 0.0, [0.0, 0.0, 0.0, 1.0]
        self.state.publish(
            0.0,
            valid=self.environment.members % 2 == 0,
            r_e=np.tile(R0_I, (self.n_members, 1)),
            v_e=np.tile(V0_I, (self.n_members, 1)),
            P=np.tile(np.eye(6), (self.n_members, 1, 1)),
        )

    def _step_impl(self, t, dt):
        self.delta_v_b = 0.0


def predicting(system: System) -> tuple[Told, MekfPredict]:
    told = system.add(Told(), "told")
    predict = system.add(MekfPredict(rate=SECOND, misalignment_sigma0=1e-3), "predict")
    system.connect(told["state"], predict["start"])
    system.connect(told["delta_v_b"], predict["delta_v_b"])
    system.connect(told["q_be"], predict["q_be"])
    return told, predict


class Fixes(Component):
    """A fix with some of its elements, at each step."""

    default_rate = SECOND
    fix = MessageOutput(fields=FIX)

    def __init__(self, present, **options):
        super().__init__(**options)
        self.present = np.array(present, dtype=float)

    def _step_impl(self, t, dt):
        n = self.n_members
        self.fix.publish(
            t,
            y=np.tile([0.0, 0.0, 7.0e5, 7500.0], (n, 1)),
            r_f_e=np.tile(0.9 * np.array(R0_I), (n, 1)),
            R=np.tile(np.diag([1e-6, 1e-6, 1.0, 0.3]), (n, 1, 1)),
            D=np.tile(np.eye(3), (n, 1, 1)),
            present=np.tile(self.present, (n, 1)),
        )


def corrected(present, members=1):
    """Fly a filter on fixes with the elements that are `present`."""
    system = System("filter")
    told, predict = predicting(system)
    sar = system.add(Fixes(present), "sar")
    correct = system.add(MekfCorrect(rate=Rate("1", offset="1"), look=LOOK), "correct")
    system.connect(predict["prior"], correct["prior"])
    system.connect(sar["fix"], correct["fix"])
    system.connect(told["q_be"], correct["q_be"])
    system.connect(correct["posterior"], predict["posterior"])
    ports = [predict["prior"], correct["estimate"], correct["innovation"]]
    return fly(system, ports, members=members, duration="2")


def test_a_filter_that_is_told_no_state_fails_and_the_others_fly():
    result = corrected([0, 0, 0, 1], members=4)
    assert [(e["member"], e["component"], e["t_s"], e["reason"]) for e in result.excluded] == [
        (1, "predict", 0.0, "no 'start' was received at t = 0"),
        (3, "predict", 0.0, "no 'start' was received at t = 0"),
    ]
    prior = result.dataset["predict.prior.r_e"]
    assert np.isfinite(prior.sel(member=[0, 2])).all()
    assert np.isnan(prior.sel(member=[1, 3])).all()


@pytest.mark.parametrize("present", [[0, 0, 0, 1], [0, 0, 1, 1], [1, 1, 0, 0], [1, 1, 1, 1]])
def test_a_fix_with_absent_elements_corrects_by_the_others(present):
    found = corrected(present).dataset.isel(time=1, member=0)
    assert found["correct.innovation.dof"] == sum(present)
    absent = np.array(present) == 0
    assert (found["correct.innovation.residual"].to_numpy()[absent] == 0.0).all()
    assert (found["correct.innovation.sigma"].to_numpy()[absent] == 1.0).all()
    assert found["correct.innovation.accepted"] == 1.0
    prior = np.trace(found["predict.prior.P"].to_numpy()[3:6, 3:6])
    assert np.trace(found["correct.estimate.P"].to_numpy()[3:6, 3:6]) <= prior
    assert len(MEASURED) == len(present)


def test_a_fix_without_any_element_corrects_nothing():
    found = corrected([0, 0, 0, 0]).dataset.isel(time=1, member=0)
    assert REASONS[int(found["correct.innovation.reason"])] == "nothing measured"
    assert found["correct.innovation.accepted"] == 0.0
    for name in ("r_e", "v_e", "q_mu", "P"):
        np.testing.assert_array_equal(
            found[f"correct.estimate.{name}"], found[f"predict.prior.{name}"]
        )
