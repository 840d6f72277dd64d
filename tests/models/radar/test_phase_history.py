"""Phase history: points of exact geometry, and the recorded one of the Gotcha set."""

from dataclasses import replace

import numpy as np
import pytest

from terrafix.models.images.aperture_matching import GATE, PARTS
from terrafix.models.radar.chirp import SPEED_OF_LIGHT
from terrafix.models.radar.compensation import straight_line
from terrafix.models.radar.correlation import contrast, shift_between
from terrafix.models.radar.phase_history import (
    PhaseHistory,
    compressed_pulses,
    ground_grid,
    moved,
    projected,
    projected_drift,
    read_gotcha,
)

SPEED = 100.0  # [m/s], assumed: it is not in the data
REACH = 144, 72  # [pixels] of 0.25 m


def history_of(points, n=80):
    """Spotlight pulses of unit points (k, 3), from 10 km."""
    frequency = 9.6e9 + 1.5e6 * (np.arange(200) - 100)
    r = np.array([7000.0, 0.0, 7000.0]) + np.outer(np.arange(n) - n / 2, [0.0, 1.5, 0.0])
    reference = np.linalg.norm(r, axis=1)
    phase = np.zeros((n, 200), complex)
    for p in points:
        beyond = np.linalg.norm(p - r, axis=1) - reference
        phase += np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(beyond, frequency))
    return PhaseHistory(phase.astype(np.complex64), frequency, r, reference)


def test_points_appear_where_they_are(aircraft):
    places = np.array([[0.0, 0.0, 0.0], [10.0, -12.0, 0.0]])
    history = history_of(places)
    grid = ground_grid(history.r, 0.25, 160, 160)
    image = projected(compressed_pulses(history), grid, aircraft.SUMS)
    for p in places:
        row, column = (np.array([p @ grid.along, p @ grid.out]) / 0.25) + 79.5
        i, j = int(row) - 3, int(column) - 3
        part = image[i : i + 8, j : j + 8]
        top = np.unravel_index(part.argmax(), part.shape)
        # half a pixel: nothing is interpolated
        assert abs(i + top[0] - row) <= 0.51
        assert abs(j + top[1] - column) <= 0.51


def test_places_that_make_no_phase_history_are_refused():
    history = history_of(np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"has .* frequencies and places"):
        PhaseHistory(history.phase, history.frequency, history.r[1:], history.reference)
    with pytest.raises(ValueError, match="not in equal steps upward"):
        PhaseHistory(history.phase, history.frequency[::-1], history.r, history.reference)
    broken = history.r.copy()
    broken[0, 0] = np.nan
    with pytest.raises(ValueError, match="r of a phase history is not finite"):
        PhaseHistory(history.phase, history.frequency, broken, history.reference)


def test_files_that_are_none_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="is not there"):
        read_gotcha([tmp_path / "none.mat"])
    file = tmp_path / "other.mat"
    file.write_bytes(b"no matlab" * 40)
    with pytest.raises(ValueError, match="is no phase history of the Gotcha set"):
        read_gotcha([file])


@pytest.fixture(scope="module")
def gotcha(aircraft, data_folder):
    """Two degrees of aspect, and a reference of the next two: other speckle, the same cars."""
    folder = data_folder / "afrl_gotcha"
    if not folder.is_dir():
        pytest.skip(f"no phase history: {folder} is absent")
    files = [folder / f"data_3dsar_pass1_az00{k}_HH.mat" for k in (1, 2, 3, 4)]
    flown, other = read_gotcha(files[:2]), read_gotcha(files[2:])
    grid = ground_grid(flown.r, 0.25, 440, 440)
    wide = projected(compressed_pulses(other), grid.grown(*REACH), aircraft.SUMS)
    return flown, flown.times(SPEED), grid, contrast(wide)


