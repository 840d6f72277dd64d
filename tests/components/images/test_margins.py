"""What `check` says of an aperture's margins, against a spherical Earth worked out by hand."""

import re
from pathlib import Path

import numpy as np
import pytest

from terrafix.cosim.basics.errors import SystemCheckError
from terrafix.cosim.files.readers import read_system
from terrafix.models.geometry.earth import EARTH

SYSTEM = Path(__file__).parents[3] / "examples" / "spacecraft_sar_closed_loop.toml"


def notes(*settings):
    found = [n for n in read_system(SYSTEM, settings).check().notes if "start of the step" not in n]
    return "\n".join(found)


def problem(*settings):
    with pytest.raises(SystemCheckError) as raised:
        read_system(SYSTEM, settings).check()
    return str(raised.value)


def sphere():
    """Slant range, effective velocity, ground speed and tan(incidence) of the example's start."""
    r_i = np.array([-1104646.3356338572, -6096830.387203118, 3395727.381187697])
    v_i = np.array([-560.0980743545368, 3729.5871618791953, 6497.9362610432145])
    speed = np.linalg.norm(v_i - EARTH.rotation_rate * np.array([-r_i[1], r_i[0], 0.0]))
    r, ground = np.linalg.norm(r_i), 6372.9e3  # the ellipsoid's radius at 29.76 N
    sine = r / ground * np.sin(np.radians(34.3))
    distance = r * np.cos(np.radians(34.3)) - ground * np.sqrt(1 - sine**2)
    below = np.arcsin(sine) - np.radians(34.3)
    on_ground = speed * ground / r * np.cos(below)
    return distance, np.sqrt(speed * on_ground), on_ground, sine / np.sqrt(1 - sine**2)


def test_the_example_has_what_the_hand_says():
    """Aperture, in lines: prf B lambda R / (2 V^2); 3 sigma of V are about 3 sigma of velocity."""
    distance, velocity, _, _ = sphere()
    aperture = 2160 * 1513 * 0.236100 * distance / (2 * velocity**2)
    text = notes()
    lines, cells = map(int, re.search(r"has (\d+) lines and (\d+) cells", text).groups())
    assert lines == pytest.approx(7452 - 960 - aperture, abs=0.015 * aperture)
    assert cells == pytest.approx(1072 - 432 + 1 - 600, abs=10)  # less what migrates
    assert "it takes 61 MiB, and forming images 244 MiB more" in text  # 8 x 7452 x 1072 / 2^20
    off, longer, spare = map(
        int, re.search(r"(\d+) m/s of .* aperture (\d+) lines longer, and (\d+)", text).groups()
    )
    assert spare == lines
    assert off == pytest.approx(30.0, abs=3.0)
    assert longer == pytest.approx(aperture * 2 * off / velocity, rel=0.05)


def test_with_the_lines_that_it_asks_for_nothing_is_narrow():
    text = notes(("echo.n_lines", "7467"))
    assert "57 lines and 34 cells to spare" in text
    assert "longer" not in text
    assert "autofocus looks" not in text


def test_an_echo_without_room_for_the_image_is_refused():
    text = problem(("echo.n_lines", "6300"))
    assert "wants an image of 960 lines by 600 cells, and of 6300 by 1072 in 'echo' 1" in text
    least = re.search(r"set echo.n_lines to (\d+) at least", text)[1]
    assert "'echo' has 0 lines" in notes(("echo.n_lines", least))
    text = problem(("former.columns", "640"))
    assert "set echo.n_cells to" in text
    assert "former.columns to less" in text


def test_a_prior_of_sixty_meters_per_second_is_ambiguous_and_one_of_110_beyond_autofocus():
    """Doppler: 3 x 2 / lambda x 60 m/s = 1525 Hz, more than half of 2160 Hz, and misalignment.

    Velocity: 330 m/s times the 1.057 by which the effective one grows with that of the orbit.
    """
    text = notes(("last_known.velocity_sigma", "60 m/s"))
    assert "3 sigma of the Doppler centroid, 1525 Hz" in text
    assert "autofocus looks" not in text
    text = notes(("last_known.velocity_sigma", "110 m/s"))
    found = re.search(r"within 300 m/s .*, and 3 sigma of it are (\d+) m/s", text)
    assert float(found[1]) == pytest.approx(330 * 1.057, rel=0.02)


def test_a_reference_is_asked_to_reach_beyond_the_image():
    """R x 3 x 0.1 degrees along the track, and times the tangent of the incidence in range."""
    distance, _, on_ground, tangent = sphere()
    moved = distance * 3 * np.radians(0.1)
    text = notes(("case", "TC-1"), ("reference.n_lines", "2500"), ("reference.n_cells", "1000"))
    for what, reach, spare in (
        ("along the track", moved, (2500 - 960) / 2 * on_ground / 2160),
        ("in range", moved * tangent, 200 * 299792458.0 / 32e6),
    ):
        found = re.search(rf"by ([\d.]+) km {what}, and 'reference' reaches ([\d.]+) km", text)
        assert float(found[1]) == pytest.approx(reach / 1e3, rel=0.03)
        assert float(found[2]) == pytest.approx(spare / 1e3, abs=0.07)
    assert "misalignment" not in notes(("case", "TC-1"))
    text = problem(("reference.n_cells", "500"))
    assert "an image of 'former' has 600 cells, and 'reference' 500: none lies within" in text


def test_where_a_value_was_refused_nothing_is_foreseen():
    with pytest.raises(SystemCheckError, match=r"has 1 problem\n.*'echo.prf' is -2160.0 Hz"):
        read_system(SYSTEM, [("echo.prf", "-2160 Hz")])


@pytest.mark.parametrize("name", ["echo", "former", "correct"])
def test_one_that_looks_to_the_other_side_is_named(name):
    """Where angles below zero are taken; elsewhere they are refused for what they are."""
    text = problem((f"{name}.look", "-34.3 deg"))
    assert f"'{name}.look'" in text
    assert "-34.3 deg" in text or "-0.598" in text
    assert "to the other side of the track" in text or "it must be positive" in text


def test_a_filter_that_believes_in_another_angle_is_told():
    said = "'correct.look' is 30 deg and 'former.look' 34.3 deg: nominally they are one antenna's"
    assert said in notes(("correct.look", "30 deg"))
    assert "one antenna's" not in notes()
