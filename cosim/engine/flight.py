"""What the flight of some members leaves behind; several flights side by side, as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.memory.fields import Field

Record = tuple[FloatArray, list[tuple[str, Field, NDArray[Any]]]]
"""Times (n,), and of each variable its name, its field and values (n, n_members, *shape)."""


@dataclass
class Flight:
    """What the flight of some members leaves behind.

    Attributes
    ----------
    members : ndarray of int64, shape (n_members,)
        Their numbers.
    records : dict of str to Record
    parameters : dict of str to (str, ndarray)
        Dispersed parameters as they reached the components: unit, and values (n_members, *shape).
    excluded : list of dict
        ``member``, ``component``, ``t_s`` and ``reason`` of every failure.
    ticks, component_steps : int
    overruns : dict of str to int
        Messages that queues lost, by port.
    notes : list of str
    """

    members: NDArray[np.int64]
    records: dict[str, Record]
    parameters: dict[str, tuple[str, NDArray[Any]]]
    excluded: list[dict[str, Any]]
    ticks: int = 0
    component_steps: int = 0
    overruns: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def history(self, record: str, prefix: str) -> tuple[FloatArray, dict[str, NDArray[Any]]]:
        """Times and arrays of a record, by name without `prefix`."""
        times, variables = self.records[record]
        return times, {name.removeprefix(prefix): values for name, _, values in variables}


def side_by_side(flights: Sequence[Flight], members: NDArray[np.int64]) -> Flight:
    """Flights of parts of an ensemble as one of all its `members`, in their order.

    A flight that ended before the others is filled up with NaN (whole numbers: with 0).
    """
    flown = np.concatenate([flight.members for flight in flights])
    order = np.argsort(flown)[np.searchsorted(np.sort(flown), members)]
    records = {
        name: _joined([f.records[name] for f in flights], order) for name in flights[0].records
    }
    parameters = {
        name: (unit, np.concatenate([f.parameters[name][1] for f in flights])[order])
        for name, (unit, _) in flights[0].parameters.items()
    }
    longest = max(flights, key=lambda flight: flight.ticks)
    overruns: dict[str, int] = {}
    for flight in flights:
        for port, count in flight.overruns.items():
            overruns[port] = overruns.get(port, 0) + count
    return Flight(
        members,
        records,
        parameters,
        sorted((e for f in flights for e in f.excluded), key=lambda e: e["t_s"]),
        longest.ticks,
        longest.component_steps,
        overruns,
        longest.notes,
    )


def _joined(records: Sequence[Record], order: NDArray[np.int64]) -> Record:
    times = max((times for times, _ in records), key=len)
    variables = []
    for each in zip(*(variables for _, variables in records), strict=True):
        name, declared, _ = each[0]
        filled = [_filled(values, len(times)) for _, _, values in each]
        variables.append((name, declared, np.concatenate(filled, axis=1)[:, order]))
    return times, variables


def _filled(values: NDArray[Any], n: int) -> NDArray[Any]:
    missing = n - len(values)
    if not missing:
        return values
    empty = np.nan if values.dtype.kind in "fc" else 0
    rest = np.full((missing, *values.shape[1:]), empty, dtype=values.dtype)
    return np.concatenate([values, rest])
