"""The master: failures, masks, determinism, members alone and together, and what it costs."""

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, RateError, StepError
from terrafix.cosim.basics.noise import NormalStream
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System


def noisy(toys, **extra):
    """Noise, dispersion, messages that reach some members, a filter that keeps a state."""
    plan = lambda step, members: (members + step) % 3 == 0  # noqa: E731 - reads as data
    parts = {
        "walk": toys.Walk(),
        "twin": toys.Walk(rate=Rate("0.3")),
        "send": toys.Sender(plan),
        "filter": toys.Filter(rate=Rate(2)),
        **extra,
    }
    links = ["walk.x -> filter.x", "send.note -> filter.note"]
    system = toys.wire(parts, links, ["walk.x", "twin.x", "filter.y", "send.note"], duration=12)
    system.disperse(Dispersion("start", ("walk.start", "twin.start"), [100.0, 0.1]))
    return system


def columns(dataset, member):
    """The arrays of one member as bytes, by name."""
    one = dataset.sel(member=member)
    return {str(k): one[k].values.tobytes() for k in one.data_vars}


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(toys):
    first, second = (toys.payload(simulate(noisy(toys), members=5).dataset) for _ in range(2))
    assert first == second
    other = toys.payload(simulate(noisy(toys), members=5, seed=1).dataset)
    assert other["walk.x"] != first["walk.x"]
    assert other["send.note"] == first["send.note"]


