r"""How the Earth is turned: UT1, the pole, and the offsets of the celestial pole at instants.

Daily values of the IERS, interpolated linearly. What is left out varies within a day: by ocean
tides the pole moves by up to 0.5 mas (16 mm on the ground).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from terrafix.models.core.iers import Orientation, orientation_table
from terrafix.models.core.timescales import Instant, table_days, table_place, ut1_minus_tai


@dataclass(frozen=True)
class EarthOrientation:
    """Orientation of the Earth at one instant or many, shape (...) each.

    Attributes
    ----------
    ut1_tai : float or ndarray
        UT1 - TAI [s].
    ut1_rate : float or ndarray
        Its rate [s/s]: the excess length of day is -86400 s times it.
    xp, yp : float or ndarray
        Coordinates of the pole [rad].
    xp_rate, yp_rate : float or ndarray
        [rad/s].
    dx, dy : float or ndarray
        Offsets of the celestial pole from the model of IAU 2006/2000A [rad].
    dx_rate, dy_rate : float or ndarray
        [rad/s].
    """

    ut1_tai: Any
    ut1_rate: Any
    xp: Any
    yp: Any
    xp_rate: Any
    yp_rate: Any
    dx: Any
    dy: Any
    dx_rate: Any
    dy_rate: Any


def earth_orientation(instant: Instant) -> EarthOrientation:
    """Orientation of the Earth by the tables of the IERS.

    Raises
    ------
    ValueError
        If an instant lies outside the tables; the message says how far they reach.
    ImportError
        If the tables are not installed.
    """
    k, part = table_place(instant)
    table: Orientation = orientation_table()
    length = table_days(k)

    def linear(values: Any) -> tuple[Any, Any]:
        step = values[k + 1] - values[k]
        return values[k] + part * step, step / length

    (xp, xp_rate), (yp, yp_rate) = linear(table.xp), linear(table.yp)
    (dx, dx_rate), (dy, dy_rate) = linear(table.dx), linear(table.dy)
    ut1_tai, ut1_rate = ut1_minus_tai(instant)
    return EarthOrientation(ut1_tai, ut1_rate, xp, yp, xp_rate, yp_rate, dx, dy, dx_rate, dy_rate)
