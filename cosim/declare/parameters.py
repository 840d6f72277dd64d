"""Declared parameters: what a person sets, validated when it is set.

Numeric parameters have a shape, a unit and a range, and a value per ensemble member once a
simulation is built, so that a dispersion can feed any of them. Choices, flags, counts, texts and
paths decide the structure of a component and are the same for all members.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import date, time
from pathlib import Path
from typing import Any, Generic, Self, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.basics.units import conversion_factor, difference, split_quantity, unit_label
from terrafix.cosim.declare.ports import Declaration, written
from terrafix.cosim.memory.fields import Unit, quoted

Value_co = TypeVar("Value_co", covariant=True)
REQUIRED: Any = object()
MOST_SHOWN = 9  # numbers in an error message


def shown(value: object) -> str:
    """Show a value as it stands in a system file."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, date | time):
        return value.isoformat()
    return repr(value)


class Setting(Declaration, Generic[Value_co]):
    """Base of everything that can be set on a component by name."""

    def __init__(self, default: object = REQUIRED, *, doc: str = "") -> None:
        self.default = default
        self.doc = doc

    @property
    def required(self) -> bool:
        """Whether a value must be given."""
        return self.default is REQUIRED

    def read(self, value: object, *, where: str, bare: bool = True) -> Value_co:
        """Turn what a person wrote into the value; `where` names it in errors.

        `bare` allows a number without a unit, taken in the declared unit.
        """
        raise NotImplementedError(type(self).__name__)

    def kind(self) -> str:
        """Describe what is accepted, for listings."""
        return type(self).__name__.lower()

    def _arguments(self) -> list[str]:
        return [] if self.required or self.default in (None, {}) else [written(self.default)]

    def write(self, value: Any) -> Any:
        """Write a value so that `read` accepts it again (TOML types only)."""
        return value

    @overload
    def __get__(self, obj: None, owner: type) -> Self: ...
    @overload
    def __get__(self, obj: object, owner: type) -> Value_co: ...
    def __get__(self, obj: object | None, owner: type) -> Self | Value_co:
        if obj is None:
            return self
        try:
            return obj.parameter_values[self.name]  # type: ignore[attr-defined, no-any-return]
        except KeyError:
            raise self._absent(obj, f"has no value yet: it takes {self.kind()}") from None

    def __set__(self, obj: object, value: object) -> None:
        obj.set_parameter(self.name, value)  # type: ignore[attr-defined]


