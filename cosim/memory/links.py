"""How values get from a slot to a reader when it is not the slot itself.

A direct link costs nothing: the reader's view is the slot's memory. The others are a private copy
and a `Transfer` that fills it: before the consumer steps (unit conversion, delay) or when the
consumer's interval begins (an input read at the start of the step).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.memory.messages import MessageSlot
from terrafix.cosim.memory.slots import Saved, SharedSlot, SignalSlot


class Transfer(Protocol):
    """Something that moves values at a defined moment of a tick."""

    def __call__(self, tick: int) -> None:
        """Move the values."""


class CopySignal:
    """Copy a signal into a private slot, converted by a factor per element."""

    def __init__(self, source: SignalSlot, target: SignalSlot, factor: FloatArray | None) -> None:
        self.source, self.target, self.factor = source, target, factor

    def __call__(self, tick: int) -> None:
        """Copy."""
        if self.factor is None:
            self.target.data[...] = self.source.data
        else:
            np.multiply(self.source.data, self.factor, out=self.target.data)


class CopyMessage:
    """Copy a message into a private slot if it changed."""

    def __init__(self, source: MessageSlot, target: MessageSlot, factor: FloatArray | None) -> None:
        self.source, self.target, self.factor = source, target, factor

    def __call__(self, tick: int) -> None:
        """Copy."""
        if self.source.version != self.target.version:
            self.target.copy_from(self.source, self.factor)


class CopyShared:
    """Hand a shared value on by reference."""

    def __init__(self, source: SharedSlot, target: SharedSlot) -> None:
        self.source, self.target = source, target

    def __call__(self, tick: int) -> None:
        """Hand on."""
        self.target.refer_to(self.source)


class DelayLine:
    """Values published at a tick, handed on a fixed number of ticks later.

    Until the delay has passed, a signal holds what was published at t = 0; a message has not
    arrived. `arrived`, if given, is called with the target for each message that is handed on.
    """

    def __init__(
        self,
        source: SignalSlot,
        target: SignalSlot,
        factor: FloatArray | None,
        delay: int,
        arrived: Callable[[Any], None] | None = None,
    ) -> None:
        self.source, self.target = source, target
        self.factor, self.delay = factor, delay
        self.arrived = arrived
        self._waiting: list[tuple[int, Saved]] = []
        self._started = False
        self._version = 0

    def collect(self, tick: int) -> None:
        """Note what the source has just published."""
        if isinstance(self.source, MessageSlot):
            if self.source.version == self._version:
                return
            self._version = self.source.version
        due = tick + self.delay
        if not self._started and not isinstance(self.source, MessageSlot):
            due = tick
        self._started = True
        self._waiting.append((due, self.source.get_state()))

    def __call__(self, tick: int) -> None:
        """Hand on what is due."""
        while self._waiting and self._waiting[0][0] <= tick:
            self.target.set_state(self._waiting.pop(0)[1])
            if self.factor is not None:
                self.target.data *= self.factor
            if self.arrived is not None:
                self.arrived(self.target)

    def get_state(self) -> Saved:
        """Arrays that reproduce the line."""
        return {
            "ticks": [due for due, _ in self._waiting],
            "values": [saved for _, saved in self._waiting],
            "started": self._started,
            "version": self._version,
        }

    def set_state(self, saved: Saved) -> None:
        """Put back what `get_state` gave."""
        self._waiting = [
            (int(due), dict(value))
            for due, value in zip(saved["ticks"], saved["values"], strict=True)
        ]
        self._started = bool(saved["started"])
        self._version = int(saved["version"])


def default_slot(fields: Any, n_members: int, default: Any) -> SignalSlot:
    """Build the slot that an unconnected input with a default reads."""
    slot = SignalSlot(fields, n_members)
    values = default if isinstance(default, dict) else {"": default}
    for name, view in slot.views.items():
        view[...] = values.get(name, 0.0)
    return slot
