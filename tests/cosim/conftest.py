"""Small components with exactly known outputs, for the tests of the core."""

from types import SimpleNamespace

import numpy as np
import pytest

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import (
    Input,
    MessageInput,
    MessageOutput,
    Output,
    SharedInput,
    SharedOutput,
    State,
    WindowInput,
)
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.system.system import System


class Clock(Component):
    """Publishes the time of its step, plus 1000 times the member's number."""

    default_rate = Rate("1")
    t = Output(unit="s")

    def _publish(self, t):
        self.t = t + 1000.0 * self.environment.members

    def _initialize_impl(self):
        self._publish(0.0)

    def _step_impl(self, t, dt):
        self._publish(t)


class Spy(Component):
    """Remembers what its inputs showed at each step; publishes the signal it saw."""

    default_rate = Rate("1")
    echo = Output(unit="s")

    def __init__(self, **options):
        super().__init__(**options)
        self.seen = []  # (t, dt, what was seen)

    def look(self):
        return self.u.copy()

    def _initialize_impl(self):
        self.echo = 0.0

    def _step_impl(self, t, dt):
        self.seen.append((t, dt, self.look()))
        self.echo = np.where(np.isnan(self.u), -1.0, self.u)

    def values(self, member=0):
        """Time and signal of one member at each step."""
        return [(t, float(value[member])) for t, _, value in self.seen]


class EndSpy(Spy):
    """Reads at the end of its step."""

    u = Input(unit="s")


class StartSpy(Spy):
    """Reads at the start of its step."""

    u = Input(unit="s", at="start")


class WindowSpy(Spy):
    """Collects all samples since its last step."""

    u = WindowInput(unit="s")

    def look(self):
        return self.u.samples.copy(), self.u.times.copy()

    def _step_impl(self, t, dt):
        self.seen.append((t, dt, self.look()))


class Sender(Component):
    """Publishes a message to the members in `plan(step, members)` at each step."""

    default_rate = Rate("1")
    note = MessageOutput((2,), unit="m")

    def __init__(self, plan=None, at_start=False, **options):
        super().__init__(**options)
        self.plan = plan or (lambda step, members: np.ones(len(members), dtype=bool))
        self.at_start = at_start

    def _send(self, t):
        members = self.environment.members
        value = np.stack([np.full(len(members), t), members.astype(float)], axis=1)
        self.note.publish(t, value, valid=self.plan(self.step_index, members))

    def _initialize_impl(self):
        if self.at_start:
            self._send(0.0)

    def _step_impl(self, t, dt):
        self._send(t)


class Reader(Component):
    """Remembers the messages it found fresh, ``(t, member, time of validity, value)``."""

    default_rate = Rate("1")
    note = MessageInput((2,), unit="m")

    def __init__(self, **options):
        super().__init__(**options)
        self.found = []
        self.stale = []
        self.queues = []

    def _step_impl(self, t, dt):
        for m in np.flatnonzero(self.note.fresh):
            value = self.note.value[m].tolist()
            self.found.append((t, int(m), float(self.note.t[m]), value))
        self.stale.append((t, self.note.fresh.copy(), self.note.value.copy()))
        self.queues.append((t, self.note.queued))


class StartReader(Reader):
    """Reads messages at the start of its step."""

    note = MessageInput((2,), unit="m", at="start")


class QueueReader(Reader):
    """Keeps up to three unread messages."""

    note = MessageInput((2,), unit="m", queue=3)


class StartQueueReader(Reader):
    """Keeps up to three unread messages, read at the start."""

    note = MessageInput((2,), unit="m", queue=3, at="start")


class FirstReader(Reader):
    """Also reads at t = 0."""

    def _initialize_impl(self):
        self._step_impl(0.0, 0.0)


