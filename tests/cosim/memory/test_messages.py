"""Messages: fresh once per consumer, valid per member, queued, never mistaken for data."""

import casadi as ca
import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, StepError, SystemCheckError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import MessageInput, MessageOutput, Output, WindowInput
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.memory.fields import Field
from terrafix.models.core.model import Model

LINK = ["send.note -> read.note"]


def every(n):
    return lambda step, members: np.full(len(members), step % n == 0)


def test_a_message_is_fresh_once(toys):
    reader = toys.Reader()
    toys.fly(toys.wire({"send": toys.Sender(every(3)), "read": reader}, LINK), 7)
    assert reader.found == [(3, 0, 3.0, [3.0, 0.0]), (6, 0, 6.0, [6.0, 0.0])]


def test_a_message_is_fresh_for_each_consumer_at_its_own_rate(toys):
    fast, slow = toys.Reader(), toys.Reader(rate=Rate("4"))
    system = toys.wire(
        {"send": toys.Sender(every(3)), "read": fast, "slow": slow},
        [*LINK, "send.note -> slow.note"],
    )
    toys.fly(system, 12)
    assert [(t, validity) for t, _, validity, _ in fast.found] == [(3, 3), (6, 6), (9, 9), (12, 12)]
    assert [(t, validity) for t, _, validity, _ in slow.found] == [(4, 3), (8, 6), (12, 12)]


def test_messages_that_were_replaced_before_they_were_read_are_counted(toys):
    system = toys.wire(
        {"send": toys.Sender(), "read": toys.Reader(rate=Rate("4"))}, LINK, duration=9
    )
    result = simulate(system, members=2)
    assert result.overruns == {"read.note": 2 * 2 * 3}
    system = toys.wire({"send": toys.Sender(), "read": toys.Reader()}, LINK, duration=9)
    assert simulate(system, members=2).overruns == {}


def test_a_message_reaches_the_members_it_is_valid_for(toys):
    plan = lambda step, members: members % 2 == step % 2  # noqa: E731 - reads as data
    reader = toys.Reader()
    toys.fly(toys.wire({"send": toys.Sender(plan), "read": reader}, LINK), 4, members=[0, 1, 5])
    assert [(t, m) for t, m, _, _ in reader.found] == [
        (1, 1),
        (1, 2),
        (2, 0),
        (3, 1),
        (3, 2),
        (4, 0),
    ]
    assert all(v == [t, (0, 1, 5)[m]] for t, m, _, v in reader.found)


def test_a_message_never_written_cannot_be_taken_for_a_measurement(toys):
    nobody = lambda step, members: members == 1  # noqa: E731 - reads as data
    reader = toys.Reader()
    toys.fly(toys.wire({"send": toys.Sender(nobody), "read": reader}, LINK), 3, members=2)
    for _, fresh, value in reader.stale:
        assert fresh.tolist() == [False, True]
        assert np.isnan(value[0]).all()
    assert reader.note.t[0] != reader.note.t[0]
    assert reader.note.sequence.tolist() == [0, 3]


def test_messages_of_t_zero(toys):
    """Read at initialization by who does something then, else at the first step; never lost."""
    first, later, offset = (
        toys.FirstReader(),
        toys.Reader(),
        toys.FirstReader(rate=Rate(2, offset=2)),
    )
    parts = {"send": toys.Sender(every(50), at_start=True), "first": first, "later": later}
    system = toys.wire(
        parts | {"offset": offset}, [f"send.note -> {k}.note" for k in ("first", "later", "offset")]
    )
    toys.fly(system, 6)
    assert [t for t, *_ in first.found] == [0]
    assert [(t, v) for t, _, v, _ in later.found] == [(1, 0)]
    assert [(t, v) for t, _, v, _ in offset.found] == [(2, 0)]
    assert not any(r.overruns for r in toys.fly(system, 6).master.wiring.readers.values())


def test_messages_read_at_the_start_come_one_step_later(toys):
    """In place (the source steps on the reader's steps only) and latched."""
    for rate, expected in ((Rate(1), [4, 7]), (Rate(2), [6, 8])):
        reader = toys.StartReader(rate=rate)
        toys.fly(toys.wire({"send": toys.Sender(every(3)), "read": reader}, LINK), 8)
        assert [t for t, *_ in reader.found] == expected


def test_delayed_messages_keep_their_time_of_validity(toys):
    reader = toys.Reader(rate=Rate("0.5"))
    toys.fly(
        toys.wire({"send": toys.Sender(every(3)), "read": reader}, [LINK[0] + " delay 1.5"]), 8
    )
    assert [(t, v) for t, _, v, _ in reader.found] == [(4.5, 3), (7.5, 6)]


