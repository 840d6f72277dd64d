"""The work of a tick, made once for each combination of components that are due together.

Where these are symbolic components with nothing between them, their ticks up to the next other
event are one call of compiled code: a stretch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from terrafix.cosim.declare.component import Component
from terrafix.cosim.engine.agenda import Group
from terrafix.cosim.engine.build import Wiring
from terrafix.cosim.kernels.stretch import Stretch
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.memory.links import CopyMessage, Transfer
from terrafix.cosim.memory.messages import MessageReader


class Entry:
    """One component's work at a tick."""

    __slots__ = ("after", "before", "clear", "component", "group", "path", "step")

    def __init__(self, path: str, component: Component, group: Group, wiring: Wiring) -> None:
        self.path = path
        self.component = component
        self.group = group
        self.step = component.step
        self.before: tuple[Transfer, ...] = tuple(wiring.before.get(path, ()))
        self.after = tuple(wiring.after.get(path, ()))
        self.clear = tuple(wiring.clear.get(path, ()))


class Program(NamedTuple):
    """The work of a tick at which certain groups are due.

    Attributes
    ----------
    entries : tuple of Entry
        Components in the order of stepping.
    latches : tuple of callable
        Transfers to inputs that are read at the start of the next step.
    samples : tuple of callable
        Recorders.
    stretch : Stretch or None
        The same for many ticks in one call, where that is possible.
    """

    entries: tuple[Entry, ...]
    latches: tuple[Transfer, ...]
    samples: tuple[Callable[[float], None], ...]
    stretch: Stretch | None

    def settle(self, tick: int) -> bool:
        """Let readers see what came before a stretch; False if something waits to be read."""
        for entry in self.entries:
            for transfer in entry.before:
                reader = _reader(transfer)
                if reader is not None and reader.waiting:
                    return False
                transfer(tick)
        return True


def stretch_of(entries: tuple[Entry, ...], latches: tuple[Transfer, ...]) -> Stretch | None:
    """The ticks of these components as one call, if nothing else happens at them.

    None of them publishes messages, so that readers stand still once they have seen what came
    before, and copies of messages have nothing to copy.
    """
    stages = []
    for entry in entries:
        component = entry.component
        if not isinstance(component, SymbolicComponent) or entry.after or entry.clear:
            return None
        stage = component.kernel_stage
        if stage is None:
            return None
        stages.append(stage)
        for transfer in entry.before:
            if not isinstance(transfer, CopyMessage) and _reader(transfer) is None:
                return None
    if not stages or not all(isinstance(transfer, CopyMessage) for transfer in latches):
        return None
    try:
        return Stretch(stages)
    except ValueError:  # arrays that overlap
        return None


def _reader(transfer: Transfer) -> MessageReader | None:
    """The reader that a transfer refreshes, if that is all it does."""
    owner = getattr(transfer, "__self__", None)
    return owner if isinstance(owner, MessageReader) and owner.depth == 1 else None
