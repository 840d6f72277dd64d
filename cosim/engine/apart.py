"""Where a component raises, for one member perhaps: that member is given up, the others fly on.

A component steps all members at once, so that what it raises ends all of them, and nobody can say
for whom it was. But a member's numbers do not depend on who flies with it: those for whom it
raises are found by flying parts of the ensemble, and the others are flown again without them.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.errors import ComponentError, StepError
from terrafix.cosim.engine.flight import Flight, side_by_side
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.system.system import System

Members = NDArray[np.int64]
Fly = Callable[[Members, int | None], Flight]
"""Flies members to the end, or for a look up to a tick; raises ComponentError."""
ASKED = 5
"""Members of a first look: where it raises for each of them alone, it is taken to for all."""


def fly_apart(fly: Fly, members: Members, error: ComponentError, *, all_the_same: bool) -> Flight:
    """Fly members though a component raises for some of them.

    Parameters
    ----------
    fly : callable
        Flies some of them; one alone is given up where a component raises.
    members : ndarray of int64
    error : ComponentError
        What it raised with all of them.
    all_the_same : bool
        Fly them though it raises for everyone, to give up each at its own time; else `error` is
        raised then.

    Raises
    ------
    ComponentError
        If it raises for everyone.
    """
    left, flights = members, []
    while True:
        raising = _raising(fly, left, error.tick)
        if not all_the_same and len(raising) == len(members):
            raise error
        flights += [fly(left[[i]], None) for i in raising]
        left = np.delete(left, raising)
        if not len(left):
            break
        try:
            flights.append(fly(left, None))
            break
        except ComponentError as later:
            error = later
    return side_by_side(flights, members)


def fly_part(
    system: System,
    members: Members,
    until: int | None,
    *,
    seed: int,
    duration: Fraction,
    runs: int,
    recording: bool,
) -> Flight:
    """Fly some members of `runs` to the end, or up to tick `until` for a look.

    One alone is given up where a component raises, unless this is but a look; a flight ends where
    nobody is left.

    Raises
    ------
    ComponentError
        If a component raises.
    """
    simulation = Simulation(
        system,
        members=members.tolist(),
        seed=seed,
        duration=duration,
        runs=runs,
        recording=recording and until is None,
    )
    master = simulation.master
    try:
        try:
            simulation.initialize()
            master.run_until(master.ticks(duration) if until is None else until)
        except ComponentError as error:
            if until is not None or len(members) > 1:
                raise
            master.give_up(error)
        except StepError:
            if master.active.any():  # it was a recorder
                raise
        return simulation.flight()
    finally:
        master.terminate()


def _raising(fly: Fly, members: Members, tick: int) -> list[int]:
    """Places of the members for whom a component raises up to a tick; with all it does."""

    def raises(places: NDArray[np.intp]) -> bool:
        try:
            fly(members[places], tick)
        except ComponentError:
            return True
        return False

    n = len(members)
    asked = np.unique(np.linspace(0, n - 1, min(ASKED, n)).astype(np.intp))
    if all(raises(asked[[k]]) for k in range(len(asked))):
        return list(range(n))
    found: list[int] = []
    suspected = [np.arange(n)]
    while suspected:
        places = suspected.pop()
        if len(places) == 1:
            found.append(int(places[0]))
            continue
        halves = np.array_split(places, 2)
        guilty = [half for half in halves if raises(half)]
        # together alone: with whom it raises is not to be told apart
        suspected += guilty or [places[[k]] for k in range(len(places))]
    return sorted(found)
