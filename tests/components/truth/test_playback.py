"""A recorded orbit, attitude or IMU in the place of a simulated one: what flies on is the same.

A result is played to the same bytes; an orbit file is interpolated, and the answer is the circle
it was written from.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from terrafix.components.truth.playback import Recording
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.models.geometry.earth import EARTH

ROOT = Path(__file__).parents[3]
OPEN_LOOP = ROOT / "examples" / "spacecraft_sar_open_loop.toml"
SENTINEL = ROOT / "examples" / "spacecraft_sar_recorded_orbit.toml"
DURATION = "17"  # [s]: two fixes, and a little of what follows
MEMBERS = 3
DOWNSTREAM = [f"correct.estimate.{n}" for n in ("r_e", "v_e", "q_mu", "P")]

RECORDED = {
    "orbit": ["r_e", "v_e", "r_i", "v_i", "delta_v_e"],
    "attitude": ["q_be", "delta_v_b", "delta_theta_b"],
    "imu": ["delta_v_b", "delta_theta_b"],
}
INPUTS = {
    "attitude": ["orbit.r_e", "orbit.v_e", "orbit.delta_v_e"],
    "imu": ["attitude.delta_v_b", "attitude.delta_theta_b"],
}


def table(text: str, name: str) -> str:
    """The part of a system file that is the table of a component."""
    begin = text.index(f"[component.{name}]")
    return text[begin : text.index("\n\n", begin)]


def with_record(folder: Path, *ports: str, period: str = "0.01 s") -> Path:
    """The open loop, recording ports on its way."""
    path = folder / "recording.toml"
    record = f'\n[record.history]\nports = {list(ports)!r}\nperiod = "{period}"\n'
    path.write_text(OPEN_LOOP.read_text() + record.replace("'", '"'))
    return path


def with_playback(folder: Path, name: str, definition: str, system: Path = OPEN_LOOP) -> Path:
    """A system with the component `name` replaced and what it was driven by disconnected."""
    text = system.read_text()
    text = text.replace(table(text, name), f"[component.{name}]\n{definition}")
    for source in INPUTS.get(name, []):
        lines = [w for w in text.splitlines() if f'"{source} -> {name}.' in w]
        assert len(lines) == 1
        text = text.replace(lines[0] + "\n", "")
    path = folder / "playback.toml"
    path.write_text(text)
    return path


def fly(path, **options):
    return simulate(read_system(path), **{"members": MEMBERS, "duration": DURATION} | options)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A short run with everything recorded whenever it steps: (dataset, file)."""
    folder = tmp_path_factory.mktemp("original")
    ports = [f"{c}.{p}" for c, names in RECORDED.items() for p in names]
    result = fly(with_record(folder, *ports), out=folder / "original.nc")
    return result.dataset, folder / "original.nc"


def definition(name: str, file: Path, **others: str) -> str:
    key = "orbit_file" if name == "orbit" else "result_file"
    settings = {key: str(file), "source": name} | others
    lines = [f'{k} = "{v}"' for k, v in settings.items()]
    return "\n".join([f'type = "recorded_{name}"', *lines])


@pytest.mark.parametrize("name", RECORDED)
def test_a_recording_in_place_of_the_original_gives_the_same_bytes(tmp_path, original, name):
    dataset, file = original
    played = fly(with_playback(tmp_path, name, definition(name, file))).dataset
    for variable in (*DOWNSTREAM, "evaluation.nees", "orbit.r_e"):
        assert played[variable].to_numpy().tobytes() == dataset[variable].to_numpy().tobytes()
    assert np.isfinite(played["evaluation.nees"]).all()


def test_a_recording_of_one_member_serves_all(tmp_path, original):
    """The truth is the same for all members, so that one recording of it is enough."""
    dataset, _ = original
    one = tmp_path / "one.nc"
    ports = [f"attitude.{p}" for p in RECORDED["attitude"]]
    fly(with_record(tmp_path, *ports), members=1, out=one)
    played = fly(with_playback(tmp_path, "attitude", definition("attitude", one))).dataset
    np.testing.assert_array_equal(played[DOWNSTREAM[0]], dataset[DOWNSTREAM[0]])


