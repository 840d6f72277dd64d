"""Filter of system D, image and inertial geolocation: 10 states, and pixels of known targets.

Real: the state (position and velocity in inertial axes, pitch and roll as Gauss-Markov processes,
two pixels of bias as random walks), two-body motion under white acceleration at 1 Hz, orbit, pixel
and sigmas of the low orbit of the thesis, targets that are not seen in every frame, nor by both
elements. Stub: a still Earth, targets drawn under the satellite in the place of image matching, a
camera that looks down. The truth draws its errors from the sigmas and densities that the filter is
told of: a right filter is then consistent.
"""

import casadi as ca
import numpy as np
import pytest
from scipy.stats import chi2, norm

import terrafix as tf
from terrafix.components.filters.family import (
    FilterCorrect,
    FilterPredict,
    fix_fields,
    value_field,
)
from terrafix.components.judges.filter_evaluation import FilterEvaluation
from terrafix.models.core.model import Model, rk4
from terrafix.models.filters.error_state import ErrorState, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.process import Process
from terrafix.models.geometry.quaternion import (
    from_matrix,
    from_rotation_vector,
    rotation_matrix,
)

MEMBERS = 200
MU, RADIUS = 3.986004418e14, 6.371e6  # [m^3/s^2], [m]
R0 = np.array([-4732.5e3, 786.2e3, 5067.8e3])  # apogee, 600 km up [m]
V0 = np.array([-298.24e3, 140.82e3, -300.35e3]) / 60  # [m/s]
FOCAL = 6000.0  # 100 m from 600 km [px]

R_SIGMA, V_SIGMA = 500.0, 0.8333  # at t = 0, per axis [m], [m/s]
ACCEL_PSD = 2.3148e-3  # [m^2/s^3]
TILT_SIGMA, TILT_TIME = 5e-4, 600.0  # [rad], [s]
BIAS_SIGMA, BIAS_PSD = 2.0, 1e-3  # [px], [px^2/s]
PIXEL = 0.5  # white noise [px]
SEEN, ELEMENT_SEEN = 0.8, 0.9  # probabilities: a target at all, each element of one that is

STATE = ErrorState(
    vector("r", unit="m", frame="i"),
    vector("v", unit="m/s", frame="i"),
    vector("pitch", 1, unit="rad"),
    vector("roll", 1, unit="rad"),
    vector("bias", 2, unit="px", labels=("u", "v")),
)


def gravity(r):
    return -MU * r / ca.norm_2(r) ** 3


PROCESS = Process(
    rates=lambda x, _, noise, __: {"r": x["v"], "v": gravity(x["r"]) + noise["accel"]},
    noise={"accel": ("accel_psd", 3)},
    decays=dict.fromkeys(("pitch", "roll"), ("tilt_time", "tilt_sigma")),
    walks={"bias": "bias_psd"},
)


def pixel(x, given):
    """Where a target (3,) is in a frame, from its center: (2, 1) [px]."""
    tilt = rotation_matrix(from_rotation_vector(ca.vertcat(x["roll"], x["pitch"], 0)))
    los = ca.mtimes(tilt, ca.mtimes(rotation_matrix(given["q_ci"]), given["r_t"] - x["r"]))
    return FOCAL * los[:2] / los[2] + x["bias"]


PIXELS = Observation(
    pixel,
    {"u": "px", "v": "px"},
    fields=[vector("r_t", unit="m", frame="i"), vector("q_ci", 4)],
)


