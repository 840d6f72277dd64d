"""Lines that were lost, in every format: filled where the file says so, found where it does not."""

import numpy as np
import pytest
from l0b_files import PRF, T0, beam, codes, write

from terrafix.models.radar.recordings.arrays import ArrayLines
from terrafix.models.radar.recordings.files import read_recording
from terrafix.models.radar.recordings.lines import slips_among
from terrafix.models.radar.recordings.recording import looked_through

N, CELLS = 1536, 256
FORMATS = ["npz", "h5"]


@pytest.fixture(scope="module")
def whole():
    """Halves, which both formats hold as they are."""
    echo = beam(N, CELLS)
    return (np.rint(2 * echo.real) / 2 + 1j * np.rint(2 * echo.imag) / 2).astype(np.complex64)


def written(folder, form, echo, place=None):
    """A file of lines at places; without them it counts its lines one by one."""
    path = folder / f"echo.{form}"
    if form == "h5":
        return write(path, codes(echo), place)
    more = {} if place is None else {"line_time_s": T0 + place / PRF}
    np.savez(path, echo=echo, first_rg_line=1, first_rg_cell=1, **more)
    return path


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("n_lost", [3, 10])
def test_lines_that_are_told_lost_are_zeros(tmp_path, whole, form, n_lost):
    lost = np.r_[200 : 200 + n_lost]
    place = np.delete(np.arange(N), lost)
    found = read_recording(written(tmp_path, form, whole[place], place))
    assert found.told().startswith(f"{n_lost} of its 1536 lines are lost, the first is line 201")
    np.testing.assert_array_equal(found.lost, lost + 1)
    expected = whole.copy()
    expected[lost] = 0
    np.testing.assert_array_equal(found.read(), expected)
    np.testing.assert_allclose(found.line_time, T0 + np.arange(N) / PRF, atol=1e-9)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("n_lost", [3, 10])
def test_lines_that_slipped_are_found(tmp_path, whole, form, n_lost):
    slipped = np.delete(whole, np.s_[700 : 700 + n_lost], axis=0)
    cure = {"npz": "line_number", "h5": "'UTCtime' does not say so"}[form]
    with pytest.raises(ValueError, match=rf"lines 700 and 701 are no neighbors.*\n.*{cure}"):
        read_recording(written(tmp_path, form, slipped))


@pytest.mark.parametrize("form", FORMATS)
def test_a_slip_beside_a_gap_is_found(tmp_path, whole, form):
    """3 lines told lost, and 3 others not: lines are numbered as they were received."""
    place = np.delete(np.arange(N - 3), np.s_[200:203])
    kept = np.delete(np.arange(N), np.s_[[200, 201, 202, 900, 901, 902]])
    with pytest.raises(ValueError, match="lines 900 and 901 are no neighbors"):
        read_recording(written(tmp_path, form, whole[kept], place))


@pytest.mark.parametrize("form", FORMATS)
def test_a_zero_line_is_lost(tmp_path, whole, form):
    echo = whole.copy()
    echo[1000] = 0
    found = read_recording(written(tmp_path, form, echo))
    np.testing.assert_array_equal(found.lost, [1001])
    np.testing.assert_array_equal(found.read(), echo)
    assert found.told().startswith("1 of its 1536 lines are lost")


@pytest.mark.parametrize("form", FORMATS)
def test_too_many_lost_lines_are_refused(tmp_path, whole, form):
    place = np.delete(np.arange(N), np.s_[60:91])
    with pytest.raises(ValueError, match=r"31 of its 1536 lines are missing .* first is line 61"):
        read_recording(written(tmp_path, form, whole[place], place))


def test_a_line_of_one_code_is_lost(tmp_path, whole):
    """A table without zero (-15.5 to 15.5, say) cannot hold a lost line but as one code."""
    samples = codes(whole)
    samples[77] = 9
    np.testing.assert_array_equal(read_recording(write(tmp_path / "a.h5", samples)).lost, [78])


@pytest.mark.parametrize("n_lost", [3, 10])
def test_slips_in_palsars_echo_are_found(data_folder, n_lost):
    """At all of 16 places: over land neighbors are alike by 0.29 to 0.38."""
    path = data_folder / "alos_palsar" / "ALPSRP264757150-H1.0__A_HH_LINE4000-5000_RANGE0-2200.h5"
    if not path.is_file():
        pytest.skip(f"no {path}")
    echo = read_recording(path).read()
    for at in range(100, 900, 50):
        torn = np.delete(echo[at - 90 : at + 100], np.s_[90 : 90 + n_lost], axis=0)
        neighbors = looked_through(ArrayLines((torn,), None))
        assert slips_among(neighbors, np.arange(len(torn))) == (90,)
