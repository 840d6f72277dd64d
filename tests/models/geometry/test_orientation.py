"""Orientation of the Earth: a day of the table, between two, and where it stops predicting."""

import numpy as np
import pytest

from terrafix.models.core.iers import orientation_table
from terrafix.models.core.timescales import tai_from
from terrafix.models.geometry.orientation import earth_orientation

ARC_SECOND = np.pi / 648000
# Bulletin B of 1 and 2 January 2017: xp, yp ["], UT1 - UTC [s], dX, dY [mas]
FIRST = np.array([0.080450, 0.263074, 0.5912975, -0.019, -0.057])
SECOND = np.array([0.080275, 0.263595, 0.5902149, -0.027, -0.065])
SI = np.array([ARC_SECOND, ARC_SECOND, 1.0, 1e-3 * ARC_SECOND, 1e-3 * ARC_SECOND])


@pytest.mark.parametrize("part", [0.0, 0.25])
def test_a_day_of_the_table_and_a_part_of_it(part):
    found = earth_orientation(tai_from("UTC", 57754, 86400 * part))
    expected = (FIRST + part * (SECOND - FIRST)) * SI
    values = (found.xp, found.yp, found.ut1_tai + 37, found.dx, found.dy)
    np.testing.assert_allclose(values, expected, rtol=1e-12)
    rates = (found.xp_rate, found.yp_rate, found.ut1_rate, found.dx_rate, found.dy_rate)
    np.testing.assert_allclose(rates, (SECOND - FIRST) * SI / 86400, rtol=1e-9)


def test_predictions_go_on_without_offsets_of_the_celestial_pole():
    """Of dX and dY the table knows about three months ahead; then they are zero, 0.3 mas off."""
    table = orientation_table()
    assert np.all(np.diff(table.day) == 1)
    assert table.dx[-1] == table.dy[-1] == 0.0
    assert np.abs(table.dx).max() < 40e-3 * ARC_SECOND
    assert np.hypot(table.xp, table.yp).max() < 0.65 * ARC_SECOND
    assert np.abs(table.ut1_utc).max() < 0.92  # leap seconds keep it so
