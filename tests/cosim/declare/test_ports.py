"""Declarations: what they say, what they refuse, and the arrays behind them."""

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, StepError, WiringError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import (
    BundleInput,
    BundleOutput,
    Input,
    MessageInput,
    MessageOutput,
    Output,
    SharedOutput,
    State,
)
from terrafix.cosim.memory.fields import Field

PRIOR = {
    "r": Field((3,), "m", "e"),
    "q": Field((4,)),
    "P": Field((2, 2), "m^2"),
    "age": Field((), "s"),
}


class Predict(Component):
    default_rate = Rate("1")
    prior = BundleOutput(PRIOR, doc="before the fix")

    def _initialize_impl(self):
        self._step_impl(0.0, 0.0)

    def _step_impl(self, t, dt):
        self.prior.r = np.arange(3.0) + t
        self.prior.q[:, 3] = 1.0
        self.prior.q[:, :3] = 0.0
        self.prior.P = np.eye(2) * t
        self.prior.age = t


class User(Component):
    default_rate = Rate("1")
    prior = BundleInput(
        {k: Field(f.shape, "km" if k == "r" else f.unit, f.frame) for k, f in PRIOR.items()}
    )

    def _step_impl(self, t, dt):
        self.seen = {k: getattr(self.prior, k).copy() for k in PRIOR}


def test_a_declaration_is_found_on_the_class_and_an_array_on_a_running_component(toys):
    assert isinstance(toys.Walk.x, Output)
    assert toys.Walk.x.single.unit == "m"
    walk = toys.Walk()
    assert list(walk.outputs()) == ["x"]
    assert str(walk["x"]) == "(unnamed).x"
    toys.fly(toys.wire({"w": walk}, []), 1, members=5)
    assert walk.x.shape == walk.position.shape == walk.start.shape == (5, 2)
    assert walk.x.flags.c_contiguous


def test_a_reader_looks_at_the_memory_of_the_source(toys):
    """No copy where nothing is converted, latched or delayed."""
    system = toys.wire(
        {"c": toys.Clock(), "e": toys.EndSpy(), "s": toys.StartSpy()}, ["c.t -> e.u", "c.t -> s.u"]
    )
    simulation = toys.fly(system, 1)
    source = simulation.master.wiring.slots["c.t"].data
    assert np.shares_memory(system.nodes["e"].u, source)
    assert np.shares_memory(system.nodes["s"].u, source)


def test_inputs_cannot_be_written(toys):
    spy = toys.EndSpy()
    toys.fly(toys.wire({"c": toys.Clock(), "e": spy}, ["c.t -> e.u"]), 1)
    with pytest.raises(ValueError, match="read-only"):
        spy.u[0] = 1.0
    with pytest.raises(AttributeError, match="'u' is an input: components do not write"):
        spy.u = 1.0


def test_bundles_carry_fields_by_name_each_converted(toys):
    user = User()
    toys.fly(toys.wire({"p": Predict(), "u": user}, ["p.prior -> u.prior"]), 2, members=2)
    np.testing.assert_array_equal(user.seen["r"], [[0.002, 0.003, 0.004]] * 2)
    np.testing.assert_array_equal(user.seen["q"], [[0, 0, 0, 1]] * 2)
    np.testing.assert_array_equal(user.seen["P"], [2 * np.eye(2)] * 2)
    np.testing.assert_array_equal(user.seen["age"], [2, 2])
    with pytest.raises(
        AttributeError, match=r"no field 'v'; the fields are \['r', 'q', 'P', 'age'\]"
    ):
        _ = user.prior.v
    with pytest.raises(AttributeError, match="field 'r' is an input"):
        user.prior.r = 0.0


def test_bundles_and_messages_are_not_assigned(toys):
    predict, send = Predict(), toys.Sender()
    toys.fly(toys.wire({"p": predict, "s": send}, []), 1)
    with pytest.raises(AttributeError, match="'prior' is a bundle: assign to its fields"):
        predict.prior = 0.0
    with pytest.raises(AttributeError, match=r"'note' is a message: call its publish"):
        send.note = 0.0


def test_outputs_never_published_are_nan(toys):
    class Mute(toys.Clock):
        def _initialize_impl(self):
            pass

        def _step_impl(self, t, dt):
            pass

    spy = toys.EndSpy()
    toys.fly(toys.wire({"c": Mute(), "e": spy}, ["c.t -> e.u"]), 1)
    assert np.isnan(spy.seen[0][2]).all()


