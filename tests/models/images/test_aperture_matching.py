"""Matching of apertures: known errors of the navigator must come back, and chance must not."""

from dataclasses import replace

import numpy as np
import pytest

from terrafix.models.images import aperture_matching
from terrafix.models.images.aperture_matching import (
    NARROWEST,
    WIDEST,
    matched_aperture,
    search_reach,
)
from terrafix.models.radar.aperture_image import aperture_image
from terrafix.models.radar.map_drift import map_drift


@pytest.fixture(scope="module")
def track(aircraft):
    return aircraft.track()


@pytest.fixture(scope="module")
def earlier(aircraft, track):
    return aircraft.reference(aircraft.LAND, track[1].mean(axis=0), 21)


def image_of(aircraft, echo, track, dp=(0, 0, 0), dv=(0, 0, 0), **options):
    """Image of a navigator that errs (truth less estimate) by dp and dv in the middle."""
    t, r, axis = track
    seen = aircraft.seen_by(echo, t, r - np.asarray(dp) - np.outer(t, dv), axis, **options)
    return aperture_image(seen, map_drift(seen.domain, seen.speed).velocity)


def matched(image, *given):
    return matched_aperture(image.amplitude(), image.grid, *given)


def error(fix, track, image):
    """Measured less true z_r and z_c of the place that a fix is of."""
    away = fix.place - track[1].mean(axis=0)
    v = (track[1][-1] - track[1][0]) / (track[0][-1] - track[0][0])
    return fix.measured - [np.linalg.norm(away), -(v @ away) / image.line.speed]


@pytest.mark.parametrize(
    ("dp", "shift"), [((1, 0, 0), 1.0), ((0, 1, 0), -0.77), ((0, 0, 1), -0.64)]
)
def test_a_meter_north_east_and_down_moves_the_image(
    dp, shift, aircraft, land_echo, track, earlier
):
    """-1.00 m along (z_c is how far the antenna is ahead: +1.00), -0.77 and -0.64 m in range."""
    fixes = [
        matched(image_of(aircraft, land_echo, track, d), earlier, aircraft.HILLS.at)
        for d in ((0, 0, 0), dp)
    ]
    assert all(f.accepted for f in fixes)
    moved = fixes[1].residual - fixes[0].residual
    along = int(dp[0] == 1)
    assert moved[along] == pytest.approx(shift, abs=0.05)
    assert moved[1 - along] == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("dv", [(0, 0.1, 0), (0, 0, 0.1)])
def test_an_error_of_velocity_moves_the_image_by_the_whole_of_the_sight(
    dv, aircraft, land_echo, track, earlier
):
    """-(p_t - p)'/V: 1.7 m for 0.1 m/s east, 1.4 m for 0.1 m/s down, which the paper leaves out.

    An eastward error shears the image, too, by 0.4 m over the swath, and what holds it need not lie
    in its middle: 0.1 m.
    """
    image = image_of(aircraft, land_echo, track, dv=dv)
    fix = matched(image, earlier, aircraft.HILLS.at)
    assert fix.accepted
    expected = -np.asarray(dv) @ (fix.place - image.line.r) / aircraft.SPEED
    assert fix.residual[1] == pytest.approx(expected, abs=0.1)
    assert abs(error(fix, track, image)).max() < 0.1


def test_errors_are_within_what_the_covariance_claims(aircraft, land_echo, track):
    """Five earlier passes of speckle of their own, navigators off by 3 m and 0.1 m/s."""
    rng = np.random.default_rng(4)
    errors, claims = [], []
    for k in range(5):
        reference = aircraft.reference(aircraft.LAND, track[1].mean(axis=0), 50 + k)
        image = image_of(aircraft, land_echo, track, rng.normal(0, 3, 3), rng.normal(0, 0.1, 3))
        fix = matched(image, reference, aircraft.HILLS.at, NARROWEST, 9.0 * np.eye(2))
        assert fix.accepted
        errors.append(error(fix, track, image))
        claims.append(np.diag(fix.covariance))
    errors = np.sqrt(np.mean(np.square(errors), axis=0))
    assert errors[0] < 0.10  # across
    assert errors[1] < 0.12  # along
    # of one scene, whose points lie well or badly between the pixels: many are in the benchmark
    assert (errors / np.sqrt(np.mean(claims, axis=0)) < 1.25).all()


