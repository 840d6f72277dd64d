"""Pictures of results: what is in them, in which units, and that they are readable."""

import numpy as np
import pytest
import xarray
from matplotlib.figure import Figure

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.evaluation import Evaluation, Quantity
from terrafix.cosim.declare.ports import Output
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.show.plots import (
    POINTS,
    PREDICTED,
    SAMPLE,
    Panel,
    draw_panel,
    evaluations,
    figure,
    plot_result,
)
from terrafix.cosim.system.system import System


class Judge(Evaluation):
    """Errors that shrink from 1000 to about 1, with a predicted sigma to match."""

    default_rate = Rate("1")
    quantities = (Quantity("place", "m", ("x", "y")), Quantity("tilt", "rad", ("z",)))
    place_error = Output((2,), unit="m", labels=("x", "y"))
    place_sigma = Output((2,), unit="m", labels=("x", "y"))
    tilt_error = Output((1,), unit="rad", labels=("z",))
    tilt_sigma = Output((1,), unit="rad", labels=("z",))

    def _judge(self, t):
        sigma = 1000.0 if t == 0 else 1.0
        self.place_error = sigma * self.normals("e", 2)
        self.place_sigma = sigma
        self.tilt_error = 0.01 * self.normals("t", 1)
        self.tilt_sigma = 0.01

    def _initialize_impl(self):
        self._judge(0.0)

    def _step_impl(self, t, dt):
        self._judge(t)


@pytest.fixture(scope="module")
def judged():
    system = System("judged", duration="20")
    system.add(Judge(), "judge")
    return simulate(system, members=30).dataset


def test_errors_are_found_by_quantity_and_axis(judged):
    panels = evaluations(judged)["judge"]
    assert {q: len(p) for q, p in panels.items()} == {"place": 2, "tilt": 1}


def test_every_member_both_sigmas_and_the_mean_are_drawn(judged):
    drawn = figure(judged)
    panel = next(ax for ax in drawn.axes if ax.lines or ax.collections)
    labels = [text.get_text() for legend in drawn.legends for text in legend.get_texts()]
    assert labels == ["error of each member", "predicted 3 sigma", "sample 3 sigma", "sample mean"]
    members = sum(len(c.get_segments()) for c in panel.collections if hasattr(c, "get_segments"))
    assert members + len(panel.lines) >= 30


def test_the_large_start_does_not_flatten_what_follows(judged):
    """3 sigma is 3000 m at first and 3 m later: the later errors must fill the panel."""
    panel = figure(judged).axes[0]
    assert panel.get_ylim()[1] < 100


def test_angles_are_shown_in_degrees(judged):
    titles = " ".join(ax.get_title() for ax in figure(judged).axes)
    assert "tilt error [deg]" in titles
    assert "place error [m]" in titles


def test_a_system_without_evaluation_shows_its_records(toys, tmp_path):
    data = toys.fly(toys.wire({"c": toys.Clock()}, [], ["c.t"]), 3).result(wall_s=0.0).dataset
    plot_result(data, tmp_path / "signals.png")
    assert (tmp_path / "signals.png").read_bytes().startswith(b"\x89PNG")


def test_nothing_to_draw_is_said(tmp_path):
    class Mute(Component):
        default_rate = Rate("1")

        def _step_impl(self, t, dt):
            pass

    system = System("mute", duration="1")
    system.add(Mute(), "mute")
    with pytest.raises(ConfigurationError, match="nothing"):
        plot_result(simulate(system).dataset, tmp_path / "none.png")