def test_an_unconnected_input_reads_its_default(toys):
    class Defaulted(toys.EndSpy):
        u = Input(unit="s", default=7.0)
        v = Input((3,), default=[1.0, 2.0, 3.0])
        note = MessageInput((2,), optional=True)

        def look(self):
            return (self.u.tolist(), self.v.tolist(), self.note.fresh.tolist())

    spy = Defaulted()
    toys.fly(toys.wire({"e": spy}, []), 1, members=2)
    assert spy.seen[0][2] == ([7.0, 7.0], [[1, 2, 3], [1, 2, 3]], [False, False])


def test_shared_values_are_passed_by_reference(toys):
    source, viewer = toys.Source(), toys.Viewer()
    toys.fly(toys.wire({"s": source, "v": viewer}, ["s.image -> v.image"]), 3, members=100)
    for (t, view), published in zip(viewer.seen, source.published[1:], strict=True):
        assert view.base is published
        assert not view.flags.writeable
        assert published[0, 0].real == t


def test_shared_values_of_another_shape_or_type_are_refused(toys):
    class Wrong(toys.Source):
        def _initialize_impl(self):
            self.image = np.zeros((3, 3), dtype=np.complex64)

    text = r"'s' failed at t = 0 s .*\n  ValueError: shared port 'image' takes shape \(None, 2\)"
    with pytest.raises(StepError, match=text):
        toys.fly(toys.wire({"s": Wrong()}, []), 1)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Input(at="middle"), "read at 'start' or 'end', not 'middle'"),
        (lambda: MessageInput(queue=0), "queue depth is 0; it must be at least 1"),
        (lambda: MessageOutput(ragged=True), "needs a capacity"),
        (lambda: Output((None, 3)), r"shape \(None, 3\) is open; only shared ports may be"),
        (lambda: Output((3,), unit=("m", "s")), r"2 units for shape \(3,\)"),
        (lambda: Output((3,), labels=("x", "y")), r"2 labels for shape \(3,\)"),
        (lambda: BundleOutput({}), "a bundle needs named fields"),
        (lambda: BundleOutput({"n": Field(dtype=np.int64)}), "field 'n': bundles hold float64"),
    ],
)
def test_declarations_that_cannot_be_are_refused(make, text):
    with pytest.raises(ConfigurationError, match=text):
        make()
    assert SharedOutput((None, 3)).single.shape == (None, 3)


def test_names_of_the_contract_cannot_be_declared():
    for name in ("rate", "step", "fail", "ports", "_hidden"):
        with pytest.raises(TypeError, match=rf"declares reserved names \['{name}'\]"):
            type("Bad", (Component,), {name: State()})
    with pytest.raises(TypeError, match=r"reserved names \['offset'\]"):  # a key in system files
        type("Bad", (Component,), {"offset": Parameter(0.0)})
    type("Good", (Component,), {"offset": Output()})


def test_a_subclass_inherits_changes_and_removes_declarations(toys):
    class Changed(toys.Walk):
        x = Output((3,), unit="km")
        start = None

    assert "x" in Changed().ports
    assert Changed.x.single.shape == (3,)
    assert Changed.settings() == {}


def test_unknown_ports_are_named_with_the_nearest():
    with pytest.raises(WiringError, match=r"'User' has no port 'priro'\n  did you mean 'prior'\?"):
        User()["priro"]


def test_states_start_where_they_say(toys):
    class Counter(Component):
        default_rate = Rate("1")
        n = State(dtype=np.int64, start=5)
        q = State((4,), start=[0, 0, 0, 1])

        def _step_impl(self, t, dt):
            self.n += 1

    counter = Counter()
    toys.fly(toys.wire({"c": counter}, []), 3, members=2)
    assert counter.n.tolist() == [8, 8]
    assert counter.q.tolist() == [[0, 0, 0, 1]] * 2


@pytest.mark.parametrize("name", ["t", "count", "valid", "value", "fresh", "sequence"])
def test_what_every_message_has_cannot_name_a_field(name):
    """Else publish() takes the field for its own argument, and a reader finds something else."""
    with pytest.raises(ConfigurationError, match=f"'{name}' cannot name a field: it is what every"):
        MessageOutput(fields={"r": Field((3,)), name: Field(())})
    BundleOutput({name: Field(())})  # a signal has no such thing
