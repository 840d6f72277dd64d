r"""Where the Sun and the Moon are, seen from the center of the Earth.

Geometric positions in the axes of GCRF: no light time, no aberration, as forces want them. The Sun
is that of ERFA's `epv00` (VSOP 2000, within 13 km of JPL's DE405), the Moon that of `moon98` (the
longest terms of ELP 2000; 6 km rms, 32 km at worst from ELP/MPP02). For both TT serves as TDB, from
which it differs by 2 ms at most.

References
----------
.. [1] X. Moisson, P. Bretagnon, "Analytical planetary solution VSOP2000", Celest. Mech. Dyn.
       Astron. 80, 2001, and the notes of `epv00` in ERFA.
.. [2] J. Meeus, "Astronomical Algorithms", 2nd ed., ch. 47, and the notes of `moon98` in ERFA.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.extras import optional
from terrafix.models.core.timescales import DAY, Instant
from terrafix.models.geometry.celestial import rotation_vector_of_earth, terrestrial_rotation
from terrafix.models.geometry.orientation import earth_orientation
from terrafix.models.geometry.quaternion import from_matrix_array

ASTRONOMICAL_UNIT = 149597870700.0
"""[m], IAU 2012."""

_MJD = 2400000.5


def sun_position(instant: Instant) -> tuple[FloatArray, FloatArray]:
    """Position [m] and velocity [m/s] of the Sun, two (..., 3), from the Earth's center in GCRF.

    Raises
    ------
    ImportError
        If the packages of the extra ``truth`` are not installed.
    """
    heliocentric, _ = _erfa().epv00(*_julian(instant))
    return _in_si(heliocentric, -1.0)


def moon_position(instant: Instant) -> tuple[FloatArray, FloatArray]:
    """Position [m] and velocity [m/s] of the Moon, two (..., 3), from the Earth's center in GCRF.

    Raises
    ------
    ImportError
        If the packages of the extra ``truth`` are not installed.
    """
    return _in_si(_erfa().moon98(*_julian(instant)), 1.0)


def environment_at(instant: Instant) -> dict[str, FloatArray]:
    """What surrounds a satellite, in ITRF axes, by name.

    Returns
    -------
    dict of str to ndarray
        Of shape (..., 3): ``omega_e``, rotation vector of the axes relative to GCRF [rad/s];
        ``sun_e`` and ``moon_e`` [m], from the center of the Earth; ``sun_rate_e`` and
        ``moon_rate_e`` [m/s], their inertial velocities. Of shape (..., 4): ``q_ei``, quaternion
        from GCRF to ITRF.

    Raises
    ------
    ValueError
        If an instant lies outside the tables of the Earth's orientation.
    ImportError
        If the packages of the extra ``truth`` are not installed.
    """
    known = earth_orientation(instant)
    C = terrestrial_rotation(instant, known)
    found = {"omega_e": rotation_vector_of_earth(instant, known), "q_ei": from_matrix_array(C)}
    for body, position in (("sun", sun_position), ("moon", moon_position)):
        names = (f"{body}_e", f"{body}_rate_e")
        for name, vector in zip(names, position(instant), strict=True):
            found[name] = np.einsum("...ij,...j->...i", C, vector)
    return found


def _in_si(pv: Any, sign: float) -> tuple[FloatArray, FloatArray]:
    r = sign * ASTRONOMICAL_UNIT * np.asarray(pv["p"])
    return r, sign * ASTRONOMICAL_UNIT / DAY * np.asarray(pv["v"])


def _julian(instant: Instant) -> tuple[Any, Any]:
    day, seconds = instant.to("TT")
    return _MJD + np.asarray(day, np.float64), np.asarray(seconds) / DAY


def _erfa() -> Any:
    return optional("erfa", "the place of the Sun or the Moon")
