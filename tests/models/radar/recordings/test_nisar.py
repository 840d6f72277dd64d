"""Recorded echo of NISAR's level 0B: ALOS PALSAR's, and small files of our own."""

from dataclasses import replace

import numpy as np
import pytest
from l0b_files import CELLS, NEAR, PRF, T0, TABLE, N, beam, circular, codes, write
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import brentq, minimize

from terrafix.models.core.hdf5 import opened
from terrafix.models.geometry.geodesy import ecef, local_axes
from terrafix.models.geometry.quaternion import rotation_matrix
from terrafix.models.motion.orbits.files import read_orbit
from terrafix.models.radar.chirp import range_compressed
from terrafix.models.radar.doppler import fractional_centroid
from terrafix.models.radar.recordings.files import read_recording
from terrafix.models.radar.recordings.nisar import _shape

ECHO = "ALPSRP264757150-H1.0__A_HH_LINE4000-5000_RANGE0-2200.h5"
REFLECTOR = "calib_RSLC_ALPSRP025826990_RIO_BRANCO_CR.h5"


def palsar(data_folder, name):
    path = data_folder / "alos_palsar" / name
    if not path.is_file():
        pytest.skip(f"no {path}")
    return path


@pytest.fixture(scope="module")
def samples():
    return codes(beam())


# ------------------------------------------------------------------ ALOS PALSAR


@pytest.fixture(scope="module")
def alos(data_folder):
    return read_recording(palsar(data_folder, ECHO))


def test_what_palsar_sent_and_when(alos):
    """Numbers of the file's own fields; the rate of samples and of pulses follow from spacings."""
    assert (alos.n_lines, alos.n_cells, alos.first_line) == (1000, 2200, 4001)
    assert alos.sent.sample_rate == pytest.approx(16e6, rel=1e-9)
    assert alos.sent.prf == pytest.approx(2150.538, abs=1e-3)
    assert alos.sent.chirp_rate * alos.sent.pulse_length == pytest.approx(-14e6, rel=1e-9)
    assert alos.near_range == 847166.0
    assert alos.track.epoch == np.datetime64("2011-01-13")
    assert alos.line_time[0] == pytest.approx(2 * 3600 + 34 * 60 + 27.825928, abs=1e-6)
    assert not len(alos.lost)


def test_palsars_samples_are_speckle_of_five_bits(alos):
    """32 levels of a step of one; intensities of noise have their mean as deviation."""
    echo = alos.read()
    assert (np.unique(echo.real) == np.arange(-15.5, 16)).all()
    assert (np.unique(echo.imag) == np.arange(-15.5, 16)).all()
    radar = alos.sent.radar(1500.0)
    power = np.abs(range_compressed(echo, radar)[:, : 2200 - radar.n_pulse]) ** 2
    assert power.std() / power.mean() == pytest.approx(1.0, abs=0.03)


def test_palsars_chirp_is_that_of_the_file(alos):
    """Differences of the ground on 4 to 40 cells, which a wrong sweep smears."""
    echo, radar = alos.read(), alos.sent.radar(1500.0)

    def contrast(factor):
        swept = replace(radar, chirp_rate=factor * radar.chirp_rate)
        power = np.abs(range_compressed(echo, swept)[:, : 2200 - radar.n_pulse]) ** 2
        ground = power.mean(axis=0) / power.mean()
        return (gaussian_filter1d(ground, 4) - gaussian_filter1d(ground, 40))[60:-60].std()

    right = contrast(1.0)
    assert right > 1.05 * max(contrast(0.97), contrast(1.03))
    assert right > 2 * contrast(-1.0)


def test_palsars_track_tells_its_doppler(alos):
    """Boresight 34.3 degrees off nadir, to the right, and the centroid of the lines' own phases.

    A misread quaternion, time or frame moves it by 2 kHz; 20 Hz are 0.02 degrees of squint.
    """
    r, v = (states[500] for states in alos.states())
    attitude = alos.track.attitude
    k = int(np.argmin(np.abs(attitude.t - alos.line_time[500])))
    boresight = np.array(rotation_matrix(attitude.q_ae[k]))[2]
    look = np.degrees(np.arccos(-boresight @ r / np.linalg.norm(r)))
    assert look == pytest.approx(34.3, abs=0.01)
    assert boresight @ np.cross(r, v) < 0
    doppler = 2 * v @ boresight / (299792458.0 / alos.sent.carrier)
    found, _ = fractional_centroid(alos.read(), alos.sent.prf)
    assert found == pytest.approx(doppler, abs=20.0)


