"""Windows hold every sample since the last step; delays hand values on later; both converted."""

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, RateError, WiringError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Input, Output, WindowInput
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.system.system import System


def test_a_window_holds_the_samples_of_the_open_closed_interval(toys):
    """(t - dt, t]: the sample of the instant itself is in, the one of the last step is not."""
    spy = toys.WindowSpy(rate=Rate(2))
    toys.fly(toys.wire({"c": toys.Clock(rate=Rate("0.5")), "w": spy}, ["c.t -> w.u"]), 4, members=2)
    for t, _, (samples, times) in spy.seen:
        assert times.tolist() == [t - 1.5, t - 1.0, t - 0.5, t]
        assert samples.tolist() == [times.tolist(), (times + 1000).tolist()]


def test_every_pulse_of_an_aperture_is_in_the_window(toys):
    """1200 pulses a second, one image a second from 0.25 s on."""
    spy = toys.WindowSpy(rate=Rate(1, offset="0.25"))
    toys.fly(toys.wire({"c": toys.Clock(rate=Rate(hz=1200)), "w": spy}, ["c.t -> w.u"]), "2.25")
    assert [len(times) for _, _, (_, times) in spy.seen] == [300, 1200, 1200]
    together = np.concatenate([times for _, _, (_, times) in spy.seen])
    np.testing.assert_array_equal(together, np.arange(1, 2701) / 1200)


def test_windows_grow_and_start_empty_again(toys):
    """Listed times: the capacity cannot be known beforehand."""
    burst = [f"{k}/100" for k in range(1, 60)] + ["3"]
    spy = toys.WindowSpy()
    parts = {
        "c": toys.Clock(rate=Rate(times=burst)),
        "w": spy,
        "fine": toys.Clock(rate=Rate("0.01")),
    }
    toys.fly(toys.wire(parts, ["c.t -> w.u"]), 3)
    assert [len(times) for _, _, (_, times) in spy.seen] == [59, 0, 1]
    np.testing.assert_array_equal(spy.seen[0][2][0][0], np.arange(1, 60) / 100)


def test_a_window_that_grew_is_put_back(toys):
    """59 samples where room was made for 16, saved before the consumer's step and set back."""

    def built():
        burst = [f"{k}/100" for k in range(1, 60)]
        parts = {
            "c": toys.Clock(rate=Rate(times=burst)),
            "w": toys.WindowSpy(),
            "fine": toys.Clock(rate=Rate("0.01")),
        }
        return toys.wire(parts, ["c.t -> w.u"])

    saved = toys.fly(built(), "0.7").get_state()
    resumed = Simulation(built())
    resumed.set_state(saved)
    resumed.run_until(1)
    ((t, _, (samples, times)),) = resumed.system.nodes["w"].seen
    assert t == 1
    np.testing.assert_array_equal(times, np.arange(1, 60) / 100)
    np.testing.assert_array_equal(samples[0], np.arange(1, 60) / 100)


def test_an_unconnected_window_with_a_default_is_empty(toys):
    class Optional(toys.WindowSpy):
        u = WindowInput(unit="s", default=0.0)

    spy = Optional()
    toys.fly(toys.wire({"w": spy}, []), 2)
    assert [samples.shape for _, _, (samples, _) in spy.seen] == [(1, 0), (1, 0)]


def test_windows_at_the_start_are_refused():
    with pytest.raises(ConfigurationError, match="a window is read at the end of the step"):
        WindowInput(at="start")


class Kilo(Component):
    """Reads the time in kilo- and milliseconds."""

    default_rate = Rate(2)
    now = Input(unit="ms")
    late = Input(unit="ms")
    window = WindowInput(unit="ms")
    y = Output()

    def _step_impl(self, t, dt):
        self.seen = (self.now.tolist(), self.late.tolist(), self.window.samples.tolist())
        self.y = 0.0


def test_signals_windows_and_delayed_signals_are_converted(toys):
    kilo = Kilo()
    links = ["c.t -> k.now", "c.t -> k.late delay 1", "c.t -> k.window"]
    toys.fly(toys.wire({"c": toys.Clock(), "k": kilo}, links), 4)
    assert kilo.seen == ([4000.0], [3000.0], [[3000.0, 4000.0]])


