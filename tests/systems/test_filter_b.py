"""Filter of system B, aircraft SAR: 18 error states and a clone of the aperture's center.

Real: the error state (position, velocity, attitude, biases of accelerometers, gyros, altimeter,
range and cross-range; position and velocity at the aperture's center), strapdown mechanization at
100 Hz in local level axes over a flat Earth, an altimeter at 10 Hz, range and zero-Doppler
cross-range of a known point at 1 Hz, valid half a second ago. Stub: a flat turn in closed form in
the place of flight, one point in the place of images. The truth draws its errors from the sigmas
and densities that the filter is told of: a right filter is then consistent.
"""

import casadi as ca
import numpy as np
import pytest
from scipy.stats import chi2

import terrafix as tf
from terrafix.components.filters.family import FilterCorrect, FilterPredict, fix_fields, value_field
from terrafix.components.judges.filter_evaluation import FilterEvaluation
from terrafix.models.core.model import Model
from terrafix.models.filters.error_state import ErrorState, clone, rotation, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.process import Process
from terrafix.models.geometry.quaternion import (
    from_rotation_vector,
    inverse,
    product,
    rotation_matrix,
)

MEMBERS = 200
SPEED, TURN, HEIGHT, GRAVITY = 70.0, np.deg2rad(1.0), 1000.0, 9.80665  # [m/s], [rad/s], [m]
SWATH = 1200.0  # ground range of the points [m], to the right
LATE = 0.5  # from an aperture's center to its image [s]

# 1-sigma, SI: north, east, down; densities of white noise; correlation times
START = np.array([3.0, 1.0, 3.0, 0.1, 0.1, 0.1, 5e-4, 5e-4, 2e-3])
VRW, ARW = 1e-3, 1.745e-5  # [m/s^1.5], [rad/s^0.5]
BIASES = {  # name: (size, unit, sigma, time)
    "b_a": (3, "m/s^2", 3e-3, 3600.0),
    "b_g": (3, "rad/s", 4.85e-6, 3600.0),
    "b_h": (1, "m", 0.8, 100.0),
    "b_r": (1, "m", 0.3, 100.0),
    "b_c": (1, "m", 0.3, 100.0),
}
ALTIMETER, RADAR = 1.0, 0.5  # white noise [m]

# the attitude takes level to body axes; its error is on the right: in level axes
PRESENT = ErrorState(
    vector("p", unit="m", frame="n"),
    vector("v", unit="m/s", frame="n"),
    rotation("q_bn", side="right"),
    *(vector(name, size, unit=unit) for name, (size, unit, _, _) in BIASES.items()),
)
STATE = ErrorState(*PRESENT, *(clone(block, "aperture") for block in PRESENT.blocks[:2]))


def mechanization(x, given, noise, _):
    """Strapdown: specific force and rate, less bias and white noise, in level axes."""
    C_nb = rotation_matrix(x["q_bn"]).T
    f_b = given["f_b"] - x["b_a"] - noise["accel"]
    w_b = given["w_b"] - x["b_g"] - noise["gyro"]
    return {
        "p": x["v"],
        "v": ca.mtimes(C_nb, f_b) + ca.vertcat(0, 0, GRAVITY),
        "q_bn": ca.mtimes(C_nb, w_b),
    }


PROCESS = Process(
    rates=mechanization,
    noise={"accel": ("accel_psd", 3), "gyro": ("gyro_psd", 3)},
    decays={name: (f"{name}_time", f"{name}_sigma") for name in BIASES},
    inputs={"f_b": 3, "w_b": 3},
)
HEIGHTS = Observation(lambda x, _: x["b_h"] - x["p"][2], {"height": "m"})


def range_and_cross_range(p, v, p_t):
    """Slant range, and how far ahead of zero Doppler, of a point (3,): (2, 1) [m]."""
    los = p_t - p
    return ca.vertcat(ca.norm_2(los), ca.dot(los, v) / ca.norm_2(v))


