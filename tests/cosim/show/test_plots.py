"""Pictures of results: what is in them, in which units, and that they are readable."""

import numpy as np
import pytest

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