@pytest.mark.parametrize("name", ["a", "z"])
def test_a_delayed_signal_is_the_value_of_then(toys, name):
    """Before the delay has passed, that of t = 0; a delay shorter than the source's step holds."""
    spy = toys.EndSpy(rate=Rate("0.5"))
    toys.fly(toys.wire({"m": toys.Clock(), name: spy}, [f"m.t -> {name}.u delay 1.5"]), 4)
    assert spy.values() == [(t / 2, max(0, (t - 3) // 2)) for t in range(1, 9)]


@pytest.mark.parametrize("delay", ["0", "1"])
@pytest.mark.parametrize("source", ["a", "z"])  # initialized before the spy, or after
def test_nothing_delayed_has_arrived_at_the_start(toys, source, delay):
    """What is read at t = 0 without a delay is the value of then."""

    class Eager(toys.EndSpy):
        def _initialize_impl(self):
            super()._initialize_impl()
            self.seen.append((0.0, 0.0, self.look()))

    spy = Eager()
    parts = {source: toys.Clock(), "m": spy}
    toys.fly(toys.wire(parts, [f"{source}.t -> m.u delay {delay}"]), 2)
    (_, first), *later = spy.values()
    assert np.isnan(first) if delay == "1" else first == 0
    assert later == [(1, 1 - float(delay)), (2, 2 - float(delay))]


class Both(Component):
    """Reads a signal at the start of its step and at its end."""

    default_rate = Rate("1")
    before = Input(unit="s", at="start")
    now = Input(unit="s")

    def _step_impl(self, t, dt):
        self.seen = [*getattr(self, "seen", []), (float(self.before[0]), float(self.now[0]))]


@pytest.mark.parametrize("rate", ["1", "0.5"])
def test_what_is_read_at_the_start_is_that_of_the_step_before(toys, rate):
    """Also where the source steps first, because it is read at the end too."""
    both = Both()
    parts = {"clock": toys.Clock(rate=Rate(rate)), "both": both}
    toys.fly(toys.wire(parts, ["clock.t -> both.before", "clock.t -> both.now"]), 3)
    assert both.seen == [(0, 1), (1, 2), (2, 3)]


def test_a_delay_and_a_start_read_add_up(toys):
    spy = toys.StartSpy()
    toys.fly(toys.wire({"m": toys.Clock(), "a": spy}, ["m.t -> a.u delay 2"]), 6)
    assert [v for _, v in spy.values()] == [0, 0, 0, 1, 2, 3]


def test_a_delay_refines_the_base_step(toys):
    spy = toys.EndSpy()
    system = toys.wire({"m": toys.Clock(), "a": spy}, ["m.t -> a.u delay 1/3"])
    simulation = toys.fly(system, 3)
    assert str(simulation.plan.base) == "1/3"
    assert [v for _, v in spy.values()] == [0, 1, 2]


def test_delays_that_cannot_be_are_refused(toys):
    with pytest.raises(RateError, match=r"delay of 'm\.t -> a\.u' is 0\.1, a binary fraction"):
        toys.wire({"m": toys.Clock(), "a": toys.EndSpy()}, []).connect("m.t", "a.u", delay=0.1)
    with pytest.raises(RateError, match="is negative"):
        toys.wire({"m": toys.Clock(), "a": toys.EndSpy()}, ["m.t -> a.u delay -1"])
    with pytest.raises(WiringError, match="not shared values or windows"):
        toys.wire({"m": toys.Clock(), "a": toys.WindowSpy()}, ["m.t -> a.u delay 1"])


def test_a_consumer_without_a_common_grid_sees_the_latest_value(toys):
    """End-read of a slower and a faster source: the last value published up to now."""
    spy = toys.EndSpy(rate=Rate("0.7"))
    with System("s") as system:
        system.add(toys.Clock(), "m")
        system.add(spy, "a")
        system.connect("m.t", "a.u")
    toys.fly(system, 7)
    assert [v for _, v in spy.values()] == [(7 * k) // 10 for k in range(1, 11)]