class Walk(Component):
    """A random walk, starting at a parameter."""

    default_rate = Rate("1")
    start = Parameter(0.0, shape=(2,), unit="m")
    x = Output((2,), unit="m")
    position = State((2,), unit="m")

    def _initialize_impl(self):
        self.position = self.start
        self.x = self.position

    def _step_impl(self, t, dt):
        self.position = self.position + np.sqrt(dt) * self.normals("walk", 2)
        self.x = self.position


class Filter(Component):
    """A stateful consumer of a signal and of messages."""

    default_rate = Rate("1")
    x = Input((2,), unit="m")
    note = MessageInput((2,), unit="m", at="start")
    y = Output((2,), unit="m")
    mean = State((2,), unit="m")

    def _initialize_impl(self):
        self.y = self.mean

    def _step_impl(self, t, dt):
        self.mean += 0.1 * (self.x - self.mean)
        self.mean += np.where(self.note.fresh[:, None], 1e-3 * self.note.value, 0.0)
        self.y = self.mean


class Failing(Component):
    """Fails member 1 at its third step, or everything, or raises."""

    default_rate = Rate("1")
    y = Output(unit="1")

    def __init__(self, how="member", **options):
        super().__init__(**options)
        self.how = how

    def _initialize_impl(self):
        self.y = 0.0
        if self.how == "all at start":
            self.fail(np.ones(self.n_members, dtype=bool), "hopeless")

    def _step_impl(self, t, dt):
        self.y = self.y + 1.0
        if self.step_index == 3:
            if self.how == "member":
                self.fail(self.environment.members == 1, "diverged")
            elif self.how == "all":
                self.fail(np.ones(self.n_members, dtype=bool), "lost")
            elif self.how == "raise":
                raise OSError("tile ends early")


class Source(Component):
    """Publishes a shared array: a new one each step."""

    default_rate = Rate("1")
    image = SharedOutput((None, 2), dtype=np.complex64)

    def __init__(self, **options):
        super().__init__(**options)
        self.published = []

    def _initialize_impl(self):
        self._step_impl(0.0, 0.0)

    def _step_impl(self, t, dt):
        self.published.append(np.full((3, 2), t, dtype=np.complex64))
        self.image = self.published[-1]


class Viewer(Component):
    """Remembers the shared arrays it saw."""

    default_rate = Rate("1")
    image = SharedInput((None, 2), dtype=np.complex64)

    def __init__(self, **options):
        super().__init__(**options)
        self.seen = []

    def _step_impl(self, t, dt):
        self.seen.append((t, self.image))


class StartViewer(Viewer):
    """Reads at the start."""

    image = SharedInput((None, 2), dtype=np.complex64, at="start")


def wire(parts, connections, records=(), name="test", **options):
    """A system of named components, ``"a.y -> b.u"`` connections and records."""
    system = System(name, **options)
    for key, part in parts.items():
        system.add(part, key)
    for connection in connections:
        text, _, delay = connection.partition(" delay ")
        source, target = text.split(" -> ")
        system.connect(source, target, delay=delay or 0)
    for record in records:
        system.record(record.replace(".", "_"), [record])
    return system


def fly(system, duration, **options):
    """Run without files; returns the simulation, to look inside."""
    simulation = Simulation(system, **options)
    simulation.run_until(duration)
    return simulation


def payload(dataset):
    """All arrays of a dataset as bytes, by name."""
    return {
        str(k): (v.shape, str(v.dtype), v.values.tobytes()) for k, v in dataset.variables.items()
    }


@pytest.fixture(scope="session")
def toys():
    return SimpleNamespace(
        **{
            c.__name__: c
            for c in (
                Clock,
                EndSpy,
                StartSpy,
                WindowSpy,
                Sender,
                Reader,
                StartReader,
                QueueReader,
                StartQueueReader,
                FirstReader,
                Walk,
                Filter,
                Failing,
                Source,
                Viewer,
                StartViewer,
            )
        },
        wire=wire,
        fly=fly,
        payload=payload,
    )