@pytest.mark.parametrize(
    ("dp", "dv"),
    [
        ((0.4, -0.3, 0.5), (0.08, 0.1, -0.12)),
        ((4.0, -5.0, 3.0), (-0.1, 0.05, 0.05)),
        ((0.5, 0.2, -0.5), (0.0, 2.0, 0.0)),
    ],
)
def test_a_wrong_track_is_recovered_from_another_aspect(dp, dv, gotcha, aircraft):
    """Range within 0.08 m, along 0.25 m, velocity 0.06 m/s: the bars for the rms of 80 draws.

    A position off by 0.5 to 5 m and a velocity by 0.1 to 2 m/s; see ``benchmarks/gotcha.py``.
    """
    history, t, grid, reference = gotcha
    true = straight_line(t, history.r)
    believed = history.r + np.asarray(dp) + np.outer(t, dv)
    profiles = moved(compressed_pulses(history), believed)
    drift, focused = projected_drift(profiles, t, grid, aircraft.SUMS)
    assert drift.accepted
    assert drift.n_rounds <= 3
    assert drift.velocity == pytest.approx(SPEED, abs=0.06)
    image = contrast(projected(focused, grid, aircraft.SUMS))
    shift = shift_between(image, reference, REACH)
    assert shift.inside
    assert shift.quality > GATE
    at = grid.spacing * (shift.pixels[0] * grid.along + shift.pixels[1] * grid.out)
    now, speed = straight_line(t, focused.r), straight_line(t, believed).speed
    assert np.linalg.norm(at - now.r) - np.linalg.norm(true.r) == pytest.approx(0.0, abs=0.08)
    assert (now.v @ (at - now.r) + true.v @ true.r) / speed == pytest.approx(0.0, abs=0.25)
    assert shift.parts > PARTS
    # what is somewhere else has peaks, too, but one bright point on another holds them
    for wrong in (image[::-1], image[:, ::-1], image[::-1, ::-1]):
        other = shift_between(np.ascontiguousarray(wrong), reference, REACH)
        assert other.quality < GATE or other.parts < PARTS


def _width(line, step):
    """Where a peak falls to half of its power, between samples."""
    top, least = int(line.argmax()), line.max() / np.sqrt(2)
    sides = []
    for side in (line[top::-1], line[top:]):
        k = int(np.argmax(side < least))
        sides.append(k - (least - side[k]) / (side[k - 1] - side[k]))
    return sum(sides) * step


def test_the_car_park_is_as_sharp_as_theory_says(data_folder, aircraft):
    """The two brightest points of four degrees of aspect, which stand alone, within 10 %.

    Between half powers, a band weighted by Hamming's window is 1.303 c / 2B wide, 1.303 lambda /
    (2 dtheta) across it; on the ground the slant is divided by the cosine of the depression, and
    the angle seen is that in the plane of the ground.
    """
    folder = data_folder / "afrl_gotcha"
    if not folder.is_dir():
        pytest.skip(f"no phase history: {folder} is absent")
    history = read_gotcha([folder / f"data_3dsar_pass1_az00{k}_HH.mat" for k in (1, 2, 3, 4)])
    level = np.linalg.norm(history.r[:, :2], axis=1)
    slope = np.cos(np.arctan2(history.r[:, 2], level).mean())
    n, k = history.phase.shape
    band = (history.frequency[-1] - history.frequency[0]) * k / (k - 1)
    east, north = history.r[:, 0], history.r[:, 1]
    angle = np.ptp(np.unwrap(np.arctan2(north, east))) * n / (n - 1)
    pulses = compressed_pulses(history)
    grid = ground_grid(history.r, 0.4, 250, 250)
    image = projected(pulses, grid, aircraft.SUMS)
    theory = {
        "out": 1.303 * SPEED_OF_LIGHT / (2 * band * slope),
        "along": 1.303 * history.wavelength / (2 * angle * slope),
    }
    weighted = replace(pulses, echo=pulses.echo * np.hamming(n).astype(np.float32)[:, None])
    step = 0.02
    at = step * np.arange(-60, 61)
    for _ in range(2):
        row, column = np.unravel_index(image.argmax(), image.shape)
        place = grid.places()[image.argmax()]
        image[row - 5 : row + 6, column - 5 : column + 6] = 0
        for axis in (grid.along, grid.out, grid.along, grid.out):
            line = np.abs(aircraft.SUMS.back_projected(weighted, place + at[:, None] * axis))
            near = np.abs(at) < 0.6
            place = place + at[near][line[near].argmax()] * axis
        for name, expected in theory.items():
            axis = getattr(grid, name)
            line = np.abs(aircraft.SUMS.back_projected(weighted, place + at[:, None] * axis))
            assert _width(line, step) == pytest.approx(expected, rel=0.1), name
