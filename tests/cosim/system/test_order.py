"""Stepping order and what each component sees: end-reads, start-reads, loops."""

from itertools import permutations

import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import SystemCheckError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.system.check import check


def seen(system, name):
    return system.nodes[name].values()


def test_sources_step_before_those_who_read_them_at_the_end(toys):
    """a -> m -> z and z -> b, against the alphabet: every link within one tick."""
    parts = {"z": toys.Clock, "m": toys.EndSpy, "b": toys.EndSpy, "a": toys.EndSpy}
    system = toys.wire(
        {k: c() for k, c in parts.items()}, ["z.t -> m.u", "m.echo -> b.u", "b.echo -> a.u"]
    )
    assert check(system).order == ["z", "m", "b", "a"]
    toys.fly(system, 3)
    assert seen(system, "a") == [(1, 1), (2, 2), (3, 3)]


def test_the_order_does_not_depend_on_the_order_of_declaration(toys):
    parts = {"clock": toys.Clock, "x": toys.EndSpy, "y": toys.StartSpy, "w": toys.EndSpy}
    links = ["clock.t -> x.u", "x.echo -> y.u", "y.echo -> w.u"]
    orders, views = set(), set()
    for names in permutations(parts):
        for connections in (links, links[::-1]):
            system = toys.wire({k: parts[k]() for k in names}, connections)
            orders.add(tuple(check(system).order))
            toys.fly(system, 3)
            views.add(tuple(tuple(seen(system, k)) for k in "xyw"))
    assert len(orders) == len(views) == 1


def test_a_start_read_steps_before_its_source_where_it_can_and_a_delay_prefers_nobody(toys):
    """So that the source's memory is read in place; else the order is that of the names."""
    for name, order in (("z", ["z", "m"]), ("a", ["a", "m"])):
        system = toys.wire({"m": toys.Clock(), name: toys.StartSpy()}, [f"m.t -> {name}.u"])
        assert check(system).order == order
        keepers = toys.fly(system, 2).master.wiring.keepers
        assert not [kept for kept in keepers if kept.startswith("copy:")]
    for name, order in (("z", ["m", "z"]), ("a", ["a", "m"])):
        links = [f"m.t -> {name}.u delay 2"]
        assert check(toys.wire({"m": toys.Clock(), name: toys.EndSpy()}, links)).order == order
    names = check(toys.wire({k: toys.Clock() for k in "cab"}, [])).order
    assert names == ["a", "b", "c"]


def test_start_reads_hold_what_was_published_a_step_ago(toys):
    """Jacobi: the source of the same rate, whether or not it has to step first."""
    for extra in ([], ["late.echo -> clock2.u"]):  # forces nothing / forces consumer after source
        parts = {"clock": toys.Clock(), "late": toys.StartSpy()}
        links = ["clock.t -> late.u"]
        if extra:
            parts["clock2"] = toys.EndSpy()
            links += extra
        system = toys.wire(parts, links)
        toys.fly(system, 4)
        assert seen(system, "late") == [(1, 0), (2, 1), (3, 2), (4, 3)]


class Both(Component):
    """Reads one signal at the end, another at the start."""

    default_rate = Rate("1")
    now = Input(unit="s")
    before = Input(unit="s", at="start")
    y = Output(unit="s")

    def __init__(self, **options):
        super().__init__(**options)
        self.seen = []

    def _initialize_impl(self):
        self.y = 0.0

    def _step_impl(self, t, dt):
        self.seen.append((t, float(self.now[0]), float(self.before[0])))
        self.y = t


def test_latched_start_read_where_the_source_must_step_first(toys):
    """Both reads are of one source: it has to step first, so the start-read is latched."""
    system = toys.wire(
        {"clock": toys.Clock(), "both": Both()}, ["clock.t -> both.now", "clock.t -> both.before"]
    )
    simulation = toys.fly(system, 3)
    assert "copy:both.before" in simulation.master.wiring.keepers
    assert system.nodes["both"].seen == [(1, 1, 0), (2, 2, 1), (3, 3, 2)]


def test_two_components_may_read_each_other_at_the_start(toys):
    """Jacobi both ways; each sees the other's value of one step earlier."""
    system = toys.wire(
        {"a": toys.StartSpy(), "clock": toys.Clock(), "b": Both()},
        ["b.y -> a.u", "a.echo -> b.before", "clock.t -> b.now"],
    )
    toys.fly(system, 5)
    assert seen(system, "a") == [(1, 0), (2, 1), (3, 2), (4, 3), (5, 4)]
    assert [before for _, _, before in system.nodes["b"].seen] == [0, 0, 1, 2, 3]


def held(t, dt, period, offset=0):
    """What a source with this period and offset had published at t - dt (0 before it stepped)."""
    k = (t - dt - offset) // period
    return max(offset + k * period, 0) if k >= 0 else 0


