"""The master: steps every component that is due, then transfers, in an order fixed beforehand.

It knows ticks, components and links, and nothing of what flows through them. Which components are
due comes from a heap of next ticks; the work of a tick is a list made once for each combination
of components that are due together. Where these are symbolic components with nothing between them,
their ticks up to the next other event are handed to one call of compiled code (`stretch`).
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import Mask
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, StepError, TerrafixError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.engine.build import Wiring, bind_components, connect_ports
from terrafix.cosim.kernels.stretch import Stretch
from terrafix.cosim.kernels.symbolic import NOT_FINITE, SymbolicComponent
from terrafix.cosim.memory.links import CopyMessage, DelayLine, Transfer
from terrafix.cosim.memory.messages import MessageReader
from terrafix.cosim.system.check import Plan
from terrafix.cosim.system.dispersion import apply_all


def _reader(transfer: Transfer) -> MessageReader | None:
    """The reader that a transfer refreshes, if that is all it does."""
    owner = getattr(transfer, "__self__", None)
    return owner if isinstance(owner, MessageReader) and owner.depth == 1 else None


class _Group:
    """Components (or one recorder) that step at the same ticks."""

    def __init__(self, rate: Rate, plan: Plan) -> None:
        self.rate = rate
        self._base, self._grid = plan.base, plan.grid
        self._numerator, self._denominator = plan.base.numerator, plan.base.denominator
        self.sample: Callable[[float], None] | None = None
        # ticks from one activation to the next; 0 where they are listed
        self.spacing = 0 if rate.period is None else int(rate.period / plan.base)
        self.move_to(0)

    def move_to(self, tick: int) -> None:
        """Stand where everything up to and including `tick` has been done."""
        self._ticks: Iterator[int] = self.rate.ticks(self._base, self._grid, after=tick)
        self.tick = self.rate.last_tick(self._base, self._grid, tick)
        self.dt = 0.0
        self.next_tick = next(self._ticks, None)

    def advance(self) -> None:
        """Move to the next activation."""
        assert self.next_tick is not None
        self.dt = (self.next_tick - self.tick) * self._numerator / self._denominator
        self.tick = self.next_tick
        self.next_tick = next(self._ticks, None)


class _Entry:
    """One component's work at a tick."""

    __slots__ = ("after", "before", "clear", "component", "group", "path", "step")

    def __init__(self, path: str, component: Component, group: _Group, wiring: Wiring) -> None:
        self.path = path
        self.component = component
        self.group = group
        self.step = component.step
        self.before: tuple[Transfer, ...] = tuple(wiring.before.get(path, ()))
        self.after = tuple(wiring.after.get(path, ()))
        self.clear = tuple(wiring.clear.get(path, ()))


class _Program(NamedTuple):
    """The work of a tick at which certain groups are due."""

    entries: tuple[_Entry, ...]
    latches: tuple[Transfer, ...]
    samples: tuple[Callable[[float], None], ...]
    stretch: Stretch | None


