"""Parameters of an FMU as parameters of its component: declared with unit, bounds and meaning.

Reals and whole numbers have one value for each member, so that a dispersion can feed them.
Booleans, enumerations (by name), texts and the structural parameters of FMI 3 are the same for all.
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import (
    REQUIRED,
    Choice,
    Count,
    Flag,
    Parameter,
    Setting,
    Text,
    shown,
)
from terrafix.cosim.exchange.fmi.run.reading import Quantity
from terrafix.cosim.exchange.fmi.run.whole import BOOLEAN, INTEGER

STRUCTURAL = "structuralParameter"
TEXT = "String"
EXACT = 2**53
"""Whole numbers up to this are exact as doubles."""
_RANGES = {"Integer": np.iinfo(np.int32), "Enumeration": np.iinfo(np.int32)} | {
    f"{sign}Int{bits}": np.iinfo(f"{sign}Int{bits}".lower())
    for sign in ("", "U")
    for bits in (8, 16, 32, 64)
}


class Numbers(Parameter):
    """Reals or whole numbers of an FMU; bounds may differ between elements.

    Parameters
    ----------
    whole : bool
        Refuse what is no whole number.
    low, high : ndarray, shape of one member
        Inclusive bounds; infinite where there is none.
    """

    def __init__(
        self,
        default: object,
        *,
        whole: bool,
        low: FloatArray,
        high: FloatArray,
        **declared: Any,
    ) -> None:
        super().__init__(default, infinite=not whole, **declared)  # type: ignore[arg-type]
        self.whole, self.low, self.high = whole, low, high

    def kind(self) -> str:
        """Describe what is accepted, for listings."""
        return super().kind().replace("number", "whole number") if self.whole else super().kind()

    def check_range(self, array: FloatArray, where: str) -> None:
        """Raise ConfigurationError if a number is not finite, not whole, or out of range."""
        super().check_range(array, where)
        unit = "" if self.unit in ("1", "") else f" {self.unit_text()}"
        low, high = (np.broadcast_to(b, array.shape) for b in (self.low, self.high))
        limits: list[tuple[NDArray[np.bool_], str, FloatArray | None]] = [
            (array < low, "must be at least", low),
            (array > high, "must be at most", high),
        ]
        if self.whole:
            limits.insert(0, (array != np.rint(array), "must be a whole number", None))
        for wrong, must, bound in limits:
            if wrong.any():
                k = tuple(int(i) for i in np.argwhere(wrong)[0])
                limit = "" if bound is None else f" {bound[k]:.15g}{unit}, says its FMU"
                raise ConfigurationError(f"{where} is {array[k]:.15g}{unit}; it {must}{limit}")


class Switch(Flag):
    """A boolean of an FMU: true or false, or 1 or 0."""

    def read(self, value: object, *, where: str, bare: bool = True) -> bool:
        """Accept a boolean, its text, or 1 or 0."""
        number = isinstance(value, int | float) and value in (0, 1)
        return super().read(bool(value) if number else value, where=where, bare=bare)


class Size(Count):
    """A structural parameter of FMI 3: how many elements arrays have."""

    def read(self, value: object, *, where: str, bare: bool = True) -> int:
        """Accept a whole number, also as a float."""
        whole = isinstance(value, float) and value.is_integer()
        return super().read(int(value) if whole else value, where=where, bare=bare)  # type: ignore[call-overload]


class Enumeration(Choice):
    """An enumeration of an FMU: one of its names, or the number that one stands for."""

    def __init__(self, items: Mapping[str, int], default: object, *, doc: str = "") -> None:
        super().__init__(tuple(items), default, doc=doc)  # type: ignore[arg-type]
        self.items = dict(items)

    def read(self, value: object, *, where: str, bare: bool = True) -> str:
        """Accept a name or a number."""
        number = value
        if isinstance(value, str) and re.fullmatch(r"\s*[+-]?\d+\s*", value):
            number = int(value)
        if isinstance(number, int | float) and not isinstance(number, bool):
            names = [n for n, v in self.items.items() if v == number]
            value = names[0] if names else value
        return super().read(value, where=where, bare=bare)


class Several(Setting[list[Any]]):
    """An array of what has no numbers: each element as `one` accepts it."""

    def __init__(
        self, one: Setting[Any], shape: Sequence[int], default: object, *, doc: str = ""
    ) -> None:
        super().__init__(default, doc=doc)
        self.one, self.shape = one, tuple(shape)

    def kind(self) -> str:
        """Describe what is accepted, for listings."""
        return f"array {self.shape} of {self.one.kind()}"

    def read(self, value: object, *, where: str, bare: bool = True) -> list[Any]:
        """Accept nested lists of the declared shape, or their text as in a file."""
        if isinstance(value, str):
            import tomllib

            try:
                value = tomllib.loads(f"list = {value}")["list"]
            except tomllib.TOMLDecodeError:
                raise self._refused(value, where) from None
        return list(self._elements(value, self.shape, where, bare))

    def _elements(self, value: Any, shape: tuple[int, ...], where: str, bare: bool) -> Any:
        if not shape:
            return self.one.read(value, where=where, bare=bare)
        if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str):
            raise self._refused(value, where)
        if len(value) != shape[0]:
            raise self._refused(value, where)
        return [
            self._elements(each, shape[1:], f"{where}[{k + 1}]", bare)
            for k, each in enumerate(value)
        ]

    def _refused(self, value: Any, where: str) -> ConfigurationError:
        return ConfigurationError(f"{where} is {shown(value)}; it takes a list, {self.kind()}")


# --------------------------------------------------------------------------------- declaring


@dataclass(frozen=True)
class Start:
    """Values that are set before initialization.

    Attributes
    ----------
    name : str
        Of the parameter, for what is said when they are refused.
    kind : str
        Type of the variables.
    references : tuple of int
    rows : ndarray or tuple of str
        Numbers of every member, (n_members, n) or (1, n); texts, the same for all.
    structural : bool
        Whether they are set in Configuration Mode.
    """

    name: str
    kind: str
    references: tuple[int, ...]
    rows: NDArray[Any] | tuple[str, ...]
    structural: bool = False

    def of(self, members: Sequence[int]) -> Start:
        """The values of some members."""
        if isinstance(self.rows, tuple) or len(self.rows) == 1:
            return self
        return replace(self, rows=self.rows[list(members)])


def setting_names(quantities: Collection[Quantity], taken: Callable[[str], bool]) -> dict[str, str]:
    """Names of parameters by those of the FMU; `taken` says which are something else already."""
    names: dict[str, str] = {}
    used: set[str] = set()
    for q in sorted(quantities, key=lambda q: not q.name.isidentifier()):  # as it is, where it can
        name = re.sub(r"\W+", "_", q.name).strip("_") or "parameter"
        name = f"v{name}" if name[0].isdigit() else name
        while name in used or taken(name) or keyword.iskeyword(name):
            name += "_"
        used.add(name)
        names[q.name] = name
    return {q.name: names[q.name] for q in quantities}


def declared_setting(q: Quantity, said: Mapping[str, str] | None = None) -> Setting[Any]:
    """The declaration of a parameter; without a default where the FMU's description has no value.

    `said` is what the annotation of an FMU of terrafix says of it. Nobody says what the elements of
    a foreign array have in common, so one number does not stand for all of them.
    """
    if q.kind in BOOLEAN:
        return _each(q, Switch, [v == 1.0 for v in q.start or ()])
    if q.kind == TEXT:
        return _each(q, Text, q.texts or ())
    items = _items(q)
    if items:
        names = {value: name for name, value in items.items()}
        starts = [names[int(v)] for v in q.start or () if int(v) in names]
        return _each(q, lambda default, doc="": Enumeration(items, default, doc=doc), starts)
    low, high = (_bounds(q, which) for which in ("min", "max"))
    if q.causality == STRUCTURAL and not q.shape:
        start = REQUIRED if not q.start else int(q.start[0])
        most = None if high >= EXACT else int(high)
        return Size(start, minimum=max(int(low), 0), maximum=most, doc=q.doc)
    default = REQUIRED if q.start is None else np.reshape(q.start, q.shape)
    options: dict[str, Any] = {"shape": q.shape, "unit": q.unit, "doc": q.doc}
    options["frame"] = "of the FMU" if said is None else said.get("frame")
    options["positive"] = said is not None and said.get("positive") == "true"
    whole = q.kind in INTEGER
    made = Numbers(default, whole=whole, low=low, high=high, **options)
    if default is not REQUIRED:
        try:
            made.read(default, where="start")
        except ConfigurationError:
            if not np.isfinite(default).all():
                return Numbers(REQUIRED, whole=whole, low=low, high=high, **options)
            low, high = np.minimum(low, default), np.maximum(high, default)  # it knows better
            return Numbers(default, whole=whole, low=low, high=high, **options)
    return made


def _each(q: Quantity, one: Callable[..., Setting[Any]], starts: Sequence[Any]) -> Setting[Any]:
    """One setting, or an array of them."""
    known = len(starts) == q.size
    if not q.shape:
        return one(starts[0] if known else REQUIRED, doc=q.doc)
    default = np.reshape(np.array(starts, dtype=object), q.shape).tolist() if known else REQUIRED
    return Several(one(REQUIRED), q.shape, default, doc=q.doc)


def _items(q: Quantity) -> dict[str, int]:
    """Names and numbers of an enumeration; none of what is not one, or has no names."""
    if q.kind != "Enumeration" or not q.variables:
        return {}
    declared = q.variables[0].declaredType
    found = declared.items if declared is not None else []
    numbers = [i.value if i.value is not None else k + 1 for k, i in enumerate(found)]
    return {str(i.name): int(v) for i, v in zip(found, numbers, strict=True)}


def _bounds(q: Quantity, which: str) -> FloatArray:
    """The least or greatest values of its elements, of the variables, their types, or the type."""
    lower = which == "min"
    widest = -np.inf if lower else np.inf
    if q.kind in _RANGES:
        info = _RANGES[q.kind]
        widest = max(int(info.min), -EXACT) if lower else min(int(info.max), EXACT)
    found = []
    for variable in q.variables:
        text = getattr(variable, which)
        if text is None and variable.declaredType is not None:
            text = getattr(variable.declaredType, which)
        number = widest if text is None else float(str(text).split()[0])
        found.append(max(number, widest) if lower else min(number, widest))
    if len(found) != q.size:  # an array of FMI 3
        found = (found or [widest])[:1] * q.size
    return np.reshape(np.array(found, dtype=np.float64), q.shape)


# --------------------------------------------------------------------------------- setting


def start_values(name: str, q: Quantity, setting: Setting[Any], value: Any) -> Start:
    """What is set on the FMU for a parameter's value: of one, or a row for each member."""
    references, structural = tuple(q.references), q.causality == STRUCTURAL
    one = setting.one if isinstance(setting, Several) else setting
    if isinstance(setting, Numbers):
        rows = np.asarray(value, dtype=np.float64).reshape(-1, q.size)
        return Start(name, q.kind, references, rows, structural)
    flat = np.ravel(np.array(value, dtype=object)).tolist()
    if isinstance(one, Text):
        return Start(name, q.kind, references, tuple(str(t) for t in flat), structural)
    if isinstance(one, Enumeration):
        flat = [one.items[each] for each in flat]
    return Start(name, q.kind, references, np.array([flat], dtype=np.float64), structural)
