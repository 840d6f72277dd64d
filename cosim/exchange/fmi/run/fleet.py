"""Instances of one FMU, one for each member: started, stepped, saved and freed together.

Values go in and out as rows of numbers, (n_members, width), all quantities side by side; of whole
numbers a row holds the 64 bits themselves (`cells`), so that none loses its last digit. A member
whose instance fails is reported with what the FMU said; the others go on. `Fleet` runs here,
`terrafix.cosim.exchange.fmi.run.remote.RemoteFleet` is the same in a process of its own.
"""

from __future__ import annotations

import ctypes as ct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.binding import (
    CO_SIMULATION,
    DISCARD,
    ENDED,
    HEARD,
    FmuEndedError,
    FmuError,
    Instance,
    Kept,
    load_library,
    references,
)
from terrafix.cosim.exchange.fmi.run.driver import (
    DISCARDED,
    DOUBLE,
    NOT_FINITE,
    NOT_OF_TYPE,
    REASONS,
    TOO_LARGE,
    Driver,
    load_driver,
)
from terrafix.cosim.exchange.fmi.run.driver import ENDED as HAS_ENDED
from terrafix.cosim.exchange.fmi.run.fmi1 import InstanceOfFmi1
from terrafix.cosim.exchange.fmi.run.parameters import Start
from terrafix.cosim.exchange.fmi.run.solvers import Integrator
from terrafix.cosim.exchange.fmi.run.whole import INTEGER, MOST, cells

Failures = dict[int, str]
"""Row of a member to what went wrong, or to an `Ended`."""
MODEL_EXCHANGE_TOLERANCE = 1e-10


class Ended(str):
    """What is said of a member whose FMU ended the simulation, as it may."""


def _said(error: FmuError) -> str:
    return Ended(error) if isinstance(error, FmuEndedError) else str(error)


_driver = load_driver
_NEVER = -1  # bits of no number
_STEP = 2  # of `enum failure` in driver.c


@dataclass(frozen=True)
class Group:
    """Variables of one type, side by side in a row of numbers."""

    kind: str
    references: tuple[int, ...]
    start: int
    size: int
    discrete: bool = False


@dataclass(frozen=True)
class Setup:
    """What a fleet is made from; plain values, so that it can be sent to another process.

    Attributes
    ----------
    file : str
    kind : str
        Co-simulation or model exchange.
    name : str
        Of the component.
    inputs, outputs : tuple of Group
        What is set before and read after each step.
    starts : tuple of Start
        Values set before initialization.
    solver : str
    tolerance : float or None
        Of the integrator in model exchange; in co-simulation handed on to the FMU, if there is one.
    event_mode : bool
        Of co-simulation with FMI 3.
    start_time : float
        Time of the FMU at t = 0 [s].
    """

    file: str
    kind: str
    name: str
    inputs: tuple[Group, ...]
    outputs: tuple[Group, ...]
    starts: tuple[Start, ...] = ()
    solver: str = "cvode"
    tolerance: float | None = None
    event_mode: bool = False
    start_time: float = 0.0

    def of(self, members: Sequence[int]) -> Setup:
        """What a fleet of some of its members is made from."""
        return replace(self, starts=tuple(start.of(members) for start in self.starts))


@dataclass(frozen=True)
class Message:
    """Values for some members that are set once: fields of a message, its time, its number."""

    kind: str
    references: tuple[int, ...]
    rows: NDArray[np.int64]
    values: NDArray[Any]

    def send(self, row: int, instance: Instance) -> None:
        """Set them on one member's instance, if they are meant for it."""
        at = np.flatnonzero(self.rows == row)
        if at.size:
            instance.set(self.kind, references(self.references), self.values[at[0]])


