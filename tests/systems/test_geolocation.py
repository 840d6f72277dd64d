"""A satellite tracks a target: three profiles as the thesis has them, and an honest filter."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import terrafix as tf
from terrafix.cosim.basics.errors import ConfigurationError

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
PRINTED = EXAMPLES / "geolocation_printed.toml"
PASS = EXAMPLES / "geolocation_pass.toml"
DATA = Path(os.environ.get("TERRAFIX_DATA", ROOT / ".." / "shared" / "data"))
LANDSAT = "landsat8/LC08_L1TP_224077_20200518_20200518_01_RT_B4.TIF"
PROFILES = ("non_updated", "image_matched", "image_corrected")
needs_data = pytest.mark.skipif(
    not (DATA / LANDSAT).is_file(), reason="the Landsat image is absent (set TERRAFIX_DATA)"
)
SIGMA0 = {"LEO": 5.47, "MOL": 1.947}  # of the target per axis at t = 0 [px]

SIZES = [
    ("known_located.georeference_sigma", "0.0145 px"),
    ("matcher.match_sigma", "0.013 px"),
    ("corrected_predict.mismatch_sigma", "0.005 px"),
    ("corrected_predict.mismatch_time", "2 s"),
]
"""Of the errors of matches in the drawn scene, which is rougher than the Landsat image; measured
with 40 members of seed 77: 0.0147 and 0.0136 px that last, 0.015 px that does not."""


def drawn(file="geolocation"):
    """A system with a drawn scene in the place of the Landsat image, which may not be there."""
    text = (EXAMPLES / f"{file}.toml").read_text()
    begin = text.index("[component.scene]")
    end = text.index("\n\n", begin)
    return text[:begin] + '[component.scene]\ntype = "ground_scene"' + text[end:]


@pytest.fixture(scope="session")
def corrected(tmp_path_factory):
    """The corrected system over a drawn scene: its file."""
    file = tmp_path_factory.mktemp("systems") / "geolocation.toml"
    file.write_text(drawn())
    return file


def rss(data, profile):
    """Root mean square of the target's error over members and epochs [px]."""
    return np.sqrt((data[f"{profile}.target_error"].values ** 2).sum(axis=-1).mean())


as_printed = pytest.mark.parametrize(
    ("orbit", "matching", "worst", "least"),
    [
        ("LEO", "parts", 0.15, 80),
        ("LEO", "whole", 0.40, 25),
        ("MOL", "parts", 0.12, 20),
        ("MOL", "whole", 0.42, 7),
    ],
)
"""Corrected error [px] at most, and times that it is without images at least, of 20 minutes."""


@as_printed
def test_the_three_profiles_of_the_thesis(orbit, matching, worst, least):
    """12 members, 300 s: errors of a correct implementation; those of 1200 s are a campaign's.

    The low orbit drifts off for 20 minutes: after five the ratio to the non-updated profile is
    half of what it becomes. The matched profile keeps its first error.
    """
    system = tf.read_system(PRINTED, [("orbit", orbit), ("matching", matching)])
    data = tf.simulate(system, members=12, duration="300").dataset
    found = {name: rss(data, name) for name in PROFILES}
    assert found["image_corrected"] < worst
    assert found["non_updated"] / found["image_corrected"] > least / 2
    square = (data["image_matched.target_error"].values ** 2).sum(axis=-1).mean(axis=1)
    np.testing.assert_allclose(np.sqrt(square / square[0]), 1.0, atol=0.15)
    # sqrt(2) sigma of 24 draws: 14 percent, four of these
    assert np.sqrt(square[0]) == pytest.approx(np.sqrt(2) * SIGMA0[orbit], rel=0.6)


@pytest.fixture(scope="module")
def without_images():
    """The high orbit's profile without images, 300 members over 20 minutes."""
    system = tf.read_system(PRINTED, [("orbit", "MOL")])
    for name in ("camera", "matcher", "georeference", "matched_correct", "corrected_correct"):
        system.remove(name)
    for name in ("image_matched", "image_corrected", "matched_predict", "corrected_predict"):
        system.remove(name)
    return tf.simulate(system, members=300).dataset


def test_matching_alone_is_no_better_than_nothing_in_the_high_orbit(without_images):
    """Its attitude wanders and comes back: what is frozen at first is no better than zero.

    Against the printed conclusion. The matched profile has the first error at all times, and that
    is the same in the mean square as any later one.
    """
    target = without_images["non_updated.target_error"].values
    frozen = (target[0] ** 2).sum(axis=-1).mean()
    assert np.sqrt(frozen / (target**2).sum(axis=-1).mean()) == pytest.approx(1.0, abs=0.15)
    assert np.sqrt(frozen) == pytest.approx(np.sqrt(2) * SIGMA0["MOL"], rel=0.15)


