"""Linear covariance against the Kalman filter in closed form, and against sampled campaigns."""

from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from campaign_parts import Filter, Judge, scalar_system
from scipy.stats import norm

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, StepError
from terrafix.cosim.campaign.campaign import run_campaign
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Capabilities, Input, MessageInput, MessageOutput, Output
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.lincov import deviations
from terrafix.cosim.lincov.deviations import linear_covariance
from terrafix.cosim.lincov.prediction import LinearCovariance
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System
from terrafix.models.core.model import Model

OPEN_LOOP = Path(__file__).parents[3] / "examples" / "spacecraft_sar_open_loop.toml"


def kalman(n, walk=0.5, noise=1.0, sigma0=2.0, tuning=1.0):
    """Variance of the error, by source, of a filter whose measurement variance may be wrong."""
    P = sigma0**2
    true = {"start": sigma0**2, "walk": 0.0, "noise": 0.0}
    for _ in range(n):
        prior = P + walk**2
        K = prior / (prior + tuning * noise**2)
        P = (1 - K) * prior
        true["walk"] += walk**2
        true = {k: (1 - K) ** 2 * v for k, v in true.items()}
        true["noise"] += K**2 * noise**2
    return P, true


@pytest.mark.parametrize("tuning", [1.0, 0.25, 4.0])
def test_a_scalar_filter_is_predicted_exactly(tuning):
    """Also where the filter's model is not the truth's."""
    found = linear_covariance(scalar_system(tuning=tuning))
    P, true = kalman(20, tuning=tuning)
    assert found.filter[-1, 0, 0] == pytest.approx(P, rel=1e-12)
    assert found.total[-1, 0, 0] == pytest.approx(sum(true.values()), rel=1e-12)
    budget = found.budget()
    assert budget["filter.w at the start"][0] ** 2 == pytest.approx(true["start"], rel=1e-9)
    assert budget["filter.w"][0] ** 2 == pytest.approx(true["walk"], rel=1e-12)
    assert budget["filter.v"][0] ** 2 == pytest.approx(true["noise"], rel=1e-12)


def test_dispersions_are_sources():
    """An unknown bias of sigma 0.3 m in every measurement."""
    system = scalar_system()
    system.disperse(Dispersion("bias", ("filter.bias",), 0.3))
    found = linear_covariance(system)
    sampled = run_campaign(system, runs=4000, workers=1).statistics["judge"]
    assert found.sigma[-1, 0] == pytest.approx(
        np.sqrt(sampled["covariance_sample"][-1, 0, 0]), rel=4 / np.sqrt(8000)
    )
    assert found.budget()["dispersion bias"][0] == pytest.approx(0.3, rel=1e-3)


@pytest.mark.parametrize(
    ("kind", "spread", "sigma"),
    [
        ("uniform", 0.3, 0.3 / np.sqrt(3)),  # half a width
        # 1 - 2 a phi(a) / (2 Phi(a) - 1) of the variance is left at a limit of a = 1 sigma
        ("truncated", 0.3, 0.3 * np.sqrt(1 - 2 * norm.pdf(1) / (2 * norm.cdf(1) - 1))),
        ("list", [-0.3, 0.0, 0.3], 0.3 * np.sqrt(2 / 3)),  # each a third of the members
    ],
)
def test_each_kind_of_dispersion_has_its_variance(kind, spread, sigma):
    system = scalar_system()
    system.disperse(Dispersion("bias", ("filter.bias",), spread, kind, limit=1.0))
    found = linear_covariance(system).budget()["dispersion bias"][0]
    assert found == pytest.approx(sigma, rel=1e-3)  # the gain is nearly 1 in the end


def test_a_prediction_survives_being_stored():
    found = linear_covariance(scalar_system())
    again = LinearCovariance.of_dataset(found.dataset())
    assert again.total.tobytes() == found.total.tobytes()
    assert again.labels == found.labels
    assert list(again.sources) == list(found.sources)


def test_a_factor_s_dispersion_is_linear_in_its_logarithm():
    """Bias 0.2 m times a factor within 1.5: sigma 0.2 ln(1.5) / sqrt(3) in the end."""
    system = scalar_system(bias=0.2)
    system.disperse(Dispersion("bias", ("filter.bias",), 1.5, kind="log_uniform"))
    found = linear_covariance(system)
    expected = 0.2 * np.log(1.5) / np.sqrt(3)
    assert found.budget()["dispersion bias"][0] == pytest.approx(expected, rel=1e-3)


def test_a_dispersion_of_what_has_no_jacobian_is_named():
    class ScaledJudge(Judge):
        """A judge with a parameter of its own."""

        scale = Parameter(1.0)

    system = System("scaled", duration=5)
    part, judge = system.add(Filter(), "filter"), system.add(ScaledJudge(), "judge")
    for port in judge.inputs():
        system.connect(part[port], judge[port])
    system.disperse(Dispersion("scale", ("judge.scale",), 0.3))
    with pytest.raises(ConfigurationError, match=r"'scale' feeds 'judge\.scale', which is no"):
        linear_covariance(system)


