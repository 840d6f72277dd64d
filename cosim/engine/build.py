"""From a checked system to arrays: bind components, make slots, tie every input to its source."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import read_only
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component, Environment
from terrafix.cosim.declare.ports import Port
from terrafix.cosim.memory.links import (
    CopyMessage,
    CopyShared,
    CopySignal,
    DelayLine,
    Transfer,
    default_slot,
)
from terrafix.cosim.memory.messages import MessageReader, MessageSlot, MessageWriter
from terrafix.cosim.memory.slots import BundleView, SharedSlot, SignalSlot, WindowView
from terrafix.cosim.system.check import Plan
from terrafix.cosim.system.flat import Connection
from terrafix.cosim.system.wiring import port_factor

Slot = SignalSlot | SharedSlot


@dataclass
class Wiring:
    """Everything between components while a simulation runs.

    Attributes
    ----------
    slots : dict of str to slot
        What each output published, by port path.
    before, latch, after : dict of str to list of callables
        By consumer path: transfers before it steps, and at the end of a tick in which it
        stepped; by producer path: what collects a value it has just published.
    clear : dict of str to list of callables
        By consumer path: windows to empty once it has stepped.
    copies : dict of str to callable
        By input: what fills its private copy, without delay.
    keepers : dict of str to object
        Everything with `get_state`/`set_state`, by a stable name: part of checkpoints.
    """

    slots: dict[str, Slot] = field(default_factory=dict)
    before: dict[str, list[Transfer]] = field(default_factory=lambda: defaultdict(list))
    latch: dict[str, list[Transfer]] = field(default_factory=lambda: defaultdict(list))
    after: dict[str, list[Callable[[int, float], None]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    clear: dict[str, list[Callable[[], None]]] = field(default_factory=lambda: defaultdict(list))
    copies: dict[str, Transfer] = field(default_factory=dict)
    keepers: dict[str, Any] = field(default_factory=dict)
    readers: dict[str, MessageReader] = field(default_factory=dict)


def bind_components(
    plan: Plan,
    *,
    seed: int,
    members: NDArray[np.int64],
    active: NDArray[np.bool_],
    fail: Callable[[str, NDArray[np.bool_], str], None],
    quiet: bool = False,
    end: Callable[[str, NDArray[np.bool_], str], None] | None = None,
) -> None:
    """Lend every component its environment and arrays."""
    for path, component in plan.flat.components.items():

        def report(mask: NDArray[np.bool_], reason: str, path: str = path) -> None:
            fail(path, mask, reason)

        def finish(mask: NDArray[np.bool_], reason: str, path: str = path) -> None:
            (end or fail)(path, mask, reason)

        component.bind(Environment(path, seed, members, active, report, quiet, finish, plan.epoch))


def connect_ports(plan: Plan, n_members: int, active: NDArray[np.bool_]) -> Wiring:
    """Make slots for all outputs and views for all inputs."""
    wiring = Wiring()
    components = plan.flat.components
    for path, component in components.items():
        for name, port in component.outputs().items():
            slot = _output(component, name, port, n_members, active)
            wiring.slots[f"{path}.{name}"] = wiring.keepers[f"slot:{path}.{name}"] = slot
    driven = {c.target: c for c in plan.flat.connections}
    place = {path: i for i, path in enumerate(plan.order)}
    for path, component in components.items():
        for name, port in component.inputs().items():
            connection = driven.get(f"{path}.{name}")
            if connection is None:
                _unconnected(component, name, port, n_members)
            else:
                _connect(plan, wiring, place, connection, component, name, port)
    return wiring


def _output(
    component: Component, name: str, port: Port[Any], n_members: int, active: NDArray[np.bool_]
) -> Slot:
    if port.kind == "shared":
        shared = SharedSlot(port.single, name)
        component.port_views[name] = shared
        return shared
    if port.kind == "message":
        writer = MessageWriter(port.name, port.fields, n_members, active)
        component.port_views[name] = writer
        return writer.slot
    slot = SignalSlot(port.fields, n_members)
    component.port_views[name] = (
        BundleView(slot.views, writable=True) if port.is_bundle else slot.views[""]
    )
    return slot


def _unconnected(component: Component, name: str, port: Port[Any], n_members: int) -> None:
    view: Any
    if port.kind == "shared":
        view = SharedSlot(port.single, name, value=port.default)
    elif port.kind == "message":
        view = MessageReader(MessageSlot(port.fields, n_members), depth=port.queue)
    else:
        default = 0.0 if port.default is None else port.default
        slot = default_slot(port.fields, n_members, default)
        view = _signal_view(port, slot)
        if port.window:
            view = WindowView(slot.views[""], 1, None)
    component.port_views[name] = view


def _signal_view(port: Port[Any], slot: SignalSlot) -> Any:
    return BundleView(slot.views, writable=False) if port.is_bundle else read_only(slot.views[""])


def _connect(
    plan: Plan,
    wiring: Wiring,
    place: dict[str, int],
    connection: Connection,
    component: Component,
    name: str,
    port: Port[Any],
) -> None:
    path, source_path = connection.target.rpartition(".")[0], plan.flat.owner(connection.source)
    slot = wiring.slots[connection.source]
    in_place = _reads_in_place(
        place[path], place[source_path], component.rate, plan.flat.components[source_path].rate
    )
    if isinstance(slot, SharedSlot):
        if port.at == "start" and not in_place:
            held = SharedSlot(port.single, name)
            wiring.latch[path].append(CopyShared(slot, held))
            wiring.keepers[f"copy:{connection.target}"] = slot = held
        component.port_views[name] = slot
        return
    source_port = plan.flat.port(connection.source)
    factor = port_factor(source_port, port)
    if port.window:
        source = plan.flat.components[source_path]
        capacity = _window_capacity(source.rate, component.rate)
        window = WindowView(slot.views[""], capacity, factor)
        component.port_views[name] = wiring.keepers[f"window:{connection.target}"] = window
        wiring.after[source_path].append(
            lambda tick, t: window.collect(source.scheduled(t))  # noqa: ARG005
        )
        wiring.clear[path].append(window.clear)
        return
    if port.queue > 1:
        assert isinstance(slot, MessageSlot)
        _connect_queue(plan, wiring, connection, component, name, port, slot, factor, in_place)
        return
    if connection.delay:
        private = type(slot)(source_port.fields, len(slot.data))
        line = DelayLine(slot, private, factor, int(connection.delay / plan.base))
        wiring.keepers[f"delay:{connection.target}"] = line
        wiring.after[source_path].append(lambda tick, t: line.collect(tick))  # noqa: ARG005
        (wiring.latch if port.at == "start" else wiring.before)[path].append(line)
        slot = _keep(wiring, connection, private)
    elif port.at == "start" and not in_place:
        private = type(slot)(source_port.fields, len(slot.data))
        copy = wiring.copies[connection.target] = _copy(slot, private, factor)
        wiring.latch[path].append(copy)
        slot = _keep(wiring, connection, private)
    elif factor is not None:
        private = type(slot)(source_port.fields, len(slot.data))
        copy = wiring.copies[connection.target] = _copy(slot, private, factor)
        wiring.before[path].append(copy)
        slot = _keep(wiring, connection, private)
    if isinstance(slot, MessageSlot):
        _read_message(wiring, connection, component, name, port, slot)
    else:
        component.port_views[name] = _signal_view(port, slot)


def _read_message(
    wiring: Wiring,
    connection: Connection,
    component: Component,
    name: str,
    port: Port[Any],
    slot: MessageSlot,
) -> MessageReader:
    reader = MessageReader(slot, depth=port.queue, at_zero=component.takes_messages_at_start)
    component.port_views[name] = wiring.readers[connection.target] = reader
    wiring.keepers[f"reader:{connection.target}"] = reader
    wiring.before[connection.target.rpartition(".")[0]].append(reader.refresh)
    return reader


def _connect_queue(
    plan: Plan,
    wiring: Wiring,
    connection: Connection,
    component: Component,
    name: str,
    port: Port[Any],
    slot: MessageSlot,
    factor: NDArray[np.float64] | None,
    in_place: bool,
) -> None:
    """Tie a queue to its source: every message is kept as soon as it is published or arrives.

    What the reader shows of the last message follows the queue; read at the start of a step,
    both stand still from the end of the step before.
    """
    path, source_path = connection.target.rpartition(".")[0], plan.flat.owner(connection.source)
    source, fields = slot, plan.flat.port(connection.source).fields
    latched = port.at == "start" and bool(connection.delay or not in_place)
    n_members = len(source.data)
    if factor is not None or connection.delay:
        slot = MessageSlot(fields, n_members)
        wiring.keepers[f"queue:{connection.target}"] = slot
    shown = slot
    if latched:
        shown = MessageSlot(fields, n_members)
        wiring.keepers[f"copy:{connection.target}"] = shown
    if connection.delay:
        line = DelayLine(source, slot, factor, int(connection.delay / plan.base))
        wiring.keepers[f"delay:{connection.target}"] = line
        wiring.after[source_path].append(lambda tick, t: line.collect(tick))  # noqa: ARG005
        (wiring.latch if latched else wiring.before)[path].append(line)
    elif factor is not None:
        copy = CopyMessage(source, slot, factor)
        wiring.after[source_path].append(lambda tick, t: copy(tick))  # noqa: ARG005
    if latched:
        wiring.latch[path].append(CopyMessage(slot, shown, None))
    reader = _read_message(wiring, connection, component, name, port, shown)
    if connection.delay:
        line.arrived = reader.collect
    else:
        wiring.after[source_path].append(lambda tick, t: reader.collect(slot))  # noqa: ARG005
    if latched:
        wiring.latch[path].append(lambda tick: reader.release())  # noqa: ARG005


def _keep(wiring: Wiring, connection: Connection, private: SignalSlot) -> SignalSlot:
    wiring.keepers[f"copy:{connection.target}"] = private
    return private


def _copy(source: SignalSlot, target: SignalSlot, factor: NDArray[np.float64] | None) -> Transfer:
    if isinstance(source, MessageSlot) and isinstance(target, MessageSlot):
        return CopyMessage(source, target, factor)
    return CopySignal(source, target, factor)


def _window_capacity(source: Rate | None, consumer: Rate | None) -> int:
    """Samples expected in a window; it grows if more come."""
    if source is None or source.period is None or consumer is None or consumer.period is None:
        return 16
    longest = max(consumer.period, consumer.offset)
    return math.ceil(longest / source.period) + 1


def _reads_in_place(place: int, source_place: int, rate: Rate | None, source: Rate | None) -> bool:
    """Whether a start-read may look at the source's memory when its component steps.

    It may if the source has not stepped since the start of the consumer's step: it steps after
    the consumer within a tick, and only at ticks at which the consumer steps too.
    """
    if place >= source_place or rate is None or rate.period is None:
        return False

    def on_grid(time: Fraction) -> bool:
        return time >= rate.offset and (time - rate.offset) % rate.period == 0  # type: ignore[operator]

    assert source is not None
    if source.times is not None:
        return all(on_grid(t) for t in source.times if t)
    assert source.period is not None
    first = source.offset or source.period
    return source.period % rate.period == 0 and on_grid(first)
