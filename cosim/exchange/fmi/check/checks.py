"""Checks of anybody's FMU that call its binary. They run in a process of their own.

Each check is a function of an archive and a kind (co-simulation or model exchange) that yields
findings. What it may assume is that the FMU loads; whatever else it does, up to a crash, is caught
by who started the process.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.exchange.fmi.check.findings import ERROR, NOTE, WARNING, Finding
from terrafix.cosim.exchange.fmi.run.archive import Archive, open_archive
from terrafix.cosim.exchange.fmi.run.binding import (
    CO_SIMULATION,
    MODEL_EXCHANGE,
    FmuEndedError,
    FmuError,
    Instance,
    load_library,
    references,
)
from terrafix.cosim.exchange.fmi.run.reading import REAL, uses_event_mode
from terrafix.cosim.exchange.fmi.run.remote import serve
from terrafix.cosim.exchange.fmi.run.whole import BOOLEAN, INTEGER

CYCLES = 1000
MOST_KNOWNS = 200
STEPS = 5
ROUNDED = 1e-6
"""Start values that differ by less have been written with fewer digits."""
SOLVED = 1e-3
"""Results that differ by less may come from an internal solver that starts anew."""
INEXACT = 1e-2
"""Derivatives off by less, of the largest, are inexact; the standard asks for no digits."""
NOISE = 1e-9
"""Outputs that change by less, of their size, may be what an iteration left."""
NOT_MADE = "the FMU could not be instantiated"
_MAY_FAIL = (
    *("Instantiate", "SetupExperiment", "EnterInitializationMode", "ExitInitializationMode"),
    *("DoStep", "NewDiscreteStates", "UpdateDiscreteStates", ""),
)
"""What the standard lets an FMU refuse where it does not like what it was given."""


@dataclass(frozen=True)
class Scalars:
    """A variable of the description with its elements' names."""

    name: str
    kind: str
    reference: int
    size: int
    start: tuple[float, ...] | None
    causality: str
    variability: str
    initial: str | None
    bounds: tuple[float, float]
    clocked: bool


class Subject:
    """The FMU under test: its variables by name and reference, and fresh instances of it."""

    def __init__(self, archive: Archive, kind: str) -> None:
        self.archive = archive
        self.kind = kind
        self.library = load_library(archive, kind)
        self.description = archive.description
        self.interface = self.library.interface
        self.variables = [_scalars(v) for v in self.description.modelVariables]
        self.by_name = {v.name: v for v in self.variables}
        experiment = self.description.defaultExperiment
        given = getattr(experiment, "stepSize", None) if experiment is not None else None
        internal = getattr(self.interface, "fixedInternalStepSize", None)
        self.h = float(given or internal or 1e-3)
        self.t0 = float(getattr(experiment, "startTime", None) or 0.0)
        self.has_state = bool(self.interface.canGetAndSetFMUstate)
        self.once = bool(self.interface.canBeInstantiatedOnlyOncePerProcess)
        self._event_mode = uses_event_mode(archive, kind)
        self._number = 0

    @property
    def n_states(self) -> int:
        """Number of continuous states."""
        return sum(self.by_name[u.variable.name].size for u in self.description.derivatives)

    def reals(self, *causalities: str) -> list[Scalars]:
        """Variables of double precision with these causalities."""
        kinds = ("Real", "Float64")
        return [
            v
            for v in self.variables
            if v.kind in kinds and v.causality in causalities and not v.clocked
        ]

    def outputs(self) -> list[Scalars]:
        """Outputs of double precision."""
        return self.reals("output")

    def instantiate(self) -> Instance:
        """A fresh instance."""
        self._number += 1
        return Instance(self.library, f"check_{self._number}", event_mode=self._event_mode)

    def initializing(self, stop: float | None = None) -> Instance:
        """A fresh instance in initialization mode."""
        instance = self.instantiate()
        try:
            instance.begin(self.t0, stop=stop)
        except FmuError:
            instance.free()
            raise
        return instance

    def started(self, stop: float | None = None) -> Instance:
        """A fresh instance, initialized; for model exchange in continuous-time mode."""
        instance = self.initializing(stop)
        try:
            self.finish(instance)
        except FmuError:
            instance.free()
            raise
        return instance

    def finish(self, instance: Instance) -> None:
        """Leave initialization mode, for that in which it is run."""
        instance.finish()
        if self.kind == MODEL_EXCHANGE:
            instance.discrete_update()
            instance.call("EnterContinuousTimeMode")

    def get(self, instance: Instance, variables: Sequence[Scalars]) -> FloatArray:
        """Values of variables of double precision, side by side."""
        if not variables:
            return np.empty(0)
        kind = variables[0].kind
        vr = references([v.reference for v in variables])
        return np.asarray(instance.get(kind, vr, sum(v.size for v in variables)), dtype=np.float64)

    def set(self, instance: Instance, variable: Scalars, values: FloatArray) -> None:
        """Set one variable."""
        instance.set(variable.kind, references([variable.reference]), values)

    def run(self, instance: Instance, n: int, first: int = 0) -> FloatArray:
        """Outputs after each of some steps, (n, width)."""
        rows = []
        for k in range(first, first + n):
            instance.step(self.t0 + k * self.h, self.h)
            rows.append(self.get(instance, self.outputs()))
        return np.array(rows)


