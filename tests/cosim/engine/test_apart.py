"""A component that raises for one member, with all of them: that one is given up, and no other."""

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.records.results import read_result
from terrafix.cosim.system.dispersion import Dispersion


class Fussy(Component):
    """Raises at the step of a member, if it is among those it steps."""

    default_rate = Rate("1")
    x = Input((2,), unit="m")
    y = Output((2,), unit="m")
    flights = 0

    def __init__(self, when=None, **options):
        super().__init__(**options)
        self.when = when or {}

    def _initialize_impl(self):
        type(self).flights += 1
        self._raise(0)
        self.y = self.x

    def _step_impl(self, t, dt):
        self._raise(self.step_index)
        self.y = self.x + 1.0

    def _raise(self, step):
        for member, at in self.when.items():
            if step == at and member in self.environment.members:
                raise np.linalg.LinAlgError(f"{self.n_members} members at {step}")


def system_of(toys, when, part=Fussy):
    parts = {"walk": toys.Walk(rate=Rate("0.5")), "part": part(when)}
    system = toys.wire(parts, ["walk.x -> part.x"], ["walk.x", "part.y"], duration=8)
    system.disperse(Dispersion("start", ("walk.start",), [100.0, 0.1]))
    return system


def test_the_others_go_on_to_the_same_bytes(toys, tmp_path):
    out, members = tmp_path / "run.nc", [7, 2, 9, 4, 0, 11]
    healthy = simulate(system_of(toys, {}), members=members).dataset
    result = simulate(system_of(toys, {4: 3, 9: 6, 5: 1}), members=members, out=out)
    assert result.status == "complete"
    assert result.excluded == [
        {
            "member": member,
            "component": "part",
            "t_s": float(step),
            "reason": f"LinAlgError: 1 members at {step}",
        }
        for member, step in ((4, 3), (9, 6))
    ]
    assert read_result(out).identical(result.dataset)
    assert result.dataset["member"].values.tolist() == members
    for member in members:
        end = {4: 2.5, 9: 5.5}.get(member, 8)  # of the walk: it steps before the part does
        for name, last in (("walk.x", end), ("part.y", np.floor(end))):
            time = healthy[name].dims[0]
            got, right = (d[name].sel(member=member) for d in (result.dataset, healthy))
            until = slice(None, last)
            assert (
                got.sel({time: until}).values.tobytes() == right.sel({time: until}).values.tobytes()
            )
            assert np.isnan(got.sel({time: slice(last + 0.1, None)})).all()
        drawn = [d["parameter:walk.start"].sel(member=member) for d in (result.dataset, healthy)]
        assert drawn[0].values.tolist() == drawn[1].values.tolist()
    assert result.notes == [
        "'part' raised with all 6 members: 2 of them were given up, and the others flown again "
        "without them"
    ]
    assert not list(tmp_path.glob("*.parts"))


def test_one_that_raises_at_the_start_is_given_up_there(toys):
    result = simulate(system_of(toys, {1: 0}), members=3)
    assert [(e["member"], e["t_s"]) for e in result.excluded] == [(1, 0.0)]
    assert np.isnan(result.dataset["part.y"].sel(member=1)).all()
    assert np.isfinite(result.dataset["part.y"].sel(member=[0, 2])).all()


@pytest.mark.parametrize("members", [2, 40])
def test_what_raises_for_everyone_is_said_at_once(toys, members):
    class Broken(Fussy):
        flights = 0

    with pytest.raises(RunError, match=rf"'part' failed at t = 2 s \(tick 4\)\n  .*{members} mem"):
        simulate(system_of(toys, dict.fromkeys(range(members), 2), Broken), members=members)
    assert Broken.flights == 1 + min(members, 5)  # of which each was asked alone


def test_each_may_raise_at_its_own_time_until_nobody_is_left(toys):
    with pytest.raises(RunError, match="no member is left at t = 4 s\n  the last, member 2") as e:
        simulate(system_of(toys, {0: 1, 1: 3, 2: 4}), members=3)
    data = e.value.result.dataset["part.y"]
    assert np.isfinite(data.values[..., 0]).sum(axis=0).tolist() == [1, 3, 4]


def test_what_raises_only_together_costs_nobody(toys):
    class Crowded(Fussy):
        def _raise(self, step):
            if self.n_members > 2 and step == 2:
                raise RuntimeError("no room")

    healthy = simulate(system_of(toys, {}), members=4).dataset
    result = simulate(system_of(toys, {}, Crowded), members=4)
    assert result.excluded == []
    assert result.dataset["part.y"].values.tobytes() == healthy["part.y"].values.tobytes()
    assert "0 of them were given up" in result.notes[0]


def test_a_mistake_in_the_configuration_is_everybodys(toys):
    class Shared(Fussy):
        def _raise(self, step):
            if self.n_members > 1 and step == 2:
                raise ConfigurationError("one for all")

    with pytest.raises(RunError, match=r"'part' failed at t = 2 s \(tick 4\)\n  one for all"):
        simulate(system_of(toys, {}, Shared), members=4)


def test_an_interrupt_while_the_others_fly_keeps_what_was_recorded(toys, tmp_path):
    class Slow(Fussy):
        flights = 0

        def _initialize_impl(self):
            super()._initialize_impl()
            if type(self).flights > 3:
                raise KeyboardInterrupt

    out = tmp_path / "run.nc"
    with pytest.raises(RunError, match="interrupted\n  what was recorded until then is in"):
        simulate(system_of(toys, {1: 3}, Slow), members=4, out=out)
    assert read_result(out)["part.y"].shape == (3, 4, 2)  # at 0, 1 and 2 s
