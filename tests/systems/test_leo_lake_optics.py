"""A lake through a lens and by other laws of attitude: camera and filter agree, or it is seen."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import terrafix as tf
from terrafix.cosim.basics.errors import SystemCheckError, TerrafixError
from terrafix.models.images.polygons import moment_noise, moments
from terrafix.models.sensors.camera import CAMERA, Seen

LAKE = Path(__file__).parents[2] / "examples" / "leo_lake.toml"
TEN_HZ = [
    (f"{n}.period", "0.1 s")
    for n in ("orbit", "camera", "moments", "predict", "correct", "evaluation")
]
MEMBERS = 15
BOUNDS = chi2.ppf([0.0005, 0.9995], 3 * MEMBERS) / MEMBERS


def read(outline, *settings, case="T1", file=LAKE):
    return tf.read_system(file, [("lakes.file", str(outline)), ("case", case), *TEN_HZ, *settings])


def nees(result):
    return result.dataset["evaluation.nees"].values[-1].mean()


def both(name, value):
    return [(f"{part}.{name}", value) for part in ("camera", "correct")]


LENS = [("distortion", "brown"), ("lens", "[-0.2, 0, 0, 0.002, -0.001]")]
"""Who does not know it is 0.66 km off after a second."""


@pytest.mark.parametrize(
    "settings",
    [
        [pair for one in LENS for pair in both(*one)],
        pytest.param(both("pointing", "geodetic"), marks=pytest.mark.campaign),
        both("mounting", "[2, -1, 30] deg"),
    ],
)
def test_a_filter_that_knows_its_camera_is_consistent(outline, settings):
    low, high = BOUNDS
    result = tf.simulate(read(outline, *settings), members=MEMBERS)
    assert len(result.evaluation["fixes"]) > 20
    assert low < nees(result) < high
    assert np.median(np.linalg.norm(result.dataset["evaluation.position_error"][-1], axis=1)) < 150


def test_a_filter_that_knows_no_lens_is_off_by_what_least_squares_foretell(outline):
    """dr = (P0^-1 + sum H' R^-1 H)^-1 sum H' R^-1 dm over ten frames, the velocity known: 0.66 km.

    The mean error of 15 members is that within its own sigma (chi-squared of three).
    """
    lens = [(f"camera.{name}", value) for name, value in LENS]
    system = read(outline, *lens, ("last_known.velocity_sigma", "0.001 m/s"))
    orbit, camera = system.find("orbit"), system.find("camera")
    system.record("truth", [orbit["r_i"], orbit["v_i"]], period="0.1")
    result = tf.simulate(system, members=MEMBERS, duration="1")
    r, v = (result.dataset[f"orbit.{n}"].values[1:, 0] for n in ("r_i", "v_i"))
    sight = tf.Simulation(system, members=1)
    sight.initialize()
    points, middle = np.asarray(system.find("lakes").vertices), system.find("lakes").center[0]
    sight.master.terminate()
    k = len(r)
    told = {n: np.tile(np.reshape(camera.setting(n), (1, -1)), (k, 1)) for n in CAMERA}
    told["t"] = 0.1 * np.arange(1, k + 1)[:, None]
    bent = Seen({"r": r, "v": v}, told, points, middle).pixels
    plain = Seen({"r": r, "v": v}, told | {"lens": np.zeros((k, 5))}, points, middle)
    m, J = moments(plain.pixels)
    H = plain.derivative(J)[..., :3]
    weight = np.linalg.inv(moment_noise(bent, np.full(k, 0.25))[0])
    information = np.eye(3) / 15e3**2 + (H.transpose(0, 2, 1) @ weight @ H).sum(axis=0)
    pull = np.einsum("kmi,kmn,kn->i", H, weight, moments(bent)[0] - m)
    foretold = np.linalg.solve(information, pull)
    error = result.dataset["evaluation.position_error"].values[-1]
    assert np.linalg.norm(foretold) > 500.0
    off = error.mean(axis=0) - foretold
    squared = off @ np.linalg.solve(np.linalg.inv(information) / MEMBERS, off)
    assert squared < chi2.ppf(0.9995, 3)


def with_attitude(outline, *settings, considered=""):
    """The system with a body that flies level, and a star tracker that the filter reads."""
    text = LAKE.read_text()
    for kind in ("orbit_predict", "lake_correct", "orbit_evaluation") if considered else ():
        text = text.replace(f'type = "{kind}"', f'type = "{kind}_considered"')
    wires = ["orbit.r_e -> level.r_e", "orbit.v_e -> level.v_e", "level.q_be -> camera.q_be"]
    wires += ["level.q_be -> tracker.q_be_true", "tracker.q_be -> correct.q_be"]
    if considered:
        wires.append("camera.attitude -> evaluation.attitude")
        text = text.replace(
            '"orbit.v_i -> evaluation.v",',
            '"orbit.v_i -> evaluation.v",\n    "still.scale -> evaluation.scale",',
        )
        text += '\n[component.still]\ntype = "still:Still"\n'
        outline.with_name("still.py").write_text(STILL)
    body, _, tail = text.partition("connect = [")
    text = body + "connect = [\n" + "".join(f'    "{w}",\n' for w in wires) + tail
    text += (
        '\n[component.level]\ntype = "lvlh_attitude"\nvelocity = "inertial"\nperiod = "0.1 s"\n'
        '[component.tracker]\ntype = "attitude_sensor"\nperiod = "0.1 s"\n'
    )
    file = outline.with_name(f"attitude{considered}.toml")
    file.write_text(text)
    return read(outline, *both("pointing", "given"), *settings, file=file, case="T2")


STILL = """
import terrafix as tf


class Still(tf.Component):
    default_rate = tf.Rate("0.1")
    scale = tf.Output((1,))

    def _initialize_impl(self):
        self.scale = 0.0

    def _step_impl(self, t, dt):
        self.scale = 0.0
"""


def test_a_filter_that_reads_the_attitude_is_consistent(outline):
    low, high = BOUNDS
    result = tf.simulate(with_attitude(outline), members=MEMBERS)
    assert low < nees(result) < high


@pytest.mark.campaign
def test_a_star_tracker_that_is_off_is_honest_once_it_is_considered(outline):
    """0.02 deg at 550 km are 190 m per axis."""
    low, high = BOUNDS
    off = ("tracker.bias_sigma", "0.02 deg")
    assert nees(tf.simulate(with_attitude(outline, off), members=MEMBERS)) > 100 * high
    told = ("predict.attitude_sigma0", "0.02 deg")
    honest = with_attitude(outline, off, told, considered="_considered")
    assert low < nees(tf.simulate(honest, members=MEMBERS)) < high


def test_a_lens_where_nothing_distorts_is_refused(outline):
    with pytest.raises(
        SystemCheckError, match=r"'correct' does not take 'lens' with .*distortion = 'none'"
    ):
        read(outline, ("correct.lens", "[0.1, 0, 0, 0, 0]"))


def test_an_attitude_is_read_where_it_is_given_and_there_alone(outline):
    with pytest.raises(
        TerrafixError, match=r"nothing is connected to 'correct\.q_be'\n  connect an"
    ):
        tf.simulate(read(outline, ("correct.pointing", "given")), members=1)
    system = with_attitude(outline)
    system.find("camera").pointing = "geodetic"
    with pytest.raises(TerrafixError, match=r"'camera\.q_be' is connected, and camera\.pointing ="):
        tf.simulate(system, members=1)


def test_a_lens_that_folds_is_refused(outline):
    """k1 = -20 at a tangent of |(320, 256)| / 1828.81 = 0.224: 1 - 60 * 0.05 < 0."""
    lens = [("camera.distortion", "brown"), ("camera.lens", "[-20, 0, 0, 0, 0]")]
    with pytest.raises(
        TerrafixError, match=r"folds the scene back into the frame within 12\.6 deg"
    ):
        tf.simulate(read(outline, *lens), members=1)
