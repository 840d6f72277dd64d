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
    def build() -> tuple[Any, list[Shape], bool]:
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
        return function, [_numpy_shape(r) for r in results], several

    name = getattr(expression, "__name__", "function")

    @wraps(expression)
    def evaluate(*arrays: ArrayLike) -> Any:
        function, result_shapes, several = build()
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
        columns = [
            np.broadcast_to(a, leading + shape).reshape(n, prod(shape)).T
            for a, shape in zip(given, shapes, strict=True)
        ]
        raw = (
            function.call([ca.DM(c) for c in columns]) if n else [ca.DM(0, 0)] * len(result_shapes)
        )
        results = tuple(
            np.ascontiguousarray(r.full().T).reshape(leading + shape)
            for r, shape in zip(raw, result_shapes, strict=True)
        )
        return results if several else results[0]

    return evaluate


def _numpy_shape(expression: Any) -> Shape:
    rows, columns = expression.shape
    if columns == 1:
        return () if rows == 1 else (rows,)
    return (rows, columns)