class _Quick:
    """Set, step and get of one instance, prepared for ctypes."""

    def __init__(self, instance: Instance, fleet: Fleet) -> None:
        library, row = fleet.library, fleet.instances.index(instance)
        name = "Real" if library.version == 2 else "Float64"
        self._instance = instance
        self._t, self._h = ct.c_double(), ct.c_double()
        output = fleet.outputs[row]
        self._dot, self._zeros = output.dot, np.zeros_like(output)

        def prepared(function: str, group: tuple[Group, ...], rows: FloatArray) -> tuple[Any, Any]:
            if not group:
                return None, ()
            vr = fleet._references[group[0]]
            where = ct.c_void_p(rows[row].ctypes.data)
            arguments = [instance.pointer, vr, ct.c_size_t(len(vr)), where]
            arguments += [] if library.version == 2 else [ct.c_size_t(rows.shape[1])]
            called = library[function]
            called.restype = ct.c_int
            return called, tuple(arguments)

        self._set, self._set_arguments = prepared(f"Set{name}", fleet.setup.inputs, fleet.inputs)
        self._get, self._get_arguments = prepared(f"Get{name}", fleet.setup.outputs, fleet.outputs)
        self._step = library["DoStep"]
        self._step.restype = ct.c_int
        flags, last = [ct.c_bool() for _ in range(3)], ct.c_double()
        after: tuple[Any, ...] = (1,)
        self._ended: tuple[Any, Any, Any] | None = None
        if library.version == 3:
            after = (ct.c_bool(True), *(ct.byref(f) for f in flags), ct.byref(last))
            self._ended = flags[1], flags[2], last
        self._step_arguments = (instance.pointer, self._t, self._h, *after)

    def __call__(self, t: float, h: float) -> None:
        self._t.value, self._h.value = t, h
        with Kept():
            self._call()
        if self._get is not None and self._dot(self._zeros) != 0.0:  # NaN: one is not finite
            raise FmuError("an output is not finite")

    def _call(self) -> None:
        if self._set is not None and self._set(*self._set_arguments) > 1:
            raise FmuError(f"{REASONS[1]}{self._instance.said()}")
        status = self._step(*self._step_arguments)
        if status > 1:
            if status == DISCARD and self._instance.ended():
                raise FmuEndedError(ENDED)
            raise FmuError(f"{REASONS[2]}{self._instance.said()}")
        if self._ended is not None and (self._ended[0].value or self._ended[1].value):
            ended, _, last = self._ended
            if ended.value:
                raise FmuEndedError(ENDED)
            if last.value < self._t.value + self._h.value:
                raise FmuError(f"fmi3{REASONS[7]}")
        if self._get is not None and self._get(*self._get_arguments) > 1:
            raise FmuError(f"{REASONS[3]}{self._instance.said()}")


