"""Symbolic functions of single vectors, evaluated on arrays of them.

The mathematics is written once, on CasADi symbols of one member. `over_members` evaluates it on
arrays with any leading axes. Every member goes through the same scalar instructions, so its
result does not depend on how many others there are.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from math import prod
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

Shape = tuple[int, ...]


def over_members(expression: Callable[..., Any], *shapes: Shape) -> Callable[..., Any]:
    """Lift a symbolic function of single quantities to arrays with leading member axes.

    Parameters
    ----------
    expression : callable
        Takes SX symbols, returns one SX expression or a tuple of them.
    *shapes : tuple of int
        Shape of each argument: ``()``, ``(n,)`` or ``(n, m)``.

    Returns
    -------
    callable
        Takes one array per argument, ``(..., *shape)``; leading axes broadcast. Returns float64
        arrays ``(..., *result_shape)``, a tuple where `expression` returns a tuple; a result of
        one element has no axis of its own.

    Raises
    ------
    ValueError
        By the returned function, if trailing axes differ from `shapes`.
    """

    @cache
    def build() -> tuple[_Evaluator, list[Shape], bool]:
        flat = [ca.SX.sym(f"a{i}", prod(shape)) for i, shape in enumerate(shapes)]
        arguments = [
            ca.reshape(a, shape[1], shape[0]).T if len(shape) == 2 else a
            for a, shape in zip(flat, shapes, strict=True)
        ]
        result = expression(*arguments)
        several = isinstance(result, tuple)
        results = [ca.SX(r) for r in (result if several else (result,))]
        columns = [ca.densify(ca.vec(r.T)) for r in results]
        function = ca.Function("over_members", flat, columns, {"cse": True})
        return _Evaluator(function), [_numpy_shape(r) for r in results], several

    name = getattr(expression, "__name__", "function")

    @wraps(expression)
    def evaluate(*arrays: ArrayLike) -> Any:
        evaluator, result_shapes, several = build()
        if len(arrays) != len(shapes):
            raise ValueError(f"{name} takes {len(shapes)} arrays, got {len(arrays)}")
        given = [np.asarray(a, dtype=np.float64) for a in arrays]
        for a, shape in zip(given, shapes, strict=True):
            if a.shape[a.ndim - len(shape) :] != shape:
                raise ValueError(f"{name}: an argument of shape {a.shape} does not end in {shape}")
        leading = np.broadcast_shapes(
            *(a.shape[: a.ndim - len(shape)] for a, shape in zip(given, shapes, strict=True))
        )
        n = prod(leading)
        rows = [
            np.ascontiguousarray(np.broadcast_to(a, leading + shape).reshape(n, prod(shape)))
            for a, shape in zip(given, shapes, strict=True)
        ]
        flat = evaluator(rows, [prod(shape) for shape in result_shapes], n)
        results = tuple(
            r.reshape(leading + shape) for r, shape in zip(flat, result_shapes, strict=True)
        )
        return results if several else results[0]

    return evaluate


_MOST_MAPS = 8


class _Evaluator:
    """A function of single columns, evaluated on rows of them.

    A number of members that was asked for before gets a function of its own, which reads and
    writes the rows where they lie; making one takes longer than a single evaluation.
    """

    def __init__(self, function: Any) -> None:
        self._function = function
        self._maps: dict[int, Any] = {}  # by number of members; None where asked for once

    def __call__(self, rows: list[Any], sizes: list[int], n: int) -> list[Any]:
        """Rows of results (n, size) from rows of arguments."""
        if not n:
            return [np.empty((0, size)) for size in sizes]
        if n not in self._maps:
            if len(self._maps) >= _MOST_MAPS:
                self._maps.clear()
            self._maps[n] = None
            raw = self._function.call([ca.DM(r.T) for r in rows])
            return [np.ascontiguousarray(r.full().T) for r in raw]
        if self._maps[n] is None:
            self._maps[n] = self._function.map(n)
        results: list[Any] = [np.empty((n, size)) for size in sizes]
        buffer, evaluate = self._maps[n].buffer()
        for i, row in enumerate(rows):
            buffer.set_arg(i, memoryview(row.reshape(-1)))
        for i, result in enumerate(results):
            buffer.set_res(i, memoryview(result.reshape(-1)))
        evaluate()
        if buffer.ret():
            raise ValueError(f"'{self._function.name()}' failed")
        return results


def _numpy_shape(expression: Any) -> Shape:
    rows, columns = expression.shape
    if columns == 1:
        return () if rows == 1 else (rows,)
    return (rows, columns)