def test_palsars_orbit_is_interpolated_to_millimeters(alos):
    assert len(alos.track.orbit.t) == 28
    assert alos.track.orbit.error() < 3e-3


@pytest.mark.parametrize(("channel", "at", "shift"), [("HH", 124104, 0.0), ("VV", 104104, 1.1)])
def test_palsars_corner_reflector_is_where_its_orbit_says(data_folder, channel, at, shift):
    """Within 1 m on the ground, where zero Doppler and slant range place it (HH).

    `at` is where the samples of a channel begin in the file, halves of 16 bits, which netCDF4 does
    not read. The reflector's place was derived from this product. VV is 1.1 m farther in range at
    the same line, presumably by the delay of its channel.
    """
    path = palsar(data_folder, REFLECTOR)
    place = ecef(np.radians(-9.71311741457592), np.radians(-68.1728216904995), 0.0)
    with opened(path) as file:
        product = file["science/LSAR/RSLC"]
        times = product["swaths/zeroDopplerTime"][...]
        ranges = product["swaths/frequencyA/slantRange"][...]
    orbit = read_orbit(path)
    since = 3 * 3600 + 3 * 60.0  # the first state, of the day from which lines are counted

    def doppler(t):
        r, v = orbit.at(t - since)
        return (r - place) @ v

    t = brentq(doppler, times[0], times[-1], xtol=1e-9)
    r, v = orbit.at(t - since)
    slant = np.linalg.norm(r - place)
    image = np.fromfile(path, "<f2", 2 * 100 * 50, offset=at).astype(float).reshape(100, 50, 2)
    line, cell = _peak(image @ [1, 1j])
    speed = np.linalg.norm(v) * np.linalg.norm(place) / np.linalg.norm(r)
    along = (times[0] + line * (times[1] - times[0]) - t) * speed
    beyond = ranges[0] + cell * (ranges[1] - ranges[0]) - slant - shift
    incidence = np.arccos((r - place) @ local_axes(place)[2] / slant)
    assert np.hypot(along, beyond / np.sin(incidence)) < 1.0
    assert along == pytest.approx(0.0, abs=0.05)
    assert beyond == pytest.approx(0.0, abs=0.05)


def test_halves_of_16_bits_are_not_read(data_folder):
    """Those of the reflector's image, which netCDF4 opens without their fields."""
    with opened(palsar(data_folder, REFLECTOR)) as file:
        samples = file["science/LSAR/RSLC/swaths/frequencyA/VV"]
        with pytest.raises(ValueError, match="not pairs 'r', 'i' of a type that is read"):
            _shape(samples)


def _peak(image):
    """Line and cell of the strongest point, between the samples."""
    k, c = np.unravel_index(np.abs(image).argmax(), image.shape)
    spectrum = np.fft.fft2(image[k - 32 : k + 32, c - 16 : c + 16])
    lines, cells = (2j * np.pi * np.fft.fftfreq(n) for n in spectrum.shape)
    found = minimize(
        lambda y: -abs(np.exp(lines * y[0]) @ spectrum @ np.exp(cells * y[1])),
        *((32.0, 16.0),),
        method="Nelder-Mead",
        options={"xatol": 1e-4, "fatol": 1.0},
    )
    return found.x[0] + k - 32, found.x[1] + c - 16


# ------------------------------------------------------------------ files of our own


def test_codes_times_and_track_are_read(tmp_path, samples):
    found = read_recording(write(tmp_path / "a.h5", samples))
    echo = found.read()
    np.testing.assert_array_equal(echo, TABLE[samples[..., 0]] + 1j * TABLE[samples[..., 1]])
    assert np.abs(echo - beam()).max() < 0.36  # halves are rounded to a quarter, twice
    np.testing.assert_allclose(found.line_time, T0 + np.arange(N) / PRF, atol=1e-9)
    assert (found.first_line, found.near_range) == (7, NEAR)
    r, v = found.states()
    true_r, true_v = circular(found.line_time)
    assert np.abs(r - true_r).max() < 1e-7
    assert np.abs(v - true_v).max() < 1e-8
    np.testing.assert_allclose(found.track.attitude.q_ae[0], [0, 0, 0.5**0.5, 0.5**0.5])
    np.testing.assert_allclose(found.track.attitude.t[0], T0 - 300)


