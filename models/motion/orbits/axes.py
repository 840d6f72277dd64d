"""Axes that files give states in, and the way from there to Earth-fixed ones."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.timescales import Instant
from terrafix.models.geometry.celestial import earth_fixed_from_frame

EARTH_FIXED = "itrf"
INERTIAL = {
    **dict.fromkeys(("GCRF", "ICRF", "GCRS"), "gcrf"),
    **dict.fromkeys(("EME2000", "J2000", "MEAN2000"), "j2000"),
    "TEME": "teme",
    **dict.fromkeys(("TOD", "TOD_EARTH", "TRUEOFDATE"), "tod"),
}
"""Inertial axes by the names that files have for them."""

_ROTATING = re.compile(r"(ITRF|ITR|IGS|IGB|IGC|WGS|EARTHFIXED|ECEF|SLR)[-_ ]?[0-9A-Z]*")
"""Realizations of one frame, which differ by centimeters."""


def frame_named(name: str) -> str:
    """The frame meant by a name: "itrf", "gcrf", "j2000", "teme" or "tod".

    Raises
    ------
    ValueError
        If it is none that is known.
    """
    plain = name.strip().upper()
    joined = re.sub(r"[ _-]", "", plain)
    if joined in INERTIAL:
        return INERTIAL[joined]
    if _ROTATING.fullmatch(plain) or joined == "EARTHFIXED":
        return EARTH_FIXED
    raise ValueError(f"its frame is '{name}', known are ITRF, {', '.join(INERTIAL)}")


def to_earth_fixed(
    frame: str, epochs: Callable[[], Instant], r: FloatArray, v: FloatArray | None
) -> tuple[FloatArray, FloatArray | None]:
    """Earth-fixed positions (n, 3) [m] and velocities [m/s] of states in a frame.

    Parameters
    ----------
    frame : str
        As `frame_named` has it.
    epochs : callable
        Gives the instants of the states, (n,): only what turns needs them, and the tables.
    r, v : ndarray, shape (n, 3)
        Velocities may be absent.

    Raises
    ------
    ValueError
        If an epoch lies outside the tables.
    ImportError
        If the extra ``truth`` is not installed.
    """
    if frame == EARTH_FIXED:
        return r, v
    r_e, v_e = earth_fixed_from_frame(frame, epochs(), r, np.zeros_like(r) if v is None else v)
    return r_e, None if v is None else v_e
