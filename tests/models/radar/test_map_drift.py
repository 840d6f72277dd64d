"""Map drift: known errors of velocity and of acceleration, and what it must not find."""

import numpy as np
import pytest

from terrafix.models.radar import lit_ground
from terrafix.models.radar.aperture_image import aperture_image
from terrafix.models.radar.map_drift import map_drift

ERRORS = [-2.0, -0.5, 0.1, 0.5, 2.0]  # [m/s]


@pytest.fixture(scope="module")
def own(aircraft):
    t, r, axis = aircraft.track()
    return t, r, axis


@pytest.fixture(scope="module")
def points_echo(aircraft, own):
    rng = np.random.default_rng(5)
    p = np.stack([rng.uniform(-60, 60, 60), rng.uniform(-110, 110, 60), np.zeros(60)], axis=1)
    return aircraft.point_echo(p, aircraft.aperture(*own), snr_db=10.0, strength=100.0)


def found(aircraft, echo, own, error, **options):
    """Map drift of a navigator that is faster than it is by an error."""
    t, r, axis = own
    seen = aircraft.seen_by(echo, t, r + np.outer(t, [error, 0, 0]), axis)
    return map_drift(seen.domain, seen.speed, **options), seen


@pytest.mark.parametrize("error", ERRORS)
def test_the_velocity_of_points_is_found_within_two_centimeters_per_second(
    error, aircraft, points_echo, own
):
    """In three rounds at most; the focused peak is 0.99 of what the true velocity gives."""
    drift, seen = found(aircraft, points_echo, own, error)
    assert drift.accepted
    assert drift.n_rounds <= 3
    assert drift.velocity == pytest.approx(aircraft.SPEED, abs=0.02)
    peaks = [
        np.abs(aperture_image(seen, v).image.valid).max() for v in (drift.velocity, aircraft.SPEED)
    ]
    assert peaks[0] > 0.99 * peaks[1]


@pytest.mark.parametrize("error", [-2.0, 0.1, 2.0])
def test_the_velocity_over_clutter_is_found_within_a_tenth(error, aircraft, land_echo, own):
    drift, _ = found(aircraft, land_echo, own, error)
    assert drift.accepted
    assert drift.velocity == pytest.approx(aircraft.SPEED, abs=0.1)


def test_too_large_a_velocity_shifts_the_looks_as_the_paper_says(aircraft, points_echo, own):
    """Eq. (14): half the aperture times (V^2 / V_hat^2 - 1), a negative shift; one round finds it
    but for second order, 4 to 10 % of the error."""
    drift, _ = found(aircraft, points_echo, own, 1.0, rounds=1)
    assert drift.velocity == pytest.approx(aircraft.SPEED, abs=0.1)
    assert abs(drift.velocity - aircraft.SPEED) < abs(
        found(aircraft, points_echo, own, 1.0, rounds=1, looks="band")[0].velocity - aircraft.SPEED
    )


def test_halves_of_the_doppler_band_are_no_looks_of_an_aperture_shorter_than_the_beam(
    aircraft, land_echo, own
):
    """An error of 0.5 m/s is found by halves of time, and made worse by halves of the band."""
    by_time, _ = found(aircraft, land_echo, own, 0.5)
    by_band, _ = found(aircraft, land_echo, own, 0.5, looks="band")
    assert abs(by_time.velocity - aircraft.SPEED) < 0.1
    assert abs(by_band.velocity - aircraft.SPEED) > 0.5


def test_a_field_without_features_is_refused(aircraft, field_echo, own):
    """The navigator keeps its velocity; a chance peak of some thousand values is 4 to 5 sigma."""
    for error in (0.0, 0.5):
        drift, seen = found(aircraft, field_echo, own, error)
        assert not drift.accepted
        assert drift.velocity == seen.speed


def test_with_two_scatterers_in_a_cell_a_field_is_not_featureless(aircraft, own, monkeypatch):
    """The trap of simulation: map drift "works" where there is nothing to see."""
    monkeypatch.setattr(lit_ground, "FEWEST", 1.0)
    echo = aircraft.echo_of(aircraft.FIELD, aircraft.aperture(*own), 3, points=False, per_cell=1.5)
    drift, _ = found(aircraft, echo, own, 0.5)
    assert drift.accepted
    assert drift.velocity == pytest.approx(aircraft.SPEED, abs=0.1)


@pytest.mark.parametrize("error", [0.03, -0.03])
def test_an_error_of_acceleration_looks_like_one_of_velocity(error, aircraft, land_echo, own):
    """R / 2V is 11.2 s: 0.03 m/s^2 (truth less estimate) along the sight give -0.335 m/s."""
    t, r, axis = own
    sight = np.array([0.0, 1200.0, aircraft.HEIGHT])
    sight /= np.linalg.norm(sight)
    drifts = []
    for a in (0.0, error):
        seen = aircraft.seen_by(land_echo, t, r - 0.5 * np.outer(t * t, a * sight), axis)
        drifts.append(map_drift(seen.domain, seen.speed).velocity)
    assert drifts[1] - drifts[0] == pytest.approx(-11.16 * error, abs=0.03)
