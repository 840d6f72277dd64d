"""Recorded echo as a component: the radar is that of the files, or of the settings, never both."""

import numpy as np
import pytest
from l0b_files import NEAR, PRF, beam, codes, write

from terrafix.components.sensors.echo import RecordedEcho
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Environment
from terrafix.models.radar.chirp import SPEED_OF_LIGHT

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
    # 0.07 lines rms are what zeros in the place of lost lines move an image by
    expected = 0.07 / PRF if files == "b.h5" else 0.0
    assert more["time_sigma"] == pytest.approx(expected, rel=1e-9)
    assert t == 0.1
    assert first_time == pytest.approx(20 / PRF, abs=1e-9)
    assert first_range == pytest.approx(near, abs=1e-6)
    assert (echo.shape, echo.dtype) == ((N, CELLS), np.complex64)
    assert np.flatnonzero(~echo.any(axis=1)).tolist() == ([9] if files == "b.h5" else [])
    component.step_index = 0
    with pytest.raises(ConfigurationError, match="its lines were received from"):
        component.step(1.0, 1.0)


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
