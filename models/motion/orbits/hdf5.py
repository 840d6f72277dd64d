"""State vectors in the HDF5 of NISAR's products, of any level, which other radars' are put into.

The first group ``orbit`` that is found holds ``time`` (n,), seconds of UTC since an epoch, and
Earth-fixed ``position`` and ``velocity`` (n, 3) [m, m/s].
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from terrafix.models.core.hdf5 import epoch_of, opened, values_of
from terrafix.models.motion.ephemeris import Ephemeris
from terrafix.models.motion.orbits.states import check_distance, check_motion

_DEEPEST = 8
"""Groups within groups that are looked through."""


def read_hdf5(path: Path) -> Ephemeris:
    """Read the state vectors of a NISAR product (HDF5).

    Raises
    ------
    ValueError
        If it is damaged, has no group ``orbit``, or its states cannot be a satellite's.
    """
    with opened(path) as file:
        group = _found(file, _DEEPEST)
        if group is None:
            raise ValueError("it is HDF5 without a group 'orbit' of state vectors")
        try:
            return orbit_of(group)
        except (OSError, RuntimeError) as error:
            raise ValueError(f"it is damaged ({error})") from error


def _found(group: Any, deepest: int) -> Any:
    if "orbit" in group.groups and "position" in group.groups["orbit"].variables:
        return group.groups["orbit"]
    inner = (_found(g, deepest - 1) for g in group.groups.values()) if deepest else ()
    return next((g for g in inner if g is not None), None)


def orbit_of(group: Any) -> Ephemeris:
    """Ephemeris of a group of state vectors, of products of any level.

    Raises
    ------
    ValueError
        If they lack something, or cannot be those of a satellite.
    """
    t = values_of(group, "time", (-1,))
    r, v = (values_of(group, name, (len(t), 3)) for name in ("position", "velocity"))
    tags = epoch_of(group["time"]) + np.rint(t * 1e9).astype("timedelta64[ns]")
    check_distance(r)
    orbit = Ephemeris(tags, t - t[0], r, v)
    check_motion(orbit)
    return orbit
