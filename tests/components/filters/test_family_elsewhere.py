"""Filters of one's own in other tools: as FMUs and in packages they give the same bytes."""

import sys

import numpy as np
import pytest

import terrafix as tf
from terrafix.cosim.exchange.ssp.export import export_ssp
from terrafix.cosim.exchange.ssp.reading import read_ssp

MODULE = """
import casadi as ca
import terrafix as tf

f = tf.filters
STATE = f.ErrorState(
    f.vector("r", 2, unit="m"),
    f.vector("v", 2, unit="m/s"),
    f.rotation("q", side="right"),
    f.considered(f.vector("offset", 1, unit="m")),
)


class Belief:
    default_rate = tf.Rate("0.1")
    error_state = STATE
    process = f.Process(
        rates=lambda x, given, w, t: {"r": x["v"], "v": w["push"], "q": w["turn"]},
        noise={"push": ("psd", 2), "turn": ("turn_psd", 3)},
    )
    psd = tf.Parameter(0.01, unit="m^2/s^3")
    turn_psd = tf.Parameter(1e-5, unit="rad^2/s")
    r_sigma0 = tf.Parameter(20.0, unit="m")
    v_sigma0 = tf.Parameter(1.0, unit="m/s")
    q_sigma0 = tf.Parameter(0.02, unit="rad")
    offset_sigma0 = tf.Parameter(0.5, unit="m")


def bearing(x, given):
    return ca.atan2(x["r"][1] + 50, x["r"][0] + 80) - 2 * ca.atan2(x["q"][2], x["q"][3])


class Place:
    error_state = STATE
    default_rate = tf.Rate("1", offset="1")
    observation = f.Observation(lambda x, given: x["r"] + x["offset"], {"x": "m", "y": "m"})


class Bearing:
    error_state = STATE
    default_rate = tf.Rate("1", offset="1")
    observation = f.Observation(bearing, {"bearing": "rad"}, angles=("bearing",))


class Truth(Belief, f.FilterTruth):
    pass


class Predict(Belief, f.FilterPredict):
    pass


class PlaceSensor(Place, f.FilterSensor):
    pass


class BearingSensor(Bearing, f.FilterSensor):
    pass


class PlaceCorrect(Place, f.FilterCorrect):
    pass


class BearingCorrect(Bearing, f.FilterCorrect):
    pass


class Monitor(Bearing, f.FilterMonitor):
    pass
"""

SYSTEM = """
schema = "terrafix-system/1"
name = "family"
duration = "12 s"
seed = 4
component.truth.type = "own_family:Truth"
component.place = {type = "own_family:PlaceSensor", sigma = "[2, 2] m"}
component.bearing.type = "own_family:BearingSensor"
component.bearing.sigma = "0.5 deg"
component.bearing.period = "2 s"
component.bearing.offset = "2 s"
component.predict.type = "own_family:Predict"
component.first = {type = "own_family:PlaceCorrect", update = "iterated"}
component.second = {type = "own_family:BearingCorrect", update = "unscented", weights = "huber"}
component.monitor.type = "own_family:Monitor"

[wiring]
connect = [
    "truth.r -> place.r",
    "truth.offset -> place.offset",
    "truth.r -> bearing.r",
    "truth.q -> bearing.q",
    "place.fix -> first.fix",
    "bearing.fix -> second.fix",
    "predict.prior -> first.prior",
    "first.estimate -> second.prior",
    "first.posterior -> second.earlier",
    "second.posterior -> predict.posterior",
    "second.innovation -> monitor.innovation",
]

[record.all]
ports = ["truth.r", "truth.q", "second.estimate", "monitor.alarms", "second.innovation"]
period = "1 s"
"""


@pytest.fixture(scope="module")
def family(tmp_path_factory):
    folder = tmp_path_factory.mktemp("family")
    (folder / "own_family.py").write_text(MODULE)
    (folder / "family.toml").write_text(SYSTEM)
    before = list(sys.path)
    yield folder / "family.toml"
    sys.path[:] = before
    sys.modules.pop("own_family", None)


@pytest.fixture(scope="module")
def native(family):
    return tf.simulate(tf.read_system(family), members=3).dataset


def test_it_flies_here(native):
    """The second correction has a fix every other second: 6 of 12, all of them seen."""
    reason = native["second.innovation.accepted"].values
    assert np.isfinite(native["second.estimate.P"].values).all()
    assert np.nansum(reason[:, 0]) == 6


@pytest.mark.parametrize(
    ("fmi", "names"),
    [pytest.param(2, ["predict", "second"], marks=pytest.mark.campaign), (3, None)],
)
def test_every_part_as_an_fmu_gives_the_same_bytes(family, native, tmp_path, fmi, names):
    system = tf.read_system(family)
    for name in names or list(system.nodes):
        file = tmp_path / f"{name}.fmu"
        tf.export_fmu(tf.read_system(family), file, component=name, fmi=fmi)
        system.replace(name, tf.components.fmu(file=file, rate=system.nodes[name].rate))
    flown = tf.simulate(system, members=3).dataset
    compared = [v for v in native.data_vars if v in flown and native[v].dtype.kind == "f"]
    assert len(compared) > 12
    for variable in compared:
        np.testing.assert_array_equal(native[variable], flown[variable], err_msg=variable)


def test_the_whole_as_a_package_comes_back_to_the_same_bytes(family, native, tmp_path):
    export_ssp(tf.read_system(family), tmp_path / "family.ssp")
    again = read_ssp(tmp_path / "family.ssp")
    again.record("all", ["second.estimate", "truth.r"], period="1")
    flown = tf.simulate(again, members=3, duration="12").dataset
    for variable in ("second.estimate.P", "second.estimate.r", "truth.r"):
        found = flown[f"{variable}@all"]
        np.testing.assert_array_equal(native[variable], found, err_msg=variable)