def test_who_is_unsure_of_his_place_claims_less(aircraft, land_echo, track, earlier):
    """By 1.3 % of it in range, (0.013 x 5 m)^2, and by 1.4 % along the track."""
    image = image_of(aircraft, land_echo, track)
    sure, unsure = (
        matched(image, earlier, aircraft.HILLS.at, NARROWEST, expected)
        for expected in (np.zeros((2, 2)), np.diag([25.0, 25.0]))
    )
    np.testing.assert_allclose(
        unsure.covariance - sure.covariance, np.diag([0.065**2, 0.07**2]), atol=1e-15
    )


@pytest.mark.parametrize("dp", [(-200.0, 20.0, 10.0), (150.0, -30.0, 20.0)])
def test_a_navigator_that_is_lost_by_two_hundred_meters_is_found(dp, aircraft, land_echo, track):
    """Within 3 m; what is left comes of blaming position for the rest."""
    wide = aircraft.reference(aircraft.LAND, track[1].mean(axis=0), 31, length=520.0)
    image = image_of(aircraft, land_echo, track, dp)
    fix = matched(image, wide, aircraft.HILLS.at, WIDEST)
    assert fix.accepted
    assert np.abs(error(fix, track, image)).max() < 3.0


def test_a_field_without_features_gives_no_fix(aircraft, field_echo, track):
    """None of 10 earlier passes: chance gives 3 to 4.5 times the rms, the gate is 7."""
    image = image_of(aircraft, field_echo, track)
    for seed in range(10):
        reference = aircraft.reference(aircraft.FIELD, track[1].mean(axis=0), seed)
        fix = matched(image, reference, aircraft.FIELD.dem.at)
        assert not fix.accepted
        assert fix.reason == "correlation has no peak that stands out"
        assert fix.quality < 5.5


def test_points_alone_are_found_by_amplitude_and_not_by_its_logarithm(aircraft, track, monkeypatch):
    """Negative control: a logarithm gives sixty points no more weight than the speckle about."""
    bare = replace(aircraft.FIELD, points_per_km2=600.0, points_db=25.0, detail=10)
    own = aircraft.aperture(*track)
    echo = aircraft.echo_of(bare, own, 5)
    reference = aircraft.reference(bare, track[1].mean(axis=0), 6)
    image = image_of(aircraft, echo, track, (1.0, -2.0, 1.0))
    fix = matched(image, reference, bare.dem.at)
    assert fix.accepted
    assert np.abs(error(fix, track, image)).max() < 0.3
    amplitude = aperture_matching.contrast

    def logarithm(image, *args, **options):
        floor = 1e-3 * image.mean()
        return amplitude(10 + np.log(np.maximum(image, floor)), *args, **options)

    monkeypatch.setattr(aperture_matching, "contrast", logarithm)
    by_logarithm = matched(image, reference, bare.dem.at)
    assert by_logarithm.quality < 0.5 * fix.quality


def test_another_place_is_refused(aircraft, land_echo, track, earlier):
    image = image_of(aircraft, land_echo, track)
    far = track[1].mean(axis=0) + np.array([150.0, 0, 0])
    elsewhere = aircraft.reference(aircraft.LAND, far, 1, length=150.0)
    fix = matched(image, elsewhere, aircraft.HILLS.at)
    assert fix.reason == "too little of it lies on the reference"
    mirrored = replace(earlier, amplitude=np.ascontiguousarray(earlier.amplitude[:, ::-1]))
    assert not matched(image, mirrored, aircraft.HILLS.at).accepted


def test_a_search_holds_three_sigma_and_no_less_than_its_floor():
    assert search_reach(np.diag([1.0, 4.0])) == NARROWEST
    assert search_reach(np.diag([5.0**2, 30.0**2])) == pytest.approx((90.0, 15.0))
    assert search_reach(np.diag([1e4, 1e6])) == WIDEST
