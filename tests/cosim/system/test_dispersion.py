"""Dispersions: one draw may feed several parameters, and is a function of seed, member and name."""

import numpy as np
import pytest
from scipy.stats import kstest, truncnorm, uniform

from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.identity import configuration
from terrafix.cosim.system.system import System


def pair(toys, *dispersions, parts=("ekf", "ukf")):
    system = toys.wire({k: toys.Walk(start=[10, 20]) for k in parts}, [], duration=1)
    for dispersion in dispersions:
        system.disperse(dispersion)
    return system


BOTH = Dispersion("initial_position", ("ekf.start", "ukf.start"), [100.0, 1.0])


def starts(system, **options):
    simulation = Simulation(system, **options)
    found = {k: c.start.copy() for k, c in system.nodes.items()}
    simulation.master.terminate()
    return found


def test_two_filters_start_from_the_same_draw(toys):
    found = starts(pair(toys, BOTH), members=50)
    assert found["ekf"].tobytes() == found["ukf"].tobytes()
    assert len(np.unique(found["ekf"][:, 0])) == 50


def test_a_draw_depends_on_seed_member_and_name_alone(toys):
    whole = starts(pair(toys, BOTH), members=50)["ekf"]
    for members in ([7], [49, 3]):
        some = starts(pair(toys, BOTH), members=members)["ekf"]
        assert some.tobytes() == whole[members].tobytes()
    alone = Dispersion("initial_position", ("ekf.start",), [100.0, 1.0])
    assert starts(pair(toys, alone, parts=("ekf",)), members=50)["ekf"].tobytes() == whole.tobytes()
    other = Dispersion("other", ("ukf.start",), [100.0, 1.0])
    both = starts(pair(toys, alone, other), members=50)
    assert both["ekf"].tobytes() == whole.tobytes() != both["ukf"].tobytes()
    assert starts(pair(toys, BOTH), members=50, seed=1)["ekf"].tobytes() != whole.tobytes()


@pytest.mark.parametrize("kind", ["normal", "uniform"])
def test_the_spread_is_the_standard_deviation_or_the_half_width(toys, kind):
    n = 20_000
    draws = starts(pair(toys, Dispersion("d", ("ekf.start",), [100.0, 1.0], kind)), members=n)[
        "ekf"
    ]
    draws = (draws - [10, 20]) / [100, 1]
    sigma = 1 if kind == "normal" else 1 / np.sqrt(3)
    np.testing.assert_allclose(draws.mean(axis=0), 0, atol=4 * sigma / np.sqrt(n))
    np.testing.assert_allclose(draws.std(axis=0), sigma, rtol=4 / np.sqrt(2 * n))
    assert kind == "normal" or np.abs(draws).max() < 1
    assert abs(np.corrcoef(draws.T)[0, 1]) < 4 / np.sqrt(n)


def drawn(toys, spread, kind, n=4000, **options):
    """Values of ekf.start, (n, 2), about 10 and 20 m."""
    dispersion = Dispersion("d", ("ekf.start",), spread, kind, **options)
    return starts(pair(toys, dispersion), members=n)["ekf"]


def test_a_factor_is_spread_evenly_in_its_logarithm(toys):
    """Between p / f and p f."""
    logs = np.log(drawn(toys, [2.0, 5.0], "log_uniform") / [10, 20]) / np.log([2, 5])
    assert kstest(logs[:, 0], uniform(-1, 2).cdf).pvalue > 1e-3
    assert kstest(logs[:, 1], uniform(-1, 2).cdf).pvalue > 1e-3


def test_a_truncated_draw_is_normal_within_its_limit(toys):
    z = (drawn(toys, [100.0, 1.0], "truncated", limit=1.5) - [10, 20]) / [100, 1]
    for column in z.T:
        assert kstest(column, truncnorm(-1.5, 1.5).cdf).pvalue > 1e-3


def test_correlated_draws_have_their_covariance_and_are_normal(toys):
    """Whitened by the inverse of the lower Cholesky factor, they are independent."""
    covariance = np.array([[4.0, -1.8], [-1.8, 1.0]])
    e = drawn(toys, covariance, "multivariate") - [10, 20]
    z = np.linalg.solve(np.linalg.cholesky(covariance), e.T)
    assert abs(np.corrcoef(z)[0, 1]) < 4 / np.sqrt(4000)
    for row in z:
        assert kstest(row, "norm").pvalue > 1e-3


def test_members_take_the_values_of_a_list_by_their_number(toys):
    dispersion = Dispersion("d", ("ekf.start",), [[1, 2], [3, 4], [5, 6]], "list")
    found = starts(pair(toys, dispersion), members=[5, 3, 7])["ekf"]
    assert found.tolist() == [[5, 6], [1, 2], [3, 4]]  # 5, 3 and 7 modulo 3