class Satellite(tf.SymbolicComponent):
    """Two-body motion under white acceleration, and what wanders in the camera."""

    default_rate = tf.Rate("1")
    r, v = tf.Output((3,), unit="m", frame="i"), tf.Output((3,), unit="m/s", frame="i")
    pitch, roll = tf.Output((1,), unit="rad"), tf.Output((1,), unit="rad")
    bias = tf.Output((2,), unit="px")

    def build_model(self):
        sizes = {"r": 3, "v": 3, "pitch": 1, "roll": 1, "bias": 2}
        x = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
        w = {f"w_{name}": ca.SX.sym(f"w_{name}", size) for name, size in sizes.items()}
        dt = ca.SX.sym("dt")
        end = rk4(lambda _, rv: ca.vertcat(rv[3:], gravity(rv[:3])), ca.vertcat(x["r"], x["v"]), dt)
        # the two integrals of white acceleration; the gradient of gravity is 1e-6 of it in a step
        dv = ca.sqrt(ACCEL_PSD * dt) * w["w_v"]
        dr = dt * (dv / 2 + ca.sqrt(ACCEL_PSD * dt / 12) * w["w_r"])
        kept = ca.exp(-dt / TILT_TIME)
        drive = TILT_SIGMA * ca.sqrt(1 - kept**2)
        return Model(
            "satellite",
            states=x,
            noise=w,
            initial={
                "r": ca.DM(R0),
                "v": ca.DM(V0),
                "pitch": TILT_SIGMA * w["w_pitch"],
                "roll": TILT_SIGMA * w["w_roll"],
                "bias": BIAS_SIGMA * w["w_bias"],
            },
            next={
                "r": end[:3] + dr,
                "v": end[3:] + dv,
                "pitch": kept * x["pitch"] + drive * w["w_pitch"],
                "roll": kept * x["roll"] + drive * w["w_roll"],
                "bias": x["bias"] + ca.sqrt(BIAS_PSD * dt) * w["w_bias"],
            },
            outputs=x,
            step=dt,
        )


class LastKnown(tf.SymbolicComponent):
    """Position and velocity as known at t = 0."""

    default_rate = tf.Rate(times=["0"])
    r, v = tf.Input((3,), unit="m", frame="i"), tf.Input((3,), unit="m/s", frame="i")
    start = tf.MessageOutput(
        fields={b.name: value_field(b) for b in STATE.blocks[:2]} | {"P": tf.Field((6, 6))}
    )

    def build_model(self):
        r, v, error = ca.SX.sym("r", 3), ca.SX.sym("v", 3), ca.SX.sym("error", 6)
        return Model(
            "last_known",
            inputs={"r": r, "v": v},
            noise={"error": error},
            outputs={
                "start.r": r - R_SIGMA * error[:3],
                "start.v": v - V_SIGMA * error[3:],
                "start.P": ca.diag([R_SIGMA**2] * 3 + [V_SIGMA**2] * 3),
            },
        )


class Camera(tf.SymbolicComponent):
    """Looks down, and finds one target within 25 km of the point under it: or not."""

    default_rate = tf.Rate("10", offset="10")
    r, v = tf.Input((3,), unit="m", frame="i"), tf.Input((3,), unit="m/s", frame="i")
    pitch, roll = tf.Input((1,), unit="rad"), tf.Input((1,), unit="rad")
    bias = tf.Input((2,), unit="px")
    said = tf.Parameter(1.0, doc="sigma that it reports, by the true one")
    fix = tf.MessageOutput(fields=fix_fields(PIXELS))

    def build_model(self):
        x = {block.name: ca.SX.sym(block.name, block.size) for block in STATE}
        said, noise = ca.SX.sym("said"), ca.SX.sym("noise", 2)
        place, luck, each = ca.SX.sym("place", 2), ca.SX.sym("luck"), ca.SX.sym("each", 2)
        down = -x["r"] / ca.norm_2(x["r"])
        across = ca.cross(down, x["v"])
        across /= ca.norm_2(across)
        ahead = ca.cross(across, down)
        q_ci = from_matrix(ca.horzcat(ahead, across, down).T)
        r_t = -RADIUS * down + 12.5e3 * (ahead * ca.tanh(place[0]) + across * ca.tanh(place[1]))
        seen = luck < norm.ppf(SEEN)
        return Model(
            "camera",
            inputs=x,
            parameters={"said": said},
            noise={"noise": noise, "place": place, "luck": luck, "each": each},
            outputs={
                "fix.y": pixel(x, {"r_t": r_t, "q_ci": q_ci}) + PIXEL * noise,
                "fix.R": (said * PIXEL) ** 2 * ca.SX.eye(2),
                "fix.r_t": r_t,
                "fix.q_ci": q_ci,
                "fix.present": each < norm.ppf(ELEMENT_SEEN),
                "fix.valid": seen,
            },
        )


