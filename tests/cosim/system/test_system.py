"""Systems: building, nesting, exposing, and every mistake reported at once."""

import pickle
from fractions import Fraction

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import (
    ComponentError,
    ConfigurationError,
    RateError,
    SystemCheckError,
    WiringError,
)
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.system.check import check
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.identity import configuration
from terrafix.cosim.system.system import System


def navigator(toys, name="inner"):
    """A filter that reads a signal from outside and exposes what it makes of it."""
    system = toys.wire(
        {"one": toys.EndSpy(), "two": toys.EndSpy()}, ["one.echo -> two.u"], name=name
    )
    system.expose("u", "one.u")
    system.expose("echo", system.nodes["two"]["echo"])
    return system


def test_nested_systems_are_flattened_for_ordering(toys):
    """Feedthrough goes into the nested system, through it, and out again, within one tick."""
    spy = toys.EndSpy()
    inner = navigator(toys)
    inner.record("inside", ["one.echo"])
    with System("outer", duration=2) as system:
        nav = system.add(inner, "nav")
        clock = system.add(toys.Clock(), "z")
        last = system.add(spy, "a")
        system.connect(clock["t"], nav["u"])
        system.connect(nav["echo"], last["u"])
        system.record("through", [nav["echo"]])
    plan = check(system)
    assert plan.order == ["z", "nav.one", "nav.two", "a"]
    result = simulate(system)
    assert spy.values() == [(1, 1), (2, 2)]
    assert result.dataset["nav.two.echo"].values[:, 0].tolist() == [0, 1, 2]
    assert result.dataset["nav.one.echo"].dims[0] == "time"


def test_systems_nest_twice_and_may_be_wired_by_path(toys):
    middle = System("middle")
    middle.add(navigator(toys), "deep")
    middle.expose("input", "deep.u")
    with System("outer") as system:
        system.add(middle, "m")
        system.add(toys.Clock(), "c")
        system.connect("c.t", "m.input")
        spy = system.add(toys.EndSpy(), "s")
        system.connect("m.deep.two.echo", "s.u")
    toys.fly(system, 1)
    assert spy.values() == [(1, 1)]
    assert system.find("m.deep.one").name == "one"
    with pytest.raises(
        ConfigurationError, match=r"no component 'm\.deep\.on'\n  did you mean 'm\.deep\.one'"
    ):
        system.find("m.deep.on")


def test_a_nested_system_flies_as_the_flat_one_does(toys):
    """The same links give the same values; noise follows the path, so parts without noise agree."""
    flat = toys.wire(
        {"c": toys.Clock(), "one": toys.EndSpy(), "two": toys.EndSpy()},
        ["c.t -> one.u", "one.echo -> two.u"],
    )
    toys.fly(flat, 3)
    outer = System("outer")
    outer.add(navigator(toys), "nav")
    outer.add(toys.Clock(), "c")
    outer.connect("c.t", "nav.u")
    toys.fly(outer, 3)
    assert outer.find("nav.two").values() == flat.find("two").values()


def test_a_system_is_not_in_two_places(toys):
    inner, outer, other = navigator(toys), System("outer"), System("other")
    outer.add(inner, "nav")
    for host, name in ((outer, "nav2"), (other, "nav")):
        with pytest.raises(ConfigurationError, match="'nav' is part of a system already"):
            host.add(inner, name)
    with pytest.raises(ConfigurationError, match="'nav' cannot contain itself"):
        inner.add(outer, "loop")
    with pytest.raises(ConfigurationError, match="this EndSpy is 'one' already; make another one"):
        outer.add(inner.nodes["one"], "again")
    outer.remove("nav")
    other.add(inner, "nav")


