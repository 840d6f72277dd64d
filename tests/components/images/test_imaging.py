"""Components that image: one echo for all members, members that do not know each other, bad input.

The scene is small (a short pulse, a narrow band), so that a whole loop takes a few seconds.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from terrafix.components.judges.album import ImageAlbum
from terrafix.cosim.basics.errors import ConfigurationError, SystemCheckError
from terrafix.cosim.basics.machine import available_memory
from terrafix.cosim.declare.component import Environment
from terrafix.cosim.engine.run import RunError, simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.records.checkpoint import read_checkpoint, write_checkpoint
from terrafix.cosim.system.dispersion import Dispersion
from terrafix.cosim.system.system import System
from terrafix.models.images.matching import REASONS
from terrafix.models.images.reference import Reference, write_reference
from terrafix.models.maps.dem import Dem, flat_dem, write_dem
from terrafix.models.radar.imaging import BLIND, OPEN
from terrafix.models.radar.imaging import REASONS as IMAGES

EXAMPLES = Path(__file__).parents[3] / "examples"
DATA = Path(os.environ.get("TERRAFIX_DATA", EXAMPLES / ".." / ".." / "shared" / "data"))
SMALL = (
    ("duration", "9 s"),
    ("echo.times", '["8.2 s"]'),
    ("reference.times", '["8.2 s"]'),
    ("former.times", '["8.2 s"]'),
    ("matcher.times", '["8.2 s"]'),
    ("echo.doppler_bandwidth", "700 Hz"),  # a fifth of the lines of the whole aperture
    ("echo.pulse_length", "9 us"),
    ("echo.chirp_rate", "-1.5555e12 Hz/s"),
    ("echo.n_lines", "4200"),
    ("echo.n_cells", "560"),
    ("former.rows", "270"),
    ("former.columns", "400"),
    ("former.azimuth_looks", "4"),
    ("reference.azimuth_looks", "4"),
    ("former.velocity_step", "4 m/s"),
    ("reference.n_lines", "2400"),
    ("reference.n_cells", "700"),
    ("terrain.point_density", "8"),
)


def small(*settings) -> System:
    pairs = [s for s in SMALL if s[0] != "duration"]
    system = read_system(EXAMPLES / "spacecraft_sar_closed_loop.toml", [*pairs, *settings])
    system.duration = "9"
    return system


def at_fix(dataset, name):
    values = dataset[name]
    return values.sel({values.dims[0]: 8.2}, method="nearest").to_numpy()


def payload(dataset, member=None):
    if member is not None:
        dataset = dataset.sel(member=[member])
    return {str(n): v.to_numpy().tobytes() for n, v in dataset.variables.items()}


@pytest.fixture(scope="module")
def flown():
    """Three members of the small loop."""
    return simulate(small(), members=3, duration="9").dataset


def test_images_formed_with_the_estimate_become_fixes(flown):
    """A kilometer and ten meters per second off, every member gets its fix and is corrected."""
    assert (at_fix(flown, "matcher.reason") == 0).all()
    assert (at_fix(flown, "matcher.fix.present") == 1).all()
    before = flown["evaluation.position_error"].to_numpy()
    assert np.linalg.norm(before[0], axis=1).max() > 1000
    assert np.linalg.norm(before[-1], axis=1).max() < 500
    D = at_fix(flown, "matcher.fix.D")
    # 0.1 m of the reference, and a tenth of pixels of 12.6 x 15 m, along and across
    sigmas = np.sqrt(np.linalg.eigvalsh(D))
    assert (sigmas > 0.09).all()
    assert (sigmas.max(axis=1) < 3.0).all()
    assert (at_fix(flown, "matcher.match_sigma") < 0.2).all()
    nis = at_fix(flown, "correct.innovation.nis")
    assert (nis < 18.5).all()  # 99.9 % of 4 degrees of freedom


def test_range_noise_is_a_members_own_and_the_image_is_shared(flown):
    ranges = at_fix(flown, "former.image.slant_range")
    assert len(np.unique(ranges)) == 3
    assert ranges.std() < 5
    assert np.ptp(at_fix(flown, "former.image.index")) == 0


def test_a_member_flown_alone_gives_the_same_bytes(flown):
    """Although images are shared, none of them knows who else asked for it."""
    alone = simulate(small(), members=[2], duration="9").dataset
    assert payload(alone) == payload(flown, 2)


@pytest.mark.parametrize("halt", ["8", "8.4"])
def test_a_state_set_back_continues_to_the_same_bytes(flown, halt, tmp_path):
    halted = Simulation(small(), members=3)
    halted.run_until(halt)
    write_checkpoint(tmp_path / "half.ckpt", halted.get_state())
    continued = Simulation(small(), members=3)
    continued.set_state(read_checkpoint(tmp_path / "half.ckpt"))
    continued.run_until("9")
    times = [d for d in flown.dims if str(d).startswith("time")]
    rest = flown.isel({d: flown[d] > float(halt) for d in times})
    assert payload(continued.result(wall_s=0.0).dataset) == payload(rest)


def test_where_autofocus_refuses_the_fix_comes_without_a_velocity(monkeypatch):
    from dataclasses import replace

    from terrafix.models.radar.imaging import FOCUS_REASONS, Imager

    focus = Imager.focus

    def refused(self, *args, **kwargs):
        processing, found = focus(self, *args, **kwargs)
        return processing, replace(found, accepted=False, reason=FOCUS_REASONS[4])

    monkeypatch.setattr(Imager, "focus", refused)
    data = simulate(small(), members=2, duration="9").dataset
    assert (at_fix(data, "matcher.reason") == 0).all()
    assert at_fix(data, "matcher.fix.present").tolist() == [[1, 1, 1, 0]] * 2
    assert (at_fix(data, "correct.innovation.accepted") == 1).all()
    assert (at_fix(data, "correct.innovation.dof") == 3).all()
    assert (at_fix(data, "former.reason") == 4).all()


def test_a_member_without_an_image_goes_without_a_fix():
    """It believes its velocity to 4 km/s: any Doppler centroid is possible. The other flies on."""
    system = small()
    sigma = np.array([10.0, 4000.0])
    system.disperse(Dispersion("lost", ("last_known.velocity_sigma",), sigma, kind="list"))
    data = simulate(system, members=2, duration="9").dataset
    assert [IMAGES[int(k)] for k in at_fix(data, "former.reason")] == ["accepted", OPEN]
    assert at_fix(data, "matcher.reason")[0] == 0
    assert at_fix(data, "correct.innovation.accepted")[0] == 1
    assert np.isfinite(data["correct.estimate.r_e"].to_numpy()[-1]).all()  # neither is failed


def test_what_is_not_recognized_gives_no_fix():
    """The reference shows another surface at the right place."""
    system = small()
    terrain = system.nodes["terrain"]
    settings = {n: terrain.setting(n) for n in terrain.settings()} | {"surface_seed": 77}
    other = system.add(type(terrain)(**settings), "other")
    system.replace(
        "reference",
        type(system.nodes["reference"])(
            rate=system.nodes["reference"].rate,
            **{
                n: system.nodes["reference"].setting(n)
                for n in system.nodes["reference"].settings()
            },
        ),
    )
    system.connections = [c for c in system.connections if c.target != "reference.surface"]
    system.connect(other["surface"], system.nodes["reference"]["surface"])
    data = simulate(system, members=2, duration="9").dataset
    reasons = {REASONS[int(r)] for r in at_fix(data, "matcher.reason")}
    assert "accepted" not in reasons
    assert np.isnan(at_fix(data, "matcher.fix.y")).all()


def failure(system, **options):
    with pytest.raises((SystemCheckError, ConfigurationError, RunError)) as raised:
        simulate(system() if callable(system) else system, duration="9", **options)
    return str(raised.value)


def test_members_with_different_truths_are_refused():
    text = failure(lambda: small(("antenna.misalignment_sigma0", "0.01 deg")), members=2)
    assert "'echo.q_mu' differs between members, but its output is one for all" in text
    assert "fly members with one truth" in text


SHARED = {
    "echo": (
        *("carrier", "prf", "sample_rate", "chirp_rate", "pulse_length", "doppler_bandwidth"),
        *("look", "squint", "antenna_length", "snr"),
    ),
    "terrain": ("flat_height", "parcels", "smooth", "fine", "point_density", "point_brightness"),
    "reference": ("look", "squint", "displacement", "snr"),
    "former": ("velocity_step", "migration_step", "band", "exposure"),
}


def test_what_is_one_for_all_members_cannot_be_dispersed():
    """Said at the start, before anything is computed with it."""
    system = small()
    system.nodes["terrain"].source = "flat"
    members = np.arange(2)
    for owner, names in SHARED.items():
        component = system.nodes[owner]
        for name in names:
            environment = Environment(owner, 0, members, members >= 0, lambda *_: None, False)
            component.bind(environment)
            values = getattr(component, name)
            values[1] = np.where(values[1] == 0.0, 1e-3, 0.99 * values[1])
            with pytest.raises(ConfigurationError) as raised:
                component.initialize()
            component.release()
            assert f"'{owner}.{name}' differs between members" in str(raised.value)
            assert "out of the dispersions, or fly one member at a time" in str(raised.value)


def test_a_member_alone_has_the_radar_that_it_was_given():
    """Not the one of the file: what a dispersion drew is what is published."""
    system = small()
    prf = np.array([2160.0, 2100.0])
    system.disperse(Dispersion("prf", ("echo.prf",), prf, kind="list"))
    simulation = Simulation(system, members=[1], duration="0.1")
    simulation.initialize()
    assert system.nodes["echo"].radar[1] == 2100.0
    simulation.master.terminate()


def test_too_little_memory_is_said_before_it_starts():
    text = failure(lambda: small(("echo.n_lines", "40000000")))
    assert "'echo' needs about" in text
    assert "for an echo of 40000000 lines of 560 cells, and" in text
    assert "set echo.n_lines or echo.n_cells to less" in text
    assert 0 < available_memory() < 1e15


@pytest.mark.parametrize("n_lines", ["2500", "3600"])  # shorter than the aperture, and longer
def test_too_few_lines_for_the_image_are_refused(n_lines):
    text = failure(lambda: small(("echo.n_lines", n_lines)))
    assert f"'former' wants an image of 1080 lines by 400 cells, and of {n_lines} by 560" in text
    assert "set echo.n_lines to 4061 at least, or former.rows to less" in text


def test_lines_shorter_than_a_pulse_are_refused():
    assert "too few are left" in failure(lambda: small(("echo.n_cells", "180")))


def test_a_look_to_the_left_in_a_right_looking_chain_is_refused():
    text = failure(lambda: small(("former.look", "-34.3 deg")))
    assert "'former.look' is -34.3 deg and 'echo.look' 34.3 deg: one looks to the other" in text
    assert "set both to the same" in text


def test_an_impossible_radar_is_refused():
    text = failure(lambda: small(("echo.chirp_rate", "-9e12 Hz/s")))
    assert "the radar of 'echo' cannot be: a chirp of 8.1e+07 Hz cannot be sampled" in text


def test_an_elevation_model_that_does_not_cover_the_footprint_is_refused(tmp_path):
    far = Dem(np.zeros((9, 9), np.float32), 0.5, 0.5, 1e-3, 1e-3)
    write_dem(far, tmp_path / "far.npz")
    settings = [
        ("terrain.source", "file"),
        ("terrain.mirrored", "false"),
        ("terrain.dem_file", str(tmp_path / "far.npz")),
    ]
    text = failure(lambda: small(*settings))
    assert "does not cover latitude 30.2" in text
    assert "it covers latitude 28.648 to 29.106, longitude 28.648 to 29.106 deg" in text


def test_voids_under_the_footprint_are_refused_unless_filled(tmp_path):
    holes = Dem(np.zeros((9, 9), np.float32), np.radians(25), np.radians(-100), 0.02, 0.02)
    holes.height[3:6, 3:6] = np.nan
    write_dem(holes, tmp_path / "holes.npz")
    settings = [
        ("terrain.source", "file"),
        ("terrain.dem_file", str(tmp_path / "holes.npz")),
    ]
    text = failure(lambda: small(*settings))
    assert "'terrain' is to mirror 'holes.npz', of which 9 points are void" in text
    assert "set terrain.fill_voids = true" in text
    text = failure(lambda: small(*settings, ("terrain.mirrored", "false")))
    assert "is void at latitude" in text
    small(*settings, ("terrain.fill_voids", "true")).nodes["terrain"].validate()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ([("terrain.source", "file")], "set terrain.dem_file, or terrain.source to jacksboro or"),
        (
            [("terrain.source", "file"), ("terrain.dem_file", "/nowhere/N44W072.hgt")],
            "'terrain' cannot read its elevation model: '/nowhere/N44W072.hgt' is not there",
        ),
        ([("album.picture", "picture.bmp")], "it takes a file that ends in .png, .svg, .pdf"),
        ([("album.picture", "/nowhere/a.png")], "but there is no folder '/nowhere'"),
    ],
)
def test_bad_files_are_refused_before_it_starts(settings, message):
    assert message in failure(lambda: small(*settings))


def test_the_album_is_drawn_at_the_end(tmp_path):
    system = small(("album.picture", str(tmp_path / "album.png")))
    assert isinstance(system.nodes["album"], ImageAlbum)
    simulate(system, members=1, duration="9")
    assert (tmp_path / "album.png").stat().st_size > 50_000


def reference_from(folder, latitude, longitude):
    """A system whose reference is a file, of a place of our choice."""
    from terrafix.components.images.reference import ReferenceFile

    rng = np.random.default_rng(0)
    rows = np.array([0.0, 399.0])
    ties = np.radians(latitude + np.array([[0.0, 0.0], [0.05, 0.05]]))
    amplitude = rng.random((400, 400)).astype(np.float32)
    east = np.radians(longitude + np.array([[0.0, 0.05], [0.0, 0.05]]))
    write_reference(Reference(amplitude, rows, rows, ties, east, ties * 0), folder / "far.npz")
    system = small()
    rate = system.nodes["reference"].rate
    wiring = [c for c in system.connections if not c.target.startswith("reference.")]
    system.replace("reference", ReferenceFile(rate=rate, folder=folder, files="far.npz"))
    system.connections = wiring
    return system


def test_a_reference_of_another_place_is_named(tmp_path):
    text = failure(reference_from(tmp_path, 48.0, 2.0))
    assert "the reference of 'matcher' does not cover the image: it lies about latitude 30." in text
    assert "the reference covers latitude 48.000 to 48.050, longitude 2.000 to 2.050 deg" in text
    assert "use a reference of this place, or list no image here" in text


def test_bad_reference_files_are_refused_before_it_starts(tmp_path):
    system = reference_from(tmp_path, 48.0, 2.0)
    system.nodes["reference"].files = "near.npz"
    assert "'reference' cannot read its reference: '" in failure(system)
    system.nodes["reference"].files = " "
    assert "'reference' has no file" in failure(system)


def recorded(folder, files="one.npz one.npz one.npz", **change):
    """How to build the real-echo system with a small recording in place of the real one."""
    rng = np.random.default_rng(0)
    arrays = {
        "i": rng.integers(1, 15, (1536, 2048)).astype(np.int8),
        "q": rng.integers(-15, 15, (1536, 2048)).astype(np.int8),
        "first_rg_line": np.array(5561),
        "first_rg_cell": np.array(1060),
    } | change
    np.savez(folder / "one.npz", **{k: v for k, v in arrays.items() if v is not None})
    settings = [
        (f"{name}.{key}", value)
        for name in ("echo", "reference")
        for key, value in (("folder", str(folder)), ("files", files))
    ]
    return lambda: read_system(EXAMPLES / "spacecraft_sar_real_echo.toml", settings)


def refusal(make, duration="5"):
    with pytest.raises((SystemCheckError, ConfigurationError, RunError)) as raised:
        simulate(make(), duration=duration)
    return str(raised.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q": None}, "it has neither 'echo' nor 'i' and 'q'"),
        ({"first_rg_line": None}, "it has no 'first_rg_line'; it holds i, q, first_rg_cell"),
        ({"i": np.zeros((9, 9), np.int8)}, "'i' has shape (9, 9), 'q' has (1536, 2048)"),
    ],
)
def test_bad_recordings_are_refused_before_it_starts(tmp_path, change, message):
    text = refusal(recorded(tmp_path, **change))
    assert "'echo' cannot read its echo: '" in text
    assert message in text
    assert "set echo.folder and echo.files, or TERRAFIX_DATA to the folder with the data" in text


def test_lost_lines_are_counted_before_it_starts(tmp_path):
    i = np.ones((1536, 2048), np.int8)
    i[100:140] = 0
    text = refusal(recorded(tmp_path, i=i, q=i))
    assert "40 of its 1536 lines are missing (zero), the first is line 101" in text


def test_a_recording_of_another_time_is_refused(tmp_path):
    text = refusal(recorded(tmp_path, first_rg_line=np.array(9000)))
    assert (
        "'echo' is to publish 'one.npz' at 4.42 s, but its lines were received from 6.545" in text
    )
    assert "list times within it, or set echo.start_line" in text


def test_too_few_files_are_refused(tmp_path):
    text = refusal(recorded(tmp_path, files="one.npz"), duration="10")
    assert "'echo' steps 3 times within 10 s, but has 1 file" in text


def test_a_recording_of_another_range_is_refused(tmp_path):
    text = refusal(recorded(tmp_path, first_rg_cell=np.array(6000)))
    assert "the boresight of 'echo' meets the ground at a slant range of 9984" in text
    assert "look at the same place: set echo.look, or the orbit" in text


def test_a_recording_of_speckle_is_not_believed(tmp_path):
    """Featureless echo: no centroid of the beam's, no image, no fix; the run goes on."""
    rng = np.random.default_rng(1)
    i, q = rng.normal(0, 5, (2, 1536, 2048)).round().astype(np.int8)
    i[i == 0] = 1
    result = simulate(recorded(tmp_path, i=i, q=q)(), members=1, duration="5")
    assert result.status == "complete"
    data = result.dataset
    values = data["former.reason"]
    assert values.sel({values.dims[0]: 4.42}, method="nearest").item() > 0
    assert np.isnan(data["matcher.fix.y"].to_numpy()).all()


def test_flat_ground_serves_the_real_echo():
    assert float(flat_dem().at(0.86, -2.15)) == 0.0


def test_a_member_that_cannot_form_an_image_goes_without_a_fix(flown):
    """Its estimate is far in space, from where this range reaches no ground: others go on."""
    system = small()
    sigma = np.array([[1000.0] * 3, [2e8] * 3])
    system.disperse(Dispersion("lost", ("last_known.position_sigma",), sigma, kind="list"))
    result = simulate(system, members=3, duration="9")
    assert result.status == "complete"
    assert not result.excluded
    reason = at_fix(result.dataset, "former.reason")
    assert IMAGES[int(reason[1])] == BLIND
    assert np.isnan(at_fix(result.dataset, "matcher.fix.y")[1]).all()
    for name in ("matcher.fix.y", "correct.estimate.r_e"):
        for member in (0, 2):
            found, alone = (at_fix(d, name)[member] for d in (result.dataset, flown))
            np.testing.assert_array_equal(found, alone)
