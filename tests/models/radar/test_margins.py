"""What an echo has to spare, against what is focused of one, and against derivatives."""

import numpy as np
import pytest

from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.imaging import Imager
from terrafix.models.radar.margins import aperture_lines, focused_size, lines_needed, sigma_of

RADAR = Radar(1.27e9, 2000.0, 16e6, -1e12, 4e-6, 200.0)


def test_the_aperture_is_that_of_the_formula():
    """B lambda R / (2 V^2) = 200 x 0.2360570 x 700e3 / (2 x 7100^2) = 0.327792 s, 655.584 lines."""
    assert aperture_lines(RADAR, 700e3, 7100.0) == pytest.approx(655.584, abs=0.001)


@pytest.mark.parametrize(("velocity", "n"), [(7000.0, 900), (7400.0, 900), (7000.0, 500)])
def test_what_is_focused_is_what_the_processor_says(velocity, n):
    """Of 160 cells, a row and a column rounded; 500 lines are shorter than the aperture, 674."""
    rng = np.random.default_rng(3)
    echo = (rng.standard_normal((n, 160)) + 1j * rng.standard_normal((n, 160))).astype(np.complex64)
    near, middle = 700e3, 700e3 + 48 * RADAR.range_spacing  # of the columns that are focused
    imager = Imager(echo, RADAR, near, -n / 2 / RADAR.prf, migration_step=1.0)
    image = imager.image(imager.processing(0.0, velocity, 0.0), velocity)
    lines, cells = focused_size(RADAR, n, 160, middle, velocity)
    assert image.rows.stop - image.rows.start == pytest.approx(lines, abs=2)
    assert image.columns.stop - image.columns.start == pytest.approx(cells, abs=1)


def test_an_echo_shorter_than_a_pulse_has_nothing_focused():
    assert focused_size(RADAR, 600, 50, 700e3, 7100.0)[1] < 0


def test_with_the_lines_that_are_needed_as_many_are_focused():
    n = lines_needed(RADAR, 100, 160, 700e3, 7100.0)
    assert focused_size(RADAR, round(n), 160, 700e3, 7100.0)[0] == pytest.approx(100, abs=0.5)


def test_sigma_is_that_of_the_gradient():
    """f = 3 x + 4 v_y with sigmas 2 and 1: the root of 36 + 16."""
    sigma = sigma_of(
        lambda r, v: float(3 * r[0] + 4 * v[1]),
        np.zeros(3),
        np.zeros(3),
        np.array([2.0, 9.0, 9.0]),
        np.array([7.0, 1.0, 7.0]),
    )
    assert sigma == pytest.approx(np.sqrt(52.0), rel=1e-12)