class Parameter(Setting[FloatArray]):
    """A number or array with a unit: ndarray, shape (n_members, *shape) in a simulation.

    Parameters
    ----------
    default : float or array_like
        In `unit`; required if absent.
    shape : tuple of int
        Of one member.
    unit : str or tuple of str
        SI; other units of the same dimension are converted when set.
    frame : str, optional
        Of a vector. One number stands for all elements of a vector without a frame (a sigma per
        axis); in a frame it would be a direction that nobody meant, and only zero is taken.
    minimum, maximum : float, optional
        Inclusive bounds in `unit`.
    positive : bool
        Refuse zero and less.
    infinite : bool
        Accept infinity (a gate that is off, say).
    """

    def __init__(
        self,
        default: ArrayLike = REQUIRED,
        *,
        shape: Sequence[int] = (),
        unit: Unit = "1",
        frame: str | None = None,
        minimum: float | None = None,
        maximum: float | None = None,
        positive: bool = False,
        infinite: bool = False,
        doc: str = "",
    ) -> None:
        super().__init__(default, doc=doc)
        self.shape = tuple(shape)
        self.unit = unit
        self.frame = frame
        self.minimum, self.maximum = minimum, maximum
        self.positive, self.infinite = positive, infinite

    def unit_text(self) -> str:
        """The unit as a person writes it."""
        return self.unit if isinstance(self.unit, str) else "(" + ", ".join(self.unit) + ")"

    def _arguments(self) -> list[str]:
        given = [] if self.required else [written(self.default)]
        if self.shape:
            given.append(f"shape={self.shape}")
        if self.unit != "1":
            given.append(f"unit={quoted(self.unit)}")
        if self.frame is not None:
            given.append(f"frame={quoted(self.frame)}")
        bounds = {"minimum": self.minimum, "maximum": self.maximum}
        given += [f"{n}={v}" for n, v in bounds.items() if v is not None]
        return given + [f"{n}=True" for n in ("positive", "infinite") if getattr(self, n)]

    def kind(self) -> str:
        """Describe what is accepted, for listings."""
        shape = "number" if not self.shape else f"array {self.shape}"
        return shape if self.unit in ("1", "") else f"{shape} [{self.unit_text()}]"

    def read(self, value: object, *, where: str, bare: bool = True) -> FloatArray:
        """Turn a number, array, or text with a unit into an array in the declared unit.

        Raises
        ------
        ConfigurationError
            If it is no number, of another dimension or shape, not finite, or out of range.
        """
        unit: str | None = None
        if isinstance(value, dict):
            extra = sorted(set(value) - {"value", "unit"})
            if extra or "value" not in value:
                raise ConfigurationError(
                    f"{where} is a table with {sorted(value)}; write {{ value = ..., unit = ... }}"
                )
            unit, value = value.get("unit"), value["value"]
            if not isinstance(unit, str | None):
                raise ConfigurationError(f"{where} has the unit {shown(unit)}; write it as text")
        if isinstance(value, str):
            text = value
            try:
                value, unit = split_quantity(value)
            except ValueError:
                raise ConfigurationError(
                    f"{where} is '{text}', which is not a number with a unit\n  {self._wanted()}"
                ) from None
        if isinstance(value, bool):
            raise ConfigurationError(f"{where} is {shown(value)}; {self._wanted()}")
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise ConfigurationError(f"{where} is {shown(value)}; {self._wanted()}") from None
        self._check_finite(array, where)
        if array.shape != self.shape:
            if array.ndim or not self._one_for_all(float(array)):
                what = f"has shape {array.shape}" if array.ndim else "is one number"
                alone = not array.ndim and self.frame is not None
                axes = f"\n  one for each axis of frame '{self.frame}'" if alone else ""
                raise ConfigurationError(f"{where} {what}; {self._wanted()}{axes}")
            array = np.full(self.shape, float(array))
        array = self._convert(array, unit, where=where, bare=bare)
        self.check_range(array, where)
        return array

    def _one_for_all(self, number: float) -> bool:
        """Whether one number says what all elements are."""
        return isinstance(self.unit, str) and (self.frame is None or number == 0.0)

    def _convert(
        self, array: FloatArray, unit: str | None, *, where: str, bare: bool
    ) -> FloatArray:
        if unit is None:
            has_unit = isinstance(self.unit, str) and self.unit not in ("1", "")
            if not bare and has_unit and not np.all(array == 0.0):
                raise ConfigurationError(f"{where} has no unit\n  {self._wanted()}")
            return array
        if not isinstance(self.unit, str):
            raise ConfigurationError(
                f"{where} has elements of different units {self.unit_text()}; give bare SI numbers"
            )
        if unit == unit_label(self.unit):  # as the file that defines it has it
            return array
        try:
            factor = conversion_factor(unit, self.unit)
        except ConfigurationError as error:
            raise ConfigurationError(f"{where} is given in {unit}: {error}") from error
        if factor is None:
            raise ConfigurationError(
                f"{where} is given in {unit}; it takes {self.kind()}\n"
                f"  {difference(unit, self.unit)}"
            )
        with np.errstate(over="ignore"):  # infinity is refused below
            return array * factor

    def _wanted(self) -> str:
        """What is accepted, and how it is written."""
        unit = f" {self.unit}" if isinstance(self.unit, str) and self.unit not in ("1", "") else ""
        number = "1.0"
        for extent in reversed(self.shape):
            number = "[" + ", ".join([number] * extent) + "]"
        return f'it takes {self.kind()}: write "{number}{unit}"'

    def _check_finite(self, array: FloatArray, where: str) -> None:
        if np.isnan(array).any() or (not self.infinite and np.isinf(array).any()):
            value = array.tolist() if array.size <= MOST_SHOWN else "not finite everywhere"
            raise ConfigurationError(f"{where} is {value}; it must be finite")

    def check_range(self, array: FloatArray, where: str) -> None:
        """Raise ConfigurationError if a number is not finite or out of the declared range."""
        self._check_finite(array, where)
        unit = "" if self.unit in ("1", "") else f" {self.unit_text()}"
        limits: list[tuple[NDArray[np.bool_], str]] = []
        if self.positive:
            limits.append((array <= 0.0, "must be positive"))
        if self.minimum is not None:
            limits.append((array < self.minimum, f"must be at least {self.minimum:g}{unit}"))
        if self.maximum is not None:
            limits.append((array > self.maximum, f"must be at most {self.maximum:g}{unit}"))
        for wrong, must in limits:
            if wrong.any():
                few = array.size <= MOST_SHOWN
                value = array.tolist() if few else float(array[wrong][0])
                raise ConfigurationError(f"{where} is {value}{unit}; it {must}")

    def write(self, value: FloatArray) -> Any:
        """Write a value with its unit as text."""
        if not isinstance(self.unit, str):
            return np.asarray(value).tolist()
        text = str(np.asarray(value).tolist())
        return text if self.unit in ("1", "") else f"{text} {self.unit}"


class Count(Setting[int]):
    """A whole number."""

    def __init__(
        self,
        default: int = REQUIRED,
        *,
        minimum: int = 0,
        maximum: int | None = None,
        doc: str = "",
    ) -> None:
        super().__init__(default, doc=doc)
        self.minimum, self.maximum = minimum, maximum

    def read(self, value: object, *, where: str, bare: bool = True) -> int:
        """Accept an integer, or text of one."""
        if isinstance(value, str) and re.fullmatch(r"\s*[+-]?\d+\s*", value):
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int):
            raise ConfigurationError(f"{where} is {shown(value)}; it takes a whole number")
        if value < self.minimum or (self.maximum is not None and value > self.maximum):
            upper = "" if self.maximum is None else f" and at most {self.maximum}"
            raise ConfigurationError(
                f"{where} is {value}; it must be at least {self.minimum}{upper}"
            )
        return value


