"""Phase history in CPHD: files that sarkit writes, of points of exact geometry."""

import numpy as np
import pytest
from cphd_files import C, write

from terrafix.components.sensors.spotlight import RecordedSpotlight
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.models.geometry.geodesy import ecef, local_axes
from terrafix.models.radar.phase_files import read_phase_history
from terrafix.models.radar.phase_history import compressed_pulses, ground_grid

CENTER = ecef(np.radians(39.78), np.radians(-84.1), 240.0)
AXES = local_axes(CENTER)
FREQUENCY = 9.6e9 + 1.5e6 * (np.arange(200) - 100)
LOCAL = np.array([[0.0, 0.0, 0.0], [10.0, -12.0, 0.0]])
"""East, north, up of the center [m]."""
AIR = np.array([7000.0, 0.0, 7000.0]) + np.outer(np.arange(96) - 47.5, [0.0, 1.5, 0.0])
SPACE = np.array([4e5, 3e4, 6e5]) + np.outer(np.arange(96) - 47.5, [10.0, 130.0, -5.0])


def earth(local):
    return CENTER + local @ AXES


def written(path, track=AIR, **change):
    return write(path, earth(LOCAL), earth(track), CENTER, FREQUENCY, **change)


def found_near(history, place, sums):
    """Where the image of a point is, sought on a grid of 1 cm over 2 m [m]."""
    pulses = compressed_pulses(history)
    grid = ground_grid(history.r, 0.01, 1, 1)
    at = 0.01 * np.arange(-60, 61)
    for axis in (grid.along, grid.out, grid.along, grid.out):
        places = place + at[:, None] * axis
        image = np.abs(sums.back_projected(pulses, places))
        place = places[image.argmax()]
    return place


@pytest.mark.parametrize("track", [AIR, SPACE], ids=["air", "space"])
@pytest.mark.parametrize("sign", [-1, 1])
def test_points_appear_where_they_are(tmp_path, aircraft, track, sign):
    """Within a tenth of the resolution of 0.5 m in range, and of what the track gives along."""
    history = read_phase_history([written(tmp_path / "a.cphd", track, sign=sign)])
    resolution = C / 2 / 300e6
    for p in LOCAL:
        start = p + np.array([0.2, -0.3, 0.0])
        assert np.linalg.norm(found_near(history, start, aircraft.SUMS) - p) < 0.1 * resolution


def test_pulses_have_their_times(tmp_path):
    history = read_phase_history([written(tmp_path / "a.cphd")])
    np.testing.assert_allclose(history.times(1.0), 1e-3 * (np.arange(96) - 47.5), atol=1e-9)


def test_a_reference_that_moves_and_samples_of_16_bits(tmp_path, aircraft):
    srp = CENTER + np.outer(np.linspace(-20, 20, 96), AXES[1])
    path = written(tmp_path / "a.cphd", form="CI4", srp=srp, AmpSF=np.linspace(1.0, 0.5, 96))
    place = found_near(read_phase_history([path]), LOCAL[1] + 0.2 * AXES[0] * 0, aircraft.SUMS)
    np.testing.assert_allclose(place, LOCAL[1], atol=0.05)


def test_the_common_band_is_read(tmp_path):
    change = {
        "FX1": FREQUENCY[3],
        "FX2": np.where(np.arange(96) < 4, FREQUENCY[190], FREQUENCY[199]),
    }
    history = read_phase_history([written(tmp_path / "a.cphd", **change)])
    np.testing.assert_allclose(history.frequency, FREQUENCY[3:191])