@pytest.mark.parametrize("n", [1, 7, 100])
def test_a_member_of_an_ensemble_equals_the_same_member_alone(toys, n):
    whole = simulate(noisy(toys), members=n).dataset
    for member in {0, n // 2, n - 1}:
        alone = simulate(noisy(toys), members=[member]).dataset
        assert columns(whole, member) == columns(alone, member)


def test_an_ensemble_may_be_split_and_shuffled(toys):
    whole = simulate(noisy(toys), members=10).dataset
    parts = simulate(noisy(toys), members=[9, 2, 5]).dataset
    for member in (9, 2, 5):
        assert columns(whole, member) == columns(parts, member)


def test_more_components_and_recorders_change_nobodys_numbers(toys):
    plain = simulate(noisy(toys), members=3).dataset
    system = noisy(toys, another=toys.Walk(rate=Rate("0.7")), spy=toys.EndSpy())
    system.add(toys.Clock(), "clock")
    system.connect("clock.t", "spy.u")
    system.record("more", ["another.x", "filter.y"], period="0.01")
    more = simulate(system, members=3).dataset
    for name in plain.data_vars:
        assert plain[name].values.tobytes() == more[name].values.tobytes(), name


def test_a_failed_member_is_masked_and_the_others_go_on_to_the_same_bits(toys):
    healthy = simulate(noisy(toys, part=toys.Failing("none")), members=4)
    result = simulate(noisy(toys, part=toys.Failing()), members=4)
    assert result.excluded == [{"member": 1, "component": "part", "t_s": 3.0, "reason": "diverged"}]
    assert result.status == "complete"
    for member in (0, 2, 3):
        assert columns(result.dataset, member) == columns(healthy.dataset, member)
    x = result.dataset["walk.x"].sel(member=1)
    assert np.isnan(x.sel(time_walk_x=slice(3, None))).all()
    assert np.isfinite(x.sel(time_walk_x=slice(0, 2))).all()


def test_a_member_fails_once_with_its_first_reason(toys):
    parts = {"a": toys.Failing(), "b": toys.Failing()}
    assert [
        e["component"] for e in simulate(toys.wire(parts, [], duration=5), members=2).excluded
    ] == ["a"]


def test_a_run_ends_when_no_member_is_left_and_keeps_its_records(toys, tmp_path):
    out = tmp_path / "run.nc"
    with pytest.raises(
        RunError, match=r"at t = 3 s \(tick 3\)\n  the last, member 1, failed in 'part': lost"
    ) as caught:
        simulate(
            toys.wire({"part": toys.Failing("all")}, [], ["part.y"], duration=9), members=2, out=out
        )
    result = caught.value.result
    assert len(result.excluded) == 2
    assert result.dataset["part.y"].values[:3, 0].tolist() == [0, 1, 2]
    assert out.is_file()


def test_a_run_does_not_begin_without_members(toys):
    system = toys.wire({"part": toys.Failing("all at start")}, [], ["part.y"], duration=9)
    with pytest.raises(RunError, match=r"no member is left at t = 0 s \(tick 0\)") as caught:
        simulate(system, members=2)
    assert caught.value.result.component_steps == 0


def test_a_component_that_raises_is_named_with_its_time_and_the_records_are_kept(toys, tmp_path):
    system = toys.wire(
        {"walk": toys.Walk(), "zeta": toys.Failing("raise", rate=Rate("0.7"))},
        [],
        ["walk.x"],
        duration=9,
    )
    out = tmp_path / "run.nc"
    with pytest.raises(RunError) as caught:
        simulate(system, out=out)
    assert str(caught.value).splitlines() == [
        "'zeta' failed at t = 2.1 s (tick 21)",
        "  OSError: tile ends early",
        f"  what was recorded until then is in {out}",
    ]
    assert isinstance(caught.value.__cause__, StepError)
    assert isinstance(caught.value.__cause__.__cause__, OSError)
    assert caught.value.result.dataset["time"].values.tolist() == [0, 1, 2]
    assert not list(tmp_path.glob("*.parts"))
    system.nodes["walk"].start = 1.0  # nothing stays bound after a failure


def test_errors_in_initialization_and_termination_name_the_component(toys):
    class Stubborn(toys.Clock):
        def terminate(self):
            raise OSError("still open")

    class Hasty(toys.Clock):
        def _initialize_impl(self):
            raise KeyError("x")

    with pytest.raises(RunError, match=r"'a' failed at t = 0 s \(tick 0\)\n  KeyError: 'x'"):
        simulate(toys.wire({"a": Hasty()}, [], duration=2))
    system = toys.wire({"a": Stubborn(), "b": toys.Walk()}, [], ["b.x"], duration=2)
    with pytest.raises(
        RunError, match=r"'a' failed at t = 2 s \(tick 2\)\n  OSError: still open"
    ) as caught:
        simulate(system)
    assert len(caught.value.result.dataset["time"]) == 3
    system.nodes["b"].start = 1.0


def test_an_interrupt_keeps_the_records(toys):
    class Interrupted(toys.Clock):
        def _step_impl(self, t, dt):
            if t == 3:
                raise KeyboardInterrupt
            super()._step_impl(t, dt)

    with pytest.raises(RunError, match="interrupted") as caught:
        simulate(toys.wire({"c": Interrupted()}, [], ["c.t"], duration=9))
    assert caught.value.result.status == "interrupted"
    assert caught.value.result.dataset["c.t"].values[:, 0].tolist() == [0, 1, 2]


def test_every_due_component_steps_once_per_activation(toys):
    """A heap of next ticks: counts and times of mixed periods, offsets and lists."""
    rates = {
        "a": Rate("0.3"),
        "b": Rate("1/7"),
        "c": Rate("2", offset="0.5"),
        "d": Rate(hz=3),
        "e": Rate(times=["0", "0.25", "4"]),
        "f": Rate("0.3"),
    }
    system = toys.wire(
        {"m": toys.Clock()} | {k: toys.EndSpy(rate=r) for k, r in rates.items()},
        [f"m.t -> {k}.u" for k in rates],
    )
    simulation = toys.fly(system, 6)
    times = {k: [t for t, _, _ in system.nodes[k].seen] for k in rates}
    assert times["a"] == times["f"] == [k * 3 / 10 for k in range(1, 21)]
    assert times["b"] == [k / 7 for k in range(1, 43)]
    assert times["c"] == [0.5, 2.5, 4.5]
    assert times["d"] == [k / 3 for k in range(1, 19)]
    grid = float(simulation.plan.grid)
    assert times["e"] == pytest.approx([0.25, 4], abs=grid)
    assert [dt for _, dt, _ in system.nodes["c"].seen] == [0.5, 2, 2]
    assert simulation.master.component_steps == sum(map(len, times.values())) + 6


@pytest.mark.parametrize("others", [(3,), (3, 5), (3, 5, 7), (7, 5, 3), (4, 6, 3)])
@pytest.mark.parametrize("first", ["a", "z"])  # stands before and after the others
def test_all_that_is_due_at_a_tick_steps_in_one_order(toys, others, first):
    """x (1 s) -> y (2 s) -> w (1 s): at t, w sees the last even second, whoever else is due."""
    last = toys.EndSpy()
    parts = {f"m{k}": toys.Clock(rate=Rate(period)) for k, period in enumerate(others)}
    names = [f"{first}{n}" for n in "xyw"]
    parts |= dict(zip(names, (toys.Clock(), toys.EndSpy(rate=Rate(2)), last), strict=True))
    x, y, w = names
    toys.fly(toys.wire(parts, [f"{x}.t -> {y}.u", f"{y}.echo -> {w}.u"]), 60)
    assert last.values() == [(t, t - t % 2) for t in range(1, 61)]


def test_a_run_in_pieces_is_the_run_in_one(toys):
    whole = toys.fly(noisy(toys), 12, members=3)
    pieces = Simulation(noisy(toys), members=3)
    for t in ("0.1", "0.3", 5, 5, "11.99", 12):
        pieces.run_until(t)
    for one, other in zip(whole.recorders, pieces.recorders, strict=True):
        assert one.history()[1].keys() == other.history()[1].keys()
        for name, values in one.history()[1].items():
            assert values.tobytes() == other.history()[1][name].tobytes()
    with pytest.raises(
        ConfigurationError, match="cannot run to t = 3 s: this simulation stands at t = 12 s"
    ):
        pieces.run_until(3)


def test_a_step_error_raised_by_a_component_is_named_too(toys):
    class Own(toys.Clock):
        def _step_impl(self, t, dt):
            raise StepError("no convergence")

    with pytest.raises(StepError, match=r"'o' failed at t = 1 s \(tick 1\)\n  no convergence"):
        toys.fly(toys.wire({"o": Own()}, []), 1)


# ---------------------------------------------------------------------- numbers of a run


@pytest.mark.parametrize("seed", [0, 3, 3 + 2**32, 2**64 + 1])
def test_draws_are_those_of_seed_path_stream_member_and_step(toys, seed):
    """Walk adds sqrt(dt) times the numbers of its stream: here summed without a simulation."""
    members = [9, 2, 5]
    walk = toys.Walk(rate=Rate(4))
    system = System("s", seed=77)
    inner = System("inner")
    inner.add(walk, "walk")
    system.add(inner, "nav")
    toys.fly(system, 12, members=members, seed=seed)
    stream = NormalStream(seed, "nav.walk", "walk", members)
    x = np.zeros((3, 2))
    for step in (1, 2, 3):
        x = x + 2.0 * stream.draw(step, 2)
    np.testing.assert_array_equal(walk.x, x)


def test_two_streams_and_two_lengths_of_one_stream_are_drawn_apart(toys):
    class Two(toys.Clock):
        def _step_impl(self, t, dt):
            self.drawn = [self.normals(*what) for what in (("a", 1), ("a", 3), ("b", 1))]

    two = Two()
    toys.fly(toys.wire({"c": two}, []), 2, seed=5)
    for drawn, what in zip(two.drawn, (("a", 1), ("a", 3), ("b", 1)), strict=True):
        expected = NormalStream(5, "c", what[0], [0]).draw(2, what[1])
        np.testing.assert_array_equal(drawn, expected)


def test_a_system_says_seed_and_members_unless_told_otherwise(toys):
    system = toys.wire({"c": toys.Clock()}, [], seed=3, members=2)
    assert (Simulation(system).seed, len(Simulation(system).members)) == (3, 2)
    assert Simulation(system, seed=0).seed == 0
    assert Simulation(system, members=[4]).members.tolist() == [4]
    with pytest.raises(ConfigurationError, match="members is 0; an ensemble has at least 1"):
        Simulation(system, members=0)
    with pytest.raises(ConfigurationError, match=r"members \[\] must be different whole numbers"):
        Simulation(system, members=[])


def test_records_can_be_left_out(toys):
    system = toys.wire({"c": toys.Clock()}, [], ["c.t"])
    assert [r.name for r in Simulation(system).recorders] == ["c_t"]
    assert Simulation(system, recording=False).recorders == []


def test_the_nominal_run_draws_no_noise_and_no_dispersion(toys):
    walk = toys.Walk(start=[3.0, 4.0])
    system = toys.wire({"w": walk}, [])
    system.disperse(Dispersion("d", ("w.start",), 100.0))
    toys.fly(system, 5, members=2, quiet=True)
    assert walk.x.tolist() == [[3, 4], [3, 4]]


def test_failures_are_told_by_the_members_numbers(toys):
    system = toys.wire({"part": toys.Failing()}, [], duration=5)
    (failure,) = simulate(system, members=[7, 1, 3]).excluded
    assert (failure["member"], failure["t_s"]) == (1, 3.0)


def test_the_last_to_fail_is_named(toys):
    class Fading(toys.Clock):
        def _step_impl(self, t, dt):
            self.fail(self.environment.members == 10 - t, f"at {t:g}")

    system = toys.wire({"part": Fading()}, [], duration=9)
    with pytest.raises(RunError, match=r"no member is left at t = 3 s .*\n.* member 7, .*: at 3"):
        simulate(system, members=[9, 8, 7])


def test_the_first_failure_to_terminate_is_named_and_all_are_given_back(toys):
    class Stubborn(toys.Clock):
        def terminate(self):
            raise OSError(f"{self.name} is open")

    system = toys.wire({k: Stubborn() for k in "abc"}, [])
    simulation = toys.fly(system, 1)
    with pytest.raises(StepError, match=r"'a' failed at t = 1 s \(tick 1\)\n  OSError: a is open"):
        simulation.master.terminate()
    assert [c.lent for c in system.nodes.values()] == [None] * 3


def test_a_start_read_is_recorded_a_step_later_than_its_source(toys):
    """At tick k it publishes what the source published at k - 1; of t = 0, its own start."""
    spy = toys.StartSpy()
    system = toys.wire(
        {"m": toys.Clock(), "s": spy},
        [
            "m.t -> s.u",
        ],
        ["s.echo"],
    )
    data = toys.fly(system, 4).result(wall_s=0.0).dataset
    assert data["s.echo"].values[:, 0].tolist() == [0, 0, 1, 2, 3]


def test_a_run_reports_its_progress_up_to_the_end(toys):
    """1000 ticks in slices of 2, their 400th part in whole ticks; the last of them the whole."""
    told = []
    system = toys.wire({"c": toys.Clock(rate=Rate("0.01"))}, [], duration=10)
    simulate(system, progress=lambda what, part: told.append((what, part)))
    assert [part for what, part in told if what == "running"] == [k / 500 for k in range(1, 501)]


def test_a_duration_of_more_ticks_than_can_be_flown_is_refused(toys, monkeypatch):
    monkeypatch.setattr("terrafix.cosim.engine.run.MAX_TICKS", 50)
    system = toys.wire({"c": toys.Clock(rate=Rate("0.1"))}, [])
    assert simulate(system, duration=5).ticks == 50
    with pytest.raises(RateError, match=r"duration is 5\.1 s at a base step of 0\.1 s: 51 ticks"):
        simulate(system, duration="5.1")


def test_members_that_do_not_fit_into_memory_are_refused(toys, monkeypatch):
    """One port of 8 bytes: 0.8 * 4096 bytes hold 409 members."""
    sizes = {"SC_PAGE_SIZE": 1024, "SC_PHYS_PAGES": 4}
    monkeypatch.setattr("os.sysconf", sizes.__getitem__)
    system = toys.wire({"c": toys.Clock()}, [])
    assert len(Simulation(system, members=409).members) == 409
    with pytest.raises(ConfigurationError, match="410 members need more than 0 GiB"):
        Simulation(system, members=410)
