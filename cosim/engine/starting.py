"""Everything published at t = 0: components one by one, or several that wait for each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import Mask
from terrafix.cosim.basics.errors import ComponentError
from terrafix.cosim.declare.settling import Settling
from terrafix.cosim.engine.build import Wiring
from terrafix.cosim.engine.program import Entry
from terrafix.cosim.memory.links import DelayLine
from terrafix.cosim.memory.slots import SignalSlot
from terrafix.cosim.system.check import Plan
from terrafix.cosim.system.start import Outputs, Together

MOST_SWEEPS = 1000
STILL = 1e-12  # change of a signal, relative to one plus its size


class Starter:
    """Initializes the components of a plan once.

    Nothing delayed has arrived at t = 0, and inputs read at the start of a step have nothing to
    hold: they are NaN, whatever the order, but where a `Settling` component takes them.
    """

    def __init__(
        self,
        plan: Plan,
        entries: Mapping[str, Entry],
        wiring: Wiring,
        active: Mask,
        failed: Callable[[str, Exception], ComponentError],
    ) -> None:
        self._plan, self._entries, self._wiring = plan, entries, wiring
        self._active, self._failed = active, failed
        self._driven = {c.target for c in plan.flat.connections}
        self._published: set[str] = set()

    def start(self) -> None:
        """Initialize every component.

        Raises
        ------
        ComponentError
            If one raises.
        """
        for path, entry in self._entries.items():
            if isinstance(entry.component, Settling):
                entry.component.undriven = self._undriven(path)
        for stage in self._plan.start.stages:
            if isinstance(stage, str):
                self._initialize(stage)
                continue
            for path in stage.settling:
                self._guarded(path, self._settling(path).begin_start)
            self._together(stage)

    def _together(self, stage: Together) -> None:
        for step in stage.steps:
            if isinstance(step, str):
                self._initialize(step)
            else:
                self._settle(step)

    def _initialize(self, path: str) -> None:
        entry = self._entries[path]

        def begin() -> None:
            for transfer in entry.before:
                if not isinstance(transfer, DelayLine):
                    transfer(0)
            component = entry.component
            if isinstance(component, Settling):
                component.known_at_start = frozenset(self._take(path))
            component.initialize()

        self._guarded(path, begin)
        for collect in entry.after:
            collect(0, 0.0)
        for clear in entry.clear:
            clear()
        if entry.component.acts_at_start():
            self._published |= {f"{path}.{name}" for name in entry.component.outputs()}

    def _guarded(self, path: str, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:
            raise self._failed(path, error) from error

    # ------------------------------------------------------------------ what wait for each other

    def _settling(self, path: str) -> Settling:
        component = self._entries[path].component
        assert isinstance(component, Settling)
        return component

    def _undriven(self, path: str) -> frozenset[str]:
        inputs = self._settling(path).inputs()
        return frozenset(name for name in inputs if f"{path}.{name}" not in self._driven)

    def _take(self, path: str) -> set[str]:
        """Bring inputs up to what their sources publish, and say which have a value."""
        found = set(self._undriven(path))
        for link in self._plan.start.taken[path]:
            if link.source in self._published:
                if (copy := self._wiring.copies.get(link.target)) is not None:
                    copy(0)
                found.add(link.target.rpartition(".")[2])
        return found

    def _settle(self, step: Outputs) -> None:
        """Ask for outputs, again and again until they stand still."""
        paths = {f"{path}.{name}" for path, names in step for name in names}
        for _ in range(MOST_SWEEPS):
            moved: dict[str, Mask] = {}
            for path, names in step:
                slots = {f"{path}.{n}": self._wiring.slots[f"{path}.{n}"] for n in names}
                signals = {n: s for n, s in slots.items() if isinstance(s, SignalSlot)}
                before = {n: s.data.copy() for n, s in signals.items()}
                component, known = self._settling(path), self._take(path)
                self._guarded(path, lambda c=component, k=known, n=names: c.settle(k, n))  # type: ignore[misc]
                for name, slot in signals.items():
                    if (changed := _moved(before[name], slot.data) & self._active).any():
                        moved[name] = changed
            first = not paths <= self._published
            self._published |= paths
            if not moved and not first:
                return
        loops = [x for x in self._plan.start.loops if any(link.source in moved for link in x)]
        links = [f"'{link}'" for loop in loops for link in loop]
        if not links:
            return  # something is not finite, which is said when it is initialized
        path = next(iter(moved)).rpartition(".")[0]
        self._entries[path].component.fail(
            np.any(list(moved.values()), axis=0),
            f"at t = 0, {', '.join(links)} did not settle in {MOST_SWEEPS} repetitions\n"
            "  give one of these connections a delay, or the FMUs other start values",
        )


def _moved(old: NDArray[Any], new: NDArray[Any]) -> Mask:
    """Members of which a signal has changed, or is not finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        size = 1.0 + np.abs(new.astype(np.float64))
        change = np.abs(new.astype(np.float64) - old.astype(np.float64))
        still = (change <= STILL * size) & np.isfinite(new)
    moved: Mask = ~still.reshape(len(new), -1).all(axis=1)
    return moved