def test_names_that_cannot_be_are_refused(toys):
    system = System("s")
    for name in ("", "1a", "a.b", "a b"):
        with pytest.raises(ConfigurationError, match="cannot name a component"):
            system.add(toys.Clock(), name)
    with pytest.raises(ConfigurationError, match="'record' cannot name a component: it is a table"):
        system.add(toys.Clock(), "record")
    system.add(toys.Clock(), "a")
    with pytest.raises(ConfigurationError, match="has a component 'a' already"):
        system.add(toys.Clock(), "a")
    with pytest.raises(ConfigurationError, match="cannot name a system"):
        System("my system")
    with pytest.raises(RateError, match="duration is 0; it must be positive"):
        System("s", duration=0)


def test_two_drivers_are_refused_also_through_nesting(toys):
    system = toys.wire({"a": toys.Clock(), "b": toys.Clock(), "s": toys.EndSpy()}, ["a.t -> s.u"])
    with pytest.raises(
        WiringError, match=r"input 's\.u' has two drivers\n  'a\.t' is connected to it already"
    ):
        system.connect("b.t", "s.u")
    inner = navigator(toys)
    inner.add(toys.Clock(), "own")
    inner.connect("own.t", "one.u")
    outer = System("outer")
    outer.add(inner, "nav")
    outer.add(toys.Clock(), "c")
    outer.connect("c.t", "nav.u")
    with pytest.raises(
        SystemCheckError, match=r"'nav\.one\.u' has two drivers\n  'nav\.own\.t' and 'c\.t'"
    ):
        check(outer)


@pytest.mark.parametrize(
    ("source", "target", "text"),
    [
        ("c.t", "spy.v", r"'spy' has no port 'v'"),
        ("clock.t", "spy.u", r"no component 'clock' in 'clock\.t'"),
        ("c", "spy.u", r"'c' is no port; write 'component\.port'"),
        ("c.t.x", "spy.u", r"'c\.t\.x' is no port"),
        ("c.t", "nav.up", r"exposes no port 'up'\n  did you mean 'u'\?"),
        ("c.t", "nav.one.echo", "is an output; a connection ends at an input"),
    ],
)
def test_ports_that_do_not_exist_are_refused(toys, source, target, text):
    system = toys.wire({"c": toys.Clock(), "spy": toys.EndSpy(), "nav": navigator(toys)}, [])
    with pytest.raises(WiringError, match=text):
        system.connect(source, target)
    with pytest.raises(WiringError, match="belongs to no component of system 'test'; add it first"):
        system.connect(toys.Clock()["t"], "spy.u")


def test_a_component_is_replaced_by_another_on_the_same_ports(toys):
    class Playback(toys.Clock):
        def _publish(self, t):
            self.t = 100 + t

    spy = toys.EndSpy()
    system = toys.wire({"truth": toys.Clock(), "spy": spy}, ["truth.t -> spy.u"], ["truth.t"])
    old = system.nodes["truth"]
    system.remove("truth")
    with pytest.raises(SystemCheckError, match=r"'spy\.u' is not connected"):
        check(system)
    system.add(Playback(), "truth")
    system.connect("truth.t", "spy.u")
    toys.fly(system, 1)
    assert spy.values() == [(1, 101)]
    assert old.name == ""


def test_replacing_keeps_the_connections(toys):
    class Playback(toys.Clock):
        def _publish(self, t):
            self.t = 100 + t

    spy = toys.EndSpy()
    system = toys.wire({"truth": toys.Clock(), "spy": spy}, ["truth.t -> spy.u"])
    system.replace("truth", Playback())
    toys.fly(system, 1)
    assert spy.values() == [(1, 101)]


def test_a_component_that_does_not_fit_replaces_nothing(toys):
    system = toys.wire({"truth": toys.Clock(), "spy": toys.EndSpy()}, ["truth.t -> spy.u"])
    before = list(system.connections)
    misfit = toys.EndSpy()
    with pytest.raises(WiringError, match="'truth' has no port 't'"):
        system.replace("truth", misfit)
    assert system.connections == before
    assert (system.nodes["truth"].name, misfit.name) == ("truth", "")
    check(system)