def test_members_are_found_by_their_number(tmp_path, original):
    dataset, file = original
    path = with_playback(tmp_path, "imu", definition("imu", file))
    alone = fly(path, members=[2]).dataset
    np.testing.assert_array_equal(alone[DOWNSTREAM[0]], dataset[DOWNSTREAM[0]].sel(member=[2]))
    with pytest.raises(ConfigurationError, match="does not hold member 3\n  record one member"):
        fly(path, members=4)


def test_an_orbit_recorded_without_inertial_axes_is_given_them(tmp_path, original):
    """Position and velocity in inertial axes follow from the Earth-fixed ones.

    5e-9 m and 5e-12 m/s: a few roundings of 7e6 m and of 7e3 m/s, turned there and back.
    """
    dataset, _ = original
    few = tmp_path / "few.nc"
    fly(with_record(tmp_path, "orbit.r_e", "orbit.v_e"), members=1, out=few)
    path = with_playback(tmp_path, "orbit", definition("orbit", few))
    path.write_text(
        path.read_text().replace('"orbit.r_e", "orbit.v_e"', '"orbit.r_i", "orbit.v_i"')
    )
    played = fly(path, members=1).dataset
    for name, limit in (("orbit.r_i", 5e-9), ("orbit.v_i", 5e-12)):
        found, truth = played[name], dataset[name]
        times = found[found.dims[0]].to_numpy()
        truth = truth.sel({truth.dims[0]: times, "member": [0]}, method="nearest")
        np.testing.assert_allclose(found, truth, atol=limit, rtol=0)


# ------------------------------------------------------------------------- what cannot be played


def refusal(path: Path) -> str:
    with pytest.raises(SystemCheckError) as caught:
        read_system(path)
    assert len(caught.value.problems) == 1
    return str(caught.value.problems[0])


def test_recordings_that_cannot_be_played_are_refused_before_the_run(tmp_path, original):
    _, file = original

    def attempt(name, file, **others):
        return refusal(with_playback(tmp_path, name, definition(name, file, **others)))

    absent = tmp_path / "absent.nc"
    assert attempt("imu", absent) == (
        f"'imu' cannot play its recording: there is no result file '{absent}'\n"
        "  record the original in an earlier run, and name the result it was written to"
    )
    garbage = tmp_path / "garbage.nc"
    garbage.write_bytes(b"no NetCDF" * 100)
    assert f"'imu' cannot play its recording: '{garbage}' is damaged" in attempt("imu", garbage)
    torn = tmp_path / "torn.nc"
    torn.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert f"'imu' cannot play its recording: '{torn}' is damaged" in attempt("imu", torn)
    assert attempt("imu", file, source="imy") == (
        f"'imu' needs 'imy.delta_v_b', which '{file}' does not hold\n"
        "  did you mean 'imu.delta_v_b'?"
    )
    assert attempt("imu", file, period="0.004 s") == (
        "'imu': 'original.nc' has no sample of 'delta_v_b' at 0.004 s; "
        "it has 1701, from 0 s to 17 s\n"
        "  record the original whenever it steps, and play it at the same rate"
    )
    assert attempt("orbit", absent) == (
        f"'orbit' needs the orbit file '{absent}', which is not there\n"
        "  set orbit.orbit_file, or TERRAFIX_DATA to the folder with the data"
    )
    assert "which is a folder" in attempt("orbit", tmp_path)
    assert "has no sample of 'r_e' at 18 s" in attempt("orbit", file, start="18 s")


def test_a_run_beyond_the_recording_is_refused_before_it_starts(tmp_path, original):
    _, file = original
    path = with_playback(tmp_path, "imu", definition("imu", file))
    with pytest.raises(SystemCheckError) as caught:
        simulate(read_system(path), members=MEMBERS, duration="18")
    assert [str(p) for p in caught.value.problems] == [
        f"'imu' is to play 'delta_v_b' until 18 s, but '{file.name}' ends at 17 s\n"
        "  fly shorter (--duration), or record the original longer"
    ]


def test_a_member_that_was_not_recorded_fails_and_the_others_fly_on(tmp_path, original):
    import xarray

    dataset, file = original
    cut = tmp_path / "cut.nc"
    with xarray.load_dataset(file) as changed:
        changed["imu.delta_v_b"][500:, 1] = np.nan
        changed.to_netcdf(cut)
    result = fly(with_playback(tmp_path, "imu", definition("imu", cut)))
    assert [(e["member"], e["component"], e["reason"]) for e in result.excluded] == [
        (1, "imu", "was not recorded")
    ]
    others = [0, 2]
    np.testing.assert_array_equal(
        result.dataset[DOWNSTREAM[0]].sel(member=others), dataset[DOWNSTREAM[0]].sel(member=others)
    )