def test_numbers_need_no_table(tmp_path):
    echo = beam().astype(np.complex64)
    numbers = np.stack([echo.real, echo.imag], axis=-1)
    found = read_recording(write(tmp_path / "a.h5", numbers, BFPQLUT=None))
    np.testing.assert_array_equal(found.read(), echo)


def test_only_samples_that_are_valid_are_echo(tmp_path, samples):
    """Two parts of a line, cells 10 to 99 and 120 on; the second one begins later in line 5."""
    one = np.tile([10, 100], (N, 1))
    two = np.tile([120, 5000], (N, 1))
    two[5, 0] = 140
    path = write(tmp_path / "a.h5", samples, validSamplesSubSwath1=one, validSamplesSubSwath2=two)
    there = read_recording(path).read(4, 6) != 0
    cell = np.arange(CELLS)
    valid = ((cell >= 10) & (cell < 100)) | (cell >= 120)
    assert not there[0, ~valid].any()
    assert there[0, valid].mean() > 0.99
    assert not there[1, 120:140].any()


def test_an_attenuation_in_db_is_undone(tmp_path, samples):
    from netCDF4 import Dataset

    db = np.where(np.arange(N) < 200, 1.0, 7.0)[:, None]
    path = write(tmp_path / "a.h5", samples, attenuation=db)
    with pytest.raises(ValueError, match="its attenuation varies, and is not told in dB"):
        read_recording(path)
    with Dataset(path, "a") as file:
        file["science/LSAR/RRSD/swaths/frequencyA/txH/rxH/attenuation"].units = "dB"
    echo = read_recording(path).read()
    plain = read_recording(write(tmp_path / "b.h5", samples)).read()
    np.testing.assert_allclose(echo[200:], plain[200:] * 10**0.3, rtol=1e-6)
    np.testing.assert_array_equal(echo[:200], plain[:200])


def test_one_channel_of_several_is_named(tmp_path, samples):
    path = write(tmp_path / "a.h5", samples, rx=("HH", "HV"))
    with pytest.raises(ValueError, match=r"several channels: A/HH, A/HV\n  name one"):
        read_recording(path)
    with pytest.raises(ValueError, match="it has no channel 'A/VV'; it has A/HH, A/HV"):
        read_recording(path, "A/VV")
    assert read_recording(path, "A/HV").n_lines == N


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"UTCtime": None}, "has no 'UTCtime'"),
        ({"UTCtime": np.zeros(N)}, "'UTCtime' does not count lines one by one"),
        ({"rangeLineIndex": np.r_[:99, 100 : N + 1]}, "'UTCtime' and 'rangeLineIndex' do not"),
        ({"slantRange": np.ones(CELLS)}, "'slantRange' does not rise evenly"),
        ({"slantRange": np.ones(3)}, r"'slantRange' has shape \(3,\), not \(256,\)"),
        ({"BFPQLUT": None}, "has no 'BFPQLUT'"),
        ({"BFPQLUT": TABLE[:32]}, r"'BFPQLUT' has shape \(32,\)"),
        ({"chirpSlope": np.nan}, "'chirpSlope' is not finite"),
        ({"chirpSlope": 9e12}, "a chirp of 7.2e.07 Hz cannot be sampled at 1.6e.07 Hz"),
        ({"quaternions": np.ones((12, 4))}, "its attitude is no unit quaternions"),
        ({"position": np.ones((12, 3))}, "state 0 lies inside the Earth, 1.73205 m"),
        ({"velocity": np.full((12, 3), 7.0)}, "velocities are not those of its positions"),
    ],
)
def test_parts_that_cannot_be_are_refused(tmp_path, samples, change, message):
    path = write(tmp_path / "a.h5", samples, **change)
    with pytest.raises(ValueError, match=message) as raised:
        read_recording(path)
    assert f"'{path}' is not recorded echo" in str(raised.value)


def test_a_torn_file_is_damaged(tmp_path, samples):
    path = write(tmp_path / "a.h5", samples)
    path.write_bytes(path.read_bytes()[:-200_000])
    with pytest.raises(ValueError, match="it is damaged"):
        read_recording(path)