class Master:
    """Runs a checked system for one ensemble.

    Parameters
    ----------
    plan : Plan
        From `terrafix.cosim.system.check.check`.
    seed : int
        Root seed.
    members : ndarray of int64
        Numbers of the members to fly.
    runs : int, optional
        How many members there are in all, where these are a part.
    quiet : bool
        Draw no noise and apply no dispersion.

    Attributes
    ----------
    tick : int
        Where the run stands.
    active : ndarray of bool, shape (n_members,)
    excluded : list of dict
        Member, component, time and reason of every failure.
    component_steps : int
    """

    def __init__(
        self,
        plan: Plan,
        *,
        seed: int,
        members: NDArray[np.int64],
        runs: int | None = None,
        quiet: bool = False,
    ) -> None:
        self.plan = plan
        self.seed = seed
        self.members = members
        self.active: Mask = np.ones(len(members), dtype=np.bool_)
        self.excluded: list[dict[str, Any]] = []
        self.tick = 0
        self.component_steps = 0
        self._numerator, self._denominator = plan.base.numerator, plan.base.denominator
        bind_components(
            plan, seed=seed, members=members, active=self.active, fail=self._exclude, quiet=quiet
        )
        self._lent = {p: c.environment for p, c in plan.flat.components.items()}
        self._terminated = False
        self.draws = apply_all(
            () if quiet else plan.flat.dispersions,
            plan.flat.components,
            seed=seed,
            members=members,
            runs=int(members.max()) + 1 if runs is None else runs,
        )
        self.wiring = connect_ports(plan, len(members), self.active)
        self.groups: list[_Group] = []
        self.group_of: dict[str, int] = {}
        for path in plan.order:
            rate = plan.flat.components[path].rate
            assert rate is not None
            self.group_of[path] = self.groups.index(self._group(rate))
        self._entries = {
            path: _Entry(
                path,
                plan.flat.components[path],
                self.groups[self.group_of[path]],
                self.wiring,
            )
            for path in plan.order
        }
        self._programs: dict[tuple[int, ...], _Program] = {}
        self._heap: list[tuple[int, int]] = []

    def _group(self, rate: Rate) -> _Group:
        for group in self.groups:
            if group.rate == rate and group.sample is None:
                return group
        group = _Group(rate, self.plan)
        self.groups.append(group)
        return group

    def observe(self, rate: Rate, sample: Callable[[float], None]) -> None:
        """Call `sample(t)` at a rate, after everything due has stepped; it influences nothing."""
        group = _Group(rate, self.plan)
        group.sample = sample
        self.groups.append(group)

    def seconds(self, tick: int) -> float:
        """Time of a tick [s], by one division."""
        return tick * self._numerator / self._denominator

    def ticks(self, duration: Fraction) -> int:
        """Number of whole base steps in a duration."""
        return int(duration / self.plan.base)

    def _exclude(self, path: str, mask: Mask, reason: str) -> None:
        newly = mask & self.active
        if not newly.any():
            return
        t = self.seconds(self.tick)
        self.excluded += [
            {"member": int(m), "component": path, "t_s": t, "reason": reason}
            for m in self.members[newly]
        ]
        self.active &= ~newly

    # ------------------------------------------------------------------ running

    def initialize(self, *, observe: bool = True) -> None:
        """Publish everything at t = 0, in the order of end-reads.

        Nothing delayed has arrived then, and start-reads have nothing to hold: these inputs are
        NaN, whatever the order. `observe` is false where a saved state replaces all of it.
        """
        for entry in self._entries.values():
            try:
                for transfer in entry.before:
                    if not isinstance(transfer, DelayLine):
                        transfer(0)
                entry.component.initialize()
            except Exception as error:
                raise self._step_error(entry.path, 0, error) from error
            for collect in entry.after:
                collect(0, 0.0)
            for clear in entry.clear:
                clear()
        for path in self._entries:
            for transfer in self.wiring.latch.get(path, ()):
                transfer(0)
        self._check_members()
        for group in self.groups:
            if observe and group.sample is not None and group.rate.starts_at_zero:
                group.sample(0.0)
        self._arm()

    def _arm(self) -> None:
        self._heap = [
            (g.next_tick, i) for i, g in enumerate(self.groups) if g.next_tick is not None
        ]
        heapq.heapify(self._heap)

    def _program(self, due: tuple[int, ...]) -> _Program:
        groups = set(due)
        entries = tuple(e for p, e in self._entries.items() if self.group_of[p] in groups)
        latches = tuple(t for e in entries for t in self.wiring.latch.get(e.path, ()))
        samples = tuple(s for i in due if (s := self.groups[i].sample) is not None)
        stretch = None
        if len(due) == 1 and not samples and self.groups[due[0]].spacing:
            stretch = self._stretch(entries, latches)
        program = _Program(entries, latches, samples, stretch)
        self._programs[due] = program
        return program

    def _stretch(
        self, entries: tuple[_Entry, ...], latches: tuple[Transfer, ...]
    ) -> Stretch | None:
        """The ticks of these components as one call, if nothing else happens at them.

        None of them publishes messages, so that readers stand still once they have seen what
        came before, and copies of messages have nothing to copy.
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

    def _fly(self, program: _Program, group: _Group, number: int, end: int) -> bool:
        """Step a group's ticks from its next one on, up to `end` and before anybody else's.

        Nothing is done, and False returned, if that is only one tick, or not like the others.
        """
        assert program.stretch is not None
        assert group.next_tick is not None
        first, spacing = group.next_tick, group.spacing
        # recorders look on once the others have stepped: a stretch may end at their tick
        others = (tick - (self.groups[i].sample is None) for tick, i in self._heap if i != number)
        last = min(end, *others) if len(self._heap) > 1 else end
        n_ticks = (last - first) // spacing + 1
        if n_ticks < 2 or first - group.tick != spacing or last * self._numerator > 2**53:
            return False
        for entry in program.entries:
            for transfer in entry.before:
                reader = _reader(transfer)
                if reader is not None and reader.waiting:
                    return False
                transfer(first)
        components = [entry.component for entry in program.entries]
        dt = spacing * self._numerator / self._denominator
        failures = program.stretch.fly(
            [component.step_index + 1 for component in components],
            tick=first,
            spacing=spacing,
            n_ticks=n_ticks,
            seconds_per_tick=(self._numerator, self._denominator),
            dt=dt,
        )
        last = first + (n_ticks - 1) * spacing
        for component in components:
            assert isinstance(component, SymbolicComponent)
            component.stretched(n_ticks, self.seconds(last), dt)
        self.component_steps += n_ticks * len(components)
        for failure in failures:
            self.tick = first + failure.tick * spacing
            components[failure.stage].fail(failure.members, NOT_FINITE)
            self._check_members()
        self.tick = last
        group.move_to(last)
        self._rearm(group, number)
        return True

    def _rearm(self, group: _Group, number: int) -> None:
        if group.next_tick is None:
            heapq.heappop(self._heap)
        else:
            heapq.heapreplace(self._heap, (group.next_tick, number))

    def run_until(self, end: int) -> None:
        """Step to tick `end`.

        Raises
        ------
        StepError
            If a component fails, or no member is left. What was recorded is untouched.
        """
        if end < self.tick:
            raise ConfigurationError(
                f"cannot run to t = {self.seconds(end):.9g} s: this simulation stands at "
                f"t = {self.seconds(self.tick):.9g} s\n  make another one, or set an earlier state"
            )
        for path, component in self.plan.flat.components.items():
            if component._environment is not self._lent[path]:
                raise ConfigurationError(
                    f"'{path}' has been terminated, or another simulation of the same system has "
                    "taken it over\n  run one after the other, or build the system twice"
                )
        heap, groups, programs = self._heap, self.groups, self._programs
        numerator, denominator = self._numerator, self._denominator
        entry: _Entry | None = None
        n_excluded = len(self.excluded)
        try:
            while heap and heap[0][0] <= end:
                tick = heap[0][0]
                if all(tick < later[0] for later in heap[1:3]):  # the children of the root
                    number = heap[0][1]
                    due: tuple[int, ...] = (number,)
                    group = groups[number]
                    program = programs.get(due) or self._program(due)
                    if program.stretch is not None and self._fly(program, group, number, end):
                        n_excluded = len(self.excluded)
                        continue
                    group.advance()
                    self._rearm(group, number)
                else:
                    due = self._pop(tick)
                    program = programs.get(due) or self._program(due)
                t = tick * numerator / denominator
                self.tick = tick
                for entry in program.entries:
                    for transfer in entry.before:
                        transfer(tick)
                    entry.step(t, entry.group.dt)
                    for collect in entry.after:
                        collect(tick, t)
                    for clear in entry.clear:
                        clear()
                self.component_steps += len(program.entries)
                entry = None
                for transfer in program.latches:
                    transfer(tick)
                for sample in program.samples:
                    sample(t)
                if len(self.excluded) != n_excluded:
                    n_excluded = len(self.excluded)
                    self._check_members()
        except Exception as error:
            if entry is None and isinstance(error, StepError):  # no member is left
                raise
            where = entry.path if entry is not None else "recorder"
            raise self._step_error(where, self.tick, error) from error
        self.tick = end

    def _pop(self, tick: int) -> tuple[int, ...]:
        due = []
        while self._heap and self._heap[0][0] == tick:
            number = heapq.heappop(self._heap)[1]
            due.append(number)
            group = self.groups[number]
            group.advance()
            if group.next_tick is not None:
                heapq.heappush(self._heap, (group.next_tick, number))
        return tuple(sorted(due))

    def _check_members(self) -> None:
        if not self.active.any():
            last = self.excluded[-1]
            raise StepError(
                f"no member is left at t = {last['t_s']:.9g} s (tick {self.tick})\n"
                f"  the last, member {last['member']}, failed in '{last['component']}': "
                f"{last['reason']}"
            )

    def _step_error(self, path: str, tick: int, error: Exception) -> StepError:
        cause = (
            str(error) if isinstance(error, TerrafixError) else f"{type(error).__name__}: {error}"
        )
        return StepError(
            f"'{path}' failed at t = {self.seconds(tick):.9g} s (tick {tick})\n  {cause}"
        )

    def terminate(self) -> None:
        """Give back everything components hold, also after a failure; a second call does nothing.

        Raises
        ------
        StepError
            If a component fails to terminate; the others are terminated all the same.
        """
        if self._terminated:
            return
        self._terminated = True
        failure: tuple[str, Exception] | None = None
        for path, component in self.plan.flat.components.items():
            if component._environment is not self._lent[path]:
                continue
            try:
                component.terminate()
            except Exception as error:
                failure = failure or (path, error)
            component.release()
        if failure is not None:
            raise self._step_error(failure[0], self.tick, failure[1]) from failure[1]

    # ------------------------------------------------------------------ checkpoints

    def get_state(self) -> dict[str, Any]:
        """Everything that a run needs to continue from here."""
        return {
            "tick": self.tick,
            "component_steps": self.component_steps,
            "active": self.active.copy(),
            "excluded": [dict(e) for e in self.excluded],
            "components": {p: e.component.get_state() for p, e in self._entries.items()},
            "links": {name: k.get_state() for name, k in self.wiring.keepers.items()},
        }

    def set_state(self, saved: dict[str, Any]) -> None:
        """Continue from where `get_state` was called."""
        self.tick = int(saved["tick"])
        self.component_steps = int(saved["component_steps"])
        self.active[:] = saved["active"]
        self.excluded[:] = [dict(e) for e in saved["excluded"]]
        for path, state in saved["components"].items():
            self._entries[path].component.set_state(state)
        for name, state in saved["links"].items():
            self.wiring.keepers[name].set_state(state)
        for group in self.groups:
            group.move_to(self.tick)
        self._arm()