class Fleet:
    """Instances of an FMU in this process.

    Parameters
    ----------
    setup : Setup
    n_members : int

    Attributes
    ----------
    inputs, outputs : ndarray, shape (n_members, width)
        Rows that are set before and filled after each step.
    drive : Driver or None
        The compiled driver that makes the calls, if there is one.
    """

    def __init__(self, setup: Setup, n_members: int) -> None:
        self._quick: dict[int, _Quick] = {}
        self._live: list[int] = []
        self._marks: dict[int, ct.c_void_p] = {}
        self.setup = setup
        self.archive = open_archive(setup.file)
        self.library = load_library(self.archive, setup.kind)
        self.inputs = np.zeros((n_members, sum(g.size for g in setup.inputs)))
        self.outputs = np.zeros((n_members, sum(g.size for g in setup.outputs)))
        self.instances: list[Instance | None] = [None] * n_members
        self._integrators: dict[int, Integrator] = {}
        exchanged = setup.kind != CO_SIMULATION
        self._eventful = np.concatenate(  # columns whose change is an event
            [
                np.arange(0),
                *(
                    np.arange(g.start, g.start + g.size)
                    for g in setup.inputs
                    if g.discrete or exchanged
                ),
            ]
        )
        self._last: dict[int, NDArray[np.int64]] = {}  # their bits, as they were set
        self._active = np.zeros(n_members, dtype=np.uint8)
        self._failed = np.zeros(n_members, dtype=np.uint8)
        self._references = {g: references(g.references) for g in (*setup.inputs, *setup.outputs)}
        self.drive: Driver | None = None
        self._call: tuple[Any, Any, Any] | None = None

    # ------------------------------------------------------------------ life cycle

    def enter(self, active: NDArray[np.bool_]) -> Failures:
        """Instantiate the active members, and enter initialization mode."""
        self._active[:] = active
        failures = self._each(np.flatnonzero(active).tolist(), self._enter_one)
        self._live = self._find_live()
        return failures

    def settle(self, known: Sequence[Group] | None, wanted: Sequence[Group]) -> Failures:
        """Set some inputs (all, if absent) and get some outputs, in initialization mode."""

        def settle_one(row: int) -> None:
            instance = self.instances[row]
            assert instance is not None
            self._set_some(instance, row, self.setup.inputs if known is None else known)
            self._get_some(instance, row, wanted)

        failures = self._each(self._live, settle_one)
        self._live = self._find_live()
        return failures

    def leave(
        self,
        active: NDArray[np.bool_],
        messages: Sequence[Message] = (),
        known: Sequence[Group] | None = None,
    ) -> Failures:
        """Set inputs (those that are `known`, if given), and leave initialization mode.

        Afterwards `outputs` hold the values at the start.
        """
        self._active[:] &= active
        self._live = self._find_live()
        failures = self._each(self._live, lambda row: self._leave_one(row, messages, known))
        self._live = self._find_live()
        self._prepare_calls()
        return failures

    def _each(self, rows: Sequence[int], action: Callable[[int], None]) -> Failures:
        failures: Failures = {}
        for row in rows:
            try:
                action(row)
            except FmuError as error:
                self._note(row, error, failures)
        return failures

    def _enter_one(self, row: int) -> None:
        name = f"{self.setup.name}_{row}"
        made = InstanceOfFmi1 if self.library.version == 1 else Instance
        instance = made(self.library, name, event_mode=self.setup.event_mode)
        self.instances[row] = instance
        structural = [s for s in self.setup.starts if s.structural]
        if structural:
            instance.call("EnterConfigurationMode")
            self._set_starts(instance, row, structural)
            instance.call("ExitConfigurationMode")
        self._set_starts(instance, row, [s for s in self.setup.starts if not s.structural])
        own = self.setup.tolerance if self.setup.kind == CO_SIMULATION else None
        instance.begin(self.setup.start_time, own)

    def _leave_one(
        self, row: int, messages: Sequence[Message], known: Sequence[Group] | None
    ) -> None:
        instance = self.instances[row]
        assert instance is not None
        self._set_some(instance, row, self.setup.inputs if known is None else known)
        for message in messages:
            message.send(row, instance)
        instance.finish()
        if self.setup.kind != CO_SIMULATION:
            self._integrators[row] = Integrator(
                instance,
                self.archive,
                self.setup.start_time,
                self.setup.solver,
                self.setup.tolerance or MODEL_EXCHANGE_TOLERANCE,
            )
        now = self.inputs[row, self._eventful].view(np.int64)
        self._last[row] = now if known is None else np.full(len(now), _NEVER)
        self._get_all(instance, row)

    def _set_starts(self, instance: Instance, row: int, starts: Sequence[Start]) -> None:
        for start in starts:
            vr, rows = references(start.references), start.rows
            try:
                if isinstance(rows, tuple):
                    instance.set_texts(vr, rows)
                else:
                    instance.set(start.kind, vr, rows[row if len(rows) > 1 else 0])
            except FmuError as error:
                raise FmuError(f"its '{start.name}' was refused: {error}", error.status) from error

    def _set_some(self, instance: Instance, row: int, groups: Sequence[Group]) -> None:
        for group in groups:
            columns = slice(group.start, group.start + group.size)
            values = cells(self.inputs, group.kind, columns)[row]
            instance.set(group.kind, self._referred(group), values)

    def _get_some(self, instance: Instance, row: int, groups: Sequence[Group]) -> None:
        for group in groups:
            values = instance.get(group.kind, self._referred(group), group.size)
            if group.kind == "UInt64" and len(values) and int(values.max()) > MOST:
                raise FmuError(f"an output (UInt64) is {values.max()}; a port holds at most {MOST}")
            columns = slice(group.start, group.start + group.size)
            cells(self.outputs, group.kind, columns)[row] = values

    def _referred(self, group: Group) -> Any:
        if group not in self._references:
            self._references[group] = references(group.references)
        return self._references[group]

    def _set_all(
        self, instance: Instance, row: int, *, discrete: tuple[bool, ...] = (False, True)
    ) -> None:
        self._set_some(instance, row, [g for g in self.setup.inputs if g.discrete in discrete])

    def _get_all(self, instance: Instance, row: int) -> None:
        self._get_some(instance, row, self.setup.outputs)
        for group in self.setup.outputs:
            columns = slice(group.start, group.start + group.size)
            if group.kind not in INTEGER and not np.isfinite(self.outputs[row, columns]).all():
                raise FmuError("an output is not finite")

    # ------------------------------------------------------------------ stepping

    def _prepare_calls(self) -> None:
        """Prepare the calls of a step, where they are set, step and get.

        A compiled driver makes them; where no compiler serves, this process does, those of double
        precision without any conversion.
        """
        if self.setup.kind != CO_SIMULATION or self.setup.event_mode or self.library.version == 1:
            return
        compiled = _driver()
        groups = (self.setup.inputs, self.setup.outputs)
        if compiled is not None:
            read, written = ([(g, self._references[g]) for g in each] for each in groups)
            self.drive = Driver(
                compiled,
                self.library,
                self.instances,
                self._active,
                self._failed,
                self.inputs,
                self.outputs,
                read,
                written,
            )
            self._call = self.drive.call, self.drive.binding, self.drive.at
        elif all(len(g) <= 1 and all(x.kind in DOUBLE for x in g) for g in groups):
            self._quick = {
                row: _Quick(instance, self)
                for row, instance in enumerate(self.instances)
                if instance is not None
            }

    def step(
        self,
        t: float,
        h: float,
        messages: Sequence[Message] = (),
        skipped: Sequence[int] = (),
    ) -> Failures:
        """Set inputs, advance all from `t` by `h` [s], and fill `outputs`.

        `skipped` are rows that are not stepped any more.
        """
        if skipped:
            self.leave_out(skipped)
        failures = self._send(messages) if messages else {}
        if self._call is not None:
            call, binding, at = self._call
            binding.t, binding.h = t, h
            return failures | self._explain() if call(at) else failures
        for row in self._live:
            try:
                self._step_one(row, t, h)
            except FmuError as error:
                self._note(row, error, failures)
        if failures:
            self._live = self._find_live()
        return failures

    def leave_out(self, rows: Sequence[int]) -> None:
        """Step some rows no more."""
        self._active[list(rows)] = 0
        self._live = self._find_live()

    def after_compiled(self) -> Failures:
        """What failed in a step that was made by compiled code alone."""
        return self._explain() if (self._failed * self._active).any() else {}

    def _find_live(self) -> list[int]:
        rows: list[int] = np.flatnonzero(self._active & (self._failed == 0)).tolist()
        return rows

    def _send(self, messages: Sequence[Message]) -> Failures:
        failures: Failures = {}
        for row in {int(r) for message in messages for r in message.rows}:
            instance = self.instances[row]
            try:
                for message in messages:
                    if instance is not None and self._active[row]:
                        message.send(row, instance)
            except FmuError as error:
                self._note(row, error, failures)
        return failures

    def _note(self, row: int, error: FmuError, failures: Failures) -> None:
        """Note why a member is not stepped any more; one that ended shows its last values."""
        self._failed[row], failures[row] = _STEP, _said(error)
        instance = self.instances[row]
        if isinstance(error, FmuEndedError) and instance is not None:
            self._failed[row] = HAS_ENDED
            try:
                self._get_all(instance, row)
            except FmuError as wrong:
                self._failed[row], failures[row] = _STEP, str(wrong)

    def _step_one(self, row: int, t: float, h: float) -> None:
        if quick := self._quick.get(row):
            quick(t, h)
            return
        instance = self.instances[row]
        assert instance is not None
        now = self.inputs[row, self._eventful].view(np.int64)
        integrator = self._integrators.get(row)
        if not len(now):
            self._set_all(instance, row)
        elif row in self._last and np.array_equal(now, self._last[row]):
            if integrator is None:
                self._set_all(instance, row, discrete=(False,))
        else:  # a jump, as every change is to an integrator; it belongs into event mode
            handle = instance.handle if integrator is None else integrator.handle
            handle(t, lambda: self._set_all(instance, row))
            self._last[row] = now
        if integrator is not None:
            integrator.advance(t, h)
        else:
            instance.step(t, h)
        self._get_all(instance, row)

    def _explain(self) -> Failures:
        found: Failures = {}
        for row in np.flatnonzero(self._failed * self._active).tolist():
            code = int(self._failed[row])
            instance = self.instances[row]
            assert instance is not None
            self._active[row] = 0
            if code == HAS_ENDED or (code == DISCARDED and instance.ended()):
                self._note(row, FmuEndedError(ENDED), found)
                continue
            found[row] = self._reason(row, instance, code)
        return found

    def _reason(self, row: int, instance: Instance, code: int) -> str:
        """Why a step failed, in words."""
        if code == NOT_FINITE:
            return "an output is not finite"
        try:  # what was refused is looked at once more
            if code == NOT_OF_TYPE:
                for group in self.setup.inputs:
                    columns = slice(group.start, group.start + group.size)
                    values = cells(self.inputs, group.kind, columns)[row]
                    instance.of_type(group.kind, self._referred(group), values)
            elif code == TOO_LARGE:
                self._get_some(instance, row, self.setup.outputs)
        except FmuError as error:
            return str(error)
        return f"fmi{self.library.version}{REASONS[code]}{instance.said()}"

    def take_log(self) -> Sequence[tuple[int, int, str]]:
        """What the FMU logged since this was last asked: row, status as FMI numbers it, text."""
        if not HEARD:
            return ()
        instances = ((row, i) for row, i in enumerate(self.instances) if i is not None)
        return [
            (row, status, text)
            for row, instance in instances
            for status, text in HEARD.pop(instance.environment, ())
        ]

    # ------------------------------------------------------------------ state

    def save(self) -> list[bytes]:
        """The state of every instance, as bytes; empty where there is none."""
        pairs = enumerate(zip(self.instances, self._failed, strict=True))
        return [
            b"" if i is None or failed else self._events_of(row) + i.serialize()
            for row, (i, failed) in pairs
        ]

    @property
    def _handles_events(self) -> bool:
        return self.setup.kind != CO_SIMULATION or self.setup.event_mode

    def _events_of(self, row: int) -> bytes:
        """What a master knows of events: the next time (NaN: none), inputs, clocks."""
        instance = self.instances[row]
        if not self._handles_events or instance is None:
            return b""
        due = self._scheduler(row).next_event
        head = np.float64(np.nan if due is None else due).tobytes()
        return head + self._last[row].tobytes() + instance.clocks.state().tobytes()

    def _scheduler(self, row: int) -> Instance | Integrator:
        """What holds the time of a member's next event."""
        found = self._integrators.get(row) or self.instances[row]
        assert found is not None
        return found

    def restore(self, saved: Sequence[bytes]) -> None:
        """Return to what `save` gave."""
        for row, data in enumerate(saved):
            instance = self.instances[row]
            if data and instance is not None:
                n = len(self._eventful)
                size = 8 * (1 + n + 3 * len(instance.clocks)) if self._handles_events else 0
                events = np.frombuffer(data[:size], np.int64)
                instance.deserialize(bytes(data[size:]))
                if row in self._integrators:
                    self._integrators[row].restart()
                if size:
                    due = float(events[:1].view(np.float64)[0])
                    self._scheduler(row).next_event = None if np.isnan(due) else due
                    self._last[row] = events[1 : 1 + n].copy()
                    instance.clocks.restore(events[1 + n :].view(np.float64).reshape(-1, 3))

    def mark(self) -> None:
        """Keep the present state of every instance that is stepped, to return to."""
        for row in self._live:
            instance = self.instances[row]
            assert instance is not None
            self._marks[row] = instance.get_state(self._marks.get(row))

    def return_to_mark(self) -> None:
        """Set every instance back to where it was marked."""
        for row in self._live:
            instance = self.instances[row]
            assert instance is not None
            instance.set_state(self._marks[row])

    def close(self) -> None:
        """Terminate and free every instance."""
        for row, state in self._marks.items():
            instance = self.instances[row]
            if instance is not None:
                instance.free_state(state)
        self._marks = {}
        for row, instance in enumerate(self.instances):
            if instance is None:
                continue
            self.instances[row] = None
            try:
                if self._failed[row] in (0, HAS_ENDED):
                    instance.terminate()
            except FmuError:
                pass  # it is freed all the same
            instance.free()
        self.drive = self._call = None