def nested(toys, part):
    """A part whose port is read, exposed, recorded and dispersed, beside one that stays."""
    system = toys.wire(
        {"part": part, "spy": toys.EndSpy(), "other": toys.Clock()}, ["part.t -> spy.u"]
    )
    system.record("both", ["part.t", "other.t"])
    system.record("part", ["part.t"])
    system.expose("time", "part.t")
    system.expose("spied", "spy.echo")
    system.disperse(Dispersion("late", ("part.t0",), "1 s"))
    return system


class Late(Component):
    """A clock that may start late."""

    default_rate = Rate("1")
    t0 = Parameter(0.0, unit="s")
    t = Output(unit="s")

    def _step_impl(self, t, dt):
        self.t = t + self.t0


def test_what_is_removed_is_gone_from_all_that_named_it(toys):
    system = nested(toys, Late())
    system.remove("part")
    assert list(system.nodes) == ["spy", "other"]
    assert system.connections == []
    assert system.exposed == {"spied": "spy.echo"}
    assert [(r.name, r.ports) for r in system.records] == [("both", ("other.t",))]
    assert system.dispersions == []


def test_what_replaces_stands_in_its_place(toys):
    system = nested(toys, Late())
    connections, exposed, records = system.connections, system.exposed, system.records
    system.replace("part", Late(t0="5 s"))
    assert list(system.nodes) == ["part", "spy", "other"]
    assert (system.connections, system.exposed, system.records) == (connections, exposed, records)
    assert len(system.dispersions) == 1
    check(system)


def test_what_does_not_fit_leaves_all_as_it_was(toys):
    """A nested system, one whose exposed port is not there, and one that cannot be prepared."""
    inner = System("inner")
    inner.add(Late(), "clock")
    inner.expose("t", "clock.t")
    system = System("test")
    system.add(inner, "part")
    system.add(toys.EndSpy(), "spy")
    system.expose("time", "part.t")
    other = System("other_name")
    other.add(Late(), "clock")
    before = dict(system.nodes)
    with pytest.raises(WiringError, match="exposes no port 't'"):  # but it is exposed on
        system.replace("part", other)
    assert dict(system.nodes) == before
    assert (inner._contained, other._contained, other.name) == (True, False, "other_name")
    with pytest.raises(ConfigurationError, match="part of a system already"):
        System("third").add(inner, "taken")
    other.expose("t", "clock.t")
    system.replace("part", other)
    System("third").add(inner, "free")

    class Broken(Component):
        def prepare(self):
            raise ConfigurationError("no file")

    broken, taken = Broken(), system.nodes["spy"]
    with pytest.raises(ConfigurationError, match="no file"):
        system.replace("part", broken)
    assert broken.name == ""
    with pytest.raises(ConfigurationError, match="this EndSpy is 'spy' already"):
        system.replace("part", taken)
    assert (taken.name, system.nodes["part"]) == ("spy", other)


def test_a_port_is_exposed_under_one_name_once(toys):
    system = nested(toys, Late())
    with pytest.raises(ConfigurationError, match=r"exposes 'part\.t' as 'time' already"):
        system.expose("time", "other.t")


@pytest.mark.parametrize(
    "error",
    [
        SystemCheckError("s", [WiringError("a"), RateError("b")], "s.toml"),
        ComponentError("nav.imu", 7, 0.07, "ValueError: no"),
    ],
)
def test_errors_cross_from_process_to_process_whole(error):
    """A worker of a campaign raises what its parent is told."""
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again)) == (type(error), str(error))
    assert [*map(str, vars(again).values())] == [*map(str, vars(error).values())]


class Needy(Component):
    needed = Parameter(unit="m")
    u = Input((3,), unit="m", frame="e")
    y = Output((3,), unit="m", frame="e")

    def validate(self):
        raise ConfigurationError("never reached: a parameter is missing")


