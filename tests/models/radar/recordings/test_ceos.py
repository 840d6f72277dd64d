"""Recorded echo in CEOS of level 1.0: files of our own, by the description, and PALSAR's scene."""

import ceos_files as ceos
import numpy as np
import pytest
from ceos_files import BIAS, LOOK, T0, coded, leader, write
from l0b_files import NEAR, PRF, beam, circular

from terrafix.models.geometry.quaternion import rotation_matrix_array
from terrafix.models.motion.orbits.files import read_orbit
from terrafix.models.radar.chirp import SPEED_OF_LIGHT
from terrafix.models.radar.recordings.files import read_recording

N, CELLS = 400, 128
ALOS = "ALPSRP264757150-H1.0__A_HH_LINE4000-5000_RANGE0-2200.h5"


@pytest.fixture(scope="module")
def samples():
    return coded(beam(N, CELLS) / 2)


def values(samples):
    return (samples[:, ::2] - BIAS) + 1j * (samples[:, 1::2] - BIAS)


def test_what_a_file_says(tmp_path, samples):
    leader(tmp_path)
    found = read_recording(write(tmp_path, samples, suffix=80))
    np.testing.assert_array_equal(found.read(), values(samples))
    np.testing.assert_array_equal(found.read(7, 9), values(samples)[7:9])
    assert (found.n_lines, found.n_cells, found.first_line) == (N, CELLS, 7)
    assert found.near_range == NEAR
    sent = found.sent
    assert sent.carrier == pytest.approx(1.27e9, rel=1e-8)
    assert (sent.prf, sent.sample_rate) == (PRF, 16e6)
    assert sent.pulse_length == pytest.approx(8e-6)
    assert sent.chirp_rate * sent.pulse_length == pytest.approx(-14e6)
    assert found.track.epoch == np.datetime64("2011-01-13")
    # whole milliseconds and lines every half of one leave a time open by half of that
    np.testing.assert_allclose(found.line_time, T0 + np.arange(N) / PRF, atol=0.26e-3)
    assert found.time_sigma == pytest.approx(0.289e-3, rel=0.01)
    assert found.told() == ""


def test_times_cut_to_a_millisecond_tell_the_first_to_microseconds(tmp_path, samples):
    """Remainders of 400 lines at 2150.538 Hz leave 25 us of the first time open."""
    leader(tmp_path)
    prf = 2150.538
    found = read_recording(write(tmp_path, samples, rate=prf))
    np.testing.assert_allclose(found.line_time, T0 + np.arange(N) / prf, atol=25e-6)


def test_the_orbit_is_that_of_the_leader(tmp_path, samples):
    path = leader(tmp_path)
    found = read_recording(write(tmp_path, samples))
    for orbit in (found.track.orbit, read_orbit(path)):
        t = T0 - 300 + 60.0 * np.arange(28)
        r, v = circular(t)
        np.testing.assert_allclose(orbit.r_e, r, atol=1e-6)
        np.testing.assert_allclose(orbit.v_e, v, atol=1e-9)
        assert orbit.tags[0] == np.datetime64("2011-01-13T02:25:00")
        assert orbit.error() < 1e-3
    r, v = found.states()
    np.testing.assert_allclose(r, circular(found.line_time)[0], atol=1e-4)


def test_angles_of_palsars_scene_give_the_quaternions_that_isce3_wrote(tmp_path, data_folder):
    """Lines, orbit and angles of ALOS PALSAR's HDF5, which was made of CEOS, put back into CEOS.

    Quaternions are ISCE3's own; times agree to what it searched by (20 us) and half of ours.
    """
    path = data_folder / "alos_palsar" / ALOS
    if not path.is_file():
        pytest.skip(f"no {path}")
    original, n = read_recording(path), 1000
    made = read_recording(ceos.repackaged(tmp_path, path, 400))
    np.testing.assert_array_equal(made.read(), original.read(0, n)[:, :400])
    assert made.first_line == original.first_line
    np.testing.assert_allclose(made.line_time, original.line_time[:n], atol=30e-6)
    r, r_made = original.states()[0], made.states()[0]
    assert np.abs(r - r_made).max() < 0.3
    turn = rotation_matrix_array(original.track.attitude.q_ae)
    np.testing.assert_allclose(rotation_matrix_array(made.track.attitude.q_ae), turn, atol=1e-8)
    np.testing.assert_allclose(made.track.attitude.t, original.track.attitude.t, atol=1e-6)


def test_the_boresight_lies_off_nadir_as_the_leader_says(tmp_path, samples):
    """To the right of the track, by 34.3 degrees less the roll of 0.01 to the left."""
    leader(tmp_path, attitudes=ceos.attitudes(T0 + np.arange(3.0), [[0.01, 0, 0]] * 3))
    found = read_recording(write(tmp_path, samples))
    matrix = rotation_matrix_array(found.track.attitude.q_ae)
    r, v = circular(found.track.attitude.t)
    nadir = -r / np.linalg.norm(r, axis=1)[:, None]
    look = np.degrees(np.arccos(np.einsum("ni,ni->n", matrix[:, 2], nadir)))
    np.testing.assert_allclose(look, LOOK - 0.01, atol=1e-6)
    assert (np.einsum("ni,ni->n", matrix[:, 2], np.cross(r, v)) < 0).all()
    assert (np.einsum("ni,ni->n", matrix[:, 1], v) < -7000).all()


