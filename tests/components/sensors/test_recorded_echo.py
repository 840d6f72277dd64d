"""Recorded echo as a component: the radar is that of the files, or of the settings, never both."""

import os
from pathlib import Path

import ceos_files
import numpy as np
import pytest
from l0b_files import NEAR, PRF, beam, codes, write

from terrafix.components.sensors.echo import RecordedEcho
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Environment
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.files.readers import read_system
from terrafix.models.radar.chirp import SPEED_OF_LIGHT

ROOT = Path(__file__).parents[3]
DATA = Path(os.environ.get("TERRAFIX_DATA", ROOT / ".." / "shared" / "data"))
REAL = ROOT / "examples" / "spacecraft_sar_real_echo.toml"
TRUTH = {"orbit", "attitude", "antenna", "terrain", "echo"}
N, CELLS = 400, 256
WHERE = {"look": 0.6, "doppler_bandwidth": 1500.0}
SENT = {
    "carrier": 1.27e9,
    "prf": PRF,
    "sample_rate": SPEED_OF_LIGHT / (2 * 9.3685143125),
    "chirp_rate": -5e11,
    "pulse_length": 8e-6,
}
"""What the files of `l0b_files` say."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("echo")
    samples = codes(beam(N, CELLS))
    write(folder / "a.h5", samples)
    kept = np.delete(np.arange(N), 9)
    write(folder / "b.h5", samples[kept], place=1000 + kept)
    write(folder / "other.h5", samples, centerFrequency=1.2e9)
    np.savez(folder / "c.npz", echo=beam(N, CELLS), first_rg_line=7, first_rg_cell=3)
    return folder


def radar(folder, files="a.h5", **settings):
    component = RecordedEcho(**WHERE, folder=folder, files=files, **settings)
    component.name = "echo"
    return component


def test_the_radar_is_that_of_the_file(folder):
    found = radar(folder)
    found.validate()
    sent = found._radar()
    for name, value in SENT.items():
        assert getattr(sent, name) == pytest.approx(value, rel=1e-9), name
    assert sent.doppler_bandwidth == 1500.0


@pytest.mark.parametrize("name", SENT)
def test_a_setting_may_repeat_the_file_and_not_contradict_it(folder, name):
    radar(folder, **{name: SENT[name] * (1 + 1e-9)}).validate()
    with pytest.raises(ConfigurationError) as raised:
        radar(folder, **{name: SENT[name] * 1.001}).validate()
    text = str(raised.value)
    assert f"'echo.{name}' is {SENT[name] * 1.001:.12g} " in text
    assert "but its files say" in text
    assert float(text.split("say ")[1].split()[0]) == pytest.approx(SENT[name], rel=1e-9)


def test_the_near_range_may_not_contradict_the_file(folder):
    radar(folder, range0=NEAR).validate()
    with pytest.raises(
        ConfigurationError, match=r"'echo.range0' is 850010 m, but its files say 85"
    ):
        radar(folder, range0=NEAR + 10).validate()


def test_what_neither_says_is_asked_for(folder):
    complete = SENT | {"range0": 990e3}
    radar(folder, "c.npz", **complete).validate()
    for name in complete:
        with pytest.raises(ConfigurationError, match=f"do not say its {name}\n  set echo.{name}"):
            radar(folder, "c.npz", **{k: v for k, v in complete.items() if k != name}).validate()


def test_files_of_two_radars_are_refused(folder):
    radar(folder, "a.h5 b.h5").validate()
    for other in ("other.h5", "c.npz"):
        with pytest.raises(ConfigurationError, match=r"has files of two radars: 'a\.h5' says"):
            radar(folder, f"a.h5 {other}", **SENT).validate()


def test_another_kind_of_file_is_named(folder):
    (folder / "d.h5").write_bytes(b"II*\0" + bytes(100))
    with pytest.raises(ConfigurationError, match=r"cannot read its echo: .*d\.h5.* TIFF"):
        radar(folder, "d.h5").validate()


@pytest.mark.parametrize(
    ("files", "line", "near", "settings"),
    [
        ("a.h5", 7, NEAR, {}),
        ("b.h5", 1007, NEAR, {}),
        ("c.npz", 7, 990e3 + 2 * 9.3685143125, SENT | {"range0": 990e3}),
    ],
)
def test_lines_are_published_when_and_where_they_were_received(
    folder, monkeypatch, files, line, near, settings
):
    """Line `start_line` at t = 0, cell 1 at `range0`; the lost line of b.h5 is zeros."""
    component = radar(folder, files, start_line=line - 20.0, **settings)
    members = np.arange(1)
    component.bind(Environment("echo", 0, members, members >= 0, lambda *_: None, False))
    sent = []
    monkeypatch.setattr(component, "_publish", lambda *args, **more: sent.append((*args, more)))
    component.step(0.1, 0.1)
    t, echo, first_time, first_range, more = sent[0]
    # 0.08 lines rms are what zeros in the place of lost lines move an image by
    expected = 0.08 / PRF if files == "b.h5" else 0.0
    assert more["time_sigma"] == pytest.approx(expected, rel=1e-9)
    assert t == 0.1
    assert first_time == pytest.approx(20 / PRF, abs=1e-9)
    assert first_range == pytest.approx(near, abs=1e-6)
    assert (echo.shape, echo.dtype) == ((N, CELLS), np.complex64)
    assert np.flatnonzero(~echo.any(axis=1)).tolist() == ([9] if files == "b.h5" else [])
    component.step_index = 0
    with pytest.raises(ConfigurationError, match="its lines were received from"):
        component.step(1.0, 1.0)


def test_ceos_says_what_its_times_leave_open(tmp_path, monkeypatch):
    """Radar and near range of its leader and lines; half a millisecond of its times is open."""
    ceos_files.leader(tmp_path)
    path = ceos_files.write(tmp_path, ceos_files.coded(beam(N, 160) / 2))
    component = radar(tmp_path, path.name, start_line=7.0)
    component.validate()
    assert component._radar().chirp_rate == pytest.approx(-14e6 / 8e-6)
    members = np.arange(1)
    component.bind(Environment("echo", 0, members, members >= 0, lambda *_: None, False))
    sent = []
    monkeypatch.setattr(component, "_publish", lambda *args, **more: sent.append((*args, more)))
    component.step(0.1, 0.1)
    t, echo, first_time, near, more = sent[0]
    assert (t, echo.shape, first_time, near) == (0.1, (N, 160), 0.0, NEAR)
    assert more["time_sigma"] == pytest.approx(1e-3 / np.sqrt(12))


def heard(tmp_path, path, torn):
    """A part of the real-echo system: what its radar publishes at 6.09 s, of lines that slipped."""
    with np.load(path) as file:
        arrays = dict(file)
    for name in ("i", "q", "agc_db"):
        arrays[name] = np.delete(arrays[name], torn, axis=0)
    np.savez(tmp_path / "torn.npz", **arrays)
    system = read_system(REAL)
    for name in [n for n in system.nodes if n not in TRUTH]:
        system.remove(name)
    system.records.clear()
    for name in ("orbit", "attitude", "antenna"):
        system.nodes[name].rate = Rate(hz=10)
    system.nodes["echo"].folder = tmp_path
    system.nodes["echo"].files = "torn.npz"
    system.nodes["echo"].rate = Rate(times=["6.09"])
    system.record("heard", ["echo.acquired"])
    return simulate(system, members=1, duration="6.1 s").dataset


def test_lines_that_slipped_are_put_where_they_belong(tmp_path, caplog):
    """Ten lines of RADARSAT-1 over Stanley Park: told, and weighed by what zeros do to an image."""
    path = DATA / "radarsat1_vancouver" / "stanley_park.npz"
    if not path.is_file():
        pytest.skip(f"no {path}")
    data = heard(tmp_path, path, np.s_[900:910])
    assert "10 of its 1536 lines are lost, the first is line 901" in caplog.text
    sigma = data["echo.acquired.time_sigma"].to_numpy()
    assert sigma[np.isfinite(sigma)] == pytest.approx(0.08 / 1256.98)


def test_a_slip_that_the_echo_does_not_tell_is_refused(tmp_path):
    """Over water: the message says where, why, and what can be done about it."""
    path = DATA / "radarsat1_vancouver" / "english_bay_1.npz"
    if not path.is_file():
        pytest.skip(f"no {path}")
    with pytest.raises((ConfigurationError, RunError), match="cannot use") as raised:
        heard(tmp_path, path, np.s_[640:650])
    text = str(raised.value)
    assert "lines 640 and 641 are no neighbors" in text
    assert "line_number" in text
    assert "before line 641 is not told: what is seen before and after it is not alike" in text


def test_a_channel_is_named_where_there_are_several(tmp_path):
    """And refused where a file has none."""
    write(tmp_path / "two.h5", codes(beam(N, CELLS)), rx=("HH", "HV"))
    np.savez(tmp_path / "c.npz", echo=beam(N, CELLS), first_rg_line=7, first_rg_cell=3)
    with pytest.raises(ConfigurationError, match="it has several channels: A/HH, A/HV"):
        radar(tmp_path, "two.h5").validate()
    radar(tmp_path, "two.h5", channel="A/HV").validate()
    with pytest.raises(ConfigurationError, match="it has no channel 'A/VV'; it has A/HH, A/HV"):
        radar(tmp_path, "two.h5", channel="A/VV").validate()
    with pytest.raises(ConfigurationError, match=r"c\.npz' has no channels: 'A/HH' need not be"):
        radar(tmp_path, "c.npz", channel="A/HH", **SENT, range0=990e3).validate()
