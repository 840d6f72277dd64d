"""Pictures of results: what is in them, in which units, and that they are readable."""

import numpy as np
import pytest
import xarray as xr

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.evaluation import Evaluation, Quantity
from terrafix.cosim.declare.ports import Output
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.show.plots import evaluations, figure, plot_result
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


class Known(Evaluation):
    """Errors and sigmas in closed form: of member m 2 m - 3 and m + 1, in degrees."""

    default_rate = Rate("1")
    quantities = (Quantity("tilt", "rad", ("z",)),)
    tilt_error = Output((1,), unit="rad", labels=("z",))
    tilt_sigma = Output((1,), unit="rad", labels=("z",))
    turn = Output(unit="rad")

    def _initialize_impl(self):
        m = self.environment.members[:, None]
        self.tilt_error = np.radians(2.0 * m - 3.0)
        self.tilt_sigma = np.radians(m + 1.0)
        self.turn = np.radians(90.0)

    def _step_impl(self, t, dt):
        pass


def known(members):
    system = System("known", duration="2")
    system.add(Known(), "judge")
    system.record("turn", ["judge.turn"])
    return simulate(system, members=members).dataset


def test_the_bounds_are_three_sigma_in_the_unit_that_is_named():
    """Of sigmas 1 to 4 deg the root mean square is 7.5^0.5; of -3, -1, 1, 3 the mean is 0.

    Their standard deviation is (20 / 3)^0.5.
    """
    panel = figure(known(4)).axes[0]
    lines = [line.get_ydata() for line in panel.lines]
    predicted, sample = 3 * np.sqrt(7.5), 3 * np.sqrt(20 / 3)
    right = [predicted, -predicted, sample, -sample, 0.0]
    np.testing.assert_allclose(lines, np.outer(right, np.ones(3)), atol=1e-12)
    (drawn,) = panel.collections
    segments = [segment[:, 1] for segment in drawn.get_segments()]
    np.testing.assert_allclose(segments, np.outer([-3, -1, 1, 3], np.ones(3)), atol=1e-12)


def test_one_member_has_its_error_and_what_was_predicted():
    panel = figure(known(1)).axes[0]
    lines = [line.get_ydata() for line in panel.lines]
    np.testing.assert_allclose(lines, [[3.0] * 3, [-3.0] * 3])


def test_signals_are_drawn_in_the_unit_that_is_named():
    data = known(1)[["judge.turn"]]
    (axes,) = figure(data).axes
    assert axes.get_title() == "judge.turn [deg]"
    np.testing.assert_allclose(axes.lines[0].get_ydata(), 90.0)


def test_peaks_of_a_long_record_are_drawn_up_and_down():
    """Two samples of 40,000, thinned to 1,200 points."""
    values = np.zeros((40_000, 1))
    values[12_345], values[23_456] = -5.0, 7.0
    record = xr.Dataset(
        {"part.y": (("time", "member"), values, {"units": "m"})},
        {"time": np.arange(40_000.0), "member": [0]},
    )
    (axes,) = figure(record).axes
    t, y = axes.lines[0].get_data()
    assert len(y) <= 1200
    assert (y.min(), y.max()) == (-5.0, 7.0)
    assert abs(t[y.argmin()] - 12_345) <= 40_000 / 600
    assert abs(t[y.argmax()] - 23_456) <= 40_000 / 600


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