# ------------------------------------------------------------------------- orbit files

RADIUS, SPACING, STATES = 7.0e6, 10, 31  # [m], [s], count
RATE = np.sqrt(EARTH.mu / RADIUS**3)  # [rad/s]


def circle(t):
    """Position and velocity on an inclined circle, in any axes, (..., 3) each."""
    u, w = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.6, 0.8])
    c, s = np.cos(RATE * np.asarray(t))[..., None], np.sin(RATE * np.asarray(t))[..., None]
    return RADIUS * (c * u + s * w), RADIUS * RATE * (c * w - s * u)


def write_eof(path: Path) -> Path:
    """An orbit file with states on the circle every 10 s."""
    vectors = []
    for k in range(STATES):
        r, v = circle(k * SPACING)
        epoch = np.datetime64("2022-09-18T00:00:00") + np.timedelta64(k * SPACING, "s")
        tags = zip(("X", "Y", "Z", "VX", "VY", "VZ"), [*r, *v], strict=True)
        values = "".join(f"<{tag}>{float(value)}</{tag}>" for tag, value in tags)
        vectors.append(f"<OSV><UTC>UTC={epoch}.000000</UTC>{values}</OSV>")
    path.write_text(
        "<Earth_Explorer_File><Ref_Frame>EARTH_FIXED</Ref_Frame>"
        "<Time_Reference>UTC</Time_Reference>"
        f'<List_of_OSVs count="{STATES}">{"".join(vectors)}</List_of_OSVs></Earth_Explorer_File>'
    )
    return path


@pytest.fixture
def eof(tmp_path):
    return write_eof(tmp_path / "circle.EOF")


def orbit_system(folder: Path, eof: Path, start: str = "0 s") -> Path:
    path = folder / "orbit.toml"
    path.write_text(
        'schema = "terrafix-system/1"\nname = "orbit"\nduration = "60 s"\n'
        f'[component.orbit]\ntype = "recorded_orbit"\nrate = "10 Hz"\norbit_file = "{eof}"\n'
        f'start = "{start}"\n'
        '[record.orbit]\nports = ["orbit.r_e", "orbit.v_e", "orbit.r_i", "orbit.delta_v_e"]\n'
    )
    return path


def test_an_orbit_file_is_interpolated_to_the_orbit_it_holds(tmp_path, eof):
    """Error of cubic Hermite interpolation: at most h^4 / 384 times the fourth derivative.

    That is r n^4 h^4 / 384 = 2.5e-4 m for the position, and its slope, r n^4 h^3 / (72 sqrt 3) =
    7.6e-5 m/s, for the velocity, of a circle of radius r at the rate n, per axis.
    """
    found = fly(orbit_system(tmp_path, eof, start="5 s"), members=2).dataset
    t = found["orbit.r_e"][found["orbit.r_e"].dims[0]].to_numpy() + 5.0
    r, v = circle(t)
    limit = RADIUS * RATE**4 * SPACING**4 / 384
    for member in (0, 1):
        np.testing.assert_allclose(found["orbit.r_e"][:, member], r, atol=limit, rtol=0)
        slope = RADIUS * RATE**4 * SPACING**3 / (72 * np.sqrt(3))
        np.testing.assert_allclose(found["orbit.v_e"][:, member], v, atol=slope, rtol=0)
    assert not found["orbit.delta_v_e"].any()
    np.testing.assert_allclose(  # axes coincide at t = 0
        found["orbit.r_i"][0], found["orbit.r_e"][0], atol=1e-9, rtol=0
    )


