"""State vectors in the leader of a CEOS product, of ALOS PALSAR say.

Its record of the platform's position holds states in equal steps: positions in meters, velocities
in m/s, Earth-fixed, from a second of a day of UTC on. No original was at hand: read as published.

References
----------
.. [1] NEC TOSHIBA Space Systems, JAXA, "ALOS product format description (PALSAR level 1.0)",
       table 3-5 (platform position data record).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from terrafix.models.core.ceos import Kind, Record, read_records
from terrafix.models.motion.ephemeris import Ephemeris
from terrafix.models.motion.orbits.states import check_distance, check_motion

POSITIONS: Kind = (18, 30, 18, 20)
POSITIONS_NAME = "its platform position record"
_STATES = 387
"""Where the first state begins."""
_WIDTH = 22
_LONGEST_STEP = 3600.0


def read_leader(path: Path) -> Ephemeris:
    """Read the state vectors of a leader.

    Raises
    ------
    ValueError
        If it has none, is damaged, or they cannot be a satellite's.
    OSError
        If it cannot be read.
    """
    found = read_records(path, {POSITIONS: POSITIONS_NAME})
    if POSITIONS not in found:
        raise ValueError("it is a leader without a record of the platform's position")
    return orbit_of(found[POSITIONS])


def orbit_of(record: Record) -> Ephemeris:
    """Ephemeris of a record of the platform's position.

    Raises
    ------
    ValueError
        If a field cannot be, or the states cannot be those of a satellite.
    """
    most = (len(record.content) - _STATES + 1) // (6 * _WIDTH)
    n = record.whole(141, 144, "the number of its states", 2, max(most, 2))
    day = day_of(record)
    second = record.number(161, 182, "the second of the day of its first state")
    step = record.number(183, 204, "the seconds between its states")
    if not (0 <= second < 86401 and 0 < step <= _LONGEST_STEP):
        raise ValueError(f"{record.what} has states from {second:g} s on, every {step:g} s")
    starts = _STATES + _WIDTH * np.arange(6 * n)
    values = [
        record.number(int(at), int(at) + _WIDTH - 1, f"number {k % 6 + 1} of state {k // 6 + 1}")
        for k, at in enumerate(starts)
    ]
    states = np.reshape(values, (n, 6))
    t = np.asarray(step * np.arange(n), np.float64)
    tags = day + np.rint((second + t) * 1e9).astype("timedelta64[ns]")
    check_distance(states[:, :3])
    orbit = Ephemeris(tags, t, states[:, :3].copy(), states[:, 3:].copy())
    check_motion(orbit)
    return orbit


def day_of(record: Record) -> np.datetime64:
    """Day that a record of the platform's position counts seconds from.

    Raises
    ------
    ValueError
        If there is no such day.
    """
    year = record.whole(145, 148, "the year of its states", 1970, 2200)
    month = record.whole(149, 152, "their month", 1, 12)
    day = record.whole(153, 156, "their day", 1, 31)
    try:
        return np.datetime64(f"{year}-{month:02}-{day:02}", "ns")
    except ValueError as error:
        raise ValueError(f"{record.what} has the day {year}-{month}-{day}") from error
