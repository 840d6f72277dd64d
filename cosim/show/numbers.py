"""How numbers and published evaluations are shown to people, in tables and pictures alike."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

_SHOWN = {
    "rad": ("deg", math.degrees(1.0)),
    "rad/s": ("deg/h", math.degrees(1.0) * 3600.0),
}


def shown_unit(unit: str) -> tuple[str, float]:
    """Unit that a person reads, and the factor to it: angles in degrees, all else as it is."""
    return _SHOWN.get(unit, (unit, 1.0))


def number(value: float | None, digits: int = 4) -> str:
    """Write a number with some significant digits; a dash for none."""
    if value is None or not math.isfinite(value):
        return "-"
    if value == 0.0:
        return "0"
    if 1e-3 <= abs(value) < 1e6:
        return f"{value:.{max(digits - 1 - math.floor(math.log10(abs(value))), 0)}f}"
    return f"{value:.{digits - 1}e}"


def is_quantity(value: object) -> bool:
    """Whether a published value is a quantity: error and sigma with a unit."""
    return isinstance(value, Mapping) and {"unit", "error"} <= set(value)


def is_consistency(value: object) -> bool:
    """Whether a published value is a consistency figure: a mean with its interval."""
    return isinstance(value, Mapping) and {"mean", "interval_95", "dof"} <= set(value)


def summaries(evaluation: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Summaries by component path; the only one of a system has the path ``""``."""
    if not evaluation:
        return {}
    nested = all(
        isinstance(v, Mapping) and not is_quantity(v) and not is_consistency(v)
        for v in evaluation.values()
    )
    return dict(evaluation) if nested else {"": evaluation}
