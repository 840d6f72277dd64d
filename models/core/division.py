"""Fewer divisions: what is divided more than once by the same number is multiplied instead.

A division costs as much as some sixteen multiplications, and derivatives are full of them:
normalizing a vector divides each of its elements by one length. The rewriting is part of the
model, before any code is made of it, so that every kernel and every FMU computes the same bits.
"""

from __future__ import annotations

from collections import Counter
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca


class _Instruction(NamedTuple):
    """One instruction of an SX function: what it does, and the registers it reads and writes."""

    kind: int
    inputs: list[int]
    outputs: list[int]


def sharing_reciprocals(function: Any) -> Any:
    """Rewrite an SX function so that every divisor is inverted at most once, a constant never.

    What divides once is left as it is. Results change by rounding.

    Parameters
    ----------
    function : Function
        Made of scalar instructions.

    Returns
    -------
    Function
        Of the same name, arguments and results.
    """
    return _sharing(function.serialize())


@lru_cache(maxsize=128)
def _sharing(serialized: str) -> Any:
    """Rewrite a function by its text: who assembles a system again asks for the same."""
    function = ca.Function.deserialize(serialized)
    code = [
        _Instruction(
            function.instruction_id(k),
            function.instruction_input(k),
            function.instruction_output(k),
        )
        for k in range(function.n_instructions())
    ]
    writer: dict[int, int] = {}  # register to the instruction that wrote it last
    divisor: dict[int, int] = {}  # division to the instruction that made its divisor
    for k, (kind, inputs, outputs) in enumerate(code):
        if kind in (ca.OP_DIV, ca.OP_INV):
            divisor[k] = writer[inputs[-1]]
        if kind != ca.OP_OUTPUT:
            writer[outputs[0]] = k
    if not divisor:
        return function
    shared = {made for made, count in Counter(divisor.values()).items() if count > 1}
    simplifying = ca.GlobalOptions.getSimplificationOnTheFly()
    ca.GlobalOptions.setSimplificationOnTheFly(False)  # it would turn x (1/y) back to x/y
    try:
        return _rewritten(function, code, divisor, shared)
    finally:
        ca.GlobalOptions.setSimplificationOnTheFly(simplifying)


def _rewritten(
    function: Any, code: list[_Instruction], divisor: dict[int, int], shared: set[int]
) -> Any:
    """Repeat the instructions; divide by multiplying where the divisor's maker is in `shared`."""
    arguments = [
        ca.SX.sym(function.name_in(i), function.numel_in(i)) for i in range(function.n_in())
    ]
    elements = [a.elements() for a in arguments]
    results = [[ca.SX(0)] * function.numel_out(i) for i in range(function.n_out())]
    register: dict[int, Any] = {}
    reciprocal: dict[int, Any] = {}
    for k, (kind, inputs, outputs) in enumerate(code):
        if kind == ca.OP_OUTPUT:
            results[outputs[0]][outputs[1]] = register[inputs[0]]
            continue
        value: Any
        if kind == ca.OP_INPUT:
            value = elements[inputs[0]][inputs[1]]
        elif kind == ca.OP_CONST:
            value = ca.SX(function.instruction_constant(k))
        elif k in divisor and register[inputs[-1]].is_constant():
            inverse = 1.0 / float(register[inputs[-1]])
            value = register[inputs[0]] * inverse if kind == ca.OP_DIV else ca.SX(inverse)
        elif divisor.get(k) in shared:
            if divisor[k] not in reciprocal:
                reciprocal[divisor[k]] = 1 / register[inputs[-1]]
            inverse = reciprocal[divisor[k]]
            value = register[inputs[0]] * inverse if kind == ca.OP_DIV else inverse
        elif len(inputs) == 1:
            value = ca.SX.unary(kind, register[inputs[0]])
        else:
            value = ca.SX.binary(kind, *(register[i] for i in inputs[:2]))
        register[outputs[0]] = value
    return ca.Function(
        function.name(),
        arguments,
        [ca.vertcat(*r) if r else ca.SX(0, 1) for r in results],
        [function.name_in(i) for i in range(function.n_in())],
        [function.name_out(i) for i in range(function.n_out())],
    )
