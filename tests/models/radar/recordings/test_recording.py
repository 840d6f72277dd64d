"""The interface of recordings: blocks, places and times of lines."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from l0b_files import write

from terrafix.models.radar.chirp import Radar
from terrafix.models.radar.imaging import Imager
from terrafix.models.radar.recordings.arrays import ArrayLines, read_npz
from terrafix.models.radar.recordings.files import read_recording
from terrafix.models.radar.recordings.recording import Recording, looked_through

PRF = 1256.98


def numbers(n, cells, place=None):
    """A recording whose line k holds k + 1 in every cell."""
    place = np.arange(n) if place is None else np.asarray(place)
    values = np.repeat(place[:, None] + 1, cells, axis=1)
    return Recording(Path("x"), ArrayLines((values,), None), place, np.zeros(0, np.intp))


def test_lines_are_read_where_they_belong():
    recording = numbers(5, 3, [0, 1, 5, 6, 9])
    assert (recording.n_lines, recording.n_cells) == (10, 3)
    expected = np.array([1, 2, 0, 0, 0, 6, 7, 0, 0, 10])
    for first in range(10):
        for last in range(first, 11):
            found = recording.read(first, last)
            assert (found.dtype, found.shape) == (np.complex64, (last - first, 3))
            np.testing.assert_array_equal(found[:, 1], expected[first:last])


def test_blocks_are_the_whole(monkeypatch):
    monkeypatch.setattr("terrafix.models.radar.recordings.recording._BLOCK", 204 * 64 + 5)
    recording = numbers(500, 64, np.delete(np.arange(510), np.s_[200:210]))
    starts, blocks = zip(*recording.blocks(), strict=True)
    assert starts == (0, 204, 408)
    np.testing.assert_array_equal(np.concatenate(blocks), recording.read())


def test_memory_is_bounded_by_a_block():
    """20,000 lines of 2,048 cells are 328 MB at once; a block is 34 MB, with its phases 3 of it."""

    class Noise:
        shape = (20000, 2048)

        def read(self, first, last):
            return np.full((last - first, 2048), 1 + 1j, np.complex64)

    tracemalloc.start()
    looked_through(Noise())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6


def test_a_file_becomes_an_image_in_four_times_its_echo(tmp_path):
    """Codes of 16 bits, complex numbers, and what the processor makes of them: 3.3 times, peak."""
    radar = Radar(5.3e9, PRF, 32.317e6, -1.4e12, 10e-6, 1000.0)
    n, cells = 2048, 1200
    rng = np.random.default_rng(1)
    path = write(tmp_path / "a.h5", rng.integers(0, 65536, (n, cells, 2), np.uint16))
    recording = read_recording(path)
    tracemalloc.start()
    imager = Imager(recording.read(), radar, 988647.0, 0.0, exposure=0.5)
    imager.image(imager.processing(-6900.0, 7062.0, 0.0), 7062.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * 8 * n * cells


@pytest.mark.parametrize("told", ["line_number", "both"])
def test_every_line_has_its_time(tmp_path, told):
    """Lines lost have times, too: those of a clock of PRF, here from 7.5 s on."""
    rng = np.random.default_rng(2)
    place = np.delete(np.arange(200), [50, 51, 120])
    more = {"line_number": place + 3}
    if told == "both":
        more["line_time_s"] = 7.5 + place / PRF
    path = tmp_path / "echo.npz"
    echo = rng.standard_normal((197, 64, 2)) @ [1, 1j]
    np.savez(path, echo=echo, first_rg_line=3, first_rg_cell=1, **more)
    found = read_npz(path)
    np.testing.assert_array_equal(found.lost, [51, 52, 121])
    if told == "line_number":
        assert found.line_time is None
    else:
        np.testing.assert_allclose(found.line_time, 7.5 + np.arange(200) / PRF, atol=1e-12)


def test_numbers_and_times_that_disagree_are_refused(tmp_path):
    path = tmp_path / "echo.npz"
    place = np.delete(np.arange(200), 50)
    np.savez(
        *(path,),
        echo=np.ones((199, 8)),
        first_rg_line=1,
        first_rg_cell=1,
        line_number=place + 1,
        line_time_s=np.arange(199) / PRF,
    )
    with pytest.raises(ValueError, match="'line_number' and 'line_time_s' do not agree"):
        read_npz(path)