def test_what_cannot_be_linearized_is_named():
    with pytest.raises(ConfigurationError, match=r"'wire' \(Tripwire\) has no symbolic Jacobian"):
        linear_covariance(scalar_system(tripwire=1))


class Given(Component):
    """What is the same for all: y = k t, at 1 Hz."""

    capabilities = Capabilities(given=True)
    default_rate = Rate("1")
    k = Parameter(2.0, unit="m/s", minimum=0.0)
    y = Output(unit="m")

    def _initialize_impl(self):
        self.y = 0.0

    def _step_impl(self, t, dt):
        self.y = self.parameter_values["k"] * t


class Doubled(SymbolicComponent):
    """Twice what it reads."""

    default_rate = Rate("1")
    u = Input(unit="m")
    y = Output(unit="m")

    def build_model(self):
        u = ca.SX.sym("u")
        return Model("doubled", inputs={"u": u}, outputs={"y": 2 * u})


class Scaled(SymbolicComponent):
    """y = k t."""

    default_rate = Rate("1")
    k = Parameter(2.0, unit="m/s")
    y = Output(unit="m")

    def build_model(self):
        k, t = ca.SX.sym("k"), ca.SX.sym("t")
        return Model("scaled", parameters={"k": k}, outputs={"y": k * t}, time=t)


class Slow(Component):
    """Twice what it reads, in Python."""

    capabilities = Capabilities(given=True)
    default_rate = Rate("1")
    u = Input(unit="m")
    y = Output(unit="m")

    def _initialize_impl(self):
        self.y = 2 * self.u

    def _step_impl(self, t, dt):
        self.y = 2 * self.u


class Failing(Given):
    """Fails beyond a slope."""

    def _step_impl(self, t, dt):
        super()._step_impl(t, dt)
        self.fail((self.parameter_values["k"] > 2.05) & (t == 3), "too steep")


class Telling(Given):
    """Publishes a matrix and a message too."""

    table = Output((2, 2))
    said = MessageOutput((2,))

    def _initialize_impl(self):
        super()._initialize_impl()
        self.table = np.eye(2)


class ReadsTable(SymbolicComponent):
    """Reads the matrix too."""

    default_rate = Rate("1")
    u = Input(unit="m")
    table = Input((2, 2))
    y = Output(unit="m")

    def build_model(self):
        u, table = ca.SX.sym("u"), ca.SX.sym("table", 2, 2)
        inputs = {"u": u, "table": table}
        return Model("reads_table", inputs=inputs, outputs={"y": u + table[0, 0]})


class ReadsMessage(SymbolicComponent):
    """Reads the message too."""

    default_rate = Rate("1")
    u = Input(unit="m")
    said = MessageInput((2,))
    y = Output(unit="m")

    def build_model(self):
        u, said, fresh = ca.SX.sym("u"), ca.SX.sym("said", 2), ca.SX.sym("fresh")
        inputs = {"u": u, "said": said, "said.fresh": fresh}
        outputs = {"y": u + ca.if_else(fresh, said[0], 0.0)}
        return Model("reads_message", inputs=inputs, outputs=outputs)


def test_what_is_given_is_taken_as_it_is():
    """It is no obstacle, and adds nothing to what deviates; what reads it need not know."""
    system, alone = scalar_system(), scalar_system()
    given = system.add(Given(), "given")
    system.connect(given["y"], system.add(Doubled(), "doubled")["u"])
    np.testing.assert_array_equal(linear_covariance(system).total, linear_covariance(alone).total)


def test_what_reads_what_noise_reaches_is_not_given():
    system = scalar_system(tripwire=1)
    system.nodes["wire"].capabilities = Capabilities(given=True)
    with pytest.raises(ConfigurationError) as raised:
        linear_covariance(system)
    assert str(raised.value) == (
        "'wire' (Tripwire) has no symbolic Jacobian, as all that can only be stepped (FMUs, "
        "components in Python), and its input 'u' reads 'filter.truth', which deviates with the "
        "noise of 'filter', so the system cannot be linearized\n"
        "  fly a campaign instead, which takes its dispersions"
    )


def judged(*parts):
    """The scalar filter, its estimate compared with what the last of some other parts publishes."""
    system = System("judged", duration=5)
    part, judge = system.add(Filter(), "filter"), system.add(Judge(), "judge")
    for port in ("estimate", "variance", "innovation", "innovation_variance"):
        system.connect(part[port], judge[port])
    for name, each in parts:
        system.add(each, name)
    for (_, before), (_, after) in pairwise(parts):
        system.connect(before["y"], after["u"])
    system.connect(parts[-1][1]["y"], judge["truth"])
    return system


