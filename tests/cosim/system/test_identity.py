"""What a run is: everything that was set is in its configuration, and a difference is named."""

import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.system.check import check
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.identity import configuration, difference, first_difference
from terrafix.cosim.system.system import System


def made(toys, *, rate="2", start=1.0, delay=0, ports=("w.x",), period="4", kind=None, **spread):
    system = System("s")
    system.add(kind or toys.Walk(start=start, rate=Rate(rate)), "w")
    system.add(toys.Clock(), "b")
    system.add(toys.Clock(), "a")
    for name in "dc":
        system.add(toys.EndSpy(), name)
    system.connect("b.t", "d.u")
    system.connect("a.t", "c.u", delay=delay)
    system.record("r", list(ports), period=period)
    options = {"spread": 2.0, "targets": ("w.start",), "kind": "normal"} | spread
    system.disperse(Dispersion("p", **options))
    return configuration(check(system))


def test_a_configuration_is_everything_that_was_set(toys):
    """Written out by hand; connections are sorted, so that their order is no difference."""
    found = made(toys)
    spy = f"{toys.EndSpy.__module__}.EndSpy"
    clock = f"{toys.Clock.__module__}.Clock"
    assert found == {
        "components": {
            "w": {
                "type": f"{toys.Walk.__module__}.Walk",
                "rate": "every 2 s",
                "start": "[1.0, 1.0] m",
            },
            "b": {"type": clock, "rate": "every 1 s"},
            "a": {"type": clock, "rate": "every 1 s"},
            "d": {"type": spy, "rate": "every 1 s"},
            "c": {"type": spy, "rate": "every 1 s"},
        },
        "connections": ["a.t -> c.u", "b.t -> d.u"],
        "records": {"r": {"ports": ["w.x"], "rate": "every 4 s"}},
        "dispersions": {"p": {"kind": "normal", "spread": "[2.0, 2.0] m", "to": ["w.start"]}},
    }


@pytest.mark.parametrize(
    ("change", "part", "name"),
    [
        ({"rate": "4"}, "components", "w"),
        ({"start": 2.0}, "components", "w"),
        ({"delay": "0.5"}, "connections", None),
        ({"ports": ("w.x", "a.t")}, "records", "r"),
        ({"period": "8"}, "records", "r"),
        ({"spread": 3.0}, "dispersions", "p"),
        ({"kind": "other"}, "components", "w"),
        ({"design": "sobol"}, "dispersions", "p"),
        ({"targets": ("w.position",)}, "dispersions", "p"),
    ],
)
def test_every_change_is_another_identity_and_is_named(toys, change, part, name):
    if change.get("kind") == "other":

        class Other(toys.Walk):
            pass

        change = {"kind": Other(start=1.0, rate=Rate("2"))}
    mine, theirs = made(toys, **change), made(toys)
    found = first_difference(mine, theirs)
    assert found is not None
    assert found[:2] == (part, name)
    assert found[2] == (theirs[part] if name is None else theirs[part][name])
    assert found[3] == (mine[part] if name is None else mine[part][name])
    assert f"other {part}" in difference("configuration", mine, theirs)


def test_the_limit_of_a_truncated_draw_is_part_of_it_and_of_no_other(toys):
    def drawn(kind, limit):
        return made_of(toys, Dispersion("p", ("w.start",), 2.0, kind, limit=limit))

    assert drawn("truncated", 2.0)["limit"] == 2.0
    assert drawn("truncated", 2.0) != drawn("truncated", 3.0)
    assert drawn("uniform", 2.0) == drawn("uniform", 3.0)
    assert drawn("uniform", 3.0) != drawn("normal", 3.0)


def made_of(toys, dispersion):
    system = toys.wire({"w": toys.Walk()}, [])
    system.disperse(dispersion)
    return configuration(check(system))["dispersions"]["p"]


def test_no_difference_is_none(toys):
    assert first_difference(made(toys), made(toys)) is None
    said = difference("configuration", made(toys), made(toys))
    assert said == "the checkpoint was made with another configuration"
    text = difference("configuration", made(toys, start=2.0), made(toys))
    there, here = text.splitlines()[1:3]
    assert "[1.0, 1.0] m" in there
    assert there.endswith(" there")
    assert "[2.0, 2.0] m" in here
    assert here.endswith(" here")