class Flag(Setting[bool]):
    """True or false."""

    def read(self, value: object, *, where: str, bare: bool = True) -> bool:
        """Accept a boolean, or the text ``true`` or ``false``."""
        if isinstance(value, str) and value.strip().lower() in ("true", "false"):
            return value.strip().lower() == "true"
        if not isinstance(value, bool):
            raise ConfigurationError(f"{where} is {shown(value)}; it takes true or false")
        return value


class Choice(Setting[str]):
    """One of several names."""

    def __init__(self, options: Sequence[str], default: str = REQUIRED, *, doc: str = "") -> None:
        super().__init__(default, doc=doc)
        self.options = tuple(options)

    def _arguments(self) -> list[str]:
        return [quoted(self.options), *super()._arguments()]

    def kind(self) -> str:
        """Describe what is accepted, for listings."""
        return " | ".join(f'"{o}"' for o in self.options)

    def read(self, value: object, *, where: str, bare: bool = True) -> str:
        """Accept one of the options."""
        if not isinstance(value, str) or value not in self.options:
            hint = nearest(str(value), self.options)
            hint = f"\n  {hint}" if hint.startswith("did you mean") else ""
            options = " or ".join(f'"{o}"' for o in self.options)
            raise ConfigurationError(f"{where} is {shown(value)}; it takes {options}{hint}")
        return value


class Text(Setting[str]):
    """Free text."""

    def read(self, value: object, *, where: str, bare: bool = True) -> str:
        """Accept text."""
        if not isinstance(value, str):
            raise ConfigurationError(f"{where} is {shown(value)}; it takes text")
        return value


class Table(Setting[dict[str, Any]]):
    """Values by name, as a table of a system file: ``start = { mass = "12 kg" }``."""

    def __init__(self, *, doc: str = "") -> None:
        super().__init__({}, doc=doc)

    def read(self, value: object, *, where: str, bare: bool = True) -> dict[str, Any]:
        """Accept a table, or its text as in a file."""
        if isinstance(value, str):
            import tomllib

            with suppress(tomllib.TOMLDecodeError):
                value = tomllib.loads(f"table = {value}")["table"]
        if not isinstance(value, dict):
            raise ConfigurationError(
                f'{where} is {shown(value)}; it takes a table: write {{ name = "1.0 m" }}'
            )
        return dict(value)


class FileTable(Table):
    """Files by name: ``files = { a = "a.fmu" }``, relative to the system file."""

    def read(self, value: object, *, where: str, bare: bool = True) -> dict[str, Any]:
        """Accept a table of paths, as `FilePath` accepts them."""
        table = super().read(value, where=where, bare=bare)
        return {k: FilePath().read(v, where=f"{where}.{k}") for k, v in table.items()}

    def beside(self, value: dict[str, Path], folder: Path) -> dict[str, Path]:
        """Take relative paths to begin at a folder."""
        return {name: folder / path for name, path in value.items()}

    def write(self, value: dict[str, Path]) -> dict[str, str]:
        """Write the paths as text."""
        return {name: str(path.absolute()) for name, path in value.items()}


_VARIABLE = re.compile(r"\$\{(\w+)(?::-([^}]*))?\}|\$(\w+)")


class FilePath(Setting[Path]):
    """A file: relative to the system file, with ``${NAME:-fallback}`` from the environment."""

    def read(self, value: object, *, where: str, bare: bool = True) -> Path:
        """Accept a path; environment variables and ``~`` are expanded."""
        if isinstance(value, Path):
            return value
        if not isinstance(value, str) or not value.strip():
            raise ConfigurationError(f"{where} is {shown(value)}; it takes the path of a file")

        def expand(match: re.Match[str]) -> str:
            name = match[1] or match[3]
            found = os.environ.get(name) or match[2]
            if found is None:
                raise ConfigurationError(
                    f"{where} is '{value}', but the environment variable {name} is not set\n"
                    f"  set {name}, or write ${{{name}:-fallback}}"
                )
            return found

        return Path(_VARIABLE.sub(expand, value)).expanduser()

    def write(self, value: Path) -> str:
        """Write the path as text."""
        return str(value)


class OptionalFilePath(Setting[Path | None]):
    """A file that need not be named: None unless it is."""

    def __init__(self, *, doc: str = "") -> None:
        super().__init__(None, doc=doc)

    def read(self, value: object, *, where: str, bare: bool = True) -> Path | None:
        """Accept a path as `FilePath` does, or None."""
        return None if value is None else FilePath().read(value, where=where, bare=bare)

    def write(self, value: Path | None) -> str | None:
        """Write the path as text, if there is one."""
        return None if value is None else str(value)


PATHS = (FilePath, OptionalFilePath)
"""Settings whose relative paths begin at the system file."""


def finite_float(value: object, where: str) -> float:
    """Read a finite number or raise ConfigurationError naming `where`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigurationError(f"{where} is {value!r}; it takes a finite number")
    return float(value)
