"""Echo of short apertures: against a chirp received sample by sample, and in its powers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from terrafix.models.radar.aperture import Antenna, flown_aperture, require_lit
from terrafix.models.radar.aperture_image import aperture_image
from terrafix.models.radar.chirp import SPEED_OF_LIGHT, range_compressed
from terrafix.models.radar.lit_ground import LitGround
from terrafix.models.radar.pulse_echo import pulse_echo
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


def test_a_wall_along_the_track_casts_a_shadow(aircraft):
    """100 m high and 1200 m away, seen from 1000 m: to 1200 * 1000 / 900 m nothing is lit."""
    t, r, axis = aircraft.track()
    hills, middle = aircraft.HILLS, r.mean(axis=0)
    place = aircraft.GROUND.geodetic(middle + np.array([0.0, 1200.0, 0.0]))
    j = hills.longitude0 + hills.longitude_step * np.arange(hills.height.shape[1])
    wall = np.where(np.abs(j - place[1]) < 0.6 * hills.longitude_step, 100.0, 0.0)
    dem = replace(hills, height=np.tile(wall.astype(np.float32), (len(hills.height), 1)))
    scene = replace(aircraft.FIELD, dem=dem)
    lit = LitGround(scene, aircraft.GROUND, aircraft.aperture(t, r, axis))
    row = lit._surface[1][lit._surface[1].shape[0] // 2]
    dark = lit.across[0] + np.flatnonzero(row < -50)
    assert dark.max() == pytest.approx(1200.0 / 0.9, abs=8.0)
    assert dark.min() == pytest.approx(1205.0, abs=8.0)
    assert len(dark) > 0.9 * np.ptp(dark)


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


def level(n, heading=0.0, bank=0.0):
    """Attitude (n, 4) that turns: to body, from north, east, down; passive, scalar last."""
    angles = [[heading + 0.01 * k, 0.0, bank] for k in range(n)]
    # the rows of a passive matrix are the axes of the body, which is what scipy turns to
    return Rotation.from_euler("ZYX", angles).as_quat()


@pytest.mark.parametrize("side", [1, -1])
def test_an_antenna_lies_along_the_fuselage_and_its_squint_turns_the_beam_forward(side, aircraft):
    """A heading of 30 deg and a squint of 5: the beam's center is 5 deg forward of the wing."""
    t = np.arange(101) / 100
    r = np.outer(t, [60.6, 35.0, 0.0]) + np.array([0.0, 0.0, -1000.0])
    antenna = Antenna(aircraft.BEAM, side, np.radians(5.0))
    own = flown_aperture(
        aircraft.RADAR, antenna, t, r, level(101, np.radians(30.0)), near_range=1460.0, n_cells=320
    )
    assert len(own.t) == 600
    np.testing.assert_allclose(own.r, np.outer(own.t, [60.6, 35.0, 0.0]) + r[0], rtol=0, atol=1e-9)
    heading = np.radians(30.0) + own.t  # 0.01 rad each 0.01 s
    beam = heading + side * (np.pi / 2 - np.radians(5.0))
    center = np.stack([np.cos(beam), np.sin(beam), 0 * beam], axis=1)
    np.testing.assert_allclose((own.axis * center).sum(axis=1), 0.0, atol=1e-6)
    assert (own.axis @ [60.6, 35.0, 0.0] > 0).all()


def test_a_bank_that_lifts_the_beam_off_the_swath_is_refused(aircraft):
    t, r, axis = aircraft.track()
    own, antenna = aircraft.aperture(t, r, axis), Antenna(aircraft.BEAM)
    require_lit(antenna, own, aircraft.GROUND, 0.0, level(1)[0])
    # the right wing up by 20 deg: the swath, 37 to 43 deg below the horizon, is 57 to 63 below it
    with pytest.raises(ValueError, match="57 to 63 deg below the wings, and the beam lights 25 to"):
        require_lit(antenna, own, aircraft.GROUND, 0.0, level(1, bank=np.radians(-20.0))[0])
    turned = level(9)
    turned[4] *= 1.1
    with pytest.raises(ValueError, match=r"the attitude at 4\.000 s is no rotation"):
        flown_aperture(
            aircraft.RADAR, antenna, np.arange(9.0), r[:9], turned, near_range=1460.0, n_cells=320
        )
