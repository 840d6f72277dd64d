"""Whole numbers and truth values of FMUs: kept to the last digit, and inside their types."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import shown

BOOLEAN = ("Boolean",)
INTEGER = (
    *("Integer", "Enumeration", "Int8", "UInt8", "Int16", "UInt16"),
    *("Int32", "UInt32", "Int64", "UInt64"),
)
MOST = 2**63 - 1
"""Of a port: signals hold 64 bits with a sign."""


def limits(kind: str, version: int) -> tuple[int, int]:
    """Least and greatest number of a type of FMI."""
    if kind in BOOLEAN:
        return 0, 1
    if kind == "Enumeration":
        kind = "Int32" if version < 3 else "Int64"
    found = np.iinfo("int32" if kind == "Integer" else kind.lower())
    return int(found.min), int(found.max)


def cells(rows: NDArray[np.float64], kind: str, columns: slice) -> NDArray[Any]:
    """Columns of rows as numbers of a type: a whole number takes the 64 bits of its cell."""
    return rows.view(np.int64)[:, columns] if kind in INTEGER else rows[:, columns]


def whole_start(name: str, kind: str, word: str) -> int:
    """A start value as a description has it."""
    with suppress(ValueError):
        return int(word)
    with suppress(ValueError, OverflowError):
        if float(word) == int(float(word)):
            return int(float(word))
    raise ConfigurationError(f"the FMU says that '{name}' ({kind}) starts at '{word}'")


def read_whole(
    value: object, kind: str, version: int, shape: tuple[int, ...], *, where: str
) -> NDArray[Any]:
    """Turn what a person wrote into whole numbers of a type, one for all elements or each its own.

    Raises
    ------
    ConfigurationError
        If one is not whole, or does not fit the type.
    """
    if isinstance(value, str):
        with suppress(ValueError):
            value = json.loads(value)
    array = np.array(value, dtype=object)
    low, high = limits(kind, version)
    for number in array.ravel().tolist():
        plain = number.item() if isinstance(number, np.generic) else number
        truth = isinstance(plain, bool) and kind in BOOLEAN
        whole = isinstance(plain, int) and not isinstance(plain, bool)
        whole |= isinstance(plain, float) and plain.is_integer()
        if not (truth or whole) or not low <= plain <= high:
            takes = "true or false" if kind in BOOLEAN else f"whole numbers from {low} to {high}"
            raise ConfigurationError(
                f"{where} is {shown(plain)}; it is of type {kind} and takes {takes}"
            )
    if array.shape not in ((), shape):
        raise ConfigurationError(f"{where} has shape {array.shape}; it takes shape {shape}")
    exact = np.vectorize(int, otypes=[object])(array) if array.size else array
    dtype = np.uint64 if kind == "UInt64" else np.int64
    return np.broadcast_to(exact.astype(dtype), shape).copy()