def test_attitude_does_not_grow(without_images):
    """0.002865 deg at 0, 10 and 20 minutes, where the thesis has 0.017; 1/e after 600 s.

    600 draws: 3 percent of a sigma; 10 and 20 percent are the bars.
    """
    angles = [without_images[f"non_updated.{n}_error"].values[..., 0] for n in ("pitch", "roll")]
    both = np.concatenate(angles, axis=1)
    sigma = np.degrees(np.sqrt((both[[0, 600, 1200]] ** 2).mean(axis=1)))
    np.testing.assert_allclose(sigma, 0.002865, rtol=0.10)
    lags = np.arange(0, 1000, 10)
    c = np.array([(both[: len(both) - k] * both[k:]).mean() for k in lags])
    assert lags[np.argmax(c / c[0] < np.exp(-1))] == pytest.approx(600, rel=0.2)


@pytest.mark.campaign
@as_printed
def test_twenty_minutes_of_the_three_profiles(orbit, matching, worst, least):
    """100 members, 1200 s: the errors and ratios of a correct implementation."""
    system = tf.read_system(PRINTED, [("orbit", orbit), ("matching", matching)])
    data = tf.simulate(system, members=100).dataset
    found = {name: rss(data, name) for name in PROFILES}
    assert found["image_corrected"] < worst
    assert found["non_updated"] / found["image_corrected"] > least
    matched = np.sqrt((data["image_matched.target_error"].values ** 2).sum(axis=-1).mean(axis=1))
    np.testing.assert_allclose(matched / matched[0], 1.0, atol=0.15)
    np.testing.assert_allclose(matched, np.sqrt(2) * SIGMA0[orbit], rtol=0.15)
    if orbit == "MOL":
        assert found["image_matched"] > 0.95 * found["non_updated"]


@needs_data
@pytest.mark.campaign
@pytest.mark.parametrize("orbit", ["LEO", "MOL"])
def test_twenty_minutes_of_the_honest_filter(orbit):
    """NEES (2) and NIS (2) of the corrected profile in [1.6, 2.4]."""
    system = tf.read_system(EXAMPLES / "geolocation.toml", [("orbit", orbit)])
    data = tf.simulate(system, members=100).dataset
    for name in ("nees", "nis"):
        assert 1.6 < np.nanmean(data[f"image_corrected.{name}"].values) < 2.4


def test_the_filter_that_is_told_what_is_so_is_consistent(corrected):
    """NEES (2) and NIS (2) of the corrected profile in [1.6, 2.4], on both orbits."""
    for orbit, spacing in (("LEO", "50 m"), ("MOL", "500 m")):
        system = tf.read_system(corrected, [("orbit", orbit), ("scene.spacing", spacing), *SIZES])
        data = tf.simulate(system, members=24, duration="120").dataset
        assert 1.6 < np.nanmean(data["image_corrected.nees"].values) < 2.4
        assert 1.6 < np.nanmean(data["image_corrected.nis"].values) < 2.4
        assert rss(data, "image_corrected") < 0.06
        assert 1.2 < np.nanmean(data["image_matched.nees"].values) < 3.0


def test_a_gyro_and_a_star_tracker_in_the_place_of_attitude_that_wanders(tmp_path):
    """Consistent with images and without; the target is then as uncertain as the orbit alone.

    4.56 px per axis at first instead of 5.47, NEES (2) of 24 members over 120 s.
    """
    file = tmp_path / "geolocation_inertial.toml"
    file.write_text(drawn("geolocation_inertial"))
    data = tf.simulate(tf.read_system(file, SIZES), members=24, duration="120").dataset
    for name in ("non_updated", "image_corrected"):
        assert 1.0 < np.nanmean(data[f"{name}.nees"].values) < 3.0
    sigma = data["non_updated.target_sigma"].values[10]
    np.testing.assert_allclose(sigma, 4.56, rtol=0.01)
    assert rss(data, "image_corrected") < 0.06


def test_with_the_printed_noise_it_is_not():
    """0.05 px, where whole pixels have 0.29: NEES far beyond eight."""
    system = tf.read_system(PRINTED, [("orbit", "MOL"), ("matching", "whole")])
    data = tf.simulate(system, members=8, duration="100").dataset
    assert np.nanmean(data["image_corrected.nees"].values) > 8.0


