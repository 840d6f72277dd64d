"""Axes that files give states in, and the way from there to Earth-fixed ones."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray

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
    frame: str,
    epochs: Callable[[], NDArray[np.datetime64]],  # noqa: ARG001
    r: FloatArray,
    v: FloatArray | None,
) -> tuple[FloatArray, FloatArray | None]:
    """Earth-fixed positions (n, 3) [m] and velocities [m/s] of states in a frame.

    Parameters
    ----------
    frame : str
        As `frame_named` has it.
    epochs : callable
        Gives TAI of the states, (n,): only what turns needs it, and the table of leap seconds.
    r, v : ndarray, shape (n, 3)
        Velocities may be absent.

    Raises
    ------
    ValueError
        If the frame is not read yet.
    """
    if frame == EARTH_FIXED:
        return r, v
    raise ValueError(
        f"its states are in {frame.upper()}, which is not read yet\n"
        "  have them written Earth-fixed (ITRF)"
    )