@pytest.mark.parametrize("delay", ["", " delay 1"])
@pytest.mark.parametrize("unit", ["m", "km"])
def test_queues_keep_every_message_in_order(toys, delay, unit):
    """Also through a unit conversion or a delay."""

    class Reader(toys.QueueReader):
        note = MessageInput((2,), unit=unit, queue=3)

    reader = Reader(rate=Rate(3))
    toys.fly(toys.wire({"send": toys.Sender(), "read": reader}, [LINK[0] + delay]), 9)
    shift, scale = 1 if delay else 0, 1e-3 if unit == "km" else 1
    for t, queued in reader.queues:
        expected = [k for k in (t - 2 - shift, t - 1 - shift, t - shift) if k > 0]
        assert [float(q["t"][0]) for q in queued] == expected
        assert [q["value"][0, 0] for q in queued] == [k * scale for k in expected]
    assert reader.note.overruns == 0


@pytest.mark.parametrize("delay", ["", " delay 1"])
@pytest.mark.parametrize("source_rate", [1, 3])  # latched, read in place
def test_queues_read_at_the_start_hold_what_came_before_the_step(toys, delay, source_rate):
    reader = toys.StartQueueReader(rate=Rate(3))
    send = toys.Sender(rate=Rate(source_rate), at_start=True)
    toys.fly(toys.wire({"send": send, "read": reader}, [LINK[0] + delay]), 12)
    shift = 1 if delay else 0
    for t, queued in reader.queues:
        window = [k for k in range(0, 13, source_rate) if t - 6 - shift < k <= t - 3 - shift]
        assert [float(q["t"][0]) for q in queued] == window
    assert [t for t, *_ in reader.found] == [t for t, q in reader.queues if q]


def test_full_queues_drop_the_oldest_and_count_it_per_member(toys):
    plan = lambda step, members: (members == 0) | (step % 4 == 0)  # noqa: E731 - reads as data
    reader = toys.QueueReader(rate=Rate(8))
    toys.fly(toys.wire({"send": toys.Sender(plan), "read": reader}, LINK), 8, members=2)
    ((_, queued),) = reader.queues
    assert [float(q["t"][0]) for q in queued] == [6, 7, 8]
    assert [q["valid"].tolist() for q in queued] == [[True, False], [True, False], [True, True]]
    assert reader.note.overruns == 5 + 1  # five of member 0, that of step 4 of member 1


class Contour(Component):
    """A ragged message: as many vertices as the step's number."""

    default_rate = Rate("1")
    outline = MessageOutput((4, 2), unit="px", ragged=True)

    def __init__(self, excess=0):
        super().__init__()
        self.excess = excess

    def _step_impl(self, t, dt):
        count = np.minimum(self.step_index + self.environment.members, 4) + self.excess
        points = np.full((self.n_members, 4, 2), np.nan)
        for m, n in enumerate(count):
            points[m, :n] = t
        self.outline.publish(t, points, count=count, valid=self.environment.members != 2)


class Tracer(Component):
    default_rate = Rate("1")
    outline = MessageInput((4, 2), unit="px", ragged=True)
    area = Output(unit="px^2")

    def _step_impl(self, t, dt):
        self.seen = [self.outline.value[m, :n].copy() for m, n in enumerate(self.outline.count)]
        self.area = [np.nansum(s) for s in self.seen]


def test_ragged_messages_carry_their_count_per_member(toys):
    trace = Tracer()
    system = toys.wire(
        {"c": Contour(), "t": trace}, ["c.outline -> t.outline"], ["c.outline"], duration=2
    )
    result = simulate(system, members=3)
    assert [len(s) for s in trace.seen] == [2, 3, 0]
    assert all((s == 2.0).all() for s in trace.seen)
    assert result.dataset["c.outline.count"].values.tolist() == [[0, 0, 0], [1, 2, 0], [2, 3, 0]]
    assert np.isnan(result.dataset["c.outline"].values[:, 2]).all()
    system.record("finer", ["c.outline"], period="0.5")
    finer = simulate(system, members=1).dataset["c.outline.count@finer"]
    assert finer.values[:, 0].tolist() == [0, 0, 1, 0, 2]  # none came in between


def test_a_ragged_message_needs_a_count_within_its_capacity(toys):
    with pytest.raises(StepError, match="'outline' holds up to 4, its count is 5"):
        toys.fly(toys.wire({"c": Contour(excess=4)}, []), 4)
    with pytest.raises(ConfigurationError, match="only a message is ragged"):
        Output((4, 2), ragged=True)


