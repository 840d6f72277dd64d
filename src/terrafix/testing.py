"""A component alone: driven by given inputs, step by step, to look at what it publishes.

driven = drive(Altimeter(sigma="25 m"), {"r_e": [7070e3, 0, 0]}, steps=100, members=8)
assert abs(driven["height"].mean() - 691_863) < 5
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate, base_step
from terrafix.cosim.basics.errors import ConfigurationError, RateError, WiringError, nearest
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import BundleOutput, MessageOutput, Output, Port, SharedOutput
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.memory.fields import Field
from terrafix.cosim.system.system import System

NAME = "driven"
"""Path of the component in its system: what its noise is keyed by."""
Values = ArrayLike | Callable[[float], ArrayLike] | Mapping[Any, Any]
"""A constant, an array with one value per step from t = 0 on, or a function of time [s]; by field
for bundles; by time [s] for messages."""


@dataclass(frozen=True)
class Messages:
    """Messages of one port, one row per step: what stood on the port then.

    Attributes
    ----------
    t : ndarray, shape (steps + 1, members)
        Time of validity [s]; NaN before the first.
    fresh : ndarray of bool, shape (steps + 1, members)
        Whether one was published in that step.
    fields : dict of str to ndarray, shape (steps + 1, members, ...)
    """

    t: FloatArray
    fresh: NDArray[np.bool_]
    fields: dict[str, NDArray[Any]]

    def __getitem__(self, field: str) -> NDArray[Any]:
        """The values of one field."""
        if field not in self.fields:
            raise KeyError(f"the message has no '{field}'; {nearest(field, self.fields)}")
        return self.fields[field]


@dataclass(frozen=True)
class Driven:
    """What a component published, step by step; the first row is that of t = 0.

    Attributes
    ----------
    times : ndarray, shape (steps + 1,)
        [s]
    outputs : dict
        By port: ndarray, shape (steps + 1, members, ...); by field for bundles; `Messages`; for a
        shared port the list of its values.
    states : dict of str to ndarray, shape (steps + 1, members, ...)
    failed : dict of int to str
        Members that failed, and why.
    """

    times: FloatArray
    outputs: dict[str, Any]
    states: dict[str, NDArray[Any]]
    failed: dict[int, str]

    def __getitem__(self, name: str) -> Any:
        """An output or a state by name."""
        found = {**self.states, **self.outputs}
        if name not in found:
            raise KeyError(f"nothing was published as '{name}'; {nearest(name, found)}")
        return found[name]


def drive(
    component: Component,
    inputs: Mapping[str, Values] | None = None,
    steps: int = 1,
    *,
    members: int = 1,
    seed: int = 0,
) -> Driven:
    """Step one component alone, as it would be stepped in a system.

    Parameters
    ----------
    component : Component
        It belongs to no system yet.
    inputs : mapping
        By port: a constant; an array with a row for each step, the first for t = 0; or a function
        of the time of the step [s]. For a bundle, the same by field. For a message, its value (or
        a dict of its fields) by the time when it comes [s].
        What is given for a step is what that step reads, at whichever end of it.
    steps : int
        How many steps of the component's own rate.
    members : int
        Size of the ensemble; inputs are the same for all.
    seed : int
        Of its noise.

    Raises
    ------
    ConfigurationError, WiringError, RateError
        If an input does not exist, does not fit or is missing, or nothing can be stepped.
    """
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        raise ConfigurationError(f"steps is {steps!r}; drive takes a whole number from 1 on")
    if not isinstance(component, Component):
        raise ConfigurationError(
            f"drive takes a component, not {component!r}\n  make one: drive(Imu(...), ...)"
        )
    if component.rate is None:
        raise RateError(
            f"a {type(component).__name__} has no rate of its own\n"
            '  give it one to be driven at: rate=Rate("0.01")'
        )
    if not isinstance(inputs, Mapping | None):
        raise ConfigurationError(
            f"inputs is {inputs!r}; drive takes a dict by the names of the component's inputs:\n"
            f"  {', '.join(component.inputs()) or 'it has none'}"
        )
    system = System("drive")
    system.add(component, NAME)
    times = _times(component.rate, steps)
    for name, values in (inputs or {}).items():
        if name not in component.inputs():
            raise WiringError(
                f"{type(component).__name__} has no input '{name}'\n"
                f"  {nearest(name, component.inputs(), what='its inputs')}"
            )
        port = component.inputs()[name]
        source = system.add(_source(name, port, values, component.rate, times), f"given_{name}")
        system.connect(source["value"], component[name])
    simulation = Simulation(system, members=members, seed=seed, duration=times[-1])
    try:
        return _collect(simulation, component, times)
    finally:
        simulation.master.terminate()


def _times(rate: Rate, steps: int) -> list[Fraction]:
    """Zero, and the times of the steps."""
    base = base_step(rate.exact_numbers, rate.times or ())
    ticks = list(islice(rate.ticks(base), steps))
    if len(ticks) < steps:
        raise RateError(f"it steps {len(ticks)} times in all, {rate}; {steps} steps were asked for")
    return [Fraction(0), *(tick * base for tick in ticks)]


def _collect(simulation: Simulation, component: Component, times: Sequence[Fraction]) -> Driven:
    rows: list[dict[str, Any]] = []
    states: list[dict[str, Any]] = []
    for t in times:
        simulation.run_until(t)
        rows.append({name: _now(component, name) for name in component.outputs()})
        states.append(component.get_state()["states"])
    outputs = {n: _stacked(p, [row[n] for row in rows]) for n, p in component.outputs().items()}
    return Driven(
        np.array([float(t) for t in times]),
        outputs,
        {n: np.stack([s[n] for s in states]) for n in states[-1]},
        {f["member"]: f["reason"] for f in simulation.master.excluded},
    )


def _now(component: Component, name: str) -> Any:
    """A copy of what stands on an output."""
    port, view = component.outputs()[name], getattr(component, name)
    if port.kind == "message":
        slot = view.slot
        fields = {n: v.copy() for n, v in slot.views.items()}
        return slot.t.copy(), slot.sequence.copy(), fields
    if port.is_bundle:
        return {n: getattr(view, n).copy() for n in port.fields}
    return view if port.kind == "shared" else view.copy()


def _stacked(port: Port[Any], rows: Sequence[Any]) -> Any:
    if port.kind == "shared":
        return list(rows)
    if port.is_bundle and port.kind != "message":
        return {n: np.stack([row[n] for row in rows]) for n in port.fields}
    if port.kind != "message":
        return np.stack(rows)
    sequence = np.stack([row[1] for row in rows])
    fresh = np.diff(sequence, axis=0, prepend=0) > 0
    fields = {n or "value": np.stack([row[2][n] for row in rows]) for n in port.fields}
    return Messages(np.stack([row[0] for row in rows]), fresh, fields)


# ---------------------------------------------------------------------- what feeds the inputs


class _Source(Component):
    """Publishes given values, one for each step of the component that is driven."""

    row: Callable[[int], dict[str, Any]]
    """Values by field, as the step of this number reads them."""
    value: Any
    """The port, which each kind of source declares."""
    ahead: int = 0
    """1 where the input is read at the start of the step: it shows the next step's value."""

    def _initialize_impl(self) -> None:
        self._publish()

    def _step_impl(self, t: float, dt: float) -> None:
        self._publish()

    def _publish(self) -> None:
        for name, value in self.row(self.step_index + self.ahead).items():
            if name:
                setattr(self.value, name, value)
            else:
                self.value = value