def test_all_mistakes_are_reported_together(toys):
    class Wrong(toys.EndSpy):
        u = Input((2,), unit="furlongs/parsek")

        def validate(self):
            raise ConfigurationError("'wrong' has a bad combination")

    system = toys.wire(
        {"needy": Needy(), "a": toys.EndSpy(), "b": toys.EndSpy(), "wrong": Wrong()},
        ["a.echo -> b.u", "b.echo -> a.u"],
    )
    system.record("h", ["needy.z"])
    system.record("both", ["a.echo", "needy.y"])
    system.disperse(Dispersion("d", ("needy.nothing",), 1))
    with pytest.raises(SystemCheckError) as caught:
        check(system)
    text = str(caught.value)
    assert text.startswith("system 'test' has 10 problems\n")
    for part in (
        "'needy' needs a value for 'needed': it takes number [m]",
        "'needy' has no rate",
        "input 'needy.u' is not connected and has no default\n  no output of the system has",
        "'wrong' has a bad combination",
        "'furlongs/parsek' is not a unit",
        "input 'wrong.u' is not connected",
        "'needy' has no port 'z'",
        "feeds 'needy.nothing', which is no numeric parameter",
        "algebraic loop",
    ):
        assert part in text
    assert len({type(p) for p in caught.value.problems}) == 3


def test_an_unconnected_input_names_what_would_fit(toys):
    system = toys.wire({"c": toys.Clock(), "s": toys.EndSpy(), "w": toys.Walk()}, [])
    text = r"outputs of the same shape, unit and frame: 'c\.t'$"
    with pytest.raises(SystemCheckError, match=text):
        check(system)


def test_a_connection_hands_nothing_on_from_the_future(toys):
    system = toys.wire({"c": toys.Clock(), "s": toys.EndSpy()}, [])
    for delay in (-1, "-1/1000"):
        with pytest.raises(RateError, match=r"delay of 'c\.t -> s\.u' is negative"):
            system.connect("c.t", "s.u", delay=delay)
    system.connect("c.t", "s.u", delay="1/1000")
    assert system.connections[0].delay == Fraction(1, 1000)


def test_optional_inputs_and_those_with_a_default_need_no_connection(toys):
    class Easy(toys.EndSpy):
        u = Input(unit="s", default=1.0)
        v = Input(optional=True)

    assert check(toys.wire({"s": Easy()}, [])).order == ["s"]


def test_an_empty_system_is_a_mistake():
    with pytest.raises(SystemCheckError, match="the system has no components"):
        check(System("nothing"))


def test_records_that_cannot_be_are_refused(toys):
    parts = lambda: {"c": toys.Clock(), "f": toys.EndSpy(rate=Rate(2)), "s": toys.Source()}  # noqa: E731
    for ports, text in (
        (["f.u"], r"names the input 'f\.u'\s+record the output that feeds it: 'c\.t'"),
        (["s.image"], "complex64; records hold real numbers"),
        (["c.t", "f.echo"], r"different rates \(every 1 s, every 2 s\)\n  give it a period"),
    ):
        system = toys.wire(parts(), ["c.t -> f.u"])
        system.record("r", ports)
        with pytest.raises(SystemCheckError, match=text):
            check(system)
    with pytest.raises(ConfigurationError, match="record 'r' names no ports"):
        System("x").record("r", [])
    with pytest.raises(ConfigurationError, match="has a record 'r' already"):
        system.record("r", ["c.t"])


def test_records_of_nested_systems_do_not_share_a_name(toys):
    inner = navigator(toys)
    inner.record("h", ["one.echo"])
    outer = System("outer")
    outer.add(inner, "nav")
    outer.add(toys.Clock(), "c")
    outer.connect("c.t", "nav.u")
    outer.record("nav_h", ["c.t"])
    with pytest.raises(SystemCheckError, match="two records are called 'nav_h'"):
        check(outer)