def test_the_same_result_gives_the_same_picture(judged, tmp_path):
    for name in ("one.png", "two.png"):
        plot_result(judged, tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    assert np.isfinite(figure(judged).get_size_inches()).all()


# ---------------------------------------------------------------------- what the lines are


def drawn_panel(error, predicted, times=None, **given):
    """The axes of one panel, and its legend: errors (n, n_members) and one sigma (n,)."""
    error, predicted = np.asarray(error, dtype=float), np.asarray(predicted, dtype=float)
    times = np.arange(len(error), dtype=float) if times is None else times
    ax = Figure().subplots()
    return ax, draw_panel(ax, Panel("place", "x", "m", times, error, predicted, **given))


def lines(ax, color):
    return [line.get_ydata().tolist() for line in ax.lines if line.get_color() == color]


def test_three_sigma_are_three_sigma_on_both_sides():
    """Of two members the sample sigma is |a - b| / sqrt(2), the mean (a + b) / 2."""
    error = np.array([[1.0, -3.0], [2.0, 2.0], [3.0, 5.0]])
    ax, legend = drawn_panel(error, [1.0, 2.0, 5.0])
    assert list(legend) == [
        "error of each member",
        "predicted 3 sigma",
        "sample 3 sigma",
        "sample mean",
    ]
    assert lines(ax, PREDICTED) == [[3, 6, 15], [-3, -6, -15]]
    above, below = lines(ax, SAMPLE)
    np.testing.assert_allclose(above, 3 * np.array([4, 0, 2]) / np.sqrt(2), rtol=1e-15)
    assert below == [-value for value in above]
    assert lines(ax, "black") == [[-1, 2, 4]]
    segments = [segment[:, 1].tolist() for c in ax.collections for segment in c.get_segments()]
    assert segments == error.T.tolist()
    assert legend["predicted 3 sigma"].get_color() == PREDICTED
    assert legend["sample 3 sigma"].get_color() == SAMPLE


def test_sample_and_mean_of_all_members_are_drawn_where_they_are_given():
    ax, _ = drawn_panel([[1, -3]] * 2, [1, 1], sample=np.array([5.0, 6]), mean=np.array([7.0, 8]))
    assert lines(ax, SAMPLE) == [[15, 18], [-15, -18]]
    assert lines(ax, "black") == [[7, 8]]


def test_the_mean_is_no_median():
    ax, _ = drawn_panel([[0.0, 0.0, 3.0], [np.nan, 1.0, 2.0]], [1, 1])
    assert lines(ax, "black") == [[1, 1.5]]


def test_one_member_has_no_sample():
    ax, legend = drawn_panel([[1.0], [2.0]], [1, 1])
    assert list(legend) == ["error", "predicted 3 sigma"]
    assert not lines(ax, SAMPLE)


def test_a_predicted_sigma_is_the_root_mean_square_in_the_unit_shown():
    """Of 3 and 4: sqrt((9 + 16) / 2); pi rad are 180 degrees."""
    sizes = ("time", "member", "axis")
    tilt = xarray.Variable(sizes, np.full((1, 2, 1), np.pi), {"units": "rad"})
    sigma = xarray.Variable(sizes, np.pi * np.array([[[3.0], [4.0]]]), {"units": "rad"})
    data = xarray.Dataset({"nav.tilt_error": tilt, "nav.tilt_sigma": sigma}, {"time": [0.0]})
    (panel,) = evaluations(data)["nav"]["tilt"]
    assert panel.unit == "deg"
    np.testing.assert_allclose(panel.error, [[180, 180]], rtol=1e-15)
    np.testing.assert_allclose(panel.predicted, [180 * np.sqrt(12.5)], rtol=1e-15)


def test_peaks_and_dips_of_a_long_history_are_kept():
    """Of 50,000 instants two stand out, one up and one down, among members that failed before."""
    n = 50_000
    error = np.ones((n, 1))
    error[n // 2 :] = np.nan
    error[12_345], error[23_456] = 90.0, -70.0
    error[n // 2 + 5] = 30.0  # alone among NaN
    predicted = np.ones(n)
    predicted[40_001], predicted[40_500] = 20.0, 0.25
    ax, _ = drawn_panel(error, predicted)
    (segment,) = ax.collections[0].get_segments()
    drawn = {value: when for when, value in segment if value in (90, -70, 30)}
    assert set(drawn) == {90, -70, 30}
    for value, when in ((90, 12_345), (-70, 23_456), (30, n // 2 + 5)):
        assert 0 <= when - drawn[value] < n / (POINTS / 2)  # in its stretch
    above, below = lines(ax, PREDICTED)
    assert (max(above), min(above)) == (60, 0.75)
    assert (min(below), max(below)) == (-60, -0.75)
    assert len(above) == POINTS


@pytest.mark.parametrize(("n", "drawn"), [(POINTS, POINTS), (POINTS + 1, POINTS)])
def test_a_history_that_is_short_enough_is_drawn_as_it_is(n, drawn):
    ax, _ = drawn_panel(np.zeros((n, 1)), np.arange(n))
    above = next(line for line in ax.lines if line.get_color() == PREDICTED)
    assert len(above.get_ydata()) == drawn
    assert (above.get_xdata().tolist() == list(range(n))) == (n == POINTS)


@pytest.mark.parametrize(
    ("large", "ratio", "limit"),
    [
        (4, 3.5, 10.0),  # 4 of 100 instants, more than 3 times what follows: cut off
        (6, 3.5, 35.0),  # more than 5 % of the time is no transient
        (4, 2.5, 25.0),  # not 3 times as large
    ],
)
@pytest.mark.parametrize("what", ["predicted", "sample", "error"])
def test_a_panel_fits_what_holds_for_95_percent_of_the_time(what, large, ratio, limit):
    """Whichever of the three is largest; with 8 % of room, and the peak named with its time."""
    high = np.full(100, 10.0)
    high[7 : 7 + large] *= ratio
    high[8] *= 1.01  # the peak is at t = 8 s
    one = np.zeros(100)
    ax, _ = drawn_panel(
        np.column_stack([-high if what == "error" else one, one]),
        (high if what == "predicted" else one) / 3,
        sample=(high if what == "sample" else one) / 3,
    )
    peak = high.max()
    edge = 1.08 * (limit if limit == 10.0 else peak)
    np.testing.assert_allclose(ax.get_ylim(), [-edge, edge], rtol=1e-12)
    said = [text.get_text() for text in ax.texts]
    assert said == (["up to 35 at t = 8 s"] if limit == 10.0 else [])
    assert ax.get_xlim() == (0, 99)


def test_a_single_instant_has_a_panel_too():
    ax, _ = drawn_panel([[1.0, 2.0]], [1.0], times=np.array([4.0]))
    assert ax.get_xlim() == (4, 5)


def test_a_run_cut_short_and_several_judges_are_told_apart(judged):
    assert figure(judged).get_suptitle() == "judged, 30 members"
    short = judged.assign_attrs(status="interrupted").isel(member=[0])
    assert figure(short).get_suptitle() == "judged (incomplete)"
    assert not [f.get_suptitle() for f in figure(judged).subfigs if f.get_suptitle()]
    renamed = judged.rename({n: f"other{n}" for n in map(str, judged.data_vars)})
    both = figure(judged.merge(renamed))
    assert [f.get_suptitle() for f in both.subfigs] == ["judge", "otherjudge"]


# ---------------------------------------------------------------------- recorded signals


def signals(**elements):
    """Recorded signals of so many elements, two instants, one member."""
    return xarray.Dataset(
        {
            name: (("time", "member", f"dim_{n}"), np.ones((2, 1, n)), {"units": "rad"})
            for name, n in elements.items()
        },
        {"time": [0.0, 1.0]},
        {"system": "s"},
    )


def test_signals_of_up_to_nine_elements_are_drawn_in_the_unit_shown():
    """1 rad is 57.29578 deg; three elements are x, y, z, others are numbered."""
    (ax,) = figure(signals(a=9, b=10)).axes
    assert ax.get_title() == "a [deg]"
    assert len(ax.lines) == 9
    np.testing.assert_allclose(ax.lines[0].get_ydata(), [57.29577951308232] * 2, rtol=1e-15)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == list("123456789")
    (ax,) = figure(signals(a=3)).axes
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["x", "y", "z"]


@pytest.mark.parametrize(("count", "rows", "columns"), [(3, 3, 1), (4, 2, 2), (5, 3, 2)])
def test_up_to_three_signals_stand_under_one_another_and_more_side_by_side(count, rows, columns):
    drawn = figure(signals(**{f"s{i}": 1 for i in range(count)}))
    shape = drawn.axes[0].get_subplotspec().get_gridspec().get_geometry()
    assert shape == (rows, columns)
    visible = [ax for ax in drawn.axes if ax.get_visible()]
    assert sorted(ax.get_title() for ax in visible) == [f"s{i} [deg]" for i in range(count)]


def test_times_of_validity_are_no_signals(toys):
    system = toys.wire({"s": toys.Sender(), "c": toys.Clock()}, [], ["s.note", "c.t"])
    drawn = figure(toys.fly(system, 3).result(wall_s=0.0).dataset)
    assert [ax.get_title() for ax in drawn.axes] == ["s.note [m]", "c.t [s]"]