def _scalars(variable: Any) -> Scalars:
    shape = tuple(int(n) for n in (variable.shape or ()))
    size = int(np.prod(shape, dtype=np.int64)) if shape else 1
    start = None
    if variable.start is not None and variable.type in (*REAL, *INTEGER, *BOOLEAN):
        text = variable.start
        words = text.split() if isinstance(text, str) else [str(x) for x in np.ravel(text)]
        start = tuple(1.0 if w == "true" else 0.0 if w == "false" else float(w) for w in words)
        if len(start) == 1 and size > 1:
            start *= size

    def bound(text: Any, otherwise: float) -> float:
        return otherwise if text is None else float(text)

    return Scalars(
        variable.name,
        variable.type,
        int(variable.valueReference),
        size,
        start,
        variable.causality or "local",
        variable.variability or "continuous",
        variable.initial,
        (bound(variable.min, -math.inf), bound(variable.max, math.inf)),
        bool(getattr(variable, "clocks", None)),
    )


# --------------------------------------------------------------------------------- checks


def check_start(subject: Subject) -> Iterator[Finding]:
    """Start values of the description against those in the binary."""
    instance = subject.initializing()
    try:
        for v in subject.variables:
            told = v.causality in ("input", "parameter") or v.initial == "exact"
            told &= not v.clocked  # which is there while its clock ticks
            if v.start is None or not told or v.kind not in (*REAL, *INTEGER, *BOOLEAN):
                continue
            got = np.asarray(
                instance.get(v.kind, references([v.reference]), v.size), dtype=np.float64
            )
            stated = np.asarray(v.start)
            wrong = np.flatnonzero(~((got == stated) | (np.isnan(got) & np.isnan(stated))))
            if not wrong.size:
                continue
            k = int(wrong[0])
            relative = abs(got[k] - stated[k]) / max(abs(got[k]), abs(stated[k]))
            digits = f", {relative:.1g} apart" if relative < 1e-3 else ""
            yield Finding(
                "start",
                WARNING if relative <= ROUNDED else ERROR,
                v.name,
                f"the description says {float(stated[k])!r}, "
                f"the binary has {float(got[k])!r}{digits}",
                "who shows or copies the start values of the description gets other results",
            )
    finally:
        instance.free()


def check_run(subject: Subject) -> Iterator[Finding]:
    """It must start and step with its own start values, and give finite outputs."""
    instance = subject.started()
    try:
        if subject.kind == CO_SIMULATION:
            values = subject.run(instance, STEPS)
        else:
            n = subject.n_states
            rates = instance.rates(n) if n else np.empty(0)
            values = np.concatenate([subject.get(instance, subject.outputs()), rates])
        if not np.isfinite(values).all():
            yield Finding(
                "run", WARNING, "outputs", "they are not finite with the FMU's own start values",
                "it cannot be tried without knowing which inputs it needs",
            )  # fmt: skip
        instance.terminate()
    finally:
        instance.free()


