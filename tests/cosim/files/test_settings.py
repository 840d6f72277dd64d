"""A setting that would change nothing is refused, however it is given."""

from math import radians
from pathlib import Path

import pytest

import terrafix as tf

SYSTEM = Path(__file__).parents[3] / "examples" / "spacecraft_sar_open_loop.toml"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"orbit.density": "1e-12 kg/m^3"}, "'density' with gravity = 'j2', drag = false"),
        ({"orbit.gravity": "two-body", "orbit.j2": "1e-3"}, "'j2' with gravity = 'two-body'"),
        ({"imu.gyro_bias_time": "100 s"}, "'gyro_bias_time' with bias = 'walk'"),
    ],
)
def test_a_parameter_that_the_chosen_model_does_not_take_is_refused(settings, said):
    with pytest.raises(tf.SystemCheckError, match=said):
        tf.read_system(SYSTEM, list(settings.items()))


def test_with_the_choice_that_takes_it_the_same_parameter_is_set():
    system = tf.read_system(SYSTEM, [("orbit.drag", "true"), ("orbit.density", "1e-12 kg/m^3")])
    assert system.find("orbit").setting("density") == 1e-12


@pytest.mark.parametrize(
    ("settings", "misalignment_deg", "underweighted"),
    [([], 0.01, 0), ([("case", "TC-2")], 0.01, 0), ([("case", "TC-1")], 0.1, 10)],
)
def test_a_choice_sets_what_stands_under_its_option(settings, misalignment_deg, underweighted):
    """As the paper's test cases have it; TC-2 is the default."""
    system = tf.read_system(SYSTEM, settings)
    for owner in ("antenna", "predict"):
        sigma = system.find(owner).setting("misalignment_sigma0")
        assert sigma == pytest.approx(radians(misalignment_deg), rel=1e-15)
    assert system.find("correct").setting("underweighted_updates") == underweighted


def test_a_dispersion_of_it_is_refused():
    system = tf.read_system(SYSTEM)
    system.disperse(tf.Dispersion("air", ("orbit.density",), "1e-13 kg/m^3"))
    with pytest.raises(tf.SystemCheckError, match=r"'air' feeds 'orbit.density'\n.*drag = false"):
        tf.simulate(system, members=2, duration="1")


def test_in_python_and_in_a_file_it_is_noted():
    """There a choice may be changed later: what is idle now is said by the check."""
    with tf.System("noted", duration="1") as system:
        system.add(tf.components.orbit(r0_i="[7e3, 0, 0] km", v0_i="[0, 7.5, 0] km/s"), "orbit")
    assert not any("density" in note for note in plan_notes(system))
    system.find("orbit").density = "1e-12 kg/m^3"
    assert any("does not take 'density'" in note for note in plan_notes(system))


def plan_notes(system):
    from terrafix.cosim.system.check import check

    return check(system).notes