def radar(at, instant):
    return Observation(
        lambda x, given: (
            range_and_cross_range(x[f"p{at}"], x[f"v{at}"], given["p_t"])
            + ca.vertcat(x["b_r"], x["b_c"])
        ),
        {"range": "m", "cross_range": "m"},
        fields=[vector("p_t", unit="m", frame="n")],
        instant=instant,
    )


LOOKS = radar("_at_aperture", "aperture")


def flight(t, of):
    """Truth in closed form, a flat turn: position, velocity (3,), heading; of numpy or casadi."""
    psi = TURN * t
    s, c = of.sin(psi), of.cos(psi)
    return (SPEED / TURN * s, SPEED / TURN * (1 - c), -HEIGHT), (SPEED * c, SPEED * s, 0.0), psi


class Aircraft(tf.SymbolicComponent):
    """A flat turn, and the IMU aboard."""

    default_rate = tf.Rate(hz=100)
    p, v = tf.Output((3,), unit="m", frame="n"), tf.Output((3,), unit="m/s", frame="n")
    q_bn = tf.Output((4,))
    f_b, w_b = tf.Output((3,), unit="m/s^2"), tf.Output((3,), unit="rad/s")
    b_a, b_g = tf.Output((3,), unit="m/s^2"), tf.Output((3,), unit="rad/s")
    b_h, b_r, b_c = (tf.Output((1,), unit="m") for _ in range(3))

    def build_model(self):
        t, dt = ca.SX.sym("t"), ca.SX.sym("dt")
        p, v, psi = flight(t, ca)
        biases = {name: ca.SX.sym(name, size) for name, (size, *_) in BIASES.items()}
        drive = {name: ca.SX.sym(f"drive_{name}", size) for name, (size, *_) in BIASES.items()}
        n_a, n_g = ca.SX.sym("n_a", 3), ca.SX.sym("n_g", 3)
        following = {}
        for name, (_, _, sigma, tau) in BIASES.items():
            kept = ca.exp(-dt / tau)
            following[name] = kept * biases[name] + sigma * ca.sqrt(1 - kept**2) * drive[name]
        scale = 1 / ca.sqrt(ca.fmax(dt, 1e-9))
        f_b = ca.vertcat(0, SPEED * TURN, -GRAVITY) + biases["b_a"] + VRW * scale * n_a
        w_b = ca.vertcat(0, 0, TURN) + biases["b_g"] + ARW * scale * n_g
        return Model(
            "aircraft",
            states=biases,
            noise={**{f"drive_{k}": s for k, s in drive.items()}, "n_a": n_a, "n_g": n_g},
            initial={name: b[2] * drive[name] for name, b in BIASES.items()},
            next=following,
            outputs={
                "p": ca.vertcat(*p),
                "v": ca.vertcat(*v),
                "q_bn": from_rotation_vector(ca.vertcat(0, 0, psi)),
                "f_b": f_b,
                "w_b": w_b,
                **biases,
            },
            step=dt,
            time=t,
        )


class LastKnown(tf.SymbolicComponent):
    """Position, velocity and attitude as known at t = 0."""

    default_rate = tf.Rate(times=["0"])
    p, v = tf.Input((3,), unit="m", frame="n"), tf.Input((3,), unit="m/s", frame="n")
    q_bn = tf.Input((4,))
    start = tf.MessageOutput(
        fields={b.name: value_field(b) for b in PRESENT.blocks[:3]} | {"P": tf.Field((9, 9))}
    )

    def build_model(self):
        p, v, q, error = (ca.SX.sym(n, k) for n, k in (("p", 3), ("v", 3), ("q", 4), ("e", 9)))
        e = START * error
        return Model(
            "last_known",
            inputs={"p": p, "v": v, "q_bn": q},
            noise={"error": error},
            outputs={
                "start.p": p - e[:3],
                "start.v": v - e[3:6],
                "start.q_bn": product(q, inverse(from_rotation_vector(e[6:]))),
                "start.P": ca.diag(START**2),
                "start.valid": 1,
            },
        )


