"""Dispersions: one draw may feed several parameters, and is a function of seed, member and name."""

import numpy as np
import pytest
from scipy import stats

from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.basics.noise import NormalStream
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


# ---------------------------------------------------------------------- draws by their formulas


UNIFORM = NormalStream(4, "dispersion", "d", np.arange(6)).uniform(0, 2)
"""What the six members draw at seed 4: the tests apply the table of `dispersion` to it."""
START = np.array([10.0, 20.0])


def drawn(toys, spread, kind, members=range(6), **options):
    dispersion = Dispersion("d", ("ekf.start", "ukf.start"), spread, kind, **options)
    found = starts(pair(toys, dispersion), members=list(members), seed=4)
    assert found["ekf"].tobytes() == found["ukf"].tobytes()
    return found["ekf"]


def test_draws_are_what_the_table_says(toys):
    """SciPy's quantile of the normal distribution and its truncated one, and plain powers."""
    sigma = np.array([100.0, 1.0])
    u, z = UNIFORM, stats.norm.ppf(UNIFORM)
    close = {"rtol": 1e-13, "atol": 1e-12}
    np.testing.assert_allclose(drawn(toys, sigma, "normal"), START + sigma * z, **close)
    np.testing.assert_allclose(drawn(toys, sigma, "uniform"), START + sigma * (2 * u - 1), **close)
    factor = np.array([2.0, 5.0])
    expected = START * factor ** (2 * u - 1)
    np.testing.assert_allclose(drawn(toys, factor, "log_uniform"), expected, **close)
    for options, limit in (({}, 3.0), ({"limit": 0.5}, 0.5)):
        truncated = START + sigma * stats.truncnorm.ppf(u, -limit, limit)
        found = drawn(toys, sigma, "truncated", **options)
        np.testing.assert_allclose(found, truncated, rtol=1e-10)
        assert (np.abs(found - START) < limit * sigma).all()


def test_a_multivariate_draw_has_the_covariance_that_was_given(toys):
    """By hand, [[4, 3], [3, 9]] has the factor [[2, 0], [1.5, sqrt(6.75)]]."""
    z = stats.norm.ppf(UNIFORM)
    expected = START + np.column_stack([2 * z[:, 0], 1.5 * z[:, 0] + np.sqrt(6.75) * z[:, 1]])
    found = drawn(toys, [[4.0, 3.0], [3.0, 9.0]], "multivariate")
    np.testing.assert_allclose(found, expected, rtol=1e-13)
    metric = drawn(toys, "[[4e-6, 3e-6], [3e-6, 9e-6]] km^2", "multivariate")
    np.testing.assert_allclose(metric, expected, rtol=1e-12)


def test_a_list_is_taken_in_turn_by_the_members_numbers(toys):
    """Member m takes value m mod 3, whoever else flies; in place of the parameter, not added."""
    values = ["[1, 2] m", "[0.3, 0.4] km", [5.0, 6.0]]
    found = drawn(toys, values, "list", members=[5, 0, 4])
    assert found.tolist() == [[5, 6], [1, 2], [300, 400]]
    text = "[[1, 2], [300, 400], [5, 6]] m"
    assert drawn(toys, text, "list", members=[5, 0, 4]).tolist() == found.tolist()


@pytest.mark.parametrize(("design", "n"), [("latin_hypercube", 10), ("sobol", 8)])
def test_designs_put_one_member_into_each_cell_of_every_dimension(toys, design, n):
    """Two dispersions of two dimensions each: n members in n equal cells, in all four."""
    both = (
        Dispersion("a", ("ekf.start",), 1.0, "uniform", design),
        Dispersion("b", ("ukf.start",), 1.0, "uniform", design),
    )
    whole = starts(pair(toys, *both), members=n, seed=4)
    columns = np.column_stack([whole["ekf"] - START, whole["ukf"] - START])
    cells = np.floor((columns + 1) / 2 * n).astype(int)
    assert [sorted(column) for column in cells.T.tolist()] == [list(range(n))] * 4
    assert len({tuple(column) for column in cells.T.tolist()}) == 4  # no two dimensions alike
    other = starts(pair(toys, *both), members=n, seed=5)
    assert (other["ekf"] != whole["ekf"]).all()


def test_a_part_of_a_design_has_the_rows_of_the_whole(toys):
    """The count is that of the last member, unless it is said how many there are in all."""
    design = Dispersion("a", ("ekf.start",), 1.0, "uniform", "latin_hypercube")
    whole = starts(pair(toys, design), members=10)["ekf"]
    for members in ([9, 2], [9, 6, 0]):
        assert (
            starts(pair(toys, design), members=members)["ekf"].tolist() == whole[members].tolist()
        )
    part = starts(pair(toys, design), members=[3, 1], runs=10)["ekf"]
    assert part.tolist() == whole[[3, 1]].tolist()
    with pytest.raises(ConfigurationError, match="design of 10 runs, and has no member 10"):
        starts(pair(toys, design), members=[10], runs=10)


@pytest.mark.parametrize(
    ("kind", "spread", "options", "text"),
    [
        ("normal", 0.0, {}, "is zero: it would not be applied"),
        ("log_uniform", [0.5, 2.0], {}, "give one above 1"),
        ("log_uniform", 1.0, {}, "give one above 1"),
        ("truncated", 1.0, {"limit": 0.0}, "it is a positive number of sigma"),
        ("multivariate", [[1.0, 0.5], [0.4, 1.0]], {}, "is not symmetric"),
        ("multivariate", [[1.0, 2.0], [2.0, 1.0]], {}, "smallest eigenvalue is -1"),  # 1 - 2
        ("multivariate", "[[1, 0], [0, 1]] m", {}, r"m is not \(m\)\^2"),
        ("list", [], {}, "not a list of values"),
    ],
)
def test_spreads_that_cannot_be_are_refused(toys, kind, spread, options, text):
    with pytest.raises(SystemCheckError, match=text):
        drawn(toys, spread, kind, **options)


def test_a_value_that_a_list_overrides_is_found(toys):
    listed = Dispersion("l", ("ekf.start",), [[1.0, 2.0]], "list")
    with pytest.raises(SystemCheckError, match="from dispersion 'l', and is fed by 'd' too"):
        starts(pair(toys, listed, Dispersion("d", ("ekf.start", "ukf.start"), 1.0)))
    two = (Dispersion("c", ("ekf.start",), 3.0), Dispersion("d", ("ekf.start",), 4.0))
    found = starts(pair(toys, *two), members=4000)["ekf"]
    # independent draws add up to sqrt(9 + 16) = 5, within 4 standard errors
    np.testing.assert_allclose(found.std(axis=0), 5.0, rtol=4 / np.sqrt(2 * 4000))


def test_dispersed_values_at_a_bound_are_accepted_and_beyond_it_refused(toys):
    class Bounded(toys.Walk):
        start = type(toys.Walk.start)(1.0, shape=(2,), unit="m", minimum=0.0)

    for values, refused in (([[0.0, 1.0]], False), ([[-1e-9, 1.0]], True)):
        system = toys.wire({"w": Bounded()}, [], duration=1)
        system.disperse(Dispersion("d", ("w.start",), values, "list"))
        if refused:
            with pytest.raises(ConfigurationError, match=r"'w\.start' after dispersion 'd'"):
                simulate(system)
        else:
            assert simulate(system).status == "complete"
