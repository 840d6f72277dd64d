"""A system at a prompt: what it consists of and lacks, in any state; names; check and graph."""

import re

import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError, WiringError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.graph import Diagram
from terrafix.cosim.system.system import System


class Source(Component):
    """Gives two numbers."""

    default_rate = Rate(hz=10)

    level = Parameter(unit="m", doc="how much")
    x = Output(unit="m")
    y = Output(unit="m")


class Sink(Component):
    """Takes two, one of them by another name."""

    x = Input(unit="m")
    z = Input(unit="m")


def half_built():
    system = System("half", doc="Not done.\n\nMore.", duration="1 min", members=20, seed=7)
    system.add(Source(), "source")
    system.add(Sink(), "sink")
    return system


def whole():
    """Two in a system of their own, and one that reads from it."""
    inner = System("inner")
    inner.add(Source(level=1.0), "source")
    inner.add(Sink(rate=Rate("2")), "sink")
    inner.connect("source.x", "sink.x")
    inner.expose("level", "source.y")
    inner.expose("wanted", "sink.z")
    outer = System("outer")
    outer.add(inner, "part")
    outer.add(Sink(rate=Rate("1")), "last")
    outer.connect("part.level", "last.x", delay=2)
    outer.connect("part.level", "last.z")
    outer.connect("part.source.x", "part.wanted")
    outer.record("all", ["part.level"], period="0.5")
    outer.disperse(Dispersion("spread", ("part.source.level",), "1 m"))
    return outer


def test_what_is_missing_is_listed():
    assert repr(half_built()) == (
        "System 'half': 2 components, 0 connections\n"
        "60 s, 20 members, seed 7\n"
        "Not done.\n"
        "\n"
        "component   type     steps\n"
        "────────────────────────────────\n"
        "source      Source   every 0.1 s\n"
        "sink        Sink     -\n"
        "\n"
        "missing: a value for 'source.level': it takes number [m]\n"
        "missing: a rate of 'sink'\n"
        "missing: a connection to 'sink.x'\n"
        "missing: a connection to 'sink.z'"
    )


def test_a_whole_system_is_shown_with_what_it_exposes_records_and_disperses():
    assert repr(whole()) == (
        "System 'outer': 2 components, 3 connections\n"
        "1 member, seed 0\n"
        "\n"
        "component   type                     steps\n"
        "──────────────────────────────────────────────\n"
        "part        System of 2 components\n"
        "last        Sink                     every 1 s\n"
        "\n"
        "from   to     ports\n"
        "───────────────────────────────────────────────\n"
        "part   last   level -> x (2 s late), level -> z\n"
        "part   part   source.x -> wanted\n"
        "\n"
        "records: all (1 port, every 0.5 s)\n"
        "disperses: spread (normal, of part.source.level)"
    )
    assert repr(whole()["part"]).endswith(
        "exposes: level = source.y, wanted = sink.z"
    )  # what it exposes is for others to connect: nothing is missing


def test_an_empty_system_wants_components():
    assert repr(System("empty")) == (
        "System 'empty': 0 components, 0 connections\n1 member, seed 0\n\nmissing: components"
    )


def test_html_says_the_same_and_escapes():
    system = half_built()
    system.doc = "a <b> & c"
    shown = system._repr_html_()
    assert "a &lt;b&gt; &amp; c" in shown
    words = " ".join(re.sub(r"<[^>]*>", " ", shown).split())
    for line in ("System 'half' : 2 components", "source Source every 0.1 s", "a rate of 'sink'"):
        assert line.replace("'", "&#x27;") in words


def test_a_broken_system_is_shown_with_what_is_broken():
    system = whole()
    system.remove("part")
    system.connections.append(type(whole().connections[0])("gone.x", "last.nothing"))
    system.record("all", ["gone.x"], period="0.5")
    shown = repr(system)
    assert "missing: 'gone.x', which 'gone.x -> last.nothing' names" in shown
    assert "missing: 'last.nothing', which" in shown
    assert "records: all" in shown


def test_nothing_that_is_done_to_a_system_makes_its_repr_raise():
    system = whole()
    del system["last"].ports["x"]
    assert "missing: 'last.x'" in repr(system)
    system.nodes["odd"] = 5
    assert repr(system).startswith("<System that cannot be shown: AttributeError")
    assert "cannot be shown" in system._repr_html_()
    unborn = System.__new__(System)
    assert "cannot be shown" in repr(unborn)
    assert "cannot be shown" in repr(Source.__new__(Source))


def test_many_components_are_counted_and_fit_a_screen():
    system = System("many")
    for i in range(40):
        system.add(Source(), f"s{i}")
        system.add(Sink(), f"k{i}")
        system.connect(f"s{i}.x", f"k{i}.x")
        system.record(f"r{i}", f"s{i}.x")
        system.disperse(Dispersion(f"d{i}", (f"s{i}.level",), 1.0))
    lines = repr(system).splitlines()
    assert len(lines) < 50
    assert lines[-1] == "and 114 more"
    assert "and 68 more" in lines
    assert "and 28 more" in lines
    assert all(len(line) <= 80 for line in lines)


# ---------------------------------------------------------------------- names


def test_names_lead_to_components_and_ports():
    system = whole()
    assert system["last"] is system.nodes["last"]
    assert str(system["last.x"]) == "last.x"
    assert system["part.source"].name == "source"
    assert repr(system["part.level"]) == '<part.level: Output(unit="m")>'
    assert str(system["part"]["level"]) == "part.level"
    system.connect(half := system["part.source.y"], system.add(Sink(), "more")["x"])
    assert str(half) == "source.y"
    assert str(system.connections[-1]) == "part.source.y -> more.x"


