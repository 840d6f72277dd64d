"""The work of a tick, made once for each combination of components that are due together.

Where these are symbolic components with nothing between them, their ticks up to the next other
event are one call of compiled code: a stretch. Others whose steps are compiled, and that follow
one another, are a chain: one call for each tick, or for many where there is nobody else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.declare.component import Component
from terrafix.cosim.engine.agenda import Group
from terrafix.cosim.engine.build import Wiring
from terrafix.cosim.kernels.chain import Chain, Compiled, CompiledStep, Copies, can_copy
from terrafix.cosim.kernels.stretch import Stretch
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.kernels.toolchain import CompilationError
from terrafix.cosim.memory.links import CopyMessage, CopySignal, Transfer
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


class Run(NamedTuple):
    """Entries that follow one another; with a chain, one call steps them."""

    entries: tuple[Entry, ...]
    chain: Chain | None


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
    runs : tuple of Run
        The entries, those that are a chain together.
    chain : Chain or None
        All of them, where it can fly many ticks in one call.
    """

    entries: tuple[Entry, ...]
    latches: tuple[Transfer, ...]
    samples: tuple[Callable[[float], None], ...]
    stretch: Stretch | None
    runs: tuple[Run, ...]
    chain: Chain | None

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


class Chains:
    """Makes runs of entries, the same chain of the same components for every program.

    Parameters
    ----------
    latches : callable
        Transfers once components have stepped, by path.
    active : ndarray of bool, shape (n_members,)
    seconds_per_tick : (int, int)
    """

    def __init__(
        self,
        latches: Callable[[str], Sequence[Transfer]],
        active: NDArray[np.bool_],
        seconds_per_tick: tuple[int, int],
    ) -> None:
        self._latches, self._active = latches, active
        self._seconds_per_tick = seconds_per_tick
        self._steps: dict[str, tuple[CompiledStep, Copies] | None] = {}
        self._made: dict[tuple[str, ...], Chain | None] = {}

    def runs(self, entries: tuple[Entry, ...]) -> tuple[Run, ...]:
        """Entries of a tick, in their order."""

        def key(entry: Entry) -> Any:
            return None if self._step(entry) is None else id(entry.group)

        found = []
        for compiled, each in groupby(entries, key):
            run = tuple(each)
            found.append(Run(run, self._chain(run) if compiled else None))
        return tuple(found)

    def _step(self, entry: Entry) -> tuple[CompiledStep, Copies] | None:
        if entry.path not in self._steps:
            self._steps[entry.path] = self._find_step(entry)
        return self._steps[entry.path]

    def _find_step(self, entry: Entry) -> tuple[CompiledStep, Copies] | None:
        if not isinstance(entry.component, Compiled) or entry.after or entry.clear:
            return None
        before = _copies(entry.before)
        step = None if before is None else entry.component.compiled_step()
        return None if before is None or step is None else (step, before)

    def _chain(self, run: tuple[Entry, ...]) -> Chain | None:
        paths = tuple(entry.path for entry in run)
        if paths not in self._made:
            found = [step for entry in run if (step := self._step(entry)) is not None]
            latches = _copies([t for path in paths for t in self._latches(path)])
            try:
                self._made[paths] = Chain(
                    [e.component for e in run if isinstance(e.component, Compiled)],
                    [step for step, _ in found],
                    [before for _, before in found],
                    latches if run[0].group.spacing else None,
                    self._active,
                    run[0].group.spacing,
                    self._seconds_per_tick,
                )
            except CompilationError:
                self._made[paths] = None
        return self._made[paths]


def _copies(transfers: Sequence[Transfer]) -> Copies | None:
    """Transfers as copies of compiled code; None where one is something else."""
    pairs = []
    for each in transfers:
        if not isinstance(each, CopySignal):
            return None
        pair = each.target.data, each.source.data, each.factor
        if not can_copy(*pair):
            return None
        pairs.append(pair)
    return Copies(pairs)