def test_vectors_of_other_frequencies_are_resampled(tmp_path, aircraft):
    """As those of a radar that follows its scene: by 9 MHz in all, and steps by a thousandth.

    Phases are those at the common frequencies to 2e-3, what 16 samples make of sinc.
    """
    other = {"SC0": FREQUENCY[0] + 1e5 * np.arange(96), "SCSS": 1.5e6 + 16.0 * np.arange(96)}
    history = read_phase_history([written(tmp_path / "a.cphd", **other)])
    assert FREQUENCY[0] + 9e6 < history.frequency[0] < FREQUENCY[0] + 30e6
    alike = read_phase_history([written(tmp_path / "b.cphd")])
    cells = np.searchsorted(alike.frequency, history.frequency - 1.0)
    np.testing.assert_allclose(history.phase, alike.phase[:, cells], atol=4e-3)
    place = found_near(history, LOCAL[1] + np.array([0.2, -0.3, 0.0]), aircraft.SUMS)
    assert np.linalg.norm(place - LOCAL[1]) < 0.05


def test_a_channel_is_named_where_there_are_several(tmp_path):
    path = written(tmp_path / "a.cphd", names=("HH", "HV"))
    with pytest.raises(ValueError, match="several channels: HH, HV\n  name one"):
        read_phase_history([path])
    with pytest.raises(ValueError, match="no channel 'VV'; it has HH, HV"):
        read_phase_history([path], "VV")
    assert read_phase_history([path], "HV").phase.shape == (96, 200)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"domain": "TOA"}, "in the domain 'TOA': transform its vectors to FX"),
        ({"SC0": FREQUENCY[0] + 1e7 * np.arange(96)}, "no frequencies are in the band of all"),
        ({"SCSS": -1.5e6}, "are not above zero"),
        ({"FX1": FREQUENCY[-1]}, "no frequencies are in the band of all"),
        ({"SRPPos": np.nan}, "'SRPPos' of its vectors is not finite"),
        ({"TxTime": 0.0, "RcvTime": 0.0}, "times of a phase history do not increase"),
        ({"RcvPos": earth(AIR + 100.0)}, "sent and received in different places"),
    ],
)
def test_files_that_are_not_read_are_refused(tmp_path, change, told):
    path = written(tmp_path / "a.cphd", **change)
    with pytest.raises(ValueError, match=told) as raised:
        read_phase_history([path])
    assert str(raised.value).startswith(f"'{path}' is no phase history that is read: ")


def test_damaged_files_are_refused_or_read(tmp_path):
    """Truncated, with bytes of the header or the XML changed, and with sizes that are absurd."""
    path = written(tmp_path / "a.cphd")
    whole, rng, refused = path.read_bytes(), np.random.default_rng(3), 0
    for k in range(30):
        damaged = bytearray(whole)
        if k % 3 == 0:
            del damaged[rng.integers(6, len(whole)) :]
        elif k % 3 == 1:
            for at in rng.integers(6, 4000, 10):
                damaged[at] = rng.integers(256)
        else:
            damaged = bytearray(whole.replace(b"<NumSamples>200", b"<NumSamples>9%02d" % k))
        path.write_bytes(bytes(damaged))
        try:
            read_phase_history([path])
        except ValueError as error:
            refused += str(error).startswith(f"'{path}' is")
        else:
            refused += k % 3 == 1
    assert refused == 30


def test_other_files_are_named(tmp_path):
    (tmp_path / "a.tif").write_bytes(b"II*\0" + bytes(99))
    with pytest.raises(ValueError, match=r"a TIFF .*\n  phase history is a file of the Gotcha set"):
        read_phase_history([tmp_path / "a.tif"])
    path = written(tmp_path / "a.cphd")
    with pytest.raises(ValueError, match="each about a reference point of its own"):
        read_phase_history([path, path])
    with pytest.raises(ValueError, match="are of two formats"):
        read_phase_history([path, tmp_path / "a.tif"])
    with pytest.raises(FileNotFoundError, match="is not there"):
        read_phase_history([tmp_path / "b.cphd"])


def test_a_speed_is_refused_where_times_are_known(tmp_path):
    written(tmp_path / "a.cphd")
    component = RecordedSpotlight(folder=tmp_path, files="a.cphd")
    component.name = "flown"
    component.validate()
    component.speed = 90.0
    with pytest.raises(ConfigurationError, match=r"'flown\.speed' is 90 m/s, but its file has the"):
        component.validate()
