"""A recorded run, smoothed: of the spacecraft in the open loop, and of a tracker of one's own."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import terrafix as tf
from terrafix.components.filters.family import FilterPredict
from terrafix.models.filters.error_state import ErrorState, considered, vector
from terrafix.models.filters.process import Process

OPEN_LOOP = Path(__file__).parents[3] / "examples" / "spacecraft_sar_open_loop.toml"


def spacecraft(*, ports=("error_transition", "transition_since", "prior"), rate="8.2", truth=True):
    system = tf.read_system(OPEN_LOOP)
    old = system.find("predict")
    settings = {name: old.setting(name) for name in ("accel_psd", "misalignment_sigma0")}
    predict = tf.components.mekf_predict_smoothed(rate=tf.Rate(hz=100), **settings)
    system.replace("predict", predict)
    recorded = [predict[name] for name in ports]
    recorded += [system.find("correct")["estimate"]]
    if truth:
        recorded += [system.find("orbit")["r_e"], system.find("orbit")["v_e"]]
        recorded += [system.find("antenna")["q_mu"]]
    system.record("smoother", recorded, rate=tf.Rate(rate))
    return system


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """TC-1 as the example has it, smaller priors, so that the filter is close to linear."""
    path = tmp_path_factory.mktemp("smoothed") / "run.nc"
    system = spacecraft()
    last_known = system.find("last_known")
    last_known.position_sigma, last_known.velocity_sigma = "100 m", "1 m/s"
    system.find("correct").underweighting = 0.0
    return tf.simulate(system, members=100, out=path), path


def test_it_knows_more_than_the_filter_and_as_much_at_the_end(flown):
    result, _ = flown
    found = tf.smooth_run(result).dataset
    assert found.sizes["time"] == 73
    filtered, smoothed = found["filter.sigma"].values, found["smoothed.sigma"].values
    assert (smoothed <= filtered * (1 + 1e-6)).all()
    np.testing.assert_allclose(smoothed[-1], filtered[-1], rtol=1e-12)
    # of the velocity at the start, 1 m/s, ten minutes of fixes leave less than a fifth
    assert (smoothed[0, :, 3:6] < 0.2).all()


def test_its_nees_is_inside_the_bounds(flown):
    """Of nine degrees: the mean of 100 members in the 99.9 % interval at the start, middle, end."""
    found = tf.smooth_run(flown[0]).dataset
    low, high = chi2.ppf([0.0005, 0.9995], 9 * 100) / 100
    for who in ("filter", "smoothed"):
        nees = found[f"{who}.nees"].values.mean(axis=1)
        for epoch in (0, 18, 36, 54, 72):
            assert low < nees[epoch] < high, (who, epoch, nees[epoch])
    # errors as it says: the root mean square over the members at the middle, within five sigma
    ratio = found["smoothed.error"].values[36].std(axis=0) / found["smoothed.sigma"].values[36, 0]
    np.testing.assert_allclose(ratio, 1.0, atol=5 / np.sqrt(200))


def test_the_command_says_the_same_of_the_file(flown, tmp_path):
    result, path = flown
    out = tmp_path / "smoothed.nc"
    ran = subprocess.run(
        [sys.executable, "-m", "terrafix", "smooth", str(path), "--out", str(out), "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    said, known = json.loads(ran.stdout), tf.smooth_run(result).summary()
    assert said["smoothed"] == known["smoothed"]
    assert said["times"] == 73
    assert said["out"] == str(out)
    again = tf.read_result(out)
    np.testing.assert_array_equal(
        again["smoothed.r_e"].values, tf.smooth_run(result).dataset["smoothed.r_e"].values
    )
    text = str(tf.smooth_run(path))
    assert "NEES smoothed mean" in text
    assert "misalignment" not in text


def test_the_filter_is_the_same_with_and_without_its_transition():
    """To the same bytes: what is put out besides changes nothing."""
    plain = tf.read_system(OPEN_LOOP)
    a = tf.simulate(plain, members=2, duration="41").dataset
    b = tf.simulate(spacecraft(), members=2, duration="41").dataset
    for name in ("position_error", "covariance"):
        np.testing.assert_array_equal(a[f"evaluation.{name}"], b[f"evaluation.{name}"])


# ----------------------------------------------------------------------------- bad input


def test_a_run_without_transitions_is_told_what_to_do():
    plain = tf.simulate(tf.read_system(OPEN_LOOP), duration="8.2")
    with pytest.raises(tf.ConfigurationError, match=r"mekf_predict_smoothed.*\n.*record together"):
        tf.smooth_run(plain)


@pytest.mark.parametrize(
    ("options", "missing"),
    [
        ({"ports": ("error_transition", "transition_since")}, "predict.prior.r_e"),
        ({"ports": ("error_transition", "prior")}, "predict.transition_since"),
    ],
)
def test_what_is_missing_in_the_record_is_named(options, missing):
    run = tf.simulate(spacecraft(**options), duration="32.8")
    with pytest.raises(tf.ConfigurationError, match=rf"not '{missing}'.*\n.*record together"):
        tf.smooth_run(run)


def test_every_fix_must_be_recorded():
    """Every other one is not enough: the transitions count from those in between."""
    run = tf.simulate(spacecraft(rate="16.4"), duration="32.8")
    with pytest.raises(tf.ConfigurationError, match=r"from t = 24.6 s.*only at 0, 16.4, 32.8"):
        tf.smooth_run(run)


def test_where_the_truth_is_not_recorded_there_are_no_errors():
    found = tf.smooth_run(tf.simulate(spacecraft(truth=False), duration="32.8"))
    assert found.missing == ("antenna.q_mu",)
    assert "no errors: the truth in antenna.q_mu was not recorded" in str(found)
    assert "smoothed.error" not in found.dataset


def test_no_run_is_refused(tmp_path):
    with pytest.raises(tf.ConfigurationError, match="there is no result file"):
        tf.smooth_run(tmp_path / "none.nc")
    with pytest.raises(tf.ConfigurationError, match="not a int"):
        tf.smooth_run(3)
    run = tf.simulate(spacecraft(), duration="8.2")
    with pytest.raises(tf.ConfigurationError, match=r"no transition of 'other'; .* predict"):
        tf.smooth_run(run, predict="other")


def test_a_considered_block_cannot_be_smoothed():
    with pytest.raises(ValueError, match="b is considered, not corrected"):

        class Predict(FilterPredict):
            error_state = ErrorState(vector("r", 1), considered(vector("b", 1)))
            process = Process()
            smoothed = True