def test_what_is_filled_and_what_moved(tmp_path):
    """Fill is zero, at both ends; a window that opened 5 cells later lies 5 cells farther."""
    leader(tmp_path)
    wide = coded(beam(N, CELLS + 5) / 2)
    samples = np.concatenate([wide[:200, : 2 * CELLS], wide[200:, 10:]])
    near = np.where(np.arange(N) < 200, NEAR, np.rint(NEAR + 5 * SPEED_OF_LIGHT / 32e6))
    said = {"left": lambda k: 3, "right": lambda k: 10, "near": lambda k: near[k]}
    found = read_recording(write(tmp_path, samples, **said))
    expected = values(wide).astype(np.complex64)
    expected[:200, :3] = expected[:200, CELLS - 10 :] = 0
    expected[200:, :8] = expected[200:, CELLS - 5 :] = 0
    np.testing.assert_array_equal(found.read(), expected)
    assert found.near_range == NEAR


def test_a_gain_that_varies_is_undone(tmp_path, samples):
    leader(tmp_path)
    found = read_recording(write(tmp_path, samples, gain=lambda k: 40 if k < 100 else 46))
    ratio = found.read() / values(samples)
    np.testing.assert_allclose(ratio[100:] / ratio[0], 10 ** (-6 / 20), rtol=1e-6)


def test_lines_of_zeros_are_lost(tmp_path, samples):
    """One that says so, and one of equal bytes."""
    leader(tmp_path)
    changed = samples.copy()
    changed[50] = 16
    found = read_recording(write(tmp_path, changed, nought=lambda k: int(k == 300)))
    np.testing.assert_array_equal(found.lost, [51, 301])


def test_lines_of_calibration_are_left_out(tmp_path, samples):
    """8 at the top and 4 at the bottom: echo begins with line 9, which is number 15."""
    leader(tmp_path, summary=ceos.summary(calibration=(3, 1, 8, N - 3, N)))
    found = read_recording(write(tmp_path, samples))
    np.testing.assert_array_equal(found.read(), values(samples)[8 : N - 4])
    assert found.first_line == 15
    assert found.line_time[0] == pytest.approx(T0 + 8 / PRF, abs=0.3e-3)


def test_of_four_channels_lines_are_half_as_frequent(tmp_path, samples):
    leader(tmp_path, summary=ceos.summary(channels=4))
    found = read_recording(write(tmp_path, samples, prf=lambda k: round(2e3 * PRF)))
    assert found.sent.prf == PRF


# ------------------------------------------------------------------ lines that slipped


@pytest.mark.parametrize("n_lost", [1, 3])
@pytest.mark.parametrize("prf", [2150.538, 1900.0])
def test_a_slip_is_found_by_the_times_and_placed_by_the_lines(tmp_path, n_lost, prf):
    """Lines count on: only times, cut to two lines, say that some were lost, and how many."""
    leader(tmp_path)
    samples = coded(beam(N + n_lost, CELLS) / 2)
    place = np.delete(np.arange(N + n_lost), np.s_[170 : 170 + n_lost])
    found = read_recording(write(tmp_path, samples[place], place, rate=prf))
    np.testing.assert_array_equal(found.place, place)
    np.testing.assert_array_equal(found.lost, 171 + np.arange(n_lost))
    np.testing.assert_allclose(found.line_time, T0 + np.arange(N + n_lost) / prf, atol=0.3e-3)
    assert found.told().startswith(f"{n_lost} of its {N + n_lost} lines are lost")


def test_two_slips_are_found(tmp_path):
    leader(tmp_path)
    samples = coded(beam(N + 5, CELLS) / 2)
    place = np.delete(np.arange(N + 5), [100, 101, 300, 301, 302])
    found = read_recording(write(tmp_path, samples[place], place, rate=2150.538))
    np.testing.assert_array_equal(found.place, place)


def test_a_slip_that_times_do_not_tell_is_refused(tmp_path):
    leader(tmp_path)
    samples = coded(beam(N + 3, CELLS) / 2)
    place = np.delete(np.arange(N + 3), np.s_[170:173])
    with pytest.raises(ValueError, match="lines 170 and 171 are no neighbors"):
        read_recording(write(tmp_path, samples[place]))


