"""Units of ports and parameters: compared by dimension, converted or refused before the run.

A thin door to Pint, loaded on first need: equal unit texts never need it.
"""

from __future__ import annotations

import json
import re
from functools import lru_cache
from typing import Any

from terrafix.cosim.basics.errors import ConfigurationError

DIMENSIONLESS = ("", "1")


@lru_cache(maxsize=1)
def _registry() -> Any:
    import pint

    registry: Any = pint.UnitRegistry()
    registry.define("px = pixel")  # of an image; Pint's own px is a length, 1/96 inch
    return registry


@lru_cache(maxsize=1024)
def _unit(text: str) -> Any:
    name = "dimensionless" if text in DIMENSIONLESS else text
    try:
        return _registry().Unit(name)
    except Exception as error:  # pint raises many types for text it cannot read
        raise ConfigurationError(
            f'\'{text}\' is not a unit\n  write it as in "m/s^2", "rad", "deg/h" or "1"'
        ) from error


@lru_cache(maxsize=1024)
def conversion_factor(source: str, target: str) -> float | None:
    """Factor that takes numbers in `source` to `target`; None if the dimensions differ.

    Raises
    ------
    ConfigurationError
        If a text is not a unit, or the conversion is not a pure factor (Celsius, say).
    """
    if source == target or (source in DIMENSIONLESS and target in DIMENSIONLESS):
        return 1.0
    a, b = _unit(source), _unit(target)
    if a.dimensionality != b.dimensionality:
        return None
    registry = _registry()
    zero = registry.Quantity(0.0, a).to(b).magnitude
    if zero != 0.0:
        raise ConfigurationError(
            f"'{source}' to '{target}' is not a pure factor; use an absolute unit such as kelvin"
        )
    return float(registry.Quantity(1.0, a).to(b).magnitude)


def check_unit(text: str) -> None:
    """Raise ConfigurationError if `text` is not a unit."""
    if text not in DIMENSIONLESS:
        _unit(text)


_TRAILING = re.compile(r"\A\s*(\[.*\]|[^\s\[\],]+(?:\s*,\s*[^\s\[\],]+)*)\s*(.*?)\s*\Z", re.DOTALL)


def split_quantity(text: str) -> tuple[Any, str | None]:
    """Split ``"34.3 deg"`` or ``"[7000, 0, 0] km"`` into number(s) and unit (None if absent).

    Numbers may be separated by commas without brackets. Raises ValueError where there is no
    number.
    """
    match = _TRAILING.match(text)
    if not match:
        raise ValueError(text)
    numbers, unit = match[1], match[2]
    if numbers.startswith("["):
        try:
            value = json.loads(_json_numbers(numbers))
        except json.JSONDecodeError:
            raise ValueError(text) from None
    elif "," in numbers:
        value = [_number(part) for part in numbers.split(",")]
    else:
        value = _number(numbers)
    return value, (unit or None)


def _number(text: str) -> float:
    return float(text.strip().replace("_", ""))


def _json_numbers(text: str) -> str:
    """Let a list hold what float() reads: 1_000, .5, 5., +3, nan, inf."""

    def convert(match: re.Match[str]) -> str:
        return json.dumps(_number(match[0]))

    return re.sub(r"[^\s\[\],]+", convert, text)


_BASE_UNITS = {
    "kilogram": "kg",
    "meter": "m",
    "second": "s",
    "ampere": "A",
    "kelvin": "K",
    "mole": "mol",
    "candela": "cd",
    "radian": "rad",
}


def base_units(text: str) -> tuple[float, dict[str, int]] | None:
    """Factor to SI base units and their exponents, as FMI wants them: ``m/s^2`` is m 1, s -2.

    None where an exponent is no whole number, or a unit has no base of its own (pixels).
    """
    unit = _unit(text)
    factor, exponents = 1.0, dict[str, int]()
    for name, power in unit._units.items():
        if name == "radian":
            reduced = {"radian": 1.0}
        else:
            quantity = _registry().Quantity(1.0, name).to_root_units()
            factor *= float(quantity.magnitude) ** power
            reduced = dict(quantity.units._units)
            if not reduced and name in ("degree", "arcminute", "arcsecond", "milliradian"):
                reduced = {"radian": 1.0}
        for base, each in reduced.items():
            if base == "gram":
                base, factor = "kilogram", factor * 1e-3 ** (each * power)
            if base not in _BASE_UNITS or each * power != int(each * power):
                return None
            symbol = _BASE_UNITS[base]
            exponents[symbol] = exponents.get(symbol, 0) + int(each * power)
    return factor, {symbol: power for symbol, power in exponents.items() if power}