@pytest.mark.parametrize("name", ["a_reader", "z_reader"])  # before and after the source by name
@pytest.mark.parametrize(
    ("source", "reader"),
    [
        ((1, 0), (1, 0)),
        ((1, 0), (3, 0)),  # a faster source
        ((6, 0), (2, 0)),  # a slower source, in step
        ((4, 0), (3, 0)),  # incommensurate
        ((2, 1), (2, 0)),  # out of phase
        ((2, 0), (2, 1)),
        ((6, 4), (2, 2)),
        ((3, 2), (4, 3)),
        ((2, 0), (2, 4)),  # steps on the reader's grid, before the reader's first step
        ((1, 0), (1, 3)),
    ],
)
def test_start_reads_of_any_source_see_the_beginning_of_the_step(toys, source, reader, name):
    clock = toys.Clock(rate=Rate(source[0], offset=source[1]))
    spy = toys.StartSpy(rate=Rate(reader[0], offset=reader[1]))
    toys.fly(toys.wire({"m": clock, name: spy}, [f"m.t -> {name}.u"]), 24)
    assert len(spy.seen) > 5
    for t, dt, value in spy.seen:
        assert value[0] == held(t, dt, *source), (t, dt)


@pytest.mark.parametrize(
    ("times", "expected"), [(["2", "4"], [0, 2, 4, 4]), (["1", "3"], [0, 1, 3, 3])]
)
def test_start_reads_of_listed_times(toys, times, expected):
    """On the reader's steps (read in place) and between them (latched)."""
    spy = toys.StartSpy(rate=Rate(2))
    parts = {"m": toys.Clock(rate=Rate(times=times)), "z": spy, "beat": toys.Clock()}
    toys.fly(toys.wire(parts, ["m.t -> z.u"]), 8)
    assert spy.values() == list(zip([2, 4, 6, 8], expected, strict=True))


def test_start_read_of_ones_own_output(toys):
    spy = toys.StartSpy()
    system = toys.wire(
        {"clock": toys.Clock(), "own": Both(), "spy": spy},
        ["own.y -> own.before", "clock.t -> own.now", "own.y -> spy.u"],
    )
    toys.fly(system, 3)
    assert system.nodes["own"].seen == [(1, 1, 0), (2, 2, 1), (3, 3, 2)]


def test_inputs_that_have_nothing_to_hold_at_initialization_are_nan_whatever_the_names(toys):
    """Delayed and start-read inputs: never the t = 0 value of a source that came first."""
    for name in ("a", "z"):
        for connection, spy in (
            ("m.t -> {}.u delay 2", toys.EndSpy),
            ("m.t -> {}.u", toys.StartSpy),
        ):

            class AtStart(spy):
                def _initialize_impl(self):
                    self.first = self.u.copy()
                    self.echo = 0.0

            reader = AtStart()
            toys.fly(toys.wire({"m": toys.Clock(), name: reader}, [connection.format(name)]), 1)
            assert reader.first != reader.first, (name, connection)


def test_a_shared_value_read_at_the_start_is_the_one_of_a_step_ago(toys):
    """By reference and whatever the names; an end-read sees the array of its own instant."""
    for early, late in (("a", "b"), ("y", "z")):
        source, now, before = toys.Source(), toys.Viewer(), toys.StartViewer()
        system = toys.wire(
            {"m": source, early: now, late: before},
            [f"m.image -> {early}.image", f"m.image -> {late}.image"],
        )
        toys.fly(system, 3)
        assert [float(v[0, 0].real) for _, v in now.seen] == [1, 2, 3]
        assert [float(v[0, 0].real) for _, v in before.seen] == [0, 1, 2]
        for (_, view), published in zip(before.seen, source.published, strict=False):
            assert view.base is published


LOOP = """algebraic loop
  matcher.echo   -> navigator.u    connected
  navigator.u    => navigator.echo read at the end of the step
  navigator.echo -> matcher.u      connected
  matcher.u      => matcher.echo   read at the end of the step
"""


def test_a_loop_of_end_reads_is_printed_link_by_link(toys):
    system = toys.wire(
        {"navigator": toys.EndSpy(), "matcher": toys.EndSpy(), "o": toys.EndSpy()},
        ["navigator.echo -> matcher.u", "matcher.echo -> navigator.u", "matcher.echo -> o.u"],
    )
    with pytest.raises(SystemCheckError) as caught:
        check(system)
    text = str(caught.value.problems[0])
    assert text.startswith(LOOP)
    assert "read one of these inputs at the start of its step" in text


def test_the_shortest_loop_is_printed(toys):
    system = toys.wire(
        {k: toys.EndSpy() for k in "abc"} | {"d": Both()},
        ["a.echo -> b.u", "b.echo -> c.u", "d.y -> a.u", "c.echo -> d.now", "d.y -> d.before"],
    )
    with pytest.raises(SystemCheckError) as caught:
        check(system)
    assert str(caught.value.problems[0]).count("->") == 4
    system = toys.wire({"a": toys.EndSpy()}, ["a.echo -> a.u"])
    with pytest.raises(SystemCheckError, match=r"a\.echo -> a\.u    connected"):
        check(system)


def test_a_delay_or_a_start_read_opens_a_loop(toys):
    parts = {"a": toys.EndSpy(), "b": toys.EndSpy()}
    toys.fly(toys.wire(parts, ["a.echo -> b.u", "b.echo -> a.u delay 1"]), 3)
    parts = {"a": toys.StartSpy(), "b": toys.EndSpy()}
    assert check(toys.wire(parts, ["a.echo -> b.u", "b.echo -> a.u"])).order == ["a", "b"]
