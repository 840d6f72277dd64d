"""Units of ports and parameters: compared by dimension, converted or refused before the run.

A thin door to Pint, loaded on first need: equal unit texts never need it. Angle is a dimension
here, so that a rotation is not taken for a frequency: 1 Hz of a wheel is 6.28 rad/s, of a filter's
pole 1/s. Elsewhere the radian alone may be left out: rad is 1, N m/rad is N m.

A unit that a file defines carries its definition, since its name is a label that another file may
use otherwise: ``kmph = 0.27778 m/s``. One that is named and nowhere defined is ``kmph = ?``, and
fits itself alone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from itertools import count
from typing import Any

from terrafix.cosim.basics.errors import ConfigurationError

DIMENSIONLESS = ("", "1")


@lru_cache(maxsize=1)
def _registry() -> Any:
    import pint

    folder = resources.files("pint")
    units, constants = (
        (folder / f"{name}_en.txt").read_text(encoding="utf-8") for name in ("default", "constants")
    )
    units = units.replace("@import constants_en.txt", constants)
    registry: Any = pint.UnitRegistry(None)
    registry.load_definitions(units.replace("radian = []", "radian = [angle]").splitlines())
    assert registry.Unit("radian").dimensionality, "Pint defines the radian otherwise than it did"
    registry.define("px = pixel")  # of an image; Pint's own px is a length, 1/96 inch
    return registry


_DEFINED = re.compile(r"(.+?) = (?:\?|(\S+)(?: ([^+?]+?))?(?: \+ (\S+))?)")
_numbers = count()


def _define(match: re.Match[str]) -> str:
    """Tell Pint of a unit with its definition; its name there."""
    _, factor, base, offset = match.groups()
    name = f"defined_unit_{next(_numbers)}"
    if factor is None:
        _registry().define(f"{name} = [dimension_of_{name}]")
    else:
        shift = f"; offset: {float(offset)!r}" if offset else ""
        times = f" * {base}" if base else ""  # Pint knows no dimension of "dimensionless" here
        _registry().define(f"{name} = {float(factor)!r}{times}{shift}")
    return name


_ROOT = re.compile(r"\bsqrt\(([^()]*)\)")


@lru_cache(maxsize=1024)
def _unit(text: str) -> Any:
    name = "dimensionless" if text in DIMENSIONLESS else _ROOT.sub(r"(\1)^0.5", text)
    try:
        if defined := _DEFINED.fullmatch(text):
            name = _define(defined)
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
    registry = _registry()
    if a.dimensionality != b.dimensionality:
        if not _differ_by_angle(a, b) or _is_rate(a, b):
            return None
        a, b = (_without_radians(unit) for unit in (a, b))
        if a.dimensionality != b.dimensionality:  # degrees or turns: a number of what?
            return None
    zero = registry.Quantity(0.0, a).to(b).magnitude
    if zero != 0.0:
        raise ConfigurationError(
            f"'{source}' to '{target}' is not a pure factor; use an absolute unit such as kelvin"
        )
    return float(registry.Quantity(1.0, a).to(b).magnitude)


def _differ_by_angle(a: Any, b: Any) -> bool:
    return set((a / b).dimensionality) == {"[angle]"}


def _is_rate(a: Any, b: Any) -> bool:
    """Whether one of two units is a rotation rate where the other is a frequency."""
    return {"[time]"} == {*a.dimensionality, *b.dimensionality} - {"[angle]"}


def _without_radians(unit: Any) -> Any:
    powers = dict(_registry().Quantity(1.0, unit).unit_items())
    return unit / _registry().Unit("radian") ** powers.get("radian", 0)


def difference(source: str, target: str) -> str:
    """Say that two units differ in dimension, and where a mistake is common, the way out."""
    text = f"the units differ: {source} is not {target}"
    for unit in (source, target):
        if unit.endswith(UNDEFINED):
            return f"{text}\n  nobody defines {unit_label(unit)}: say which unit it is"
    a, b = _unit(source), _unit(target)
    if _differ_by_angle(a, b):
        if _is_rate(a, b):
            return (
                f"{text}\n  a rotation (rad/s, deg/h, rpm) and a frequency (Hz, 1/s) are not one "
                "dimension:\n  a turn is 2 pi rad; write both sides as rad/s, or both as Hz"
            )
        return f"{text}\n  an angle becomes a plain number in radians alone: write it in rad"
    for word in re.findall(r"[a-zA-Z]*g\b", source):
        corrected = re.sub(rf"\b{word}\b", f"{word}_0", source)
        try:
            if _unit(corrected).dimensionality == b.dimensionality:
                return f"{text}\n  g is gram; for standard gravity write {corrected}"
        except ConfigurationError:
            continue
    return text


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
    for name, power in _registry().Quantity(1.0, unit).unit_items():
        if name == "radian":
            reduced = {"radian": 1.0}
        else:
            quantity = _registry().Quantity(1.0, name).to_root_units()
            zero = _registry().Quantity(0.0, name).to_root_units().magnitude
            factor *= float(quantity.magnitude - zero) ** power
            reduced = dict(quantity.unit_items())
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


def base_offset(text: str) -> float:
    """What zero is in SI base units: 273.15 of degC, 0 of most."""
    try:
        return float(_registry().Quantity(0.0, _unit(text)).to_root_units().magnitude)
    except ValueError:  # Pint adds no offset within a compound unit
        return 0.0


# ------------------------------------------------------------- units that files define

SI_BASE = tuple(_BASE_UNITS.values())
UNDEFINED = " = ?"
_OTHER_NAMES = {"Ohm": "ohm", "\N{OHM SIGN}": "ohm", "\N{GREEK CAPITAL LETTER OMEGA}": "ohm"}
_OTHER_NAMES |= {"rev": "revolution"}
_METRIC = (
    *("m", "g", "s", "A", "K", "mol", "cd", "rad", "sr", "Hz", "N", "Pa", "W", "J", "C", "V", "F"),
    *("Ohm", "S", "Wb", "T", "H", "lm", "lx", "Bq", "Gy", "Sv", "kat", "l", "L", "bar", "t", "eV"),
)
_NOT_METRIC = ("min", "h", "d", "deg", "degC", "degF", "rev", "rpm", "u", "%")
_PREFIXES = ("", *"yzafpnumcdhkMGTPEZY", "da")
_SYMBOL = re.compile(r"([^\W\d_]+|%)(?:\^?([+-]?\d{1,2}))?")
_DANGEROUS = re.compile(r"\*\*|\^[^A-Za-z]*\^|\d{4}|[^\w%./*^()+ \-]|.{101}")


def unit_label(text: str) -> str:
    """The name of a unit without its definition."""
    return text.partition(" = ")[0]


def unit_by_definition(
    label: str, factor: float, powers: Mapping[str, int], offset: float = 0.0
) -> str:
    """Unit of a file that says what its label means: ``factor`` times SI base units plus an offset.

    The label, as we write it, where it means that here too (``m/s^2`` for Modelica's m/s2; the
    radian may be left out by the definition); otherwise the label with its definition.
    """
    wanted = {symbol: power for symbol, power in powers.items() if power}
    for text in (label, _translated(label)):
        if not _DANGEROUS.search(text) and _means(text, factor, wanted, offset):
            return text
    above, below = (
        " ".join(f"{s}^{abs(p)}" if abs(p) > 1 else s for s, p in wanted.items() if p * sign > 0)
        for sign in (1, -1)
    )
    base = f"{above or '1'}/({below})" if " " in below else f"{above or '1'}/{below}"
    base = base if below else above
    name = " ".join(label.replace("=", " ").split())
    return f"{name} = {factor!r}{' ' * bool(base)}{base}" + f" + {offset!r}" * bool(offset)


def _means(text: str, factor: float, powers: Mapping[str, int], offset: float) -> bool:
    try:
        found = base_units(text)
        shift = base_offset(text)
    except ConfigurationError:
        return False
    if found is None:
        return False
    own, own_powers = found
    if "rad" not in powers:
        own_powers.pop("rad", None)
    close = abs(own - factor) <= 1e-9 * abs(own) and abs(shift - offset) <= 1e-9 * abs(shift)
    return close and own_powers == dict(powers)


def unit_by_name(label: str) -> str:
    """Unit of a file that says its name alone: of SI in Modelica's spelling or ours.

    Anything else is not guessed; it fits itself alone.
    """
    if label in DIMENSIONLESS:
        return "1"
    rest = _SYMBOL.sub(lambda m: "" if _is_known(m[1]) else "?", label)
    text = _translated(label)
    if not _DANGEROUS.search(label) and re.fullmatch(r"[1/.*^() +-]*", rest):
        try:
            check_unit(text)
        except ConfigurationError:
            pass
        else:
            return text
    return f"{' '.join(label.replace('=', ' ').split())}{UNDEFINED}"


def _is_known(symbol: str) -> bool:
    return symbol in _NOT_METRIC or any(
        symbol == f"{prefix}{unit}" for prefix in _PREFIXES for unit in _METRIC
    )


def _translated(label: str) -> str:
    """Modelica's ``kg.m2/s-1`` as we write it: ``kg m^2/s^-1``."""

    def one(match: re.Match[str]) -> str:
        power = f"^{match[2]}" if match[2] else ""
        return f"{_OTHER_NAMES.get(match[1], match[1])}{power}"

    return _SYMBOL.sub(one, label.strip()).replace(".", " ")
