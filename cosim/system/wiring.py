"""Whether an output may feed an input, and by what factor; errors that show both sides."""

from __future__ import annotations

from typing import Any

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError, WiringError
from terrafix.cosim.basics.units import conversion_factor, difference
from terrafix.cosim.declare.ports import Port
from terrafix.cosim.memory.fields import Field


def describe(*ports: tuple[str, Port[Any]]) -> list[str]:
    """Describe ports, given with their paths, in one line per field, column below column."""
    rows = []
    for path, port in ports:
        side = "input" if port.is_input else "output"
        kind = "" if port.kind == "signal" else f" {port.kind}"
        for name, field in port.fields.items():
            dtype = "" if np.dtype(field.dtype) == np.float64 else f" {np.dtype(field.dtype)}"
            rows.append(
                (
                    f"{path}.{name}" if name else path,
                    f"{side}{kind}",
                    f"shape {field.shape}".replace("None", "any") + dtype,
                    f"unit {field.unit_text()}",
                    f"frame {field.frame}" if field.frame else "",
                )
            )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = ([f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)] for row in rows)
    return ["  " + "  ".join(cells).rstrip() for cells in padded]


def _field_problem(name: str, source: Field, target: Field) -> str | None:
    prefix = f"field '{name}': " if name else ""
    if len(source.shape) != len(target.shape) or any(
        a is not None and b is not None and a != b
        for a, b in zip(source.shape, target.shape, strict=True)
    ):
        return f"{prefix}the shapes differ: {source.shape} is not {target.shape}"
    if np.dtype(source.dtype) != np.dtype(target.dtype):
        return f"{prefix}the types differ: {np.dtype(source.dtype)} is not {np.dtype(target.dtype)}"
    if source.ragged != target.ragged:
        return f"{prefix}one side is ragged, the other is not"
    try:
        factor = field_factor(source, target)
    except ConfigurationError as error:
        return f"{prefix}{error}"
    if factor is None:
        return f"{prefix}{_units_differ(source, target)}"
    if source.frame != target.frame:
        return (
            f"{prefix}the frames differ: {source.frame or 'none'} is not {target.frame or 'none'}"
        )
    if np.dtype(source.dtype) != np.float64 and np.any(factor != 1.0):
        return (
            f"{prefix}only float64 ports are converted: "
            f"declare both sides in {source.unit_text()} or in {target.unit_text()}"
        )
    return None


def _units_differ(source: Field, target: Field) -> str:
    if isinstance(source.unit, str) and isinstance(target.unit, str):
        return difference(source.unit, target.unit)
    return f"the units differ: {source.unit_text()} is not {target.unit_text()}"


def field_factor(source: Field, target: Field) -> FloatArray | None:
    """Factors from one field's unit(s) to another's, scalar or by last axis; None if none fits."""
    if source.unit == target.unit:
        return np.float64(1.0)  # type: ignore[return-value]
    n = source.shape[-1] if source.shape else 1
    count = n if n is not None else 1

    def spread(unit: str | tuple[str, ...]) -> tuple[str, ...]:
        return (unit,) * count if isinstance(unit, str) else unit

    a, b = spread(source.unit), spread(target.unit)
    if len(a) != len(b):
        return None
    factors = [conversion_factor(x, y) for x, y in zip(a, b, strict=True)]
    if any(f is None for f in factors):
        return None
    return np.array(factors, dtype=np.float64) if source.shape else np.float64(factors[0])  # type: ignore[return-value]


def port_factor(source: Port[Any], target: Port[Any]) -> FloatArray | None:
    """Factors by flat element, shape (width,); None where every factor is one."""
    parts = []
    for name in source.fields:
        field = source.fields[name]
        factor = field_factor(field, target.fields[name])
        assert factor is not None
        parts.append(np.broadcast_to(factor, field.fixed_shape).reshape(-1))
    flat = np.concatenate(parts)
    return None if np.all(flat == 1.0) else flat


def check_connection(
    source_path: str, source: Port[Any], target_path: str, target: Port[Any]
) -> None:
    """Raise WiringError, showing both sides, if `source` cannot feed `target`."""
    problem: str | None = None
    if source.is_input or not target.is_input:
        what = "an input" if source.is_input else "an output"
        which, should = (
            (source_path, "a connection goes from an output to an input")
            if source.is_input
            else (target_path, "a connection ends at an input")
        )
        problem = f"{which} is {what}; {should}"
    elif source.kind != target.kind:
        problem = f"a {source.kind} cannot feed a {target.kind}"
        if {source.kind, target.kind} == {"signal", "message"}:
            problem += ": a message has a time of validity and is fresh once, a signal is held"
    elif set(source.fields) != set(target.fields):
        have = [n for n in source.fields if n] or ["no fields"]
        want = [n for n in target.fields if n] or ["no fields"]
        problem = f"the fields differ: {', '.join(have)} is not {', '.join(want)}"
    elif target.window and source.is_bundle:
        problem = "a window collects a plain signal, not a bundle"
    else:
        found = (_field_problem(n, f, target.fields[n]) for n, f in source.fields.items())
        problem = next((p for p in found if p), None)
    if problem:
        lines = [f"cannot connect '{source_path}' to '{target_path}'"]
        lines += describe((source_path, source), (target_path, target))
        raise WiringError("\n".join([*lines, f"  {problem}"]))