def check_state(subject: Subject) -> Iterator[Finding]:
    """A state that is set again must lead to the same outputs, to the last bit."""
    if subject.kind != CO_SIMULATION:
        return
    if not subject.has_state:
        yield Finding("state", NOTE, "canGetAndSetFMUState", "its state cannot be got and set")
        return
    instance = subject.started()
    try:
        subject.run(instance, STEPS)
        state = instance.get_state()
        first = subject.run(instance, STEPS, STEPS)
        instance.set_state(state)
        again = subject.run(instance, STEPS, STEPS)
        instance.free_state(state)
        if not np.array_equal(first, again, equal_nan=True):
            yield _different("state", subject, first, again, "after its state was set back",
                             "a master that repeats steps gets other results")  # fmt: skip
        if not subject.interface.canSerializeFMUstate:
            yield Finding(
                "state", NOTE, "canSerializeFMUState", "its state cannot be kept as bytes"
            )
            return
        if subject.once:
            return
        other, restarted = subject.started(), subject.started()
        try:
            subject.run(restarted, STEPS)
            other.deserialize(restarted.serialize())
            moved = subject.run(other, STEPS, STEPS)
        finally:
            restarted.free()
            other.free()
        if not np.array_equal(first, moved, equal_nan=True):
            yield _different("state", subject, first, moved, "in another instance, from bytes",
                             "a resumed run gets other results")  # fmt: skip
    finally:
        instance.free()


def check_reset(subject: Subject) -> Iterator[Finding]:
    """Reset must lead back to the state after instantiation."""
    instance = subject.started()
    try:
        if subject.kind == CO_SIMULATION:
            first = subject.run(instance, STEPS)
        else:
            first = subject.get(instance, subject.outputs())
        instance.reset()
        instance.begin(subject.t0)
        subject.finish(instance)
        if subject.kind == CO_SIMULATION:
            again = subject.run(instance, STEPS)
        else:
            again = subject.get(instance, subject.outputs())
        if not np.array_equal(first, again, equal_nan=True):
            yield _different("reset", subject, first, again, "after a reset",
                             "a campaign that resets its instances is wrong")  # fmt: skip
    finally:
        instance.free()


def check_instances(subject: Subject) -> Iterator[Finding]:
    """Two instances at once must not disturb each other."""
    if subject.once:
        yield Finding("instances", NOTE, "canBeInstantiatedOnlyOncePerProcess", "it says so")
        return
    alone = subject.started()
    try:
        if subject.kind == CO_SIMULATION:
            expected = subject.run(alone, STEPS)
        else:
            expected = subject.get(alone, subject.outputs())
    finally:
        alone.free()
    pair = [subject.started(), subject.started()]
    try:
        if subject.kind == CO_SIMULATION:
            rows: list[list[FloatArray]] = [[], []]
            for k in range(STEPS):
                for found, instance in zip(rows, pair, strict=True):
                    found.append(subject.run(instance, 1, k)[0])
            found_values = [np.array(r) for r in rows]
        else:
            found_values = [subject.get(i, subject.outputs()) for i in pair]
        for values in found_values:
            if not np.array_equal(values, expected, equal_nan=True):
                yield _different("instances", subject, expected, values, "beside another instance",
                                 "an ensemble in one process is wrong")  # fmt: skip
                return
    finally:
        for instance in pair:
            instance.free()


