"""What an aperture measures, and its derivative: the rows of the paper, with what it leaves out."""

import casadi as ca
import numpy as np
import pytest

from terrafix.models.core.batch import over_members
from terrafix.models.filters.error_state import ErrorState, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.models import correct_model
from terrafix.models.filters.navigator import (
    DRIFTING,
    NAVIGATOR,
    altimeter_observation,
    navigator_process,
    shift_observation,
)
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.quaternion import rotation_matrix_array
from terrafix.models.motion.strapdown import EARTHS, from_level
from terrafix.models.sensors.aperture import aperture_model

PLACES = NAVIGATOR.places
CENTER = ("r_e_at_aperture", "v_e_at_aperture")


def cross_matrix(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def geometry(earth, squint=0.0):
    """Values at 70 m/s and 1000 m, and a point 1200 m to the right, `squint` [m] ahead."""
    make = over_members(
        lambda a, h, v, rph: tuple(from_level(a, 0.0, h, v, rph, earth)), (), (), (3,), (3,)
    )
    r, v, q = make(0.0, 1000.0, [70.0, 3.0, -1.0], [0.1, 0.05, 0.2])
    ned = np.eye(3) if earth == "flat" else np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0.0]])
    values = {"r_e": r, "v_e": v, "q_be": q}
    values |= dict(zip(CENTER, (r, v), strict=True))
    values |= {b.name: np.full(b.size, 0.1) for b in NAVIGATOR if b.name not in values}
    C_eb = rotation_matrix_array(q).T
    rate = 0.0 if earth == "flat" else EARTH.rotation_rate
    gravity = ned.T @ [0, 0, 9.8]
    coriolis = 2 * rate * np.array([-v[1], v[0], 0.0])
    wanted = np.array([0.3, -0.2, 0.1]) + coriolis - gravity
    return values, {
        "p_t_e": r + ned.T @ [squint, 1200.0, 1000.0],
        "speed": np.array([70.0]),
        "f_b": C_eb.T @ wanted + 0.1,
        "t_center": np.zeros(1),
    }


def derivative(observation, values, given):
    """Of a prediction by the error at zero, (m, n), and the prediction."""
    state = {name: ca.DM(value) for name, value in values.items()}
    error = ca.SX.sym("error", NAVIGATOR.size)
    y = observation.predict(NAVIGATOR.retract(state, error), given)
    function = ca.Function("f", [error], [ca.jacobian(y, error), y])
    H, at = function(ca.DM.zeros(NAVIGATOR.size))
    return H.full(), at.full().ravel()


def columns(H, name):
    return H[:, PLACES[name]]


@pytest.mark.parametrize("squint", [0.0, 300.0])
@pytest.mark.parametrize("earth", EARTHS)
def test_rows_are_those_derived_by_hand(earth, squint):
    """Range -u' on position; cross-range v'/V on position and *all* of -d'/V on velocity.

    Map drift l' on velocity, +(R/2V) u'[f x] on attitude and +(R/2V) u'C on the accelerometers'
    bias: signs of C_true = (I + [theta x]) C, truth minus estimate. The reading's second part
    falls with speed, so that l' is 1 + d'a / 2V^2 times itself; Coriolis adds 0.0016.
    """
    values, given = geometry(earth, squint)
    H, y = derivative(shift_observation(earth), values, given)
    r, v = (values[name] for name in CENTER)
    d = given["p_t_e"] - r
    R, V, u = np.linalg.norm(d), np.linalg.norm(v), d / np.linalg.norm(d)
    assert y[0] == pytest.approx(R + 0.1, rel=1e-12)
    assert y[1] == pytest.approx(-d @ v / 70.0 + 0.1, rel=1e-9)
    assert columns(H, CENTER[0])[:2] == pytest.approx(np.array([-u, v / 70.0]), abs=1e-12)
    assert columns(H, CENTER[1])[:2] == pytest.approx(np.array([0 * d, -d / 70.0]), abs=1e-9)
    for name, row in (("range_bias", [1, 0, 0]), ("cross_range_bias", [0, 1, 0])):
        assert columns(H, name).ravel() == pytest.approx(row)
    C_eb = rotation_matrix_array(values["q_be"]).T
    f = C_eb @ (given["f_b"] - values["accel_bias_b"])
    half = R / (2 * V)
    assert columns(H, "q_be")[2] == pytest.approx(half * u @ cross_matrix(f), rel=1e-9)
    assert columns(H, "accel_bias_b")[2] == pytest.approx(half * u @ C_eb, rel=1e-9)
    along = 1 + (V - y[2]) / V  # d'a = 2V (V - y)
    assert columns(H, CENTER[1])[2] == pytest.approx(along * v / V, abs=2e-3)
    assert not columns(H, "r_e").any()
    assert not columns(H, "v_e").any()


