"""Echo of short apertures: against a chirp received sample by sample, and in its powers."""

from dataclasses import replace

import numpy as np
import pytest

from terrafix.models.radar.aperture import LitGround, pulse_echo
from terrafix.models.radar.aperture_image import aperture_image
from terrafix.models.radar.chirp import SPEED_OF_LIGHT, range_compressed
from terrafix.models.radar.scene import brightness


def test_the_echo_of_a_point_is_that_of_a_chirp_received_sample_by_sample(aircraft):
    """Within 1.5 % of its peak: of impulses shared between cells a quarter as large."""
    t, r, axis = aircraft.track(acceleration=(0.5, 1.0, -1.0), n=41)
    own = aircraft.aperture(t, r, axis)
    p = np.array([3.0, 13.7, 0.0])
    echo = aircraft.point_echo(p[None], own)
    radar = aircraft.RADAR
    raw = np.zeros((len(t), aircraft.N_CELLS + 2 * radar.n_pulse), np.complex64)
    delay = 2 * aircraft.NEAR / SPEED_OF_LIGHT + np.arange(raw.shape[1]) / radar.sample_rate
    R = np.linalg.norm(p - r, axis=1)
    gain = (1 - (((p - r) * axis).sum(axis=1) / R / own.null) ** 2) ** 3
    for k in range(len(t)):
        u = delay - 2 * R[k] / SPEED_OF_LIGHT
        inside = (u >= 0) & (u < radar.pulse_length)
        u = u[inside] - radar.pulse_length / 2
        cycles = 0.5 * radar.chirp_rate * u**2 - 2 * (R[k] - R[own.middle]) / radar.wavelength
        raw[k, inside] = gain[k] * np.exp(2j * np.pi * cycles)
    expected = range_compressed(raw, radar)[:, : aircraft.N_CELLS]
    expected *= np.vdot(expected[20], echo[20]) / np.vdot(expected[20], expected[20])
    assert np.abs(echo).max() == pytest.approx(1.0, abs=0.05)
    assert np.abs(echo - expected).max() < 0.015


def test_clutter_and_noise_have_the_power_they_are_said_to_have(aircraft, field_echo, points):
    """Of a unit point's peak at the beam's center: clutter its brightness, noise a tenth.

    A point that is seen by the whole aperture has the mean of the pattern over 2.6 deg, 0.95. Power
    of some thousand cells is known to 3 %; a tenth is allowed for the noise's band, which is not
    matched to a point.
    """
    t, r, axis = aircraft.track()
    own = aircraft.aperture(t, r, axis)

    def image(echo):
        return aperture_image(aircraft.seen_by(echo, t, r, axis)).image

    unit = points.Peak(image(aircraft.point_echo(np.zeros((1, 3)), own)).data).height / 0.95
    noise = pulse_echo([], own, aircraft.SUMS, np.random.default_rng(3), snr_db=10.0)
    assert (np.abs(image(noise).valid) ** 2).mean() / unit**2 == pytest.approx(0.1, rel=0.1)
    seen = image(field_echo)
    middle = slice(seen.rows.start + 200, seen.rows.stop - 200), slice(100, 220)
    power = (np.abs(seen.data[middle]) ** 2).mean() / (0.95 * unit) ** 2
    level = float(brightness(np.array(aircraft.HEIGHT / aircraft.RANGE)))
    assert power - 0.1 / 0.95**2 == pytest.approx(level, rel=0.1)


def test_a_scene_is_lit_to_the_left_as_to_the_right(aircraft):
    """The swath of the other side; its clutter is heard in the same cells."""
    t, r, axis = aircraft.track()
    sides = [
        LitGround(aircraft.FIELD, aircraft.GROUND, aircraft.aperture(t, r, axis, side))
        for side in (1, -1)
    ]
    assert sides[0].across == pytest.approx(sides[1].across)
    assert (sides[0].out + sides[1].out) == pytest.approx(0.0)


def test_what_cannot_be_received_is_refused(aircraft):
    t, r, axis = aircraft.track()
    own = aircraft.aperture(t, r, axis)
    with pytest.raises(ValueError, match="2 scatterers in a resolution cell give the echo a tex"):
        LitGround(aircraft.FIELD, aircraft.GROUND, own).clutter(np.random.default_rng(0), 2.0)
    slow = replace(aircraft.RADAR, prf=300.0, doppler_bandwidth=200.0)
    with pytest.raises(
        ValueError, match=r"a beam of 5\.0 deg holds 391 Hz of Doppler at 70\.0 m/s"
    ):
        replace(own, radar=slow, t=2 * t, r=2 * r - r.mean(axis=0))
    with pytest.raises(ValueError, match="looks to side 1"):
        replace(own, side=0)
    with pytest.raises(ValueError, match="1/600 s apart"):
        replace(own, t=t + np.where(t > 0, 0.01, 0.0))
    with pytest.raises(ValueError, match="is not above the ground"):
        LitGround(aircraft.FIELD, aircraft.GROUND, replace(own, r=r + np.array([0, 0, 1100.0])))
    with pytest.raises(ValueError, match="does not reach the ground, 3000 m below"):
        LitGround(aircraft.FIELD, aircraft.GROUND, replace(own, r=r - np.array([0, 0, 2000.0])))