class Predict(FilterPredict):
    """Where the satellite is between targets, and how its camera wanders."""

    default_rate = tf.Rate("1")
    error_state, process, told = STATE, PROCESS, ("r", "v")
    sigmas = {"pitch": "tilt_sigma", "roll": "tilt_sigma"}  # noqa: RUF012
    accel_psd = tf.Parameter(ACCEL_PSD, unit="m^2/s^3")
    tilt_time = tf.Parameter(TILT_TIME, unit="s")
    tilt_sigma = tf.Parameter(TILT_SIGMA, unit="rad")
    bias_sigma0 = tf.Parameter(BIAS_SIGMA, unit="px")
    bias_psd = tf.Parameter(BIAS_PSD, unit="px^2/s")


class Correct(FilterCorrect):
    """By the pixel of a target."""

    default_rate = tf.Rate("10", offset="10")
    error_state, observation = STATE, PIXELS


class Judge(FilterEvaluation):
    """All 10 errors."""

    default_rate = tf.Rate("10")
    error_state, observation = STATE, PIXELS


def satellite(*, duration="600", seed=1, said=1.0, **settings):
    with tf.System("satellite", duration=duration, seed=seed) as system:
        truth, known = system.add(Satellite(), "truth"), system.add(LastKnown(), "known")
        camera = system.add(Camera(said=said), "camera")
        predict = system.add(Predict(**settings), "predict")
        correct, judge = system.add(Correct(), "correct"), system.add(Judge(), "judge")
        system.connect(known["start"], predict["start"])
        system.connect(camera["fix"], correct["fix"])
        system.connect(predict["prior"], correct["prior"])
        system.connect(correct["posterior"], predict["posterior"])
        system.connect(correct["estimate"], judge["estimate"])
        system.connect(correct["innovation"], judge["innovation"])
        for block in STATE:
            system.connect(truth[block.name], camera[block.name])
            system.connect(truth[block.name], judge[block.name])
        for name in ("r", "v"):
            system.connect(truth[name], known[name])
    return system


def interval(dof, n):
    """Where the mean of n independent chi-square values lies in 99.9 % of all cases."""
    return chi2.ppf([0.0005, 0.9995], dof * n) / n


def nees(data):
    """Mean over members, each ten seconds."""
    return data["judge.nees"].values.mean(axis=1)


def nis(data):
    """Sum over all fixes, by its degrees of freedom; and these."""
    dof = np.nansum(data["judge.nis_dof"].values)
    return np.nansum(data["judge.nis"].values) / dof, dof


def test_errors_and_innovations_are_of_the_size_that_the_filter_says():
    """NEES of all 10 errors at each of some epochs, NIS over all fixes: of one element and of two.

    Each is in its interval of 99.9 %. Epochs are not pooled, as their errors are correlated;
    innovations are white, hence the sum of all NIS has as many degrees of freedom as elements.
    """
    data = tf.simulate(satellite(), members=MEMBERS).dataset
    low, high = interval(10, MEMBERS)
    at = nees(data)[[10, 20, 30, 40, 50, 60]]
    assert ((low < at) & (at < high)).all(), at
    ratio, dof = nis(data)
    low, high = interval(1, dof)
    assert low < ratio < high
    # each frame is one of its kind, independent of all others: 4.5 sigma of a binomial
    frames = 60 * MEMBERS
    for elements, p in ((1, 2 * ELEMENT_SEEN * (1 - ELEMENT_SEEN)), (2, ELEMENT_SEEN**2)):
        count = (data["judge.nis_dof"].values == elements).sum()
        assert count / frames == pytest.approx(SEEN * p, abs=4.5 * np.sqrt(SEEN * p / frames))


@pytest.mark.parametrize(
    ("settings", "seen_by"),
    [
        ({"said": 0.5}, "innovations too"),
        ({"tilt_sigma": TILT_SIGMA / 2}, "innovations too"),
        ({"bias_sigma0": 0.1}, "the truth"),
        ({"accel_psd": ACCEL_PSD / 10}, "the truth"),
    ],
    ids=["pixel noise", "tilt", "bias", "acceleration"],
)
def test_a_filter_that_is_told_too_little_is_found_out(settings, seen_by):
    """Outside the same intervals: its errors always, its innovations where tilt does not hide it.

    A bias of 2 pixels looks like a tilt, of which there are 3 pixels; so does an error of position.
    """
    data = tf.simulate(satellite(**settings), members=MEMBERS).dataset
    assert nees(data)[-1] > interval(10, MEMBERS)[1]
    ratio, dof = nis(data)
    assert seen_by == "the truth" or ratio > interval(1, dof)[1]