def test_notes_tell_what_is_allowed_but_worth_knowing(toys):
    class Milli(toys.EndSpy):
        u = Input(unit="ms")

    system = toys.wire(
        {"c": toys.Clock(), "s": toys.StartSpy(), "m": Milli()}, ["c.t -> s.u", "c.t -> m.u"]
    )
    system.record("fine", ["c.t"], period="0.25")
    notes = " | ".join(check(system).notes)
    assert "'s.u' is read at the start of the step: it sees 'c.t' of one step earlier" in notes
    assert "'c.t -> m.u' is converted from s to ms (x 1000)" in notes
    assert "between its steps the last value is held" in notes


def test_two_simulations_of_one_system_do_not_mix(toys):
    """The later one takes the components; the earlier one refuses to go on with them."""
    system = toys.wire({"c": toys.Clock()}, [])
    first = Simulation(system)
    first.run_until(1)
    second = Simulation(system, members=3)
    with pytest.raises(
        ConfigurationError, match="another simulation of the same system has taken it"
    ):
        first.run_until(2)
    first.master.terminate()  # lets go of nothing that is not its own
    second.run_until(2)
    np.testing.assert_array_equal(system.nodes["c"].t, [2, 1002, 2002])


def test_members_are_different_whole_numbers(toys):
    system = toys.wire({"c": toys.Clock()}, [])
    for members in (0, -1, True, [], [1, 1], [-1], [0.5], [2**32]):
        with pytest.raises(ConfigurationError, match="members"):
            Simulation(system, members=members)


def test_a_component_without_a_step_is_refused_before_the_run():
    class Idle(Component):
        default_rate = Rate("1")

    system = System("test")
    system.add(Idle(), "idle")
    with pytest.raises(
        SystemCheckError, match=r"'idle' cannot step: Idle must provide _step_impl\(t, dt\)"
    ):
        check(system)


def test_a_schedule_is_all_of_its_times(toys):
    """Two schedules that differ from the fifth time on are two: for records and for identity."""
    times = ["1", "2", "3", "4", "5"], ["1", "2", "3", "4", "6"]
    flown = []
    for listed in times:
        system = System("listed", duration="8")
        system.add(toys.Clock(rate=Rate(times=listed)), "a")
        system.add(toys.Clock(rate=Rate(times=times[0])), "b")
        system.record("both", ["a.t", "b.t"])
        flown.append(system)
    identity = configuration(check(flown[0]))
    assert identity["components"]["a"]["rate"] == "at 1, 2, 3, 4, 5 s"
    with pytest.raises(SystemCheckError, match="watches components of different rates"):
        check(flown[1])
    flown[1].records.clear()
    other = configuration(check(flown[1]))
    assert other["components"]["a"] != identity["components"]["a"]


# ---------------------------------------------------------------------- base steps and notes


def test_the_base_step_divides_periods_offsets_delays_and_records(toys):
    """gcd of 1, 3/10 and 1/4 s is 1/20 s; a record of 1/7 s makes it 1/140 s, not the grid."""
    parts = {"a": toys.Clock(rate=Rate(1, offset="0.3")), "b": toys.EndSpy()}
    system = toys.wire(parts, ["a.t -> b.u delay 1/4"])
    plan = check(system)
    assert (plan.base, plan.grid) == (Fraction(1, 20), Fraction(1, 20))
    system.record("fine", ["a.t"], period="1/7")
    plan = check(system)
    assert (plan.base, plan.grid) == (Fraction(1, 140), Fraction(1, 20))


def test_listed_times_may_be_a_base_step_apart_and_no_closer(toys):
    """Beside a clock of 1 s: 0.5 s and 1.5 s are apart, 0.5 s and 1.4 s are not."""
    for times, fine in ((["0.5", "1.5"], True), (["0.5", "1.4"], False)):
        parts = {"a": toys.Clock(rate=Rate(times=times)), "b": toys.Clock()}
        if fine:
            check(toys.wire(parts, []))
        else:
            with pytest.raises(SystemCheckError, match=r"closer than the base step of 1 s"):
                check(toys.wire(parts, []))


