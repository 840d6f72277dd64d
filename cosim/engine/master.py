"""The master: steps every component that is due, then transfers, in an order fixed beforehand.

It knows ticks, components and links, and nothing of what flows through them: `agenda` says who is
due, `program` what there is to do then.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import Mask
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import (
    ComponentError,
    ConfigurationError,
    StepError,
    TerrafixError,
)
from terrafix.cosim.engine.agenda import Agenda
from terrafix.cosim.engine.build import bind_components, connect_ports
from terrafix.cosim.engine.program import Chains, Entry, Program, Run, stretch_of
from terrafix.cosim.engine.starting import Starter
from terrafix.cosim.kernels.chain import Chain, Compiled
from terrafix.cosim.kernels.symbolic import NOT_FINITE, SymbolicComponent
from terrafix.cosim.system.check import Plan
from terrafix.cosim.system.dispersion import apply_all


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
    runs : int
        How many members there are in all; these may be a part.
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
        runs: int,
        quiet: bool = False,
    ) -> None:
        self.plan = plan
        self.seed = seed
        self.members = members
        self.active: Mask = np.ones(len(members), dtype=np.bool_)
        self.excluded: list[dict[str, Any]] = []
        self.ended: list[dict[str, Any]] = []
        self._ending: list[tuple[str, Mask, str]] = []
        self.tick = 0
        self.component_steps = 0
        self._numerator, self._denominator = plan.base.numerator, plan.base.denominator
        bind_components(
            plan,
            seed=seed,
            members=members,
            active=self.active,
            fail=self._exclude,
            quiet=quiet,
            end=lambda *ending: self._ending.append(ending),
        )
        self._lent = {p: c.environment for p, c in plan.flat.components.items()}
        self._terminated = False
        self.draws = apply_all(
            () if quiet else plan.flat.dispersions,
            plan.flat.components,
            seed=seed,
            members=members,
            runs=runs,
        )
        self.wiring = connect_ports(plan, len(members), self.active)
        self.agenda = Agenda(plan)
        self.group_of: dict[str, int] = {}
        self.entries: dict[str, Entry] = {}
        for path in plan.order:
            component = plan.flat.components[path]
            assert component.rate is not None
            number = self.group_of[path] = self.agenda.number(component.rate)
            self.entries[path] = Entry(path, component, self.agenda.groups[number], self.wiring)
        self._aloft: list[Chain] = []
        self._forget_programs()

    def _forget_programs(self) -> None:
        self._land()
        self.programs: dict[tuple[int, ...], Program] = {}
        latch = self.wiring.latch
        self._chains = Chains(
            lambda path: latch.get(path, ()), self.active, (self._numerator, self._denominator)
        )

    def observe(self, rate: Rate, sample: Callable[[float], None]) -> None:
        """Call `sample(t)` at a rate, after everything due has stepped; it influences nothing."""
        self.agenda.observe(rate, sample)

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

    def _end_members(self) -> None:
        """Stop members whose runs a component ended in this tick, which is observed."""
        t = self.seconds(self.tick)
        for path, mask, reason in self._ending:
            newly = mask & self.active
            self.ended += [
                {"member": int(m), "component": path, "t_s": t, "reason": reason}
                for m in self.members[newly]
            ]
            self.active &= ~newly
        self._ending.clear()
        self._check_members()

    # ------------------------------------------------------------------ running

    def initialize(self, *, observe: bool = True) -> None:
        """Publish everything at t = 0, in the order that the plan has for it.

        `observe` is false where a saved state replaces all of it.
        """
        self._forget_programs()
        Starter(self.plan, self.entries, self.wiring, self.active, self._component_error).start()
        for path in self.entries:
            for transfer in self.wiring.latch.get(path, ()):
                transfer(0)
        self._check_members()
        for group in self.agenda.groups:
            if observe and group.sample is not None and group.rate.starts_at_zero:
                group.sample(0.0)
        self.agenda.move_to(0)
        if self._ending:
            self._end_members()

    def _program(self, due: tuple[int, ...]) -> Program:
        groups = self.agenda.groups
        entries = tuple(e for p, e in self.entries.items() if self.group_of[p] in due)
        latches = tuple(t for e in entries for t in self.wiring.latch.get(e.path, ()))
        samples = tuple(s for i in due if (s := groups[i].sample) is not None)
        alone = len(due) == 1 and not samples and groups[due[0]].spacing
        stretch = stretch_of(entries, latches) if alone else None
        runs = self._chains.runs(entries)
        chain = runs[0].chain if alone and len(runs) == 1 else None
        if chain is not None and chain.latches is None:
            chain = None
        program = self.programs[due] = Program(entries, latches, samples, stretch, runs, chain)
        return program

    def _fly(self, program: Program, number: int, end: int) -> bool:
        """Step a group's ticks from its next one on, up to `end` and before anybody else's.

        Nothing is done, and False returned, if that is only one tick, or not like the others.
        """
        group, n_ticks = self.agenda.groups[number], self.agenda.alone(number, end)
        first, spacing = group.next_tick, group.spacing
        assert program.stretch is not None
        assert first is not None
        last = first + (n_ticks - 1) * spacing
        if n_ticks < 2 or last * self._numerator > 2**53 or not program.settle(first):
            return False
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
        for component in components:
            assert isinstance(component, SymbolicComponent)
            component.stretched(n_ticks, self.seconds(last), dt)
        self.component_steps += n_ticks * len(components)
        for failure in failures:
            self.tick = first + failure.tick * spacing
            components[failure.stage].fail(failure.members, NOT_FINITE)
            self._check_members()
        self.tick = last
        self.agenda.leap(number, last)
        return True

    # ------------------------------------------------------------------ chains

    def _ready(self, chain: Chain) -> None:
        """Let a chain take off, once others with components of it have landed."""
        if not chain.aloft:
            own = set(chain.components)
            for other in self._aloft:
                if not own.isdisjoint(other.components):
                    other.land()
            self._aloft = [c for c in self._aloft if c.aloft] + [chain]
        chain.ready()

    def _land(self) -> None:
        for chain in self._aloft:
            chain.land()
        self._aloft = []

    def _attend(self, chain: Chain, run: Run) -> None:
        """Let the component for which a chain has stopped do what its step left to do."""
        entry = run.entries[chain.stage]
        assert isinstance(entry.component, Compiled)
        try:
            entry.component.attend_compiled()
        except Exception as error:
            raise self._component_error(entry.path, error) from error
        chain.ready()

    def _step_run(self, run: Run, chain: Chain, tick: int, t: float) -> None:
        """Step the components of a chain once."""
        self._ready(chain)
        stopped = chain.start(tick, tick, t, latched=False)
        while stopped:
            self._attend(chain, run)
            stopped = chain.go_on()

    def _glide(self, program: Program, number: int, end: int) -> bool:
        """Fly a group whose components are one chain, as `_fly` does; perhaps not all the way."""
        group, chain, run = self.agenda.groups[number], program.chain, program.runs[0]
        assert chain is not None
        first, spacing = group.next_tick, group.spacing
        assert first is not None
        n_ticks = min(self.agenda.alone(number, end), chain.most)
        last = first + (n_ticks - 1) * spacing
        if n_ticks < 1 or max(last * self._numerator, self._denominator) > 2**53:
            return False
        begun = time.perf_counter()
        self._ready(chain)
        tick = first
        while True:
            n_excluded = len(self.excluded)
            stopped = chain.start(tick, last, self.seconds(tick), latched=True)
            self.tick = chain.tick
            chain.stop_after_this_tick()
            while stopped:
                self._attend(chain, run)
                stopped = chain.go_on()
            self.component_steps += ((self.tick - tick) // spacing + 1) * len(run.entries)
            self.agenda.leap(number, self.tick)
            if len(self.excluded) != n_excluded:
                self._check_members()
            if self._ending:
                self._end_members()
            tick = self.tick + spacing
            if tick > last:
                break
            chain.ready()
        taken = time.perf_counter() - begun
        if taken < 0.02 and n_ticks == chain.most:
            chain.most *= 2
        elif taken > 0.1:
            chain.most = max(chain.most // 4, 1)
        return True

    def run_until(self, end: int) -> None:
        """Step to tick `end`.

        Raises
        ------
        ComponentError
            If a component raises.
        StepError
            If no member is left, or a recorder fails. What was recorded is untouched.
        """
        if end < self.tick:
            raise ConfigurationError(
                f"cannot run to t = {self.seconds(end):.9g} s: this simulation stands at "
                f"t = {self.seconds(self.tick):.9g} s\n  make another one, or set an earlier state"
            )
        for path, component in self.plan.flat.components.items():
            if component.lent is not self._lent[path]:
                raise ConfigurationError(
                    f"'{path}' has been terminated, or another simulation of the same system has "
                    "taken it over\n  run one after the other, or build the system twice"
                )
        agenda, programs = self.agenda, self.programs
        numerator, denominator = self._numerator, self._denominator
        entry: Entry | None = None
        n_excluded = len(self.excluded)
        try:
            while agenda.heap and (tick := agenda.heap[0][0]) <= end:
                due = agenda.due(tick)
                program = programs.get(due) or self._program(due)
                if program.stretch is not None and self._fly(program, due[0], end):
                    n_excluded = len(self.excluded)
                    continue
                if program.chain is not None and self._glide(program, due[0], end):
                    n_excluded = len(self.excluded)
                    continue
                agenda.advance(due)
                self.tick, t = tick, tick * numerator / denominator
                for run in program.runs:
                    if run.chain is not None:
                        self._step_run(run, run.chain, tick, t)
                        continue
                    for entry in run.entries:
                        for transfer in entry.before:
                            transfer(tick)
                        entry.step(t, entry.group.dt)
                        for collect in entry.after:
                            collect(tick, t)
                        for clear in entry.clear:
                            clear()
                    entry = None
                for latch in program.latches:
                    latch(tick)
                for sample in program.samples:
                    sample(t)
                self.component_steps += len(program.entries)
                if len(self.excluded) != n_excluded:
                    n_excluded = len(self.excluded)
                    self._check_members()
                if self._ending:
                    self._end_members()
        except Exception as error:
            if entry is None and isinstance(error, StepError):  # no member is left
                raise
            if entry is not None:
                raise self._component_error(entry.path, error) from error
            raise StepError(
                f"'recorder' failed at t = {self.seconds(self.tick):.9g} s (tick {self.tick})\n"
                f"  {_said(error)}"
            ) from error
        finally:
            self._land()
        self.tick = end

    def _check_members(self) -> None:
        if not self.active.any():
            if self.ended:
                raise EverybodyEndedError("the runs of all members have ended")
            last = self.excluded[-1]
            raise StepError(nobody_left(last, f"{last['t_s']:.9g} s (tick {self.tick})"))

    def _component_error(self, path: str, error: Exception) -> ComponentError:
        return ComponentError(path, self.tick, self.seconds(self.tick), _said(error))

    def give_up(self, error: ComponentError) -> None:
        """Exclude all members that are left, for what a component raised."""
        self._exclude(error.component, self.active.copy(), error.reason)

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
        self._land()
        failure: tuple[str, Exception] | None = None
        for path, component in self.plan.flat.components.items():
            if component.lent is not self._lent[path]:
                continue
            try:
                component.terminate()
            except Exception as error:
                failure = failure or (path, error)
            component.release()
        if failure is not None:
            raise self._component_error(*failure) from failure[1]

    # ------------------------------------------------------------------ checkpoints

    def get_state(self) -> dict[str, Any]:
        """Everything that a run needs to continue from here."""
        self._land()
        return {
            "tick": self.tick,
            "component_steps": self.component_steps,
            "active": self.active.copy(),
            "excluded": [dict(e) for e in self.excluded],
            "ended": [dict(e) for e in self.ended],
            "components": {p: e.component.get_state() for p, e in self.entries.items()},
            "links": {name: k.get_state() for name, k in self.wiring.keepers.items()},
        }

    def set_state(self, saved: dict[str, Any]) -> None:
        """Continue from where `get_state` was called."""
        self._land()
        self.tick = int(saved["tick"])
        self.component_steps = int(saved["component_steps"])
        self.active[:] = saved["active"]
        self.excluded[:] = [dict(e) for e in saved["excluded"]]
        self.ended[:] = [dict(e) for e in saved.get("ended", ())]
        for path, state in saved["components"].items():
            self.entries[path].component.set_state(state)
        for name, state in saved["links"].items():
            self.wiring.keepers[name].set_state(state)
        self.agenda.move_to(self.tick)


class EverybodyEndedError(StepError):
    """The run is complete before its time: components have ended the runs of all members."""


def nobody_left(last: Mapping[str, Any], when: str) -> str:
    """Say that the last member has failed, of which `last` says how."""
    return (
        f"no member is left at t = {when}\n  the last, member {last['member']}, failed in "
        f"'{last['component']}': {last['reason']}"
    )


def _said(error: Exception) -> str:
    """What was raised, in words."""
    return str(error) if isinstance(error, TerrafixError) else f"{type(error).__name__}: {error}"