@pytest.mark.parametrize("design", ["latin_hypercube", "sobol"])
def test_a_design_is_laid_out_over_all_runs_and_all_dispersions(toys, design):
    """Each of 16 cells of each of four axes holds one of 16 members, whoever is flown."""
    one = Dispersion("one", ("ekf.start",), [1.0, 1.0], "uniform", design)
    two = Dispersion("two", ("ukf.start",), [1.0, 1.0], "uniform", design)

    def cells(members):
        found = starts(pair(toys, one, two), members=members, runs=16)
        places = np.hstack([found["ekf"], found["ukf"]]) - [10, 20, 10, 20]
        return np.floor((places + 1) * 8).astype(int)

    whole = cells(16)
    assert (np.sort(whole, axis=0) == np.arange(16)[:, None]).all()
    assert len({tuple(column) for column in whole.T}) == 4
    assert cells([9, 2]).tolist() == whole[[9, 2]].tolist()


@pytest.mark.parametrize(
    ("kind", "here", "there"),
    [
        ("normal", np.array([1.0, 0.1]), np.array([1.0, 0.1 + 1e-12])),
        ("list", np.arange(4000.0).reshape(2000, 2), np.arange(4000.0).reshape(2000, 2) ** 1.0),
    ],
)
def test_a_spread_is_part_of_what_a_run_is_to_the_last_digit(toys, kind, here, there):
    """Not as NumPy prints it: with eight digits, and dots in the middle of a long list."""
    if kind == "list":
        there[1000] += 0.5
    runs = [
        configuration(pair(toys, Dispersion("d", ("ekf.start",), spread, kind)).check())
        for spread in (here, there)
    ]
    assert runs[0] != runs[1]
    same = configuration(pair(toys, Dispersion("d", ("ekf.start",), here.copy(), kind)).check())
    assert runs[0] == same


def test_units_and_dispersed_values_are_read_back_in_the_result(toys):
    system = pair(toys, Dispersion("d", ("ekf.start",), "0.1 km"))
    result = simulate(system, members=3)
    stored = result.dataset["parameter:ekf.start"]
    assert stored.attrs["units"] == "m"
    np.testing.assert_array_equal(stored.values, starts(system, members=3)["ekf"])
    assert np.abs(stored.values - [10, 20]).max() > 10


def test_dispersions_do_not_pile_up_over_runs(toys):
    system = pair(toys, BOTH)
    first, second = starts(system, members=3), starts(system, members=3)
    assert first["ekf"].tobytes() == second["ekf"].tobytes()
    np.testing.assert_array_equal(system.nodes["ekf"].setting("start"), [10, 20])


def test_dispersions_of_nested_systems_take_its_path(toys):
    inner = pair(toys, BOTH)
    outer = System("outer", duration=1)
    outer.add(inner, "nav")
    simulation = Simulation(outer, members=2)
    assert list(simulation.master.draws) == ["nav.initial_position"]
    assert simulation.parameters.keys() == {"nav.ekf.start", "nav.ukf.start"}


@pytest.mark.parametrize(
    ("dispersion", "text"),
    [
        (Dispersion("d", ("efk.start",), 1), r"no component 'efk'\n  did you mean 'ekf'\?"),
        (
            Dispersion("d", ("ekf.x",), 1),
            "no numeric parameter\n  numeric parameters: position, start",
        ),
        (Dispersion("d", (), 1), "feeds no parameter"),
        (Dispersion("d", ("ekf.start",), -1), "must be at least 0"),
        (Dispersion("d", ("ekf.start",), "1 s"), "the units differ: s is not m"),
        (Dispersion("d", ("ekf.start",), 1, "gaussian"), "is of kind 'gaussian'"),
    ],
)
def test_dispersions_that_cannot_be_are_found_before_the_run(toys, dispersion, text):
    with pytest.raises(SystemCheckError, match=text):
        Simulation(pair(toys, dispersion))


def test_a_draw_out_of_range_is_refused_and_nothing_stays_bound(toys):
    class Positive(toys.Walk):
        start = type(toys.Walk.start)(1.0, shape=(2,), unit="m", positive=True)

    system = toys.wire({"w": Positive()}, [], duration=1)
    system.disperse(Dispersion("d", ("w.start",), 100.0))
    with pytest.raises(ConfigurationError, match=r"'w\.start' after dispersion 'd'"):
        simulate(system, members=10)
    system.nodes["w"].start = 2.0


def test_dispersions_have_one_name_each(toys):
    with pytest.raises(ConfigurationError, match="has a dispersion 'initial_position' already"):
        pair(toys, BOTH, BOTH)
