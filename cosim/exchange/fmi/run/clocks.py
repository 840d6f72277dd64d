"""Input clocks of FMI 3 that depend on time: when they tick, and that they do, in event mode.

A constant or fixed clock ticks at its shift and then in its interval, as the description says. Of
others the FMU is asked for the interval after each update of its discrete states: a countdown ticks
once after it, the others again and again. A triggered clock ticks when its environment wants it to,
and never here.
"""

from __future__ import annotations

import ctypes as ct
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Protocol

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError

COUNTDOWN, TRIGGERED = "countdown", "triggered"
_UNCHANGED, _CHANGED = 1, 2  # of fmi3IntervalQualifier
_NEAR = 1e-9  # of an interval


class _Instance(Protocol):
    def call(self, name: str, *arguments: Any, accept: int = 1) -> int: ...


@dataclass(frozen=True)
class ClockSaid:
    """What a description says of an input clock.

    Attributes
    ----------
    name : str
    reference : int
    kind : str
        Its intervalVariability.
    interval, shift : Fraction
        [s]; the interval is None where the FMU is asked for it.
    """

    name: str
    reference: int
    kind: str
    interval: Fraction | None = None
    shift: Fraction = Fraction(0)


@dataclass
class _Clock:
    said: ClockSaid
    number: int = 0
    due: float | None = None
    step: float = 0.0


class Clocks:
    """Input clocks of one instance.

    Parameters
    ----------
    said : iterable of ClockSaid
        By the description.
    """

    def __init__(self, said: Iterable[ClockSaid] = ()) -> None:
        self._clocks = [_Clock(each) for each in said if each.kind != TRIGGERED]
        self._start = 0.0

    def __len__(self) -> int:
        return len(self._clocks)

    @property
    def next(self) -> float | None:
        """Time of the next tick [s]."""
        return min((c.due for c in self._clocks if c.due is not None), default=None)

    def begin(self, t: float) -> None:
        """Note the time of the start [s], which those with a known interval count from."""
        self._start = t
        for c in self._clocks:
            if c.said.interval is not None:
                c.due, c.step = t + float(c.said.shift), float(c.said.interval)

    def tick(self, instance: _Instance, t: float) -> None:
        """Let those tick whose time has come, in event mode."""
        due = [c for c in self._clocks if c.due is not None and c.due <= t + _NEAR * c.step]
        if not due:
            return
        references = (ct.c_uint32 * len(due))(*(c.said.reference for c in due))
        active = (ct.c_bool * len(due))(*[True] * len(due))
        instance.call("SetClock", references, ct.c_size_t(len(due)), active)
        for c in due:
            c.number += 1
            c.due = None
            if c.said.interval is not None:
                c.due = self._start + float(c.said.shift + c.number * c.said.interval)

    def update(self, instance: _Instance, t: float) -> None:
        """Ask for the intervals that the FMU decides, after its discrete states were updated."""
        asked = [c for c in self._clocks if c.said.interval is None]
        for c in asked:
            interval, qualifier = ct.c_double(), ct.c_int()
            instance.call(
                "GetIntervalDecimal",
                (ct.c_uint32 * 1)(c.said.reference), ct.c_size_t(1),
                ct.byref(interval), ct.byref(qualifier),
            )  # fmt: skip
            again = c.due is None and c.said.kind != COUNTDOWN and qualifier.value == _UNCHANGED
            if again or qualifier.value == _CHANGED:
                c.step, c.due = interval.value, t + interval.value

    def state(self) -> FloatArray:
        """What `restore` takes: number of ticks, next time, interval, of each."""
        rows = [(c.number, np.nan if c.due is None else c.due, c.step) for c in self._clocks]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)

    def restore(self, state: FloatArray) -> None:
        """Return to what `state` gave."""
        for c, (number, due, step) in zip(self._clocks, state.tolist(), strict=True):
            c.number, c.due, c.step = int(number), None if np.isnan(due) else due, step


def read_clocks(root: Any) -> tuple[ClockSaid, ...]:
    """Input clocks of a description, an XML tree."""
    return tuple(_read(e) for e in root.iter("Clock") if e.get("causality") == "input")


def _read(element: Any) -> ClockSaid:
    kind = element.get("intervalVariability", "")
    interval = _seconds(element, "interval") if kind in ("constant", "fixed") else None
    shift = _seconds(element, "shift") or Fraction(0)
    reference = int(element.get("valueReference"))
    return ClockSaid(element.get("name"), reference, kind, interval, shift)


def _seconds(element: Any, what: str) -> Fraction | None:
    """An interval or shift, written as decimal or as a count of 1 / resolution."""
    decimal = element.get(f"{what}Decimal")
    counter, resolution = element.get(f"{what}Counter"), element.get("resolution")
    if decimal is None and None in (counter, resolution):
        return None
    try:
        found = Fraction(int(counter), int(resolution)) if decimal is None else Fraction(decimal)
    except (ValueError, ArithmeticError):
        found = Fraction(-1)
    if found < 0 or (what == "interval" and not found):
        said = decimal if decimal is not None else f"{counter} / {resolution}"
        raise ConfigurationError(
            f"the FMU says that the {what} of its clock '{element.get('name')}' is '{said}' s\n"
            "  ask for another from the tool that wrote it"
        )
    return found