class _MessageSource(Component):
    """Publishes given messages, each in the first step at or after its time."""

    coming: Sequence[tuple[float, dict[str, Any]]]
    value: Any

    def _initialize_impl(self) -> None:
        self._publish(0.0)

    def _step_impl(self, t: float, dt: float) -> None:
        self._publish(t)

    def _publish(self, t: float) -> None:
        while self.coming and self.coming[0][0] <= t + 1e-9:
            (valid_at, fields), self.coming = self.coming[0], self.coming[1:]
            given = {
                n or "value": np.broadcast_to(v, (self.n_members, *np.shape(v)))
                for n, v in fields.items()
            }
            self.value.publish(valid_at, **given)


def _source(
    name: str, port: Port[Any], values: Values, rate: Rate, times: Sequence[Fraction]
) -> Component:
    seconds = [float(t) for t in times]
    if port.kind == "message":
        kind = type("Messages", (_MessageSource,), {"value": _output(port)})
        made: Any = kind(rate=rate)
        made.coming = _messages(name, port, values, seconds[-1])
        return made  # type: ignore[no-any-return]
    one = port.fields.get("")
    kind = type("Given", (_Source,), {"value": _output(port)})
    source: Any = kind(rate=rate)
    source.ahead = int(port.at == "start")
    by_field = {"": values} if one is not None else values
    if not isinstance(by_field, Mapping) or set(by_field) != set(port.fields):
        raise ConfigurationError(
            f"input '{name}' is a bundle of {', '.join(port.fields)}\n"
            "  give a dict with all of them"
        )
    rows = {n: _rows(name, n, port.fields[n], v, seconds) for n, v in by_field.items()}
    last = len(seconds) - 1
    source.row = lambda k: {n: row(min(k, last)) for n, row in rows.items()}
    return source  # type: ignore[no-any-return]