def check_cycles(subject: Subject) -> Iterator[Finding]:
    """A thousand times instantiated and freed: no failure, bounded memory."""
    if subject.once:
        return
    early = 0
    for k in range(CYCLES):
        try:
            subject.instantiate().free()
        except FmuError as error:
            yield Finding(
                "cycles", WARNING, f"instance {k + 1}", str(error),
                "a campaign with as many members ends here",
            )  # fmt: skip
            return
        if k == CYCLES // 4:
            early = _resident()
    grown = (_resident() - early) / (CYCLES - CYCLES // 4)
    if early and grown > 1024:
        yield Finding(
            "cycles", WARNING, "memory", f"each instance leaves {grown / 1024:.1f} KiB behind",
            "a long campaign in one process runs out of memory",
        )  # fmt: skip


def check_step_size(subject: Subject, case: str) -> Iterator[Finding]:
    """A step that makes no sense, or that the FMU says it cannot do, is better refused."""
    internal = float(getattr(subject.interface, "fixedInternalStepSize", None) or 0.0)
    what, h = {
        "negative": ("a negative step", -subject.h),
        "zero": ("a step of zero", 0.0),
        "NaN": ("a step of NaN", math.nan),
        "fraction": (f"a step that is no multiple of {internal:g} s", 0.37 * internal),
        "past": ("a step past the stop time", subject.h),
    }[case]
    if case == "fraction" and not internal:
        return
    instance = subject.started(stop=subject.t0 + subject.h if case == "past" else None)
    try:
        t = subject.t0
        if case == "past":
            instance.step(t, h)
            t += h
        try:
            instance.step(t, h)
        except FmuError as error:
            if error.status == 4:
                yield Finding("step size", WARNING, "doStep", f"{what} is fatal: {error}",
                              "one wrong step costs the whole process")  # fmt: skip
            return
    finally:
        instance.free()
    if case == "zero":
        return  # it does nothing
    # "If the environment tries to compute past stopTime, the FMU has to return Error"
    severity = ERROR if case == "past" else WARNING
    yield Finding("step size", severity, "doStep", f"{what} is accepted",
                  "a master's mistake goes on unnoticed, with wrong results")  # fmt: skip


def check_derivatives(subject: Subject) -> Iterator[Finding]:
    """Directional derivatives against central differences."""
    element = "CoSimulation" if subject.kind == CO_SIMULATION else "ModelExchange"
    if element not in subject.archive.directional:
        yield Finding("derivatives", NOTE, "providesDirectionalDerivatives", "it has none")
        return
    if subject.kind == MODEL_EXCHANGE:
        yield from _derivatives_of_rates(subject)
    elif subject.has_state:
        yield from _derivatives_of_steps(subject)


def _derivatives_of_rates(subject: Subject) -> Iterator[Finding]:
    description = subject.description
    states = [subject.by_name[u.variable.derivative.name] for u in description.derivatives]
    rates = [subject.by_name[u.variable.name] for u in description.derivatives]
    n = sum(v.size for v in states)
    instance = subject.started()
    try:
        x = instance.get_vector("GetContinuousStates", n).copy()
        inputs = [v for v in subject.reals("input") if v.variability == "continuous"]
        outputs = [v for v in subject.outputs() if v.variability == "continuous"]
        unknowns = rates + outputs
        starts = np.cumsum([0] + [v.size for v in states]).tolist()

        def evaluate() -> FloatArray:
            # through get, not the vector function: the same door that importers take
            return np.concatenate([instance.rates(n), subject.get(instance, outputs)])

        for v, at in zip([*states, *inputs][:MOST_KNOWNS], [*starts[:-1], *[-1] * len(inputs)],
                         strict=False):  # fmt: skip
            now = x[at : at + v.size] if at >= 0 else subject.get(instance, [v])
            for k in range(v.size):
                h = 1e-5 * max(1.0, float(np.max(np.abs(now))))

                def moved(by: float, v: Scalars = v, at: int = at, k: int = k,
                          now: FloatArray = now) -> FloatArray:  # fmt: skip
                    if at >= 0:
                        y = x.copy()
                        y[at + k] += by
                        instance.set_states(y)
                    else:
                        value = now.copy()
                        value[k] += by
                        subject.set(instance, v, value)
                    return evaluate()

                difference = (moved(h) - moved(-h)) / (2 * h)
                moved(0.0)
                seed = np.zeros(v.size)
                seed[k] = 1.0
                stated = instance.directional(
                    references([u.reference for u in unknowns]),
                    references([v.reference]),
                    seed.tolist(),
                    sum(u.size for u in unknowns),
                )
                scale = float(np.max(np.abs(evaluate()))) * 1e-16 / h
                yield from _compared("derivatives", v, k, unknowns, stated, difference, scale)
    finally:
        instance.free()


def _derivatives_of_steps(subject: Subject) -> Iterator[Finding]:
    """Outputs by inputs: at once, or through the step that the inputs were set for."""
    stated_for = _stated(subject.description.outputs)
    outputs = subject.outputs()
    inputs = subject.reals("input")
    if not inputs or not outputs:
        return
    instance = subject.started()
    try:
        subject.run(instance, 2)
        before = instance.get_state()
        t = subject.t0 + 2 * subject.h

        def response(
            v: Scalars, value: FloatArray, now: FloatArray, *, at_once: bool
        ) -> FloatArray:
            instance.set_state(before)
            if at_once:
                subject.set(instance, v, now)
                instance.step(t, subject.h)
            subject.set(instance, v, value)
            if not at_once:
                instance.step(t, subject.h)
            return subject.get(instance, outputs)

        count = 0
        hidden: list[str] = []
        for v in inputs:
            for k in range(v.size):
                count += 1
                if count > MOST_KNOWNS:
                    break
                instance.set_state(before)
                now = subject.get(instance, [v])
                size = float(np.max(np.abs(now)))
                h = 1e-5 * (size if size > 0 else 1.0)
                along = np.eye(v.size)[k]
                try:
                    through, instant, wider = (
                        (
                            response(v, now + by * along, now, at_once=a)
                            - response(v, now - by * along, now, at_once=a)
                        )
                        / (2 * by)
                        for a, by in ((False, h), (True, h), (False, 4 * h))
                    )
                except FmuError:
                    continue  # it refuses such a value
                if np.max(np.abs(through - wider)) > 1e-3 * np.max(np.abs(through)):
                    hidden.append(v.name)
                    continue
                instance.set_state(before)
                subject.set(instance, v, now)
                instance.step(t, subject.h)
                seed = np.zeros(v.size)
                seed[k] = 1.0
                found = instance.directional(
                    references([o.reference for o in outputs]),
                    references([v.reference]),
                    seed.tolist(),
                    sum(o.size for o in outputs),
                )
                columns = np.concatenate(
                    [np.full(o.size, v.name in stated_for.get(o.name, {v.name})) for o in outputs]
                )
                meant = (instant, through) if np.any(instant) else (through, instant)
                scale = float(np.max(np.abs(subject.get(instance, outputs)))) * 1e-16 / h
                wrong = [
                    [*_compared("derivatives", v, k, outputs, found * columns, by * columns, scale)]
                    for by in meant
                ]
                if all(wrong):  # the standard says neither "at once" nor "through a step"
                    yield from wrong[0]
                elif not np.any(instant):
                    for each in wrong[0]:
                        yield replace(each, severity=NOTE, why="right at once, not for the step")
        instance.free_state(before)
        if hidden:
            yield Finding("derivatives", NOTE, ", ".join(dict.fromkeys(hidden)), "differences over "
                          "several widths disagree, as of a stair or a solver of its own: its "
                          "derivatives by them were not compared")  # fmt: skip
    finally:
        instance.free()


def _compared(
    check: str,
    known: Scalars,
    element: int,
    unknowns: Sequence[Scalars],
    stated: FloatArray,
    difference: FloatArray,
    rounding: float,
) -> Iterator[Finding]:
    column = max(float(np.max(np.abs(difference), initial=0.0)), 1e-300)
    wrong = np.abs(stated - difference) > 1e-4 * column + 100 * rounding
    if not wrong.any():
        return
    row = int(np.argmax(np.abs(stated - difference)))
    far = abs(stated[row] - difference[row]) > INEXACT * column
    names = [
        f"{u.name}[{k + 1}]" if u.size > 1 else u.name for u in unknowns for k in range(u.size)
    ]
    by = f"{known.name}[{element + 1}]" if known.size > 1 else known.name
    yield Finding(
        check,
        ERROR if far else WARNING,
        f"d {names[row]} / d {by}",
        f"it says {stated[row]:.9g}, differences give {difference[row]:.9g}",
        "Newton iterations converge slowly or not, and linearizations are wrong",
    )


def _stated(unknowns: Sequence[Any]) -> dict[str, set[str]]:
    """Names each unknown depends on; one without a list depends on everything, and is left out."""
    return {
        u.variable.name: {d.name for d in u.dependencies}
        for u in unknowns
        if u.dependencies is not None
    }


def check_dependencies(subject: Subject) -> Iterator[Finding]:
    """What changes at once although the description does not say that it depends."""
    stated = _stated(subject.description.initialUnknowns)
    outputs = [v for v in subject.outputs() if v.name in stated]
    if outputs:
        knowns = [v for v in subject.reals("input", "parameter") if v.start is not None]
        yield from _reached(subject, stated, outputs, knowns[:MOST_KNOWNS], "InitialUnknowns")
    if subject.kind != CO_SIMULATION:
        return
    stated = _stated(subject.description.outputs)
    outputs = [v for v in subject.outputs() if v.name in stated]
    inputs = subject.reals("input")[:MOST_KNOWNS]
    if outputs and inputs:
        yield from _reached(subject, stated, outputs, inputs, "Outputs")


def _reached(
    subject: Subject,
    stated: dict[str, set[str]],
    outputs: Sequence[Scalars],
    knowns: Sequence[Scalars],
    where: str,
) -> Iterator[Finding]:
    starts = np.cumsum([0] + [v.size for v in outputs])
    begin = subject.initializing if where == "InitialUnknowns" else subject.started
    instance = begin()
    try:
        before = subject.get(instance, outputs)
        for v in knowns:
            now = subject.get(instance, [v])
            with np.errstate(over="ignore"):  # of the largest number, which stands for infinity
                value = now + 1e-3 * np.where(now == 0, 1.0, np.abs(now))
            value = np.clip(value, *v.bounds)
            try:
                subject.set(instance, v, value)
                after = subject.get(instance, outputs)
            except FmuError:
                instance.free()
                instance = begin()
                continue  # it refuses such a value
            subject.set(instance, v, now)
            noise = np.abs(subject.get(instance, outputs) - before)
            size = np.maximum(np.abs(before), np.abs(after))
            changed = np.abs(after - before) > np.maximum(10 * noise, NOISE * size)
            for o, a, b in zip(outputs, starts, starts[1:], strict=False):
                if changed[a:b].any() and v.name not in stated[o.name]:
                    yield Finding(
                        "dependencies",
                        ERROR,
                        f"{where}: {o.name}",
                        f"it changes with '{v.name}', which its dependencies do not name",
                        "a master that orders its calls by them uses old values",
                    )
    finally:
        instance.free()


def _different(
    check: str, subject: Subject, expected: FloatArray, found: FloatArray, when: str, why: str
) -> Finding:
    rows, columns = np.atleast_2d(expected), np.atleast_2d(found)
    apart = np.nanmax(np.abs(rows - columns), axis=0)
    size = np.nanmax(np.maximum(np.abs(rows), np.abs(columns)), axis=0)
    relative = np.nan_to_num(apart / np.where(size > 0, size, 1.0))
    relative[(np.isnan(rows) != np.isnan(columns)).any(axis=0)] = np.inf
    column = int(np.argmax(relative))
    names = [v.name for v in subject.outputs() for _ in range(v.size)]
    what = f"it differs by {apart[column]:.3g}, {relative[column]:.1g} of its size, {when}"
    severity = ERROR
    if check == "state" and relative[column] <= SOLVED:
        severity, why = WARNING, f"its own solver seems to start anew: {why}"
    return Finding(check, severity, names[column], what, why)


def _resident() -> int:
    """Resident memory of this process [bytes]; 0 where it is not known."""
    try:
        with open("/proc/self/statm") as file:  # noqa: PTH123 - a number of the kernel's
            return int(file.read().split()[1]) * 4096
    except OSError:
        return 0


CHECKS: dict[str, Callable[[Subject], Iterator[Finding]]] = {
    "start": check_start,
    "run": check_run,
    "derivatives": check_derivatives,
    "state": check_state,
    "reset": check_reset,
    "instances": check_instances,
    "cycles": check_cycles,
    **{
        f"step size, {case}": partial(check_step_size, case=case)
        for case in ("negative", "zero", "NaN", "fraction", "past")
    },
    "dependencies": check_dependencies,
}


def run_check(file: str, kind: str, name: str) -> list[Finding]:
    """Run one check; what the FMU refuses there is a finding too."""
    subject = Subject(open_archive(file), kind)
    found: list[Finding] = []
    try:
        for finding in CHECKS[name](subject):
            found.append(finding)
            if len(found) >= 20:
                break
    except FmuError as error:
        sets = error.function.startswith("Set") and "state" not in error.function.lower()
        severity = WARNING if sets or error.function in _MAY_FAIL else ERROR
        if isinstance(error, FmuEndedError):
            severity = NOTE
        why = "an importer meets the same refusal"
        found.append(Finding(name.split(",")[0], severity, kind, str(error), why))
    return found


def sample(file: str, kind: str) -> FloatArray:
    """Outputs of the first instance of a process, to see whether another process has the same."""
    subject = Subject(open_archive(file), kind)
    instance = subject.started()
    try:
        if kind == CO_SIMULATION:
            return subject.run(instance, 2 * STEPS)
        return subject.get(instance, subject.outputs())
    finally:
        instance.free()


def load(file: str, kind: str) -> None:
    """Load the binary, so that a check alone is timed."""
    Subject(open_archive(file), kind)


def main() -> None:
    """Run checks for another process."""
    serve({"check": run_check, "load": load, "sample": sample})
