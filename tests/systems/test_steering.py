"""A steered antenna: other looks and squints for each image, one schedule that all follow."""

from pathlib import Path

import numpy as np
import pytest

from terrafix.cosim.basics.ensembles import chi_square_interval
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.system import System
from terrafix.models.filters.consistency import normalized_square
from terrafix.models.filters.spacecraft import STATE

SYSTEM = Path(__file__).parents[2] / "examples" / "spacecraft_sar_open_loop.toml"
LOOKS = "[34.3, -34.3, 34.3, -20] deg"
SQUINTS = "[0, 2, -1, 0] deg"
MEMBERS = 60


STEERED = """
[component.steering]
type = "antenna_steering"
period = "8.2 s"
offset = "8.2 s"
"""


def steered_system(folder, **parameters) -> System:
    """The open loop, of which the radar and the filter take the attitude of steered axes."""
    text = SYSTEM.read_text()
    for old, new in (
        ('look = "34.3 deg"', 'look = "0 deg"'),
        ('"attitude.q_be -> sar.q_be"', '"steering.steered_true -> sar.q_be"'),
        ('"ads.q_be -> correct.q_be"', '"steering.steered -> correct.q_be"'),
        (
            "connect = [",
            'connect = ["attitude.q_be -> steering.q_be_true", "ads.q_be -> steering.q_be",',
        ),
        ("# Sensors", STEERED + "".join(f'{k} = "{v}"\n' for k, v in parameters.items())),
    ):
        assert old in text
        text = text.replace(old, new)
    path = folder / "steered.toml"
    path.write_text(text)
    system = read_system(path, [("case", "TC-2")])
    parts = system.nodes
    system.record("points", [parts["sar"]["fix"], parts["antenna"]["q_mu"]], period="8.2 s")
    return system


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    system = steered_system(tmp_path_factory.mktemp("steered"), looks=LOOKS, squints=SQUINTS)
    return simulate(system, members=MEMBERS, seed=3, duration="32.8 s").dataset


def at(data, name):
    """The four fixes: times, members, ..."""
    return data[name].to_numpy()[-4:]


def test_each_image_lies_where_its_look_and_squint_point(flown):
    """Angles off the vertical plane of the track and ahead of broadside, to the misalignment."""
    r, v = at(flown, "orbit.r_e")[:, 0], at(flown, "orbit.v_e")[:, 0]
    line = at(flown, "sar.fix.r_f_e")[:, 0] - r
    line /= np.linalg.norm(line, axis=1)[:, None]
    down = -r / np.linalg.norm(r, axis=1)[:, None]
    right = np.cross(down, v)
    right /= np.linalg.norm(right, axis=1)[:, None]
    ahead = np.cross(right, down)
    look = np.arctan2(np.sum(line * right, axis=1), np.sum(line * down, axis=1))
    squint = np.arcsin(np.sum(line * ahead, axis=1))
    np.testing.assert_allclose(np.degrees(look), [34.3, -34.3, 34.3, -20.0], atol=0.05)
    np.testing.assert_allclose(np.degrees(squint), [0.0, 2.0, -1.0, 0.0], atol=0.05)


def test_the_filter_follows_a_steered_antenna(flown):
    """NEES of the ensemble is inside its interval after each of the fixes."""
    truth = [at(flown, name) for name in ("orbit.r_e", "orbit.v_e", "antenna.q_mu")]
    estimate = [at(flown, f"correct.estimate.{k}") for k in ("r_e", "v_e", "q_mu")]
    P = at(flown, "correct.estimate.P")
    low, high = chi_square_interval(9.0, MEMBERS, 0.999)
    for k in range(4):
        error = STATE.difference_of_arrays(*(x[k] for x in (*estimate, *truth)))
        assert low < normalized_square(error, P[k]).mean() < high
    # looks to both sides see what one side does not: up and across are told apart
    assert (at(flown, "correct.innovation.accepted") == 1).all()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"looks": "[34.3, -34.3] deg"}, "steps 4 times within 32.8 s, but is steered 2 times"),
        ({"looks": LOOKS, "squints": "[1, 2] deg"}, "has 4 looks and 2 squints"),
        ({"looks": "34.3 -34.3"}, "not angles with a unit"),
        ({"looks": "[34.3, -34.3]"}, "not angles with a unit"),
        ({"looks": "[34.3, 134.3] deg"}, "less than 90 deg to a side"),
    ],
)
def test_schedules_that_cannot_be_are_refused(tmp_path, parameters, message):
    with pytest.raises((ConfigurationError, SystemCheckError), match=message):
        simulate(steered_system(tmp_path, **parameters), members=1, duration="32.8 s")