class Matcher(Component):
    """A message of several fields."""

    default_rate = Rate("1")
    match = MessageOutput(fields={"offset": Field((2,), "px"), "peak": Field()})

    def _step_impl(self, t, dt):
        self.match.publish(t - 0.5, offset=np.ones((self.n_members, 2)), **self.rest)

    rest: dict = {"peak": 0.9}  # noqa: RUF012 - replaced by the test


class MatchReader(Component):
    default_rate = Rate("1")
    match = MessageInput(fields={"offset": Field((2,), "px"), "peak": Field()})

    def _step_impl(self, t, dt):
        self.seen = (self.match.offset.tolist(), self.match.peak.tolist(), self.match.t.tolist())


def test_messages_with_fields(toys):
    reader = MatchReader()
    toys.fly(toys.wire({"m": Matcher(), "r": reader}, ["m.match -> r.match"]), 1)
    assert reader.seen == ([[1, 1]], [0.9], [0.5])
    with pytest.raises(
        AttributeError, match=r"no field 'peek'; the fields are \['offset', 'peak'\]"
    ):
        _ = reader.match.peek


def test_incomplete_messages_are_refused(toys):
    class Partial(Matcher):
        rest = {"quality": 1.0}  # noqa: RUF012 - constant

    with pytest.raises(StepError, match=r"missing \['peak'\], unknown \['quality'\]"):
        toys.fly(toys.wire({"m": Partial()}, []), 1)


def test_an_excluded_member_gets_no_more_messages(toys):
    class Quitter(toys.Sender):
        def _step_impl(self, t, dt):
            if self.step_index == 2:
                self.fail(self.environment.members == 1, "gone")
            super()._step_impl(t, dt)

    reader = toys.Reader()
    toys.fly(toys.wire({"send": Quitter(), "read": reader}, LINK), 3, members=2)
    assert [(t, m) for t, m, *_ in reader.found] == [(1, 0), (1, 1), (2, 0), (3, 0)]


# ---------------------------------------------------------------------- symbolic models


def gated_model():
    y, fresh, x, when = (
        ca.SX.sym(s, *n) for s, n in (("y", (2,)), ("f", ()), ("x", (2,)), ("t", ()))
    )
    got = fresh > 0.5
    new = ca.if_else(got, x + y, x)
    return Model(
        "gated",
        inputs={"note": y, "note.fresh": fresh, "note.t": when},
        states={"x": x},
        next={"x": new},
        outputs={
            "total": x,
            "answer.y": 2 * x,
            "answer.valid": got,
            "answer.age": ca.if_else(got, when, 0),
        },
    )


class Gated(SymbolicComponent):
    """Adds up messages and answers each."""

    default_rate = Rate("1")
    note = MessageInput((2,), unit="m")
    total = Output((2,), unit="m")
    answer = MessageOutput(fields={"y": Field((2,), "m"), "age": Field((), "s")})

    def build_model(self):
        return gated_model()


class GatedLate(Gated):
    note = MessageInput((2,), unit="m", at="start")


@pytest.mark.parametrize("kind", [Gated, GatedLate])
def test_a_symbolic_model_does_not_take_a_message_never_written_for_data(toys, kind):
    """Its numbers are NaN until then, and touch nothing; the answers go to who asked."""
    plan = lambda step, members: (members == 1) & (step % 2 == 0)  # noqa: E731 - reads as data
    system = toys.wire(
        {"send": toys.Sender(plan), "g": kind()},
        ["send.note -> g.note"],
        ["g.total", "g.answer"],
        duration=6,
    )
    result = simulate(system, members=2)
    assert result.excluded == []
    late = kind is GatedLate
    total = {False: [0, 0, 2, 2, 6, 6, 12], True: [0, 0, 0, 2, 2, 6, 6]}[late]
    assert result.dataset["g.total"].values[:, 1, 0].tolist() == total
    assert (result.dataset["g.total"].values[:, 0] == 0).all()
    answers = result.dataset["g.answer.t"].values
    assert np.isnan(answers[:, 0]).all()
    expected = [t + late for t in (2, 4, 6) if t + late <= 6]
    assert answers[np.isfinite(answers[:, 1]), 1].tolist() == expected


def test_symbolic_models_refuse_what_has_no_fixed_shape(toys):
    class Windowed(Gated):
        note = WindowInput((2,), unit="m")

    system = toys.wire({"g": Windowed(), "w": toys.Walk()}, ["w.x -> g.note"], duration=1)
    with pytest.raises(SystemCheckError, match="has an input 'note', but port 'note' is window"):
        simulate(system)
