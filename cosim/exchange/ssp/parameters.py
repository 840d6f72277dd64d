"""Parameter sets of SSP packages: values by name, their mappings and transformations."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.units import UNDEFINED, conversion_factor, unit_label
from terrafix.cosim.exchange.fmi.run.component import Fmu
from terrafix.cosim.exchange.fmi.run.reading import Quantity
from terrafix.cosim.exchange.fmi.run.whole import BOOLEAN, INTEGER
from terrafix.cosim.exchange.ssp.names import SSM, SSV, tag

_WORDS = {"true": 1.0, "false": 0.0}


@dataclass(frozen=True)
class Transformation:
    """What happens to a value on its way: a factor and an offset, or a table."""

    factor: float = 1.0
    offset: float = 0.0
    table: tuple[tuple[str, str], ...] = ()

    @property
    def changes(self) -> bool:
        """Whether it does anything."""
        return bool(self.table) or (self.factor, self.offset) != (1.0, 0.0)


@dataclass(frozen=True)
class Value:
    """A value of a parameter set, as text, and what happens to it on its way.

    Attributes
    ----------
    text : str
        Of an array all elements, row by row.
    unit : str or None
    kind : str
        Real, Integer, Boolean, String, Enumeration; of SSP 2.0 also Float64, Int32, ...
    steps : tuple of Transformation
        Applied in the unit of what it is set to.
    words : tuple of str
        Elements, where they stand one by one.
    """

    text: str
    unit: str | None = None
    kind: str = "Real"
    steps: tuple[Transformation, ...] = ()
    words: tuple[str, ...] = ()

    def elements(self) -> list[Value]:
        """One value for each element."""
        one_by_one = self.kind in ("String", "Enumeration", "Binary")
        words = self.words or ((self.text,) if one_by_one else self.text.split())
        return [replace(self, text=word, words=()) for word in words]

    def through(self, step: Transformation, *, keep_unit: bool = True) -> Value:
        """The value after a transformation."""
        steps = (*self.steps, step) if step.changes else self.steps
        return replace(self, steps=steps, unit=self.unit if keep_unit else None)


def exact(text: str, where: str) -> Fraction:
    """A finite number of a package, exact.

    Raises
    ------
    ConfigurationError
        If it is none; `where` says whose it is.
    """
    try:
        found = Fraction(text.strip())
        float(found)
    except (ValueError, ZeroDivisionError):
        raise ConfigurationError(f"{where} is '{text}', which is no number") from None
    except OverflowError:
        raise ConfigurationError(f"{where} is '{text}', which is too large") from None
    return found


def integer(text: str, where: str) -> int:
    """A whole number of a package.

    Raises
    ------
    ConfigurationError
        If it is none; `where` says whose it is.
    """
    found = exact(text, where)
    if found.denominator != 1:
        raise ConfigurationError(f"{where} is '{text}', which is no whole number")
    return int(found)


def transformation(parent: ET.Element, where: str) -> Transformation:
    """The transformation that a connection or a mapping entry holds.

    Raises
    ------
    ConfigurationError
        If it is none that terrafix reads; `where` says whose it is.
    """
    for child in parent:
        kind = child.tag.rpartition("}")[2]
        if kind == "LinearTransformation":
            factor, offset = (
                float(exact(child.get(name) or default, f"{where}: {name} of its {kind}"))
                for name, default in (("factor", "1"), ("offset", "0"))
            )
            return Transformation(factor, offset)
        if kind in ("BooleanMappingTransformation", "IntegerMappingTransformation",
                    "EnumerationMappingTransformation"):  # fmt: skip
            entries = [e for e in child if e.tag.rpartition("}")[2] == "MapEntry"]
            pairs = ((str(e.get("source")), str(e.get("target"))) for e in entries)
            return Transformation(table=tuple(pairs))
        if kind.endswith("Transformation"):
            raise ConfigurationError(f"{where} has a {kind}, which terrafix does not read")
    return Transformation()


def read_set(root: ET.Element, prefix: str) -> dict[str, Value]:
    """Values of a parameter set by name, the prefix of its binding first."""
    found = {}
    for parameter in root.iter(tag(SSV, "Parameter")):
        value = next(iter(parameter), None)
        if value is None:
            continue
        kind = value.tag.rpartition("}")[2]
        words = tuple(each.text or "" for each in value if each.tag == tag(SSV, "Value"))
        text = value.get("value", words[0] if words else "")
        name = prefix + str(parameter.get("name"))
        found[name] = Value(text, value.get("unit"), kind, words=words)
    return found


def mapped(values: Mapping[str, Value], mapping: ET.Element, where: str) -> dict[str, Value]:
    """Values under the names that a parameter mapping gives them: one may have several, or none."""
    found: dict[str, Value] = {}
    for entry in mapping.iter(tag(SSM, "MappingEntry")):
        source, target = str(entry.get("source")), str(entry.get("target"))
        if source in values:
            keep = entry.get("suppressUnitConversion", "false") not in ("true", "1")
            step = transformation(entry, f"{where}: the mapping of '{source}'")
            found[target] = values[source].through(step, keep_unit=keep)
    return found


# --------------------------------------------------------------------------------- start values


def starts_of(fmu: Fmu, values: Mapping[str, Value]) -> dict[str, Any]:
    """What ``start`` of an FMU is given: elements of arrays together; what it lacks is left out.

    Raises
    ------
    ConfigurationError
        If a value cannot be one of its variable's type.
    """
    starts: dict[str, Any] = {
        name: _text(name, values[name]) for name in fmu.interface.texts if name in values
    }
    for quantity in fmu.settable().values():
        names = quantity.scalars()
        given = _elements(quantity, values)
        if all(g is None for g in given):
            continue
        numbers: list[float | int] = []
        for k, (name, value) in enumerate(zip(names, given, strict=True)):
            if value is not None:
                numbers.append(_number(name, value, quantity, k))
            elif quantity.start is not None:
                numbers.append(quantity.start[k])
            else:
                raise ConfigurationError(f"its parameter set has no value for '{name}'")
        shape = quantity.shape
        starts[quantity.name] = (
            np.reshape(np.array(numbers, dtype=object), shape).tolist() if shape else numbers[0]
        )
    return starts


def sizes_of(fmu: Fmu, values: Mapping[str, Value]) -> dict[str, Any]:
    """Of what ``start`` is given the structural parameters: they give the others their shapes."""
    structural = [
        n for n, q in fmu.interface.parameters.items() if q.causality == "structuralParameter"
    ]
    sizes = {n: values[n] for n in structural if n in values}
    return {n: v for n, v in starts_of(fmu, sizes).items() if n in sizes} if sizes else {}


def _elements(quantity: Quantity, values: Mapping[str, Value]) -> list[Value | None]:
    """Values of its elements: of the whole, and of elements that are set by themselves."""
    names = quantity.scalars()
    whole: list[Value | None] = [None] * len(names)
    if quantity.shape and quantity.name in values:
        given = values[quantity.name].elements()
        if len(given) not in (1, len(names)):
            raise ConfigurationError(
                f"'{quantity.name}' has {len(names)} elements, and its parameter set gives "
                f"{len(given)}"
            )
        whole = [*given] * (len(names) // len(given)) if given else whole
    elif quantity.name in values:
        whole = [values[quantity.name]]
    return [values.get(n, w) for n, w in zip(names, whole, strict=True)]


def _text(name: str, value: Value) -> str:
    if any(step.factor != 1.0 or step.offset for step in value.steps):
        raise ConfigurationError(f"'{name}' is text; a linear transformation is of numbers")
    text = value.text
    for step in value.steps:
        text = dict(step.table).get(text, text)
    return text


def _number(name: str, value: Value, quantity: Quantity, k: int) -> float | int:
    """A value as a number in the unit of the variable."""
    text = value.text.strip()
    tables = [step.table for step in value.steps if step.table]
    if tables:
        for table in tables:
            text = _looked_up(text, table)
        return _plain(name, text, quantity)
    number = _plain(name, text, quantity)
    unit = (
        quantity.unit if isinstance(quantity.unit, str) else quantity.unit[k % len(quantity.unit)]
    )
    if value.unit and unit not in ("", "1") and not _same_unit(value.unit, unit):
        factor = conversion_factor(value.unit, unit)
        if factor is None:
            raise ConfigurationError(f"'{name}' is given in {value.unit}, but it is in {unit}")
        number *= factor
    for step in value.steps:
        number = step.factor * number + step.offset
    return number


def _same_unit(given: str, own: str) -> bool:
    """Whether units are one; what a set does not define, it leaves to the FMU's own label."""
    return given == own or (given.endswith(UNDEFINED) and unit_label(given) == unit_label(own))


def _looked_up(text: str, table: Sequence[tuple[str, str]]) -> str:
    """What a table makes of a value; what it does not list stays as it is."""
    for source, target in table:
        if text == source or _same(text, source):
            return target
    return text


def _same(a: str, b: str) -> bool:
    """Whether two texts are the same truth value or number."""
    try:
        return float(_WORDS.get(a, a)) == float(_WORDS.get(b, b))
    except ValueError:
        return False


def _plain(name: str, text: str, quantity: Quantity) -> float | int:
    if text in quantity.items:
        return quantity.items[text]
    if quantity.kind in INTEGER and re.fullmatch(r"[+-]?\d+", text):
        return int(text)  # to the last digit
    try:
        number = float(_WORDS.get(text, text))
    except ValueError:
        what = f"one of {', '.join(quantity.items)}" if quantity.items else "a number"
        raise ConfigurationError(f"'{name}' takes {what}, not '{text}'") from None
    if quantity.kind in BOOLEAN and number not in (0.0, 1.0):
        raise ConfigurationError(f"'{name}' takes true or false, not '{text}'")
    return number
