"""The pulse and its compression: closed forms of a linear chirp."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import resample

from terrafix.models.radar.chirp import (
    chirp_replica,
    gain_of,
    range_compressed,
    unit_phasor,
)


def test_phases_of_many_cycles_keep_their_precision():
    """1e7 cycles and a quarter: single precision alone would be off by whole cycles."""
    cycles = np.array([1e7 + 0.25, -1e7 - 0.125, 0.5])
    expected = np.exp(2j * np.pi * np.array([0.25, -0.125, 0.5]))
    np.testing.assert_allclose(unit_phasor(cycles), expected, atol=5e-7)


def test_a_pulse_is_compressed_to_its_first_cell_with_unit_peak(points):
    radar = points.PALSAR
    echo = np.zeros((3, 1000), np.complex64)
    echo[1, 200 : 200 + radar.n_pulse] = chirp_replica(radar)
    compressed = np.abs(range_compressed(echo, radar))
    assert np.unravel_index(compressed.argmax(), compressed.shape) == (1, 200)
    assert compressed[1, 200] == pytest.approx(1.0, abs=1e-5)
    assert compressed[[0, 2]].max() < 1e-6


def test_a_window_lowers_the_sidelobes(points):
    """First sidelobe of a rectangular spectrum -13.3 dB; a Kaiser window of 2.5 about -21 dB."""
    radar = points.PALSAR
    echo = np.zeros((1, 2000), np.complex64)
    echo[0, 800 : 800 + radar.n_pulse] = chirp_replica(radar)

    def sidelobe(window):
        line = range_compressed(echo, radar, window)[0]
        fine = np.abs(resample(line, 16 * len(line)))
        top = int(fine.argmax())
        return 20 * np.log10(np.delete(fine, np.arange(top - 24, top + 25)).max() / fine.max())

    assert sidelobe("boxcar") == pytest.approx(-13.3, abs=1.0)
    assert sidelobe(("kaiser", 2.5)) < -19


def test_gain_control_is_undone():
    echo = np.ones((3, 4), np.complex64)
    levels = np.array([3.0, 4.0, 3.0])
    restored = echo * (10 ** (-levels / 20))[:, None].astype(np.float32)
    restored *= gain_of(levels, len(echo))[:, None]
    np.testing.assert_allclose(restored / restored[0], 1.0, rtol=1e-6)
    with pytest.raises(ValueError, match="an echo of 3 lines wants as many finite attenuations"):
        gain_of([1.0], 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"prf": -1.0}, "prf of a radar cannot be -1.0"),
        ({"carrier": np.nan}, "carrier of a radar cannot be nan"),
        ({"chirp_rate": 1e12}, "cannot be sampled at"),
        ({"doppler_bandwidth": 3000.0}, "exceeds the pulse repetition frequency"),
        ({"pulse_length": 5e-8, "chirp_rate": 1e9}, "is shorter than two samples"),
    ],
)
def test_impossible_radars_are_refused(change, message, points):
    with pytest.raises(ValueError, match=message):
        replace(points.PALSAR, **change)
