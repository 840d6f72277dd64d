"""Diagrams: every component and connection is in them, and the same system draws the same."""

import re
from itertools import pairwise

from terrafix.cosim.declare.ports import Input
from terrafix.cosim.system.graph import Diagram, _place, arrows
from terrafix.cosim.system.order import stepping_order


def loop(toys):
    """A filter with a feedback that is read at the start of the step, and a delayed spy."""
    return toys.wire(
        {
            "truth": toys.Clock(),
            "back": toys.StartSpy(),
            "late": toys.EndSpy(),
            "spy": toys.EndSpy(),
        },
        ["truth.t -> spy.u", "spy.echo -> back.u", "truth.t -> late.u delay 2"],
    )


def test_mermaid_names_components_links_and_when_they_are_read(toys):
    text = Diagram(loop(toys)).mermaid
    assert re.findall(r"<b>(\w+)</b>", text) == stepping_order(loop(toys).flatten())
    assert '"t → u"' in text
    assert '"echo → u, read at the start of the step"' in text
    assert '"t → u (delay 2 s)"' in text


def test_messages_are_dashed(toys):
    system = toys.wire({"a": toys.Sender(), "b": toys.Reader()}, ["a.note -> b.note"])
    text = Diagram(system).mermaid
    assert "-.->" in text


def test_each_kind_of_port_has_its_line_from_source_to_reader(toys):
    """Mermaid's thick line for shared values; a delay is no read at the start of the step."""
    parts = {"s": toys.Source(), "v": toys.Viewer(), "c": toys.Clock(), "e": toys.EndSpy()}
    system = toys.wire(parts, ["s.image -> v.image", "c.t -> e.u delay 1/2"])
    lines = Diagram(system).mermaid.splitlines()
    assert lines[0] == "flowchart LR"
    boxes = {line.split('["<b>')[0].strip(): line.split("<b>")[1][0] for line in lines[1:5]}
    assert sorted(boxes.values()) == ["c", "e", "s", "v"]
    links = [re.fullmatch(r' +(c\d) (\S+)\|"(.*)"\| (c\d)', line).groups() for line in lines[5:]]
    found = {(boxes[a], arrow, label, boxes[b]) for a, arrow, label, b in links}
    assert found == {
        ("s", "==>", "image", "v"),
        ("c", "-->", "t → u (delay 0.5 s)", "e"),
    }


def test_layers_count_the_reads_within_a_tick(toys):
    """a -> b -> c, and x, which c alone reads, stands next to it; what runs back counts nothing."""

    class Two(toys.EndSpy):
        v = Input(unit="s")

    parts = {"a": toys.Clock(), "b": toys.EndSpy(), "c": Two(), "x": toys.Clock()}
    parts["back"] = toys.StartSpy()
    links = ["a.t -> b.u", "b.echo -> c.u", "x.t -> c.v", "c.echo -> back.u"]
    flat = toys.wire(parts, links).flatten()
    drawn = arrows(flat)
    assert {a.source: a.back for a in drawn} == {"a": False, "b": False, "x": False, "c": True}
    boxes, _ = _place(stepping_order(flat), drawn)
    assert {p: boxes[p].layer for p in parts} == {"a": 0, "b": 1, "c": 2, "x": 1, "back": 0}


def test_sources_stand_left_of_readers_and_nothing_overlaps(toys):
    flat = loop(toys).flatten()
    order = stepping_order(flat)
    boxes, columns = _place(order, arrows(flat))
    assert boxes["truth"].layer < boxes["spy"].layer
    for column in columns.values():
        for above, below in pairwise(column):
            gap = (boxes[above].y - boxes[above].height / 2) - (
                boxes[below].y + boxes[below].height / 2
            )
            assert gap > 0


def test_the_same_system_gives_the_same_picture(toys, tmp_path):
    for name in ("one.png", "two.png"):
        loop(toys).graph(tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