@pytest.mark.parametrize(
    ("parts", "factor"), [([], 1.0), ([("twice", Doubled())], 2.0), ([("slow", Slow())], 2.0)]
)
def test_what_is_given_deviates_with_its_dispersed_parameters(parts, factor):
    """By t sigma, or twice that, behind what is symbolic or can only be stepped."""
    system = judged(("given", Given()), *parts)
    assert not [n for n in linear_covariance(system).sources if "dispersion" in n]
    system.disperse(Dispersion("k", ("given.k",), 0.3))
    found = linear_covariance(system)
    expected = factor * 0.3 * found.times
    sigma = np.sqrt(found.sources["dispersion k"][:, 0, 0])
    np.testing.assert_allclose(sigma, expected, rtol=1e-12)
    system.disperse(Dispersion("more", ("given.k",), 0.4))  # of the same parameter
    found = linear_covariance(system)
    np.testing.assert_allclose(found.budget()["dispersion k"], 5 * factor * 0.3, rtol=1e-12)
    np.testing.assert_allclose(found.budget()["dispersion more"], 5 * factor * 0.4, rtol=1e-12)


def test_a_dispersed_symbolic_component_reaches_what_can_only_be_stepped():
    system = judged(("scaled", Scaled()), ("slow", Slow()))
    system.disperse(Dispersion("k", ("scaled.k",), 0.3))
    found = linear_covariance(system)
    sigma = np.sqrt(found.sources["dispersion k"][:, 0, 0])
    np.testing.assert_allclose(sigma, 2 * 0.3 * found.times, rtol=1e-12)


def test_what_nobody_reads_changes_nothing():
    system, alone = scalar_system(), scalar_system()
    system.add(Scaled(), "scaled")
    system.disperse(Dispersion("k", ("scaled.k",), 0.3))
    np.testing.assert_array_equal(linear_covariance(system).total, linear_covariance(alone).total)


def test_dispersions_of_what_can_only_be_stepped_that_cannot_be_linearized():
    def refused(given, reader=None, port=None):
        system = judged(("given", given), *([] if reader is None else [("reader", reader)]))
        if reader is not None:
            system.connect(given[port], reader[port])
        system.disperse(Dispersion("k", ("given.k",), 0.4))
        linear_covariance(system)

    with pytest.raises(ConfigurationError, match=r"'given.k' is -0.1 m/s; (?s:.*) fly a campaign"):
        refused(Given(k=0.0))
    with pytest.raises(StepError, match=r"'given' at t = 3 s, in a member .*: too steep\n  fly a"):
        refused(Failing())
    with pytest.raises(ConfigurationError, match=r"'given.table' is a matrix of what has no sym"):
        refused(Telling(), ReadsTable(), "table")
    with pytest.raises(ConfigurationError, match=r"'given.said' is a message of what has no sym"):
        refused(Telling(), ReadsMessage(), "said")


@pytest.fixture(scope="module")
def open_loop():
    return linear_covariance(read_system(OPEN_LOOP, [("case", "TC-2")]), duration="123")


def test_the_open_loop_is_predicted(open_loop):
    """A matched filter: what it predicts is what its errors are, but for a few ticks' turn."""
    np.testing.assert_allclose(open_loop.sigma, open_loop.sigma_filter, rtol=2e-3)


def test_a_jacobian_serves_its_neighbors(monkeypatch):
    """As with one per tick, to the error of the midpoint rule.

    That is a twenty-fourth of the square of what the orbit turns in the ticks that share one: in
    17 ticks of 10 ms 2e-4 rad.
    """
    system = read_system(OPEN_LOOP, [("case", "TC-2")])
    shared = linear_covariance(system, duration="24.6")
    monkeypatch.setattr(deviations, "EVERY", 1)
    each = linear_covariance(system, duration="24.6")
    np.testing.assert_allclose(shared.sigma, each.sigma, rtol=2e-4**2 / 24)
    assert shared.sigma.tobytes() != each.sigma.tobytes()


def test_the_misalignment_about_the_boresight_is_not_observed(open_loop):
    first = open_loop.unobserved()[0]
    assert open_loop.labels[int(np.abs(first.components).argmax())] == "misalignment z"
    assert abs(first.components).max() > 0.999
    assert first.remaining == pytest.approx(1.0, abs=1e-6)


def test_the_open_loop_as_sampled(open_loop):
    """256 members: a sigma's standard error is 4.4 %; four of them for 9 axes at one epoch."""
    from terrafix.cosim.campaign.batch import FileSource

    source = FileSource(str(OPEN_LOOP), (("case", "TC-2"),))
    s = run_campaign(source, runs=256, duration="123", workers=1).statistics["evaluation"]
    sample = np.sqrt(np.diagonal(s["covariance_sample"][-1]))
    predicted = np.sqrt(np.diagonal(s["covariance_predicted"][-1]))
    np.testing.assert_allclose(sample, open_loop.sigma[-1], rtol=4 / np.sqrt(512))
    np.testing.assert_allclose(predicted, open_loop.sigma_filter[-1], rtol=5e-3)
