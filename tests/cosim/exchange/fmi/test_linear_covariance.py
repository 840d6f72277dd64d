"""Linear covariance of systems with FMUs: what the native components give, and a closed form."""

from __future__ import annotations

import numpy as np
import pytest
from campaign_parts import Filter, Judge, scalar_system
from fmu_helpers import OPEN_LOOP
from small_fmus import Variable, small_fmu

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.write.export import export_fmu
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.lincov.deviations import linear_covariance
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System

METRE = '<Unit name="m"><BaseUnit m="1"/></Unit>'
SPREAD = (
    Dispersion("position", ("orbit.r0_i",), "[100, 200, 300] m"),
    Dispersion("velocity", ("orbit.v0_i",), "0.1 m/s"),
)


def open_loop(spread=(), **fmus):
    """The open loop, some of its components FMUs; its filter knows nothing of J2.

    So it does not take the start of the orbit out of its error.
    """
    system = read_system(OPEN_LOOP, [("predict.gravity", "two-body")])
    for each in spread:
        system.disperse(each)
    for name, file in fmus.items():
        system.replace(name, Fmu(file=file, rate=system.find(name).rate))
    return system


def assert_alike(found, native):
    """Every number; covariances relative to the sigmas of their axes at that time."""
    assert list(found.sources) == list(native.sources)
    assert list(found.budget()) == list(native.budget())
    np.testing.assert_array_equal(found.times, native.times)
    np.testing.assert_allclose(found.sigma, native.sigma, rtol=1e-6)
    np.testing.assert_allclose(found.sigma_filter, native.sigma_filter, rtol=1e-12)
    largest = native.sigma[:, :, None] * native.sigma[:, None, :]
    for source, covariance in native.sources.items():
        off = np.abs(found.sources[source] - covariance) / largest
        assert off.max() < (1e-6 if source.startswith("dispersion") else 1e-12), source
    for one, other in zip(found.directions, native.directions, strict=True):
        assert one.remaining == pytest.approx(other.remaining, rel=1e-12)
        np.testing.assert_allclose(one.components, other.components, atol=1e-12)


@pytest.fixture(scope="module")
def native():
    return linear_covariance(open_loop(SPREAD), duration="41")


def test_an_orbit_from_an_fmu_without_dispersions_changes_nothing(exported):
    found = linear_covariance(open_loop(orbit=exported("orbit", 2)), duration="8.2")
    assert_alike(found, linear_covariance(open_loop(), duration="8.2"))


@pytest.mark.parametrize(("fmi", "parts"), [(2, ["orbit"]), (3, ["orbit", "attitude"])])
def test_a_dispersed_orbit_from_an_fmu_is_predicted_as_the_native_one(exported, native, fmi, parts):
    """Alone, and with an FMU that reads it.

    Positions of 7e6 m are rounded to 1e-9 m, of differences over 50 m that make up to 2 m of error.
    """
    fmus = {name: exported(name, fmi) for name in parts}
    found = linear_covariance(open_loop(SPREAD, **fmus), duration="41")
    assert_alike(found, native)
    position = found.budget()["dispersion position"][:3]
    assert position.max() > 1.0
    np.testing.assert_allclose(position, native.budget()["dispersion position"][:3], rtol=2e-6)
    velocity = found.budget()["dispersion velocity"][:3]
    np.testing.assert_allclose(velocity, native.budget()["dispersion velocity"][:3], rtol=1e-5)


@pytest.mark.parametrize(("fmi", "isolate"), [(2, False), (3, True)])
def test_a_slope_s_sigma_grows_with_time(tmp_path, fmi, isolate):
    """y = k t: sigma_y = t sigma_k, whatever the estimate that is compared with it."""
    k, y = Variable("k", causality="parameter", start=2.0), Variable("y", start=0.0, unit="m")
    file = small_fmu(
        tmp_path / "slope.fmu",
        fmi,
        [k, y],
        step="m->r[1] = m->r[0] * (t + h);",
        units=METRE,
    )
    system = System("slope", duration=5)
    part, judge = system.add(Filter(), "filter"), system.add(Judge(), "judge")
    for port in ("estimate", "variance", "innovation", "innovation_variance"):
        system.connect(part[port], judge[port])
    slope = system.add(Fmu(file=file, rate=Rate("1"), isolate=isolate), "slope")
    system.connect(slope["y"], judge["truth"])
    system.disperse(Dispersion("k", ("slope.k",), 0.3))
    found = linear_covariance(system)
    sigma = np.sqrt(found.sources["dispersion k"][:, 0, 0])
    np.testing.assert_allclose(sigma, 0.3 * np.arange(6), rtol=1e-12)


def test_fmus_that_noise_reaches_are_refused(exported, tmp_path):
    system = scalar_system()
    export_fmu(Filter(), tmp_path / "noisy.fmu")
    system.replace("filter", Fmu(file=tmp_path / "noisy.fmu", rate=Rate("1")))
    with pytest.raises(ConfigurationError) as raised:
        linear_covariance(system)
    assert str(raised.value) == (
        "'filter' (Fmu) has no symbolic Jacobian, as all that can only be stepped (FMUs, "
        "components in Python), and may draw noise of its own, so the system cannot be linearized\n"
        "  fly a campaign instead, which takes its dispersions"
    )
    system = scalar_system()
    u, y = Variable("u", causality="input", start=0.0, unit="m"), Variable("y", start=0.0)
    file = small_fmu(tmp_path / "reads.fmu", 3, [u, y], units=METRE)
    reader = system.add(Fmu(file=file, rate=Rate("1")), "reader")
    system.connect(system.nodes["filter"]["truth"], reader["u"])
    with pytest.raises(
        ConfigurationError,
        match=r"'reader' \(Fmu\) .*, and its input 'u' reads 'filter.truth', which deviates with "
        r"the noise of 'filter', so the system cannot be linearized\n  fly a campaign instead",
    ):
        linear_covariance(system)
