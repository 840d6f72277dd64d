"""The closed loop, on simulated and on recorded echo; benchmarks/ has the ensembles.

Bars of a single set of images are those of the sampling error of few members; what an ensemble
over independent scenes must show is measured by `benchmarks/closed_loop.py`.
"""

import importlib.util
import os
import tomllib
from pathlib import Path

import numpy as np
import pytest

from terrafix.cosim.engine.run import RunError, simulate
from terrafix.models.filters.consistency import normalized_square
from terrafix.models.geometry.geolocation import track_axes
from terrafix.models.radar.chirp import SPEED_OF_LIGHT
from terrafix.models.sensors.effective_velocity import effective_velocity_array

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
DATA = Path(os.environ.get("TERRAFIX_DATA", ROOT / ".." / "shared" / "data"))


def benchmark(name):
    """A benchmark as a module: it knows the truth of the fixes."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_images_formed_with_the_estimate_correct_it():
    """One set of three images with four members, and the same without images.

    The misalignment is one for all members of a set: of the nine degrees of freedom three are the
    same draw, and their mean over members stays a chi-square value of three.
    """
    closed_loop = benchmark("closed_loop")
    closed = closed_loop.outcome(closed_loop.closed_loop("TC-2", 20), 20, 4)
    covariances = closed_loop.reported(closed)
    opened = closed_loop.outcome(closed_loop.open_loop("TC-2", 20, *covariances), 20, 60)
    assert closed["accepted"].all()
    assert np.isfinite(closed["velocity"]).all()
    # four sigma of the reported covariance; the velocity with what the relief adds
    for fix, axes, D in zip(closed["fix"], closed["axes"], closed["D"], strict=True):
        sigma = np.sqrt(np.diagonal(axes @ D[0] @ axes.T))
        assert (np.abs(fix[0]) < 4 * sigma).all()
    assert np.abs(closed["velocity"]).max() < 0.4
    for k in range(3):
        own, other = (
            np.sqrt(np.mean([np.trace(P[3:6, 3:6]) for P in loop["P"][k]]))
            for loop in (closed, opened)
        )
        assert own == pytest.approx(other, rel=0.2)
        for loop in (closed, opened):
            nees = np.mean(normalized_square(loop["error"][k], loop["P"][k]))
            assert 2.0 < nees < 27.9  # 99.9 % of one draw of nine degrees of freedom
    speed = np.linalg.norm(closed["error"][:, :, 3:6], axis=2)
    assert speed[0].max() > 3
    assert speed[2].max() < 1


@pytest.fixture(scope="module")
def real():
    folder = DATA / "radarsat1_vancouver"
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} is absent (set TERRAFIX_DATA)")
    return benchmark("real_echo")


def test_recorded_echo_corrects_the_estimate(real):
    """All fixes, within half a pixel of where the looks are, and the velocity within 4 sigma."""
    data = simulate(real.real_echo(), members=3).dataset
    opened = simulate(real.open_loop(), members=3).dataset
    echo = real.real_echo().nodes["echo"]
    for t in map(float, real.TIMES):
        assert (real.at(data, "correct.innovation.accepted", t) == 1).all()
        assert (real.at(data, "former.image.focused", t) == 1).all()
        names = ("orbit.r_e", "orbit.v_e", "attitude.q_be", "antenna.q_mu")
        truth = [real.at(data, name, t)[0] for name in names]
        beam = real.boresight(echo, *truth)
        error = real.at(data, "matcher.fix.r_f_e", t) - beam.point
        pixels = (error @ track_axes(beam.point, truth[1]).T)[:, :2] / real.PIXEL
        assert np.abs(pixels.mean(axis=0)).max() < 0.5
        assert np.sqrt(np.mean(np.sum(pixels**2, axis=1))) < 0.5
        V = real.at(data, "matcher.fix.y", t)[:, 3]
        expected = effective_velocity_array(truth[0], truth[1], beam.point)
        assert pytest.approx(float(expected), abs=4 * real.VELOCITY_SIGMA) == V
        own, other = (real.velocity(d, t)[0] for d in (data, opened))
        assert np.linalg.norm(own) == pytest.approx(np.linalg.norm(other), rel=0.2)


def test_level_along_the_inertial_velocity_explains_the_recorded_doppler(real):
    """Without any squint -6588 Hz of the -7011 Hz recorded: 94 %."""
    system = real.real_echo()
    echo = system.nodes["echo"]
    data = simulate(system_without_images(real), members=1, duration="6.5").dataset
    truth = [real.at(data, name, 6.09)[0] for name in ("orbit.r_e", "orbit.v_e", "attitude.q_be")]
    echo.squint = 0.0
    doppler = real.boresight(echo, *truth, np.array([0, 0, 0, 1.0])).doppler(SPEED_OF_LIGHT / 5.3e9)
    assert doppler == pytest.approx(-6588, abs=2)
    assert 0.9 < doppler / -7011 < 1


def system_without_images(real):
    system = real.open_loop()
    for name in ("matcher", "correct", "evaluation", "predict", "last_known", "ads", "imu"):
        system.remove(name)
    system.records = [r for r in system.records if r.name in ("truth", "pointing")]
    return system


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["MirroredReference", "OtherPlace"])
def test_references_that_show_something_else_are_not_recognized(real, kind):
    if kind == "OtherPlace":
        simulate(real.with_reference(real.Kept), members=1, duration="6.5")
        real.OtherPlace.images.append(real.OtherPlace.images[1])
    data = simulate(real.with_reference(getattr(real, kind)), members=1, duration="5").dataset
    assert not (real.at(data, "matcher.reason", 4.42) == 0).any()


def test_a_reference_that_is_geocoded_10_km_off_is_not_searched_and_told(real):
    """Seven sigma of the estimate: it is not of the place that the image shows."""
    system = real.with_reference(real.MisplacedReference)
    with pytest.raises(RunError, match=r"(?s)reference of 'matcher' does not cover the image") as e:
        simulate(system, members=1, duration="5")
    assert e.value.result is not None


def test_the_two_closed_loops_differ_in_their_sources_alone():
    """The same components and connections; other types where echo and reference come from."""
    one, other = (
        tomllib.loads((EXAMPLES / f"spacecraft_sar_{name}.toml").read_text())
        for name in ("closed_loop", "real_echo")
    )
    assert one["component"].keys() == other["component"].keys()
    differ = {
        name
        for name in one["component"]
        if one["component"][name]["type"] != other["component"][name]["type"]
    }
    assert differ == {"echo", "reference"}
    wires = set(one["wiring"]["connect"]) ^ set(other["wiring"]["connect"])
    assert wires == {"terrain.surface -> echo.surface", "terrain.surface -> reference.surface"}