def test_an_exposed_port_goes_before_a_component_of_its_name():
    inner = System("inner")
    inner.add(Source(level=1.0), "x")
    inner.expose("x", "x.x")
    assert repr(inner["x"]) == '<inner.x: Output(unit="m")>'
    assert repr(inner["x.y"]) == '<x.y: Output(unit="m")>'


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("lasst", "system 'outer' has no component and exposes no port 'lasst'\n  did you mean 'l"),
        ("last.w", "'last' has no port 'w'\n  its ports: x, z"),
        ("part.levle", "system 'part' has no component and exposes no port 'levle'\n  did you m"),
    ],
)
def test_wrong_names_are_answered(name, text):
    with pytest.raises(WiringError) as refused:
        whole()[name]
    assert str(refused.value).startswith(text)


def test_a_component_cannot_be_connected_whole():
    system = whole()
    with pytest.raises(WiringError, match="Sink is no port\n  name one of its ports"):
        system.connect("part.level", system["last"])


def test_names_are_completed():
    assert whole()._ipython_key_completions_() == ["part", "last", "last.x", "last.z"]
    inner = whole()["part"]._ipython_key_completions_()
    assert inner == [
        "source",
        "sink",
        "level",
        "wanted",
        *("source.x", "source.y"),
        "sink.x",
        "sink.z",
    ]


def test_nodes_are_shown_by_type():
    system = whole()
    assert repr(system.nodes) == "{'part': System, 'last': Sink}"
    with pytest.raises(WiringError):
        system.replace("part", Source(level=1.0))  # it has no port "level"
    assert repr(system.nodes) == "{'part': System, 'last': Sink}"


# ---------------------------------------------------------------------- check and graph


def test_check_gives_a_plan_that_shows_itself(toys):
    system = toys.wire({"clock": toys.Clock(), "spy": toys.EndSpy()}, ["clock.t -> spy.u"])
    assert repr(system.check()) == (
        f"{system.name}: 2 components in stepping order, 1 connection, base step 1 s\n"
        "    component   type     steps\n"
        "──────────────────────────────────\n"
        "1   clock       Clock    every 1 s\n"
        "2   spy         EndSpy   every 1 s\n"
        "ok"
    )
    assert system.check().content()["order"] == ["clock", "spy"]
    assert "<table" in system.check()._repr_html_()


def test_check_looks_at_the_duration(toys):
    class Short(toys.Clock):
        def validate_duration(self, duration):
            if duration > 5:
                raise ConfigurationError(f"ends before {duration:g} s")

    system = toys.wire({"short": Short()}, [])
    system.check("5 s")
    with pytest.raises(SystemCheckError, match="ends before 6 s"):
        system.check(6)
    system.duration = None
    system.check()


def test_a_graph_is_text_here_and_a_picture_there(toys, tmp_path):
    system = toys.wire({"clock": toys.Clock(), "spy": toys.EndSpy()}, ["clock.t -> spy.u"])
    drawn = system.graph()
    assert repr(drawn) == (
        "flowchart LR\n"
        '    c0["<b>clock</b><br/>Clock<br/>every 1 s"]\n'
        '    c1["<b>spy</b><br/>EndSpy<br/>every 1 s"]\n'
        '    c0 -->|"t → u"| c1'
    )
    assert drawn._repr_svg_().lstrip().startswith("<?xml")
    assert 'style="max-width:100%' in drawn._repr_svg_()
    assert drawn.svg() == Diagram(system).svg()
    system.remove("spy")
    assert "spy" in repr(drawn), "it shows the system as it was when it was drawn"
    assert system.graph(tmp_path / "a.mmd") is None
    assert (tmp_path / "a.mmd").read_text() == system.graph().mermaid


def test_a_graph_that_cannot_be_drawn_is_answered(toys, tmp_path):
    system = toys.wire({"clock": toys.Clock()}, [])
    with pytest.raises(ConfigurationError, match=r"is no .svg or .png or .mmd file\n.*'a.svg'"):
        system.graph(tmp_path / "a.jpg")
    with pytest.raises(ConfigurationError, match="cannot write"):
        system.graph(tmp_path / "absent" / "a.svg")
    with pytest.raises(SystemCheckError):
        half_built().graph()


def test_a_plan_tells_its_numbers(toys):
    """A step of 1/4 s, the gcd of 1 s and a delay of 3/4 s; components are counted from one."""
    system = toys.wire({"c": toys.Clock(), "s": toys.EndSpy()}, ["c.t -> s.u delay 3/4"])
    plan = system.check()
    told = plan.content()
    assert (told["base_step_s"], told["base_step"]) == (0.25, "0.25 s")
    assert told["connections"] == [{"source": "c.t", "target": "s.u", "delay_s": 0.75, "at": "end"}]
    rows = [line.split() for line in repr(plan).splitlines()]
    assert [row[:2] for row in rows if row and row[0].isdigit()] == [["1", "c"], ["2", "s"]]


def test_one_is_singular_and_none_is_plural():
    empty = System("e", duration="2")
    assert "0 components, 0 connections\n2 s, 1 member, seed 0" in repr(empty)
    empty.add(Source(level=1.0), "source")
    assert "1 component, 0 connections" in repr(empty)


def test_only_what_must_be_connected_is_missing(toys):
    class Easy(toys.EndSpy):
        v = Input(default=0.0)

    shown = repr(toys.wire({"s": Easy()}, []))
    assert shown.count("missing: ") == 1
    assert "missing: a connection to 's.u'" in shown