class Altimeter(tf.SymbolicComponent):
    """Height over a flat ground."""

    default_rate = tf.Rate(hz=10, offset="0.1")
    p, b_h = tf.Input((3,), unit="m", frame="n"), tf.Input((1,), unit="m")
    fix = tf.MessageOutput(fields=fix_fields(HEIGHTS))

    def build_model(self):
        p, b_h, noise = ca.SX.sym("p", 3), ca.SX.sym("b_h"), ca.SX.sym("noise")
        return Model(
            "altimeter",
            inputs={"p": p, "b_h": b_h},
            noise={"noise": noise},
            outputs={
                "fix.y": b_h - p[2] + ALTIMETER * noise,
                "fix.R": ALTIMETER**2,
                "fix.present": 1,
                "fix.valid": 1,
            },
        )


class Radar(tf.Component):
    """Range and cross-range of a point that was about abeam half a second ago."""

    default_rate = tf.Rate("1", offset="1")
    b_r, b_c = tf.Input((1,), unit="m"), tf.Input((1,), unit="m")
    said = tf.Parameter([1.0, 1.0], shape=(2,), doc="sigma that it reports, by the true one")
    age = tf.Parameter(LATE, unit="s", doc="that it reports")
    fix = tf.MessageOutput(fields=fix_fields(LOOKS))

    def _step_impl(self, t, dt):
        p, v, psi = (np.array(x) for x in flight(t - LATE, np))
        right = np.array([-np.sin(psi), np.cos(psi), 0.0])
        ahead = 100.0 * self.normals("place", 1)
        p_t = p * [1, 1, 0] + SWATH * right + ahead * v / SPEED
        los = p_t - p
        y = np.stack([np.linalg.norm(los, axis=1), los @ v / SPEED], axis=1)
        y += np.concatenate([self.b_r, self.b_c], axis=1) + RADAR * self.normals("noise", 2)
        R = (RADAR * self.said)[:, :, None] ** 2 * np.eye(2)
        self.fix.publish(t - self.age, y=y, R=R, p_t=p_t, present=1.0)


class Mark(tf.Component):
    """Says when an aperture has its center."""

    default_rate = tf.Rate("1", offset="0.5")
    aperture = tf.MessageOutput(fields={"index": tf.Field(())})

    def _step_impl(self, t, dt):
        self.aperture.publish(t, index=0.0)


def filter_of(state, looks):
    """The filter's three components and its evaluation, for an error state and what is seen."""

    class Predict(FilterPredict):
        """Dead reckoning by IMU."""

        default_rate = tf.Rate(hz=100)
        error_state, process, told = state, PROCESS, ("p", "v", "q_bn")
        sigmas = {name: f"{name}_sigma" for name in BIASES}  # noqa: RUF012
        accel_psd = tf.Parameter(VRW**2, unit="m^2/s^3")
        gyro_psd = tf.Parameter(ARW**2, unit="rad^2/s")
        f_b, w_b = tf.Input((3,), unit="m/s^2"), tf.Input((3,), unit="rad/s")
        b_a_sigma, b_a_time = bias("b_a")
        b_g_sigma, b_g_time = bias("b_g")
        b_h_sigma, b_h_time = bias("b_h")
        b_r_sigma, b_r_time = bias("b_r")
        b_c_sigma, b_c_time = bias("b_c")

    class CorrectHeight(FilterCorrect):
        """By the altimeter."""

        default_rate = tf.Rate(hz=10, offset="0.1")
        error_state, observation = state, HEIGHTS

    class CorrectLook(FilterCorrect):
        """By range and cross-range."""

        default_rate = tf.Rate(hz=10, offset="0.1")
        error_state, observation = state, looks

    class Judge(FilterEvaluation):
        """All 18 errors of now."""

        default_rate = tf.Rate("1")
        error_state, observation = state, looks

    return Predict(), CorrectHeight(), CorrectLook(), Judge()


