"""Recorded echo: lost lines are filled where the file says which, and found where it does not."""

import numpy as np
import pytest

from terrafix.models.radar.recordings.files import read_recording

N, CELLS, FIRST = 300, 512, 41


def echo(rng, n=N, cells=CELLS):
    """Complex noise of a beam that oversamples twice: neighboring lines are correlated by 0.6."""
    spectrum = rng.standard_normal((n, cells, 2)) @ [1, 1j]
    spectrum[np.abs(np.fft.fftfreq(n)) > 0.25] = 0
    return (10 * np.fft.ifft(spectrum, axis=0) * np.sqrt(n)).astype(np.complex64)


@pytest.fixture
def whole():
    return echo(np.random.default_rng(3))


def written(tmp_path, lines, **more):
    path = tmp_path / "echo.npz"
    np.savez(path, echo=lines, first_rg_line=FIRST, first_rg_cell=7, **more)
    return path


def without(whole, lost):
    return np.delete(whole, lost, axis=0), np.delete(np.arange(N), lost)


LOST = [100, 101, 102, 250]


@pytest.mark.parametrize("told", ["number", "time", "zeros"])
def test_lost_lines_are_zeros_where_they_were(tmp_path, whole, told):
    lines, places = without(whole, LOST)
    if told == "number":
        path = written(tmp_path, lines, line_number=FIRST + places)
    elif told == "time":
        times = (
            1234.5 + places / 1256.98 + np.random.default_rng(0).uniform(-1e-5, 1e-5, len(places))
        )
        path = written(tmp_path, lines, line_time_s=times)
    else:
        lines = whole.copy()
        lines[LOST] = 0
        path = written(tmp_path, lines)
    found = read_recording(path)
    expected = whole.copy()
    expected[LOST] = 0
    np.testing.assert_array_equal(found.read(), expected)
    np.testing.assert_array_equal(found.lost, [101, 102, 103, 251])
    assert (found.first_line, found.first_cell) == (FIRST, 7)
    assert found.told().startswith("4 of its 300 lines are lost, the first is line 101")


def test_one_zero_line_does_not_refuse_a_file(tmp_path, whole):
    whole[0] = 0
    found = read_recording(written(tmp_path, whole))
    np.testing.assert_array_equal(found.lost, [1])


def test_a_whole_recording_has_lost_nothing(tmp_path, whole):
    found = read_recording(written(tmp_path, whole, line_number=FIRST + np.arange(N)))
    assert not len(found.lost)
    assert found.told() == ""
    np.testing.assert_array_equal(found.read(), whole)


@pytest.mark.parametrize("n_lost", [1, 2, 10])
def test_a_slip_is_found(tmp_path, whole, n_lost):
    lines, _ = without(whole, np.s_[150 : 150 + n_lost])
    with pytest.raises(ValueError, match=r"lines 150 and 151 are no neighbors.*\n.*line_number"):
        read_recording(written(tmp_path, lines))


def test_noise_without_a_beam_has_no_slips(tmp_path):
    """Lines of noise are never neighbors: of 3,000 pairs none falls by 5 standard errors."""
    rng = np.random.default_rng(5)
    read_recording(written(tmp_path, (rng.standard_normal((3000, 64, 2)) @ [1, 1j])))


def test_too_many_lost_lines_are_refused(tmp_path, whole):
    lines, places = without(whole, np.s_[60:67])
    with pytest.raises(ValueError, match=r"7 of its 300 lines are missing .* the first is line 61"):
        read_recording(written(tmp_path, lines, line_number=FIRST + places))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"line_number": np.arange(N)}, "'line_number' begins with 0, 'first_rg_line' is 41"),
        ({"line_number": FIRST + np.arange(N - 1)}, r"'line_number' has shape \(299,\), for 300"),
        ({"line_number": FIRST + np.maximum(np.arange(N) - 1, 0)}, "look at its element 0"),
        ({"line_number": FIRST + np.arange(N) * 1.004}, "does not count lines one by one"),
        ({"line_time_s": -np.arange(N) / 1257}, "'line_time_s' does not count lines"),
        ({"line_time_s": np.arange(N) / 1257 + (np.arange(N) > 99) * 4e-4}, "look at its element"),
        ({"line_time_s": np.full(N, np.nan)}, "does not count"),
    ],
)
def test_numbers_that_do_not_count_are_refused(tmp_path, whole, more, message):
    with pytest.raises(ValueError, match=message):
        read_recording(written(tmp_path, whole, **more))


@pytest.mark.parametrize("name", ["airport", "english_bay_2", "stanley_park", "ubc"])
def test_slips_in_real_echo_are_found(tmp_path, data_folder, name):
    """Ten lines of RADARSAT-1 taken out: found at most places, and nothing where none are."""
    path = data_folder / "radarsat1_vancouver" / f"{name}.npz"
    if not path.is_file():
        pytest.skip(f"no {path}")
    lines, found = read_recording(path).read(), 0
    places = range(100, 1400, 100)
    for at in places:
        torn = written(tmp_path, np.delete(lines[at - 90 : at + 100], np.s_[90:100], axis=0))
        try:
            read_recording(torn)
        except ValueError as error:
            found += "lines 90 and 91 are no neighbors" in str(error)
    assert found >= 0.8 * len(places)