def test_a_component_is_asked_whether_it_serves_the_duration(toys):
    class Short(toys.Clock):
        def validate_duration(self, duration):
            if duration > 5.0:
                raise ConfigurationError(f"ends before {duration:g} s")

    system = toys.wire({"c": Short()}, [], duration=6)
    for duration in (None, "5.5", "1 min"):
        with pytest.raises(SystemCheckError, match=r"ends before (6|5\.5|60) s"):
            system.check(duration)
    system.check(5)
    check(system)  # not said: not asked


@pytest.mark.parametrize(
    ("rate", "noted"),
    [
        (Rate("1"), False),
        (Rate("3"), False),
        (Rate("1", offset=2), False),
        (Rate("0.5"), True),
        (Rate("1", offset="0.5"), True),
        (Rate("1.5"), True),
    ],
)
def test_a_record_between_the_steps_of_its_source_is_noted(toys, rate, noted):
    system = toys.wire({"c": toys.Clock()}, [])
    system.record("r", ["c.t"], rate=rate)
    assert any("the last value is held" in note for note in check(system).notes) == noted


def test_equal_units_in_other_words_are_no_conversion(toys):
    class Unit(toys.EndSpy):
        u = Input(unit="second")

    notes = check(toys.wire({"c": toys.Clock(), "s": Unit()}, ["c.t -> s.u"])).notes
    assert not notes


def test_what_would_fit_has_the_same_shape_unit_and_frame_and_is_not_its_own(toys):
    class Source(Component):
        default_rate = Rate("1")
        good = Output((3,), unit="m", frame="e")
        scaled = Output((3,), unit="km", frame="e")
        turned = Output((3,), unit="m", frame="i")
        short = Output((2,), unit="m", frame="e")

        def _step_impl(self, t, dt):
            pass

    class Sink(Source):
        u = Input((3,), unit="m", frame="e")

    with pytest.raises(SystemCheckError) as caught:
        check(toys.wire({"source": Source(), "sink": Sink()}, []))
    (problem,) = caught.value.problems
    assert str(problem).endswith("unit and frame: 'source.good'")


def test_a_component_that_never_steps_needs_no_step():
    class Map(Component):
        default_rate = Rate(times=[0])
        height = Output(unit="m")

        def _initialize_impl(self):
            self.height = 8.0

    system = System("still", duration=1)
    system.add(Map(), "map")
    simulation = Simulation(system)
    simulation.run_until(1)
    assert system.nodes["map"].height.tolist() == [8.0]
    assert simulation.master.component_steps == 0


def test_delays_rates_and_dispersions_come_through_nesting_and_replacing(toys):
    inner = toys.wire({"c": toys.Clock(), "s": toys.EndSpy()}, ["c.t -> s.u delay 2"])
    inner.add(toys.Walk(), "w")
    inner.record("own", ["s.echo"], period="0.5")
    inner.disperse(Dispersion("d", ("w.start",), 1.0))
    inner.replace("s", toys.EndSpy())
    outer = System("outer")
    outer.add(inner, "in")
    flat = outer.flatten()
    assert [(c.source, c.target, c.delay) for c in flat.connections] == [("in.c.t", "in.s.u", 2)]
    assert [(r.name, r.ports, r.rate) for r in flat.records] == [
        ("in_own", ("in.s.echo",), Rate("0.5"))
    ]
    assert [(d.name, d.targets) for d in flat.dispersions] == [("in.d", ("in.w.start",))]
    outer.add(toys.EndSpy(), "out")
    outer.connect("in.c.t", "out.u", delay=3)
    assert outer.flatten().connections[1].delay == 3