def bias(name):
    """Sigma and correlation time of a bias, as the truth has them."""
    _, unit, sigma, time = BIASES[name]
    return tf.Parameter(sigma, unit=unit), tf.Parameter(time, unit="s")


def aircraft(*, cloned=True, duration="25", seed=1, **radar_settings):
    with tf.System("aircraft", duration=duration, seed=seed) as system:
        truth, known = system.add(Aircraft(), "truth"), system.add(LastKnown(), "known")
        altimeter = system.add(Altimeter(), "altimeter")
        sar = system.add(Radar(**radar_settings), "radar")
        parts = filter_of(STATE, LOOKS) if cloned else filter_of(PRESENT, radar("", ""))
        names = ("predict", "height", "look", "judge")
        predict, height, look, judge = map(system.add, parts, names)
        for name in ("p", "v", "q_bn"):
            system.connect(truth[name], known[name])
        system.connect(known["start"], predict["start"])
        for name in ("f_b", "w_b"):
            system.connect(truth[name], predict[name])
        for name in ("p", "b_h"):
            system.connect(truth[name], altimeter[name])
        for name in ("b_r", "b_c"):
            system.connect(truth[name], sar[name])
        if cloned:
            system.connect(system.add(Mark(), "mark")["aperture"], predict["aperture"])
        system.connect(altimeter["fix"], height["fix"])
        system.connect(sar["fix"], look["fix"])
        system.connect(predict["prior"], height["prior"])
        system.connect(height["estimate"], look["prior"])
        system.connect(height["posterior"], look["earlier"])
        system.connect(look["posterior"], predict["posterior"])
        system.connect(look["estimate"], judge["estimate"])
        system.connect(look["innovation"], judge["innovation"])
        for block in PRESENT:
            system.connect(truth[block.name], judge[block.name])
        system.record("innovations", [height["innovation"], look["innovation"]])
    return system


def nees(data):
    """Mean over members, each second."""
    return data["judge.nees"].values.mean(axis=1)


def nis(data, name):
    """Mean over all fixes of all members, and their number."""
    values = data[f"{name}.innovation.nis"].values
    return np.nanmean(values), np.isfinite(values).sum()


def interval(dof, n):
    """Where the mean of n independent chi-square values lies in 99.9 % of all cases."""
    return chi2.ppf([0.0005, 0.9995], dof * n) / n


def test_errors_and_innovations_are_of_the_size_that_the_filter_says():
    """NEES of all 18 errors at each of some epochs; NIS of both corrections of the chain.

    Each mean is in its interval of 99.9 %. Epochs are not pooled, as their errors are correlated
    (biases are hardly observed); innovations are white, hence all count.
    """
    data = tf.simulate(aircraft(), members=MEMBERS).dataset
    low, high = interval(18, MEMBERS)
    at = nees(data)[[5, 10, 15, 20, 25]]
    assert ((low < at) & (at < high)).all(), at
    for name, dof, fixes in (("height", 1, 250), ("look", 2, 25)):
        mean, n = nis(data, name)
        assert n == fixes * MEMBERS  # none was refused
        low, high = interval(dof, n)
        assert low < mean < high, name


@pytest.mark.parametrize("element", [0, 1])
def test_a_radar_that_claims_half_its_noise_is_found_out(element):
    """R of range or cross-range a quarter of the truth: outside the same intervals."""
    said = [1.0, 1.0]
    said[element] = 0.5
    data = tf.simulate(aircraft(said=said, duration="15"), members=MEMBERS).dataset
    assert nees(data)[-1] > interval(18, MEMBERS)[1]
    assert nis(data, "look")[0] > interval(2, 15 * MEMBERS)[1]


def test_a_filter_without_a_clone_is_found_out():
    """A fix of half a second ago taken as if of now: 35 m of flight are no noise."""
    data = tf.simulate(aircraft(cloned=False, age="0 s", duration="5"), members=MEMBERS).dataset
    assert nees(data)[-1] > interval(18, MEMBERS)[1]
    assert nis(data, "look")[0] > interval(2, 5 * MEMBERS)[1]
