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
Places = NDArray[np.intp]
Fly = Callable[[Members, int | None], Flight]
"""Flies members to the end, or for a look up to a tick; raises ComponentError."""
ASKED = 4
"""Members of a first look, and the first: where it raises for each of them alone, it is taken to
raise for all."""


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
        raises = _look(fly, left, error.tick)
        everyone = all(raises(place) for place in _spread(len(left)))
        if everyone and not all_the_same and len(left) == len(members):
            raise error
        places = np.arange(len(left)) if everyone else _halved(raises, len(left))
        flights += [fly(left[[place]], None) for place in places]
        left = np.delete(left, places)
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


def _look(fly: Fly, members: Members, tick: int) -> Callable[[Places], bool]:
    """Whether a component raises up to a tick, for the members at some places."""

    def raises(places: Places) -> bool:
        try:
            fly(members[places], tick)
        except ComponentError:
            return True
        return False

    return raises


def _spread(n: int) -> list[Places]:
    """A few places of n, each alone."""
    return [np.array([place]) for place in sorted({(n - 1) * k // ASKED for k in range(ASKED + 1)})]


def _halved(raises: Callable[[Places], bool], n: int) -> Places:
    """Places of n for which it raises, where it does for all n together."""
    found: list[int] = []
    suspected = [np.arange(n)]
    while suspected:
        places = suspected.pop()
        if len(places) == 1:
            found.append(int(places[0]))
            continue
        guilty = [half for half in np.array_split(places, 2) if raises(half)]
        # where it raises with neither half, but with both: each is flown alone
        suspected += guilty or [places[[k]] for k in range(len(places))]
    return np.array(sorted(found))