def test_members_that_start_at_other_times_are_at_other_places(tmp_path, eof):
    """Each on the circle of the file, at its own start; who starts beyond its end fails alone."""
    system = read_system(orbit_system(tmp_path, eof))
    starts = np.array([0.0, 100.0, STATES * SPACING])
    system.disperse(Dispersion("start", ("orbit.start",), starts, kind="list"))
    result = simulate(system, members=3, duration="5")
    found = result.dataset["orbit.r_e"]
    t = found[found.dims[0]].to_numpy()
    limit = RADIUS * RATE**4 * SPACING**4 / 384
    for member in (0, 1):
        r, _ = circle(t + starts[member])
        np.testing.assert_allclose(found[:, member], r, atol=limit, rtol=0)
    (failure,) = result.excluded
    assert (failure["member"], failure["t_s"]) == (2, 0.0)
    assert failure["reason"] == "the orbit file does not cover this time"


def test_members_with_other_angles_of_the_earth_are_at_other_inertial_places(tmp_path, eof):
    system = read_system(orbit_system(tmp_path, eof))
    angles = np.array([0.0, np.pi / 2])
    system.disperse(Dispersion("angle", ("orbit.earth_angle0",), angles, kind="list"))
    found = simulate(system, members=2, duration="1").dataset
    x, y, z = found["orbit.r_i"].to_numpy()[0, 0]
    np.testing.assert_allclose(found["orbit.r_i"][0, 1], [-y, x, z], atol=1e-6)


def test_orbit_files_that_cannot_be_used_are_refused_before_the_run(tmp_path, eof):
    hint = "  set orbit.orbit_file, or TERRAFIX_DATA to the folder with the data"
    assert refusal(orbit_system(tmp_path, eof, start="300 s")) == (
        "'orbit.start' is 300 s, but 'circle.EOF' covers 300 s from "
        "2022-09-18T00:00:00.000000000 UTC"
    )
    torn = tmp_path / "torn.EOF"
    torn.write_text(eof.read_text()[:2000])
    text = refusal(orbit_system(tmp_path, torn))
    assert text.startswith(
        f"'orbit' cannot read its orbit file: {torn}: damaged or truncated orbit file"
    )
    assert text.endswith(hint)
    short = tmp_path / "short.EOF"
    short.write_text(eof.read_text().replace("<OSV>", "<GONE>", 1).replace("</OSV>", "</GONE>", 1))
    assert "holds 30 state vectors but declares 31" in refusal(orbit_system(tmp_path, short))
    absent = tmp_path / "absent.EOF"
    assert refusal(orbit_system(tmp_path, absent)) == (
        f"'orbit' needs the orbit file '{absent}', which is not there\n{hint}"
    )


def test_a_run_beyond_the_orbit_file_is_refused_before_it_starts(tmp_path, eof):
    system = read_system(orbit_system(tmp_path, eof, start="250 s"))
    simulate(system, duration="50")
    with pytest.raises(SystemCheckError) as caught:
        simulate(system, duration="51")
    assert str(caught.value.problems[0]) == (
        "'orbit' is to play until 301 s after the first state of 'circle.EOF', which covers 300 s\n"
        "  fly shorter (--duration), or set an earlier orbit.start"
    )


def test_the_real_orbit_of_sentinel_1_is_flown():
    """Interpolated states must agree with the file's own: the one of 8250 s after its first."""
    from terrafix.models.motion.ephemeris import read_eof

    folder = Path(os.environ.get("TERRAFIX_DATA", ROOT / ".." / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data: {folder} is absent (set TERRAFIX_DATA)")
    system = read_system(SENTINEL, [("record.truth.period", "1")])
    result = simulate(system, members=1, duration="9")
    ephemeris = read_eof(next((folder / "sentinel1").glob("*.EOF")))
    row = int(np.flatnonzero(ephemeris.t == 8250.0)[0])  # the run begins 4 s before it
    truth = result.dataset["orbit.r_e"]
    time = str(truth.dims[0])
    np.testing.assert_array_equal(truth.sel({time: 4.0, "member": 0}), ephemeris.r_e[row])
    assert not result.excluded


def test_members_are_looked_up_by_their_number():
    """Of a recording of members 9, 2 and 5, in this order, each gets its own samples."""
    recording = Recording.__new__(Recording)
    recording.members = np.array([9, 2, 5])
    values = np.array([[[90.0], [20.0], [50.0]]])
    recording.samples = {"r_e": (np.zeros(1), values)}
    recording.choose(np.array([2, 9, 5]))
    np.testing.assert_array_equal(recording.samples["r_e"][1][0, :, 0], [20.0, 90.0, 50.0])
