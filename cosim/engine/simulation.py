"""A system built for one ensemble: components bound, kernels made, recorders set."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.clock import Exact, seconds, text_seconds
from terrafix.cosim.basics.errors import (
    CheckpointError,
    ConfigurationError,
)
from terrafix.cosim.declare.evaluation import Evaluation
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import State
from terrafix.cosim.engine.flight import Flight
from terrafix.cosim.engine.master import Master
from terrafix.cosim.engine.result import Exclusion, Result
from terrafix.cosim.kernels.build import build_kernels
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.cosim.memory.slots import SignalSlot
from terrafix.cosim.records.recorder import Recorder, write_manifest
from terrafix.cosim.system.check import Plan, check, check_duration, record_rate
from terrafix.cosim.system.identity import configuration, difference
from terrafix.cosim.system.system import System

Progress = Callable[[str, float], None]
"""Called with what is being done and the fraction done, often."""
MAX_MEMBER = 2**32 - 1  # a word of the counter that noise is drawn from


class Simulation:
    """A system built for one ensemble: what `simulate` runs, for use step by step.

    Parameters
    ----------
    system : System
    members : int or sequence of int, optional
        How many members, or which (a part of an ensemble keeps its numbers and draws).
    seed : int, optional
        Root seed; the system's own if absent.
    duration : exact time, optional
        How long it will run [s]: recordings that end earlier are refused.
    runs : int, optional
        How many members there are in all, where `members` are a part of them: designs are laid
        out over all.
    recording : bool
        Whether the system's records are taken; what evaluations publish always is.
    quiet : bool
        Fly the nominal run: no noise is drawn, no dispersion applied.
    folder : Path, optional
        Where records are kept while the run goes on.

    Attributes
    ----------
    checkpoint : Path or None
        What an interrupted run can be resumed from.

    Raises
    ------
    SystemCheckError
        With every problem of the system.
    """

    def __init__(
        self,
        system: System,
        *,
        members: int | Sequence[int] | None = None,
        seed: int | None = None,
        duration: Exact | None = None,
        runs: int | None = None,
        recording: bool = True,
        quiet: bool = False,
        folder: Path | None = None,
        progress: Progress | None = None,
    ) -> None:
        started = time.perf_counter()
        self.system = system
        length = None if duration is None else seconds(duration, "duration")
        self.plan: Plan = check(system, duration=length)
        if length is not None:
            check_duration(length, self.plan.base)
        self.members = _member_numbers(system.members if members is None else members)
        self.seed = system.seed if seed is None else seed
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise ConfigurationError(f"seed is {self.seed!r}; it is a whole number from 0 on")
        _refuse_together(self.plan, len(self.members))
        _refuse_too_large(self.plan, len(self.members))
        self.runs = int(self.members.max()) + 1 if runs is None else runs
        self.folder = folder
        self.checkpoint: Path | None = None
        try:
            self.master = Master(
                self.plan, seed=self.seed, members=self.members, runs=self.runs, quiet=quiet
            )
            self.kernel = self._build_kernels(progress)
            self.recorders = self._make_recorders(recording=recording)
        except BaseException:
            for component in self.plan.flat.components.values():
                component.release()
            raise
        self.parameters = self._read_back()
        self.configuration = configuration(self.plan)
        self.initialized = False
        self.setup_s = time.perf_counter() - started

    def _build_kernels(self, progress: Progress | None) -> str:
        symbolic = {
            p: c for p, c in self.plan.flat.components.items() if isinstance(c, SymbolicComponent)
        }
        if not symbolic:
            return "none"
        new = [c for c in symbolic.values() if c.kept_kernel is None]
        requests = [c.kernel_request() for c in new]

        def report(done: int, total: int) -> None:
            if progress is not None:
                progress("compiling kernels", done / total)

        for component, kernel in zip(new, build_kernels(requests, progress=report), strict=True):
            component.keep_kernel(kernel)
        kinds = set()
        for component in symbolic.values():
            kept = component.kept_kernel
            assert kept is not None
            component.bind_kernel(kept)
            kinds.add(kept.kind)
        return "+".join(sorted(kinds))

    def _make_recorders(self, *, recording: bool) -> list[Recorder]:
        recorders = []
        flat, wiring = self.plan.flat, self.master.wiring

        def recorder(name: str, ports: Sequence[str]) -> Recorder:
            slots = {}
            for path in ports:
                slot = wiring.slots[path]
                assert isinstance(slot, SignalSlot)
                slots[path] = (flat.port(path), slot)
            return Recorder(name, slots, self.master.active, self.folder)

        for record in flat.records if recording else ():
            made = recorder(record.name, record.ports)
            self.master.observe(record_rate(flat, record), made.sample)
            recorders.append(made)
        self._histories: dict[str, str] = {}
        taken = {r.name for r in flat.records}
        for path, component in flat.components.items():
            if isinstance(component, Evaluation):
                name = path.replace(".", "_")
                while name in taken:
                    name += "_history"
                taken.add(name)
                made = recorder(name, [f"{path}.{p}" for p in component.recorded_ports()])
                assert component.rate is not None
                self.master.observe(component.rate, made.sample)
                recorders.append(made)
                self._histories[path] = name
        return recorders

    def _read_back(self) -> dict[str, tuple[str, NDArray[Any]]]:
        """Dispersed parameters as they reached the components."""
        found = {}
        for dispersion in self.plan.flat.dispersions:
            for target in dispersion.targets:
                owner, _, name = target.rpartition(".")
                component = self.plan.flat.components[owner]
                declared = component.settings().get(name)
                if isinstance(declared, Parameter):
                    found[target] = (declared.unit_text(), component.parameter_values[name].copy())
                else:
                    state = component.declarations[name]
                    assert isinstance(state, State)
                    unit = state.field.unit_text()
                    found[target] = (unit, component.state_arrays[name].copy())
        return found

    def __repr__(self) -> str:
        return f"<{_standing(self)}>" if hasattr(self, "setup_s") else "<Simulation, not built>"

    # ------------------------------------------------------------------ running

    def initialize(self) -> None:
        """Publish everything at t = 0."""
        self._initialize(observe=True)

    def _initialize(self, *, observe: bool) -> None:
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_manifest(self.folder, self.recorders, self.attributes("interrupted"))
        self.master.initialize(observe=observe)
        self.initialized = True

    def run_until(self, t: Exact) -> None:
        """Step to time `t` [s]; initializes first if that was not done."""
        if not self.initialized:
            self.initialize()
        self.master.run_until(self.master.ticks(seconds(t, "time")))

    def get_state(self) -> dict[str, Any]:
        """Everything that is needed to continue from here in another process."""
        from terrafix.cosim.records.results import versions

        return {
            "master": self.master.get_state(),
            "recorders": {r.name: r.get_state() for r in self.recorders},
            "identity": self._identity(),
            "versions": versions(self.plan.epoch),
        }

    def set_state(self, saved: dict[str, Any]) -> None:
        """Continue from a saved state.

        Raises
        ------
        CheckpointError
            If it belongs to another system, seed or ensemble; the difference is named.
        """
        self.check_identity(saved)
        if not self.initialized:
            self._initialize(observe=False)
        self.master.set_state(saved["master"])
        for recorder in self.recorders:
            recorder.set_state(saved["recorders"][recorder.name])

    def check_identity(self, saved: dict[str, Any]) -> None:
        """Raise CheckpointError if a saved state belongs to another system, seed or ensemble."""
        mine, theirs = self._identity(), saved["identity"]
        differing = [k for k in mine if mine[k] != theirs.get(k)]
        if differing:
            key = differing[0]
            raise CheckpointError(difference(key, mine[key], theirs.get(key)))

    def _identity(self) -> dict[str, Any]:
        return {
            "system": self.system.name,
            "seed": self.seed,
            "members": [int(m) for m in self.members],
            "configuration": self.configuration,
        }

    # ------------------------------------------------------------------ results

    def attributes(
        self, status: str, excluded: list[dict[str, Any]] | None = None
    ) -> dict[str, Any]:
        """What is stored with every result; `excluded` where others flew it."""
        from terrafix.cosim.basics.machine import cpu_name
        from terrafix.cosim.records.results import versions

        return {
            "system": self.system.name,
            "doc": self.system.doc,
            "status": status,
            "seed": self.seed,
            "members": [int(m) for m in self.members],
            "excluded": self.master.excluded if excluded is None else excluded,
            "base_step_s": text_seconds(self.plan.base),
            **({} if self.plan.epoch is None else {"epoch": self.plan.epoch}),
            "order": self.plan.order,
            "kernel": self.kernel,
            "versions": versions(self.plan.epoch),
            "cpu": cpu_name(),
            "configuration": self.configuration,
        }

    def _notes(self) -> list[str]:
        """What a person should know although nothing failed."""
        silent = [
            path
            for path, slot in self.master.wiring.slots.items()
            if isinstance(slot, SignalSlot) and slot.never_written
        ]
        notes = [
            f"'{path}': {remark}"
            for path, component in self.plan.flat.components.items()
            for remark in component.remarks
        ]
        notes += [f"output '{path}' was never published" for path in silent]
        groups: dict[tuple[str, float, str], list[str]] = {}
        for e in self.master.ended:
            found = groups.setdefault((e["component"], e["t_s"], e["reason"]), [])
            found.append(str(e["member"]))
        for (path, t, reason), members in groups.items():
            many = "s" if len(members) > 1 else ""
            shown = ", ".join(members[:8]) + (", ..." if len(members) > 8 else "")
            notes.append(
                f"'{path}' ended the run of member{many} {shown} at t = {t:.9g} s: {reason}"
            )
        return notes

    def flight(self) -> Flight:
        """What was flown so far."""
        from terrafix.cosim.records.results import from_recorders

        readers = self.master.wiring.readers
        return Flight(
            self.members,
            from_recorders(self.recorders),
            self.parameters,
            list(self.master.excluded),
            self.master.tick,
            self.master.component_steps,
            {path: r.overruns for path, r in readers.items() if r.overruns},
            self._notes(),
        )

    def history(
        self, path: str, flight: Flight | None = None
    ) -> tuple[NDArray[np.float64], dict[str, NDArray[Any]]]:
        """What an evaluation component published: times, and arrays by port name.

        Of what was flown so far, unless it was flown otherwise.
        """
        return (flight or self.flight()).history(self._histories[path], f"{path}.")

    def evaluate(self, flight: Flight | None = None) -> dict[str, Any]:
        """What evaluation components publish, from what was recorded so far, or otherwise."""
        flight = flight or self.flight()
        found = {}
        for path in self._histories:
            component = self.plan.flat.components[path]
            assert isinstance(component, Evaluation)
            found[path] = component.summarize(*self.history(path, flight))
        return next(iter(found.values())) if len(found) == 1 else found

    def result(
        self, *, wall_s: float, status: str = "complete", flight: Flight | None = None
    ) -> Result:
        """Gather what was recorded here, or in a flight of the same members that went otherwise."""
        from terrafix.cosim.records.results import build_dataset

        flight = flight or self.flight()
        try:
            evaluation = self.evaluate(flight)
        except Exception:
            if status == "complete":
                raise
            evaluation = {}  # a history cut short must not cost the records
        attributes = self.attributes(status, flight.excluded) | {"evaluation": evaluation}
        return Result(
            system=self.system.name,
            seed=self.seed,
            members=len(self.members),
            excluded=cast("list[Exclusion]", flight.excluded),
            ticks=flight.ticks,
            component_steps=flight.component_steps,
            wall_s=wall_s,
            setup_s=self.setup_s,
            kernel=self.kernel,
            evaluation=evaluation,
            dataset=build_dataset(flight.records, self.members, attributes, flight.parameters),
            status=status,
            overruns=flight.overruns,
            notes=flight.notes,
        )


def _standing(simulation: Simulation) -> str:
    """Which simulation it is, and how far it got."""
    n, master = len(simulation.members), simulation.master
    return (
        f"Simulation of '{simulation.system.name}': {n} member{'' if n == 1 else 's'}, "
        f"seed {simulation.seed}, kernel {simulation.kernel}, "
        f"t = {master.seconds(master.tick):g} s"
        + ("" if simulation.initialized else ", not initialized")
    )


def flown_alone(plan: Plan) -> str | None:
    """Path of a component that shares what is of one member, so that members fly one at a time."""
    return next((p for p, c in plan.flat.components.items() if c.alone()), None)


def _refuse_together(plan: Plan, n_members: int) -> None:
    path = flown_alone(plan)
    if path is not None and n_members > 1:
        raise ConfigurationError(
            f"what '{path}' shares is of one member, as it is set, and {n_members} are to be flown "
            "together\n  fly them one at a time: terrafix campaign --runs N, or --members 1"
        )


def _refuse_too_large(plan: Plan, n_members: int) -> None:
    """Raise ConfigurationError if the ports alone would not fit into this machine's memory."""
    if not hasattr(os, "sysconf") or "SC_PHYS_PAGES" not in os.sysconf_names:
        return
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    one = sum(
        f.size * np.dtype(f.dtype).itemsize
        for c in plan.flat.components.values()
        for p in c.ports.values()
        for f in p.fields.values()
        if p.kind != "shared"
    )
    if n_members * one > 0.8 * memory:
        raise ConfigurationError(
            f"{n_members} members need more than {n_members * one / 2**30:.0f} GiB for their ports "
            f"alone; this machine has {memory / 2**30:.0f} GiB\n  fly fewer at a time"
        )


def _member_numbers(members: int | Sequence[int]) -> NDArray[np.int64]:
    if isinstance(members, bool) or (isinstance(members, int) and members < 1):
        raise ConfigurationError(f"members is {members}; an ensemble has at least 1")
    if isinstance(members, int) and members > MAX_MEMBER:
        raise ConfigurationError(f"members is {members}; there are at most {MAX_MEMBER}")
    numbers = np.arange(members) if isinstance(members, int) else np.asarray(members)
    if (
        numbers.ndim != 1
        or not len(numbers)
        or numbers.dtype.kind not in "iu"
        or len(set(numbers.tolist())) != len(numbers)
        or numbers.min() < 0
        or numbers.max() > MAX_MEMBER
    ):
        raise ConfigurationError(
            f"members {members} must be different whole numbers from 0 to {MAX_MEMBER}"
        )
    return numbers.astype(np.int64)