def test_times_that_run_back_are_refused(tmp_path, samples):
    leader(tmp_path)
    late = {"millisecond": lambda k: 9_005_671 + k // 2 - 20 * (k > 200)}
    with pytest.raises(ValueError, match=r"the time of line 202 is too early"):
        read_recording(write(tmp_path, samples, **late))


# ------------------------------------------------------------------ what is no such file


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"prf": lambda k: 2_000_000 + (k > 99)},
            r"frequency \(bytes 57 on\) is 2000000, and from line 101",
        ),
        ({"scan": lambda k: 2}, "scans"),
        ({"compressed": lambda k: 1}, "is compressed in range"),
        ({"right": lambda k: 200}, "line 1 is said to be filled by 200 of its 128 cells"),
        ({"right": lambda k: -1}, "line 1 is said to be filled by -1 of its 128 cells"),
        ({"day": lambda k: 400}, r"line 1 says 400 for the day of the year \(bytes 41 to 44\)"),
        ({"millisecond": lambda k: -5}, "line 1 says -5 for the millisecond of the day"),
        ({"near": lambda k: 0}, r"lines begin at 0 to 0 m \(bytes 117 to 120\)"),
        ({"near": lambda k: NEAR + 1e6 * (k > 5)}, r"lines begin at 850000 to 1.85e\+06 m"),
        ({"number": lambda k: 3}, r"'line number \(bytes 13 to 16\)' does not count"),
        ({"number": lambda k: 3 + k * 10**6}, "2% of them may be"),
    ],
)
def test_lines_that_cannot_be_are_named(tmp_path, samples, change, told):
    leader(tmp_path)
    path = write(tmp_path, samples, **change)
    with pytest.raises(ValueError, match=told) as raised:
        read_recording(path)
    assert str(raised.value).startswith(f"'{path}' is not recorded echo: ")


@pytest.mark.parametrize(
    ("records", "told"),
    [
        ({"summary": ceos.summary(wavelength=0.0)}, r"a wavelength of 0 m \(bytes 501 to 516\)"),
        ({"summary": ceos.summary(sample_rate="abc")}, "'abc' for the sampling rate"),
        ({"summary": ceos.summary(channels=9)}, "says 9 for the number of channels"),
        ({"summary": ceos.summary(clock=0.0)}, "a clock angle of 0 deg"),
        ({"summary": ceos.summary(calibration=(3, 1, 399, 0, 0))}, "leaves lines 400 to 400"),
        ({"summary": b""}, "lacks data set summary"),
        ({"attitudes": b""}, "lacks attitude record"),
        ({"calibration": ceos.calibration(0.0)}, "sweeps 0 Hz"),
        ({"positions": ceos.positions([0, 60], np.ones((2, 3)), np.ones((2, 3)))}, "inside the E"),
        ({"start": b"\0\0\0\1\x0b\xc0\x12\x12\xff\xff\xff\xff"}, "that it is 4294967295"),
        ({"calibration": ceos.calibration()[:-1]}, "is 13212 bytes long, and 13211"),
    ],
)  # fmt: skip
def test_leaders_that_cannot_be_are_named(tmp_path, samples, records, told):
    leader(tmp_path, **records)
    with pytest.raises(ValueError, match=told):
        read_recording(write(tmp_path, samples))


def test_a_leader_that_is_elsewhere_is_asked_for(tmp_path, samples):
    path = write(tmp_path, samples)
    with pytest.raises(ValueError, match=r"its leader 'LED-\w+-H1\.0__A' is not beside"):
        read_recording(path)
    with pytest.raises(ValueError, match=r"not named IMG-HH-\.\.\."):
        read_recording(path.rename(tmp_path / "echo.raw"))


@pytest.mark.parametrize(
    ("made", "told"),
    [
        ((10**6 - 1, 668, 256), "it is truncated: its descriptor says 999999 lines of 668 bytes"),
        ((0, 668, 256), "says 0 for the number of its lines"),
        ((N, 668, 90_000_000), "says 90000000 for the bytes of samples"),
        ((N, 700, 256), "record of a line has 700 bytes .* its first line says 668"),
        ((N, 668, 512), "has 668 bytes .*, 512 of them samples"),
        ((N, 668, 256, "IU2", "UNSIGNED INTEGER*2"), r"formed already: .* \(level 1.5\)"),
        ((N, 668, 256, "C*8", "COMPLEX REAL*4"), r"formed already: .* \(level 1.1\)"),
        ((N, 668, 256, "", ""), "of a kind that it does not name"),
    ],
)
def test_descriptors_that_cannot_be_are_named(tmp_path, samples, made, told):
    leader(tmp_path)
    path = write(tmp_path, samples)
    path.write_bytes(ceos.descriptor(*made) + path.read_bytes()[720:])
    with pytest.raises(ValueError, match=told):
        read_recording(path)


@pytest.mark.parametrize("which", ["IMG", "LED"])
def test_damaged_files_are_refused_or_read(tmp_path, samples, which):
    """Truncated, and with bytes changed at random: a ValueError that names the file, or read."""
    rng = np.random.default_rng(5)
    led, img = leader(tmp_path), write(tmp_path, samples[:60])
    target = img if which == "IMG" else led
    whole, told = target.read_bytes(), []
    for k in range(40):
        damaged = bytearray(whole)
        if k % 2:
            del damaged[rng.integers(1, len(whole)) :]
        else:
            at = rng.integers(0, min(len(whole), 9000), 30)
            for i in at:
                damaged[i] = rng.integers(256)
        target.write_bytes(bytes(damaged))
        try:
            read_recording(img)
        except ValueError as error:
            told.append(str(error))
    assert len(told) >= 20
    assert all(text.startswith(f"'{img}' is not recorded echo: ") for text in told)