def _output(port: Port[Any]) -> Port[Any]:
    """The output that an input can be connected to as it is."""
    if port.is_bundle and port.kind != "message":
        return BundleOutput(dict(port.fields))
    make = {"message": MessageOutput, "shared": SharedOutput, "signal": Output}[port.kind]
    if port.is_bundle:
        return make(fields=dict(port.fields))
    one = port.single
    return make(one.shape, unit=one.unit, frame=one.frame, dtype=one.dtype, ragged=one.ragged)


def _rows(
    name: str, part: str, field: Field, values: Any, seconds: Sequence[float]
) -> Callable[[int], NDArray[Any]]:
    """What each step reads, checked before anything runs."""
    where = f"input '{name}'" + (f", field '{part}'" if part else "")
    if callable(values):
        given = [_array(where, field, values(t)) for t in seconds]
    else:
        array = _array(where, field, values)
        constant = _fits(array.shape, field.shape)
        if not constant and len(array) != len(seconds):
            raise ConfigurationError(
                f"{where} takes shape {field.shape}, got {array.shape}\n"
                f"  give one value, or {len(seconds)} of them (t = 0 and every step), or a "
                "function of time"
            )
        given = [array] * len(seconds) if constant else list(array)
    for value in given:
        if not _fits(value.shape, field.shape):
            raise ConfigurationError(f"{where} takes shape {field.shape}, got {value.shape}")
    return lambda k: given[k]


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    return len(shape) == len(expected) and all(
        e is None or e == n for n, e in zip(shape, expected, strict=True)
    )


def _array(where: str, field: Field, value: Any) -> NDArray[Any]:
    """The value as the port's dtype; text, None, ragged lists and what would be rounded are not."""
    try:
        array = np.asarray(value)
    except ValueError:
        raise ConfigurationError(f"{where} takes shape {field.shape}, got uneven rows") from None
    if not np.can_cast(array.dtype, field.dtype, "same_kind"):
        raise ConfigurationError(
            f"{where} takes {np.dtype(field.dtype)} in {field.unit_text()}, got {value!r}\n"
            "  give plain numbers, a function of time or, for messages, a dict by time"
        )
    return array.astype(field.dtype)


def _messages(
    name: str, port: Port[Any], values: Any, end: float
) -> list[tuple[float, dict[str, Any]]]:
    if not isinstance(values, Mapping):
        raise ConfigurationError(
            f"input '{name}' takes messages\n  give them by the time when they come: {{8.2: value}}"
        )
    for t in values:
        if not isinstance(t, int | float | np.number) or not 0.0 <= t <= end + 1e-9:
            raise ConfigurationError(
                f"a message to input '{name}' comes at {t!r}\n"
                f"  the component is driven from 0 to {end:g} s: give a time in it, or more steps"
            )
    found = []
    for t, value in sorted(values.items()):
        fields = value if port.is_bundle else {"": value}
        if not isinstance(fields, Mapping) or set(fields) != set(port.fields):
            raise ConfigurationError(
                f"a message to input '{name}' has the fields {', '.join(port.fields)}\n"
                "  give a dict with all of them"
            )
        arrays = {}
        for part, each in fields.items():
            where = f"input '{name}'" + (f", field '{part}'" if part else "")
            field = port.fields[part]
            arrays[part] = _array(where, field, each)
            if not _fits(arrays[part].shape, field.shape):
                raise ConfigurationError(
                    f"{where} takes shape {field.shape}, got {arrays[part].shape}"
                )
        found.append((float(t), arrays))
    return found
