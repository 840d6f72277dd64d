"""Diagrams: every component and connection is in them, and the same system draws the same."""

import re
from itertools import pairwise

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
