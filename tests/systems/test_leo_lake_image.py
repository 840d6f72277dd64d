"""The lake through rendered images: what is measured in them is as good as it says."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import terrafix as tf
from terrafix.models.filters.lake import MOMENTS

ROOT = Path(__file__).parents[2]
IMAGE = ROOT / "examples" / "leo_lake_image.toml"
MEMBERS = 5
EVERY = [(f"{n}.period", "1 s") for n in ("camera", "imager", "moments", "correct", "evaluation")]


def flown(outline, *settings, members=MEMBERS, **options):
    told = [("lakes.file", str(outline)), ("case", "T1"), *EVERY, *settings]
    system = tf.read_system(IMAGE, told)
    system.record("told", [system.find("moments")[n] for n in ("fix", "clear")], period="1")
    return tf.simulate(system, members=members, **options)


@pytest.fixture(scope="module")
def seen(outline):
    return flown(outline)


@pytest.mark.campaign
def test_moments_of_images_are_those_of_the_outline_within_their_noise(outline, seen):
    """Against the contour's own moments, of the same members: 5 by 7 images, six each."""
    told = [("lakes.file", str(outline)), ("case", "T1"), *EVERY]
    exact = tf.read_system(IMAGE, told)
    exact.replace("moments", tf.components.contour_moments(rate=tf.Rate("1")))
    exact.remove("imager")
    exact.connect("camera.contour", "moments.contour")
    exact.record("told", [exact.find("moments")["fix"]], period="1")
    truth = tf.simulate(exact, members=MEMBERS).dataset["moments.fix.y"].values[1:]
    y, R = (seen.dataset[f"moments.fix.{n}"].values[1:] for n in ("y", "R"))
    error = (y - truth).reshape(-1, len(MOMENTS))
    squared = np.einsum("ki,kij,kj->k", error, np.linalg.inv(R.reshape(-1, 6, 6)), error)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(error)) / len(error)
    assert low < squared.mean() < high
    # the area without bias, to 0.05 %
    assert abs(error[:, 0].mean()) < 5e-4 * truth[..., 0].mean()


def test_it_is_consistent_through_images(seen):
    nees = seen.dataset["evaluation.nees"].values
    low, high = chi2.ppf([0.0005, 0.9995], 3 * MEMBERS) / MEMBERS
    assert low < nees[-1].mean() < high
    error = np.linalg.norm(seen.dataset["evaluation.position_error"].values[-1], axis=1)
    assert np.median(error) < 60.0


def test_clouds_at_the_shore_make_no_fix(outline):
    cloudy = flown(outline, ("imager.clouds", "0.5"), members=3)
    clear = cloudy.dataset["moments.clear"].values[1:]
    fixes = np.isfinite(cloudy.dataset["evaluation.accepted"].values[1:])
    assert clear.mean() < 0.5
    np.testing.assert_array_equal(fixes, clear > 0)


def test_a_member_alone_sees_the_same_image(outline):
    together = flown(outline, members=3, duration="2")
    alone = flown(outline, members=[2], duration="2")
    name = "evaluation.position_error"
    np.testing.assert_array_equal(together.dataset[name].values[:, 2], alone.dataset[name][:, 0])


def test_images_without_water_are_said_once_with_the_first_one_s_reason(outline, caplog):
    """Water as bright as land."""
    result = flown(outline, ("imager.water", "0.25"), members=2, duration="2")
    assert not result.evaluation.get("fixes")
    (said,) = [r.getMessage() for r in caplog.records if r.name.startswith("terrafix")]
    assert said.startswith(
        "'moments' made no fix of 4 images: 4 show no water, 0 the shore behind clouds\n"
        "  the first without: an image shows water, 6 standard deviations or more darker than land"
    )