def test_what_is_printed_as_the_measurement_makes_it_worse(tmp_path):
    """Equation (3.13) takes the attitude off an offset that has it in: the negative control."""
    text = PRINTED.read_text().replace(
        '[component.corrected_correct]\ntype = "target_correct_printed"',
        '[component.corrected_correct]\ntype = "target_correct_misprinted"',
    )
    text = text.replace(
        '    "georeference.fix -> matcher.reference",\n',
        '    "georeference.fix -> matcher.reference",\n'
        '    "satellite.aim -> corrected_correct.aim",\n',
    )
    found = {}
    for name, content in (("right", PRINTED.read_text()), ("wrong", text)):
        file = tmp_path / "geolocation_printed.toml"
        file.write_text(content)
        system = tf.read_system(file)
        found[name] = rss(tf.simulate(system, members=8, duration="400").dataset, PROFILES[2])
    assert found["wrong"] > 1.3 * found["right"]


MOVED = """
import terrafix as tf


class Moved(tf.Component):
    default_rate = tf.Rate("1")
    true = tf.Input((2,), unit="px")
    off = tf.Parameter([0.0, 0.0], shape=(2,), unit="px")
    target = tf.Output((2,), unit="px")

    def _initialize_impl(self):
        self.target = self.true + self.off

    def _step_impl(self, t, dt):
        self.target = self.true + self.off
"""


def test_georeferencing_follows_the_image_and_not_the_truth(tmp_path):
    """Only what the camera sees is moved, by (3, -2) px: the estimate follows to a tenth of one."""
    text = PRINTED.read_text().replace(
        '"satellite.target -> camera.target"',
        '"satellite.target -> moved.true",\n    "moved.target -> camera.target"',
    )
    text += '\n[component.moved]\ntype = "own_moved:Moved"\n'
    file = tmp_path / "geolocation_printed.toml"
    file.write_text(text)
    (tmp_path / "own_moved.py").write_text(MOVED)
    estimates = []
    for off in ("[0, 0] px", "[3, -2] px"):
        system = tf.read_system(file, [("moved.off", off)])
        system.record("estimates", ["corrected_correct.estimate"], period="1")
        data = tf.simulate(system, members=5, duration="5").dataset
        estimates.append(data["corrected_correct.estimate.target"].values)
    moved = estimates[1] - estimates[0]
    np.testing.assert_allclose(moved, np.broadcast_to([3.0, -2.0], moved.shape), atol=0.1)


def test_members_alone_and_together_and_resumed_are_the_same_bytes(corrected):
    def read():
        return tf.read_system(corrected, [("scene.spacing", "50 m"), ("camera.hidden", "0.1")])

    whole = tf.simulate(read(), members=4, duration="6").dataset
    alone = tf.simulate(read(), members=[3], duration="6").dataset
    for name in (f"{p}.target_error" for p in PROFILES):
        np.testing.assert_array_equal(whole[name].values[:, 3], alone[name].values[:, 0])
    half = tf.Simulation(read(), members=4)
    half.run_until("3")
    again = tf.Simulation(read(), members=4)
    again.set_state(half.get_state())
    again.run_until("6")
    error = again.result(wall_s=0.0).dataset["image_corrected.target_error"].values
    np.testing.assert_array_equal(error[-1], whole["image_corrected.target_error"].values[-1])


@pytest.mark.parametrize(
    ("settings", "worst"),
    [
        ((("camera.blur", "1 px"), ("georeference.blur", "1 px")), 0.1),
        ((("camera.smear", "[2, 0] px"),), 0.3),
        ((("camera.light_rate", "5e-3 1/s"), ("matcher.method", "ncc")), 0.1),
        ((("matcher.method", "phase"),), 0.3),
        ((("camera.hidden", "0.1"),), 0.1),
        ((("camera.hidden", "0.1"), ("matcher.method", "phase")), 0.1),
        ((("camera.turn_rate", "2e-4 rad/s"),), 0.3),
        ((("camera.stretch_rate", "2e-4 1/s"),), 0.3),
    ],
    ids=["blur", "smear", "light", "phase", "hidden", "hidden-phase", "turn", "stretch"],
)
def test_what_disturbs_images_leaves_parts_of_a_pixel(corrected, settings, worst):
    """The thesis' future work, one by one; what hides a part of the ground is left out."""
    system = tf.read_system(corrected, [("scene.spacing", "50 m"), *settings])
    system.record("matches", ["matcher.reason"], period="1")
    data = tf.simulate(system, members=6, duration="30").dataset
    assert rss(data, "image_corrected") < worst
    # without a second look a cloud over a tenth leaves a third of the frames below 0.5
    assert (data["matcher.reason"].values == 0).mean() > 0.95


