"""Exact time: rational periods, integer ticks, schedules.

A period is a rational number of seconds. The base step is the rational greatest common divisor of
all periods, offsets and delays of a system; time is an integer tick, and seconds come from one
division, never from a sum.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from itertools import pairwise

from terrafix.cosim.basics.errors import RateError

Exact = int | str | Fraction | Decimal
"""What is accepted as an exact number of seconds or hertz."""
MOST_TIMES = 8
"""Times that a repr lists."""

_SECONDS: dict[str, int | Fraction] = {
    "": 1,
    "s": 1,
    "ms": Fraction(1, 1000),
    "us": Fraction(1, 10**6),
    "min": 60,
    "h": 3600,
}
_HERTZ: dict[str, int | Fraction] = {"": 1, "Hz": 1, "kHz": 1000, "MHz": 10**6}
_NUMBER = re.compile(
    r"\s*([+-]?(?:\d+/\d+|(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?))\s*([A-Za-z]*)\s*\Z"
)


def _decimal_hint(value: float) -> str:
    near = Fraction(value).limit_denominator(100_000)
    text = f"{value:.12g}"
    if near == 0:
        return f'write "{text}" (exact)'
    if near.denominator == 1:
        return f'write {near.numerator} or "{near.numerator}"'
    return f'write "{text}" (exact) or "{near.numerator}/{near.denominator}"'


def _scale(unit: str, units: dict[str, int | Fraction]) -> int | Fraction | None:
    """Factor of a unit; its case matters only where it is mixed: mHz is no MHz."""
    if unit in units or not (unit.islower() or unit.isupper()):
        return units.get(unit)
    return {u.lower(): scale for u, scale in units.items()}.get(unit.lower())


def _exact(value: object, what: str, units: dict[str, int | Fraction], kind: str) -> Fraction:
    if isinstance(value, bool):
        raise RateError(f"{what} is {value}; give {kind}")
    if isinstance(value, int | Fraction | Decimal):
        if isinstance(value, Decimal) and not value.is_finite():
            raise RateError(f"{what} is {value}; give a finite number")
        return Fraction(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise RateError(f"{what} is {value}; give a finite number")
        raise RateError(
            f"{what} is {value!r}, a binary fraction near {value:.12g}\n  {_decimal_hint(value)}"
        )
    if isinstance(value, str):
        match = _NUMBER.match(value)
        scale = _scale(match[2], units) if match else None
        if match and scale is not None:
            number = match[1]
            if number.endswith("/0") or re.search(r"/0+\Z", number):
                raise RateError(f"{what} is '{value}': division by zero")
            exponent = re.search(r"[eE]([+-]?\d+)\Z", number)
            if exponent and abs(int(exponent[1])) > 18:
                raise RateError(
                    f"{what} is '{value}', which no simulation can count\n  give {kind}"
                )
            return Fraction(number) * scale
        accepted = ", ".join(u for u in units if u)
        raise RateError(
            f"{what} is '{value}', which is not {kind}\n"
            f'  write a number such as "8.2", "1/30" or "{"10 ms" if "ms" in units else "100 Hz"}"'
            f" (units: {accepted})"
        )
    raise RateError(f"{what} is {value!r} of type {type(value).__name__}; give {kind} as a string")


def seconds(value: object, what: str = "duration") -> Fraction:
    """Exact seconds from an int, a fraction, a decimal or a string such as ``"8.2 s"``.

    Raises
    ------
    RateError
        If `value` is a float (it would be a binary fraction) or is not a time.
    """
    return _exact(value, what, _SECONDS, "a time in seconds")


def hertz(value: object, what: str = "rate") -> Fraction:
    """Exact hertz from an int, a fraction, a decimal or a string such as ``"100 Hz"``."""
    return _exact(value, what, _HERTZ, "a rate in hertz")


def text_seconds(value: Fraction) -> str:
    """Write seconds so that `seconds` reads the same number back."""
    denominator = value.denominator
    while denominator % 2 == 0:
        denominator //= 2
    while denominator % 5 == 0:
        denominator //= 5
    if denominator == 1:
        decimal = Decimal(value.numerator) / Decimal(value.denominator)
        if Fraction(decimal) == value:  # not longer than the 28 digits of a Decimal
            return f"{decimal:f}"
    return f"{value.numerator}/{value.denominator}"


def rational_gcd(values: Iterable[Fraction]) -> Fraction:
    """Greatest rational of which every positive value is an integer multiple."""
    numerator, denominator = 0, 1
    for value in values:
        if value:
            lcm = math.lcm(denominator, value.denominator)
            numerator = math.gcd(
                numerator * (lcm // denominator), value.numerator * (lcm // value.denominator)
            )
            denominator = lcm
    return Fraction(numerator, denominator)


@dataclass(frozen=True, repr=False)
class Rate:
    """When a component steps: a period with an offset, or a list of times.

    Activations are at ``offset + k * period`` for k = 0, 1, ..., or at the listed times. Every
    component is initialized at t = 0 and steps at its activations after 0; it publishes messages
    at 0 only if 0 is one of its activations (offset 0, the default).

    Parameters
    ----------
    period : int, str, Fraction or Decimal, optional
        Seconds between steps, exact: ``"8.2"``, ``"1/30"``, ``"10 ms"``.
    hz : int, str, Fraction or Decimal, optional
        Steps per second, in place of `period`.
    offset : int, str, Fraction or Decimal
        Time of the first activation [s].
    times : sequence, optional
        Explicit activation times [s], increasing, in place of a period.

    Raises
    ------
    RateError
        If a number is a float, not positive, or the arguments contradict each other.
    """

    period: Fraction | None
    offset: Fraction
    times: tuple[Fraction, ...] | None

    def __init__(
        self,
        period: Exact | None = None,
        *,
        hz: Exact | None = None,
        offset: Exact = 0,
        times: Sequence[Exact] | None = None,
    ) -> None:
        if sum(v is not None for v in (period, hz, times)) != 1:
            raise RateError("give exactly one of a period, hz or times")
        exact_period: Fraction | None = None
        exact_times: tuple[Fraction, ...] | None = None
        if period is not None:
            exact_period = seconds(period, "period")
        elif hz is not None:
            frequency = hertz(hz)
            if frequency <= 0:
                raise RateError(f"rate is {hz}; it must be positive")
            exact_period = 1 / frequency
        else:
            assert times is not None
            if isinstance(times, str):
                raise RateError(f"times is the text '{times}'; give a list of times")
            exact_times = tuple(seconds(t, "time") for t in times)
            if not exact_times:
                raise RateError("times is empty; give at least one time")
            if exact_times[0] < 0 or any(b <= a for a, b in pairwise(exact_times)):
                raise RateError("times must be increasing and not negative")
        if exact_period is not None and exact_period <= 0:
            raise RateError(f"period is {text_seconds(exact_period)} s; it must be positive")
        exact_offset = seconds(offset, "offset")
        if exact_offset < 0:
            raise RateError(f"offset is {text_seconds(exact_offset)} s; it must not be negative")
        if exact_times is not None and exact_offset:
            raise RateError("an offset goes with a period, not with a list of times")
        object.__setattr__(self, "period", exact_period)
        object.__setattr__(self, "offset", exact_offset)
        object.__setattr__(self, "times", exact_times)

    @property
    def starts_at_zero(self) -> bool:
        """Whether t = 0 is an activation."""
        return self.times[0] == 0 if self.times else self.offset == 0

    @property
    def last(self) -> float:
        """Time of the last activation [s]; infinity for a period."""
        return math.inf if self.times is None else float(self.times[-1])

    @property
    def exact_numbers(self) -> tuple[Fraction, ...]:
        """The numbers that the base step must divide. Listed times are snapped instead."""
        return () if self.period is None else (self.period, self.offset)

    def ticks(self, base: Fraction, grid: Fraction | None = None, after: int = 0) -> Iterator[int]:
        """Yield the tick of each activation after the tick `after`.

        Parameters
        ----------
        base : Fraction
            Length of a tick [s]; divides `exact_numbers`.
        grid : Fraction, optional
            A multiple of `base` to which listed times are snapped [s]; `base` if absent. A time
            between two points goes to the later one: the data exist by then.
        after : int
            Where to begin; activations at t = 0 are initialization.
        """
        if self.times is not None:
            yield from (tick for tick in self._snapped(base, grid) if tick > after)
            return
        tick, increment = self._regular(base)
        if tick <= after:
            tick += ((after - tick) // increment + 1) * increment
        while True:
            yield tick
            tick += increment

    def last_tick(self, base: Fraction, grid: Fraction | None, tick: int) -> int:
        """Tick of the last activation up to and including `tick`; 0 if there is none."""
        if self.times is not None:
            return max((t for t in self._snapped(base, grid) if t <= tick), default=0)
        first, increment = self._regular(base)
        return tick - (tick - first) % increment if tick >= first else 0

    def _regular(self, base: Fraction) -> tuple[int, int]:
        """First activation and increment, in ticks."""
        assert self.period is not None
        first, increment = self.offset / base, self.period / base
        assert first.denominator == increment.denominator == 1
        return first.numerator, increment.numerator

    def _snapped(self, base: Fraction, grid: Fraction | None) -> list[int]:
        assert self.times is not None
        grid = grid or base
        ticks_per_point = int(grid / base)
        return [math.ceil(time / grid) * ticks_per_point for time in self.times]

    def __repr__(self) -> str:
        """The call that makes it; a long list of times is cut, with their count after it."""
        if self.times is None:
            assert self.period is not None
            offset = f', offset="{text_seconds(self.offset)} s"' if self.offset else ""
            return f'Rate("{text_seconds(self.period)} s"{offset})'
        listed = [f'"{text_seconds(t)} s"' for t in self.times]
        if len(listed) <= MOST_TIMES:
            return f"Rate(times=[{', '.join(listed)}])"
        cut = ", ".join([*listed[: MOST_TIMES // 2], "...", listed[-1]])
        return f"Rate(times=[{cut}])  # {len(listed)} times"

    def identity(self) -> str:
        """All of it, as `str` but with every listed time: equal for equal rates alone."""
        if self.times is None:
            return str(self)
        return f"at {', '.join(map(text_seconds, self.times))} s"

    def __str__(self) -> str:
        if self.times is not None:
            shown = ", ".join(text_seconds(t) for t in self.times[:4])
            return f"at {shown}{', ...' if len(self.times) > 4 else ''} s"
        assert self.period is not None
        text = f"every {text_seconds(self.period)} s"
        if self.offset:
            text += f" from {text_seconds(self.offset)} s"
        return text


def base_step(numbers: Iterable[Fraction], listed: Iterable[Fraction] = ()) -> Fraction:
    """Choose the base step: the gcd of all exact numbers, else of the listed times, else 1 s."""
    return rational_gcd(numbers) or rational_gcd(listed) or Fraction(1)