def test_an_acceleration_is_taken_for_a_speed():
    """0.03 m/s^2 along the line of sight is -0.335 m/s at 1562 m and 70 m/s, the notes' number."""
    values, given = geometry("flat")
    values |= {"v_e_at_aperture": np.array([70.0, 0.0, 0.0])}
    observation = shift_observation("flat")
    d = given["p_t_e"] - values["r_e"]
    u = d / np.linalg.norm(d)
    C_be = rotation_matrix_array(values["q_be"])
    pushed = {**given, "f_b": given["f_b"] + C_be @ (0.03 * u)}
    change = derivative(observation, values, pushed)[1] - derivative(observation, values, given)[1]
    assert change == pytest.approx([0.0, 0.0, -0.335], abs=5e-4)


def test_height_is_that_of_the_earth_chosen():
    """1000 m on both; up is the opposite of down, and outward on the equator."""
    for earth, up in (("flat", [0, 0, -1]), ("wgs84", [1, 0, 0])):
        values, _ = geometry(earth)
        H, y = derivative(altimeter_observation(earth), values, {})
        assert y == pytest.approx([1000.1], abs=1e-6)
        assert H[0, PLACES["r_e"]] == pytest.approx(np.array(up), abs=1e-6)
        assert columns(H, "altimeter_bias") == pytest.approx(1.0)


def test_an_earth_that_is_none_is_refused():
    for make in (
        altimeter_observation,
        shift_observation,
        lambda e: navigator_process(DRIFTING, e),
    ):
        with pytest.raises(ValueError, match="earth must be one of"):
            make("round")


def test_a_fix_may_say_in_a_field_when_it_is_valid():
    """What came late is weighed by the field's time; another time is refused."""
    state = ErrorState(vector("x", 1))
    seen = Observation(
        lambda x, _: x["x"], {"x": "1"}, fields=[vector("taken", 1, unit="s")], valid_at="taken"
    )
    model = correct_model("late", state, seen, underweighting=False)
    assert "fix.t" not in model.inputs
    names = list(model.inputs)
    step = model.step_function()

    def reason(taken):
        given = dict.fromkeys(names, 0.0) | {"prior.P": 1.0, "fix.R": 1.0, "fix.fresh": 1.0}
        given |= {"fix.present": 1.0, "fix.taken": taken}
        results = step(*(given[n] for n in names), np.inf, 5.0)
        return float(results[list(model.outputs).index("innovation.reason")])

    assert (reason(5.0), reason(4.5)) == (0.0, 4.0)
    with pytest.raises(ValueError, match="valid at 'when', which is no field"):
        Observation(lambda x, _: x["x"], {"x": "1"}, valid_at="when")


def test_an_aperture_averages_the_force_in_the_axes_of_its_end():
    """A force held in body axes that turn about z by 0.3 rad in an aperture of 8 steps.

    Its mean in the axes of the end is the integral of a rotation: sin(a) / a and (1 - cos(a)) / a.
    """
    model = aperture_model()
    step, dt, length, angle = model.step_function(), 0.125, 1.0, 0.3
    turn, force = np.array([0.0, 0.0, angle / 8]), np.array([1.0, 2.0, -9.8])
    c, s = np.sin(angle) / angle, (1 - np.cos(angle)) / angle
    expected = [c * 1.0 + s * 2.0, c * 2.0 - s * 1.0, -9.8]
    gained, marks = np.zeros(3), []
    for k in range(1, 17):
        f_b, index, mark, gained = step(force * dt, turn, gained, length, dt, k * dt)
        marks.append((float(index), float(mark)))
        if k in (8, 16):  # the ends
            assert f_b.full().ravel() == pytest.approx(expected, rel=1e-12)
    assert [k for k, (_, mark) in enumerate(marks, 1) if mark] == [4, 12]
    assert [index for index, _ in marks] == [0.0] * 8 + [1.0] * 8