def test_light_is_what_squares_do_not_stand(corrected):
    """Lighter by 15 percent after 30 s, and told to no one: squares are worse than correlation."""
    found = {}
    for method in ("ssd", "ncc"):
        light = [("camera.light_rate", "5e-3 1/s"), ("matcher.method", method)]
        system = tf.read_system(corrected, [("scene.spacing", "50 m"), *light])
        found[method] = rss(tf.simulate(system, members=6, duration="30").dataset, PROFILES[2])
    assert found["ssd"] > 1.5 * found["ncc"]


def test_frames_without_texture_make_no_fix():
    """A scene that noise drowns: nothing is matched, nothing corrected, nothing fails."""
    drowned = [(f"{n}.noise", "60") for n in ("camera", "matcher", "georeference")]
    system = tf.read_system(PRINTED, drowned)
    system.record("matches", ["matcher.reason"], period="1")
    data = tf.simulate(system, members=3, duration="5").dataset
    assert (data["matcher.reason"].values != 0).all()
    error = [data[f"{p}.target_error"].values for p in PROFILES]
    np.testing.assert_allclose(error[2], error[0], rtol=0, atol=1e-9)


def refused(match, file, *settings):
    with pytest.raises((ConfigurationError, tf.TerrafixError), match=match):
        tf.simulate(tf.read_system(file, list(settings)), members=2, duration="2")


def test_an_orbit_that_meets_the_earth_is_refused():
    refused(
        "the orbit meets the Earth: its perigee lies -", PRINTED, ("satellite.eccentricity", "0.07")
    )


def test_a_template_larger_than_the_image_is_refused():
    refused(r"'matcher\.template' is 64 pixels, larger than", PRINTED, ("matcher.template", "64"))


@pytest.mark.parametrize("name", ["matcher", "georeference"])
def test_an_odd_template_is_refused(name):
    """Of an even frame it has no middle: it would be half a pixel off on the map."""
    refused(
        rf"'{name}\.template' is 37 pixels, and a frame has 48: an odd number",
        PRINTED,
        (f"{name}.template", "37"),
    )


def test_an_image_that_is_absent_or_empty_is_refused(tmp_path):
    file = tmp_path / "ground.tif"
    image = [("scene.source", "texture"), ("scene.file", str(file))]
    refused(
        r"ground\.tif': no such file or directory\n  set scene\.file, or TERRAFIX_DATA to the f",
        PRINTED,
        *image,
    )
    Image.fromarray(np.zeros((300, 300), np.uint8)).save(file)
    refused("is the same everywhere: it has no texture", PRINTED, *image)


def test_a_map_smaller_than_the_gate_is_refused(tmp_path):
    refused("the map of 'georeference' is smaller than the gate", _small_map(tmp_path))


def _small_map(folder):
    text = PRINTED.read_text()
    text = text.replace(
        "[component.scene]",
        '[component.map]\ntype = "ground_scene"\nsize = 256\nspacing = "20 m"\n\n[component.scene]',
    )
    for name in ("scene", "place", "grid"):
        text = text.replace(f"scene.{name} -> georeference", f"map.{name} -> georeference")
    file = folder / "geolocation_printed.toml"
    file.write_text(text)
    return file


@needs_data
def test_a_target_on_the_ground_is_tracked_while_it_is_in_view():
    """83 s within 25 degrees; matched to the first frame, and to the map itself."""
    system = tf.read_system(PASS)
    system.record("views", ["satellite.off_nadir"], period="1")
    data = tf.simulate(system, members=12).dataset
    inside = data["satellite.off_nadir"].values[:, 0] < np.radians(25.0)
    assert inside.sum() == pytest.approx(83, abs=1)
    assert rss(data, "image_corrected") < 0.15
    assert rss(data, "map_matched") < 0.05
    assert rss(data, "non_updated") > 5.0


@needs_data
def test_what_is_never_in_view_is_refused():
    refused(
        "is never in view: it is below the horizon for all of",
        PASS,
        ("satellite.earth_angle0", "180 deg"),
    )
    refused(
        "is not in view of 'camera' at t = 0: it is 25.30 deg off",
        PASS,
        ("camera.widest", "20 deg"),
    )
    refused("lies beyond the map 'LC08", PASS, ("scene.latitude", "-27 deg"))


@needs_data
def test_a_real_texture_is_matched_and_the_filter_consistent_with_it():
    """Every frame, to 0.03 px; NEES (2) as of the drawn scene."""
    system = tf.read_system(EXAMPLES / "geolocation.toml")
    data = tf.simulate(system, members=20, duration="200").dataset
    assert np.isfinite(data["image_corrected.nis"].values).all()
    assert rss(data, "image_corrected") < 0.05
    assert 1.4 < np.nanmean(data["image_corrected.nees"].values) < 2.6
