"""Recorded tracks: what is read and refused, splines against closed forms, coordinated attitude."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from terrafix.models.core.batch import over_members
from terrafix.models.geometry.geodesy import ecef
from terrafix.models.geometry.quaternion import angle_between_array
from terrafix.models.motion.gravity import STANDARD_GRAVITY
from terrafix.models.motion.strapdown import EARTHS, Motion, from_level, level_view
from terrafix.models.motion.track import SmoothTrack, follow_array, read_track

LATITUDE, LONGITUDE, SPEED, RATE = np.radians(47.0), np.radians(8.0), 60.0, np.radians(3.0)
PLACE = "time,latitude,longitude,height"
MERIDIAN, PARALLEL = 6369000.0, 4357000.0  # [m] for a radian, there

see = {
    e: over_members(
        lambda r, v, q, e=e: tuple(level_view(Motion(r, v, q), e, (LATITUDE, LONGITUDE)).values()),
        *((3,), (3,), (4,)),
    )
    for e in EARTHS
}
place = {
    e: over_members(
        lambda a, b, h, v, rph, e=e: tuple(from_level(a, b, h, v, rph, e, (LATITUDE, LONGITUDE))),
        *((), (), (), (3,), (3,)),
    )
    for e in EARTHS
}


def circle(t):
    """Places in degrees of a level turn to the right, 3 deg/s at 60 m/s, first north."""
    radius = SPEED / RATE
    north, east = radius * np.sin(RATE * t), radius * (1 - np.cos(RATE * t))
    latitude, longitude = LATITUDE + north / MERIDIAN, LONGITUDE + east / PARALLEL
    return np.degrees(latitude), np.degrees(longitude), np.full_like(t, 800.0)


def table(t, *columns, names=PLACE):
    rows = np.column_stack([t, *columns])
    return "\n".join([names, *(",".join(f"{x:.17g}" for x in row) for row in rows)]) + "\n"


@pytest.fixture
def write(tmp_path):
    def to_file(text):
        path = tmp_path / "track.csv"
        path.write_text(text)
        return path

    return to_file


@pytest.mark.parametrize("earth", EARTHS)
def test_a_circle_is_flown_with_the_bank_of_its_turn(write, earth):
    """atan(V rate / g) = 17.8 degrees, level, the nose ahead; speed to the spline's error.

    The chart's scales and the Earth's turning make a per mille of it.
    """
    t = np.arange(0.0, 61.0)
    smooth = SmoothTrack(read_track(write(table(t, *circle(t)))), earth)
    motion = smooth.at(np.array([20.25, 40.5]))
    _, _, height, v_n, angles = see[earth](*motion)
    np.testing.assert_allclose(height, 800.0, atol=0.05)
    np.testing.assert_allclose(np.linalg.norm(v_n, axis=1), SPEED, rtol=2e-3)
    bank = np.arctan(SPEED * RATE / STANDARD_GRAVITY)
    np.testing.assert_allclose(angles[:, 0], bank, rtol=5e-3)
    np.testing.assert_allclose(angles[:, 1], 0.0, atol=1e-3)
    np.testing.assert_allclose(angles[:, 2], [RATE * 20.25, RATE * 40.5], atol=3e-3)


def test_the_spline_is_of_sixth_order(write):
    """The error of place between the rows falls by 2^6 as they come twice as close."""
    errors = []
    for h in (12.0, 6.0, 3.0):
        t = np.arange(0.0, 240.5, h)
        smooth = SmoothTrack(read_track(write(table(t, *circle(t)))))
        now = np.linspace(96.0, 144.0, 77)
        latitude, longitude, height = circle(now)
        truth = ecef(np.radians(latitude), np.radians(longitude), height)
        errors.append(np.linalg.norm(smooth.at(now).r_e - truth, axis=1).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > 5.5), errors


def test_a_track_that_is_flown_stays_on_its_spline(write):
    """By the trapezoidal rule, h^2 / 12 times the change of acceleration: 3e-5 m at 100 Hz."""
    t = np.arange(0.0, 31.0)
    smooth = SmoothTrack(read_track(write(table(t, *circle(t)))))
    n, dt = 3000, 0.01
    wanted = smooth.at(dt * np.arange(n + 1))
    r, v, q = wanted.r_e[0], wanted.v_e[0], wanted.q_be[0]
    for k in range(n):
        r, v, q, *_ = follow_array["wgs84"](r, v, q, wanted.v_e[k + 1], wanted.q_be[k + 1], dt)
    assert np.linalg.norm(r - wanted.r_e[-1]) < 3e-5
    assert angle_between_array(q, wanted.q_be[-1]) < 1e-12


@pytest.mark.parametrize("earth", EARTHS)
@pytest.mark.parametrize("kind", ["angles", "quaternion"])
def test_a_recorded_attitude_is_met_at_its_rows(write, earth, kind):
    t = np.arange(0.0, 20.0)
    angles = np.stack([10 * np.sin(t / 3), 2 * np.cos(t / 4), 350 + 3 * t], axis=-1)  # [deg]
    attitude, names = angles, f"{PLACE},roll,pitch,heading"
    if kind == "quaternion":  # of either sign
        attitude = Rotation.from_euler("xyz", angles, degrees=True).as_quat()
        attitude[::2] *= -1
        names = f"{PLACE},q_x,q_y,q_z,q_w"
    text = table(t, *circle(t), attitude, names=names)
    smooth = SmoothTrack(read_track(write(text)), earth)
    found = see[earth](*smooth.at(t))[4]
    off = np.degrees(found) - angles
    np.testing.assert_allclose((off + 180) % 360 - 180, 0.0, atol=1e-8)


def test_noise_of_places_is_smoothed_out(write):
    """Rows each second with 2 m of noise: the smooth track is nearer, and does not shake."""
    rng = np.random.default_rng(8)
    t = np.arange(0.0, 121.0)
    latitude, longitude, height = circle(t)
    sigma = 2.0
    noise = rng.normal(0, sigma, (3, len(t)))
    noisy = (
        latitude + np.degrees(noise[0] / MERIDIAN),
        longitude + np.degrees(noise[1] / PARALLEL),
        height + noise[2],
    )
    track = read_track(write(table(t, *noisy)))
    smooth, through = SmoothTrack(track, "wgs84", sigma), SmoothTrack(track)
    truth = ecef(np.radians(latitude), np.radians(longitude), height)
    inner = slice(10, -10)
    error = (smooth.at(t).r_e - truth)[inner]
    assert np.sqrt(np.mean(error**2)) < 0.6 * sigma
    residual = np.linalg.norm(smooth.at(t).r_e - through.at(t).r_e) / np.sqrt(3 * len(t))
    assert residual == pytest.approx(sigma, rel=0.15)
    np.testing.assert_allclose(np.linalg.norm(smooth.at(t).v_e[inner], axis=1), SPEED, atol=3.0)


GOOD = [[float(t), 47.0 + 5e-4 * t, 8.0, 500.0] for t in range(12)]


def rows(change):
    """The good track with one row changed, as a file."""
    changed = [list(row) for row in GOOD]
    change(changed)
    return "time,latitude,longitude,height\n" + "".join(
        ",".join(str(x) for x in row) + "\n" for row in changed
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        (
            "time,lat,lon,height\n",
            r"has the columns time, lat, lon, height\n  a track has time, lat",
        ),
        (rows(lambda r: r.__delitem__(slice(3, None))), "has 3 rows; a track has 6 or more"),
        (rows(lambda r: r[5].__setitem__(0, 3.5)), "line 7: time 3.5 s does not come after 4 s"),
        (rows(lambda r: r[5].__setitem__(0, 4.0)), "line 7: time 4 s does not come after 4 s"),
        (rows(lambda r: r[2].__setitem__(3, "nan")), "line 4: height is 'nan', not a number"),
        (rows(lambda r: r[2].__setitem__(3, "high")), "line 4: height is 'high', not a number"),
        (rows(lambda r: r[2].pop()), "line 4: 3 numbers for 4 columns"),
        (rows(lambda r: r[2].__setitem__(1, 91.0)), "line 4: latitude 91, longitude 8 is no place"),
    ],
)
def test_tables_that_are_no_track_are_refused(write, text, said):
    with pytest.raises(ValueError, match=said):
        read_track(write(text))


def test_an_attitude_that_is_no_rotation_is_refused(write):
    t = np.arange(8.0)
    q = np.tile([0.0, 0.0, 0.6, 0.8], (8, 1))
    q[4] = [0.0, 0.0, 0.6, 0.7]
    names = f"{PLACE},q_x,q_y,q_z,q_w"
    with pytest.raises(ValueError, match=r"line 6: the attitude is no rotation.* length 0\.922"):
        read_track(write(table(t, *circle(t), q, names=names)))
    names = f"{PLACE},roll,pitch,heading"
    angles = np.tile([0.0, 95.0, 0.0], (8, 1))
    with pytest.raises(ValueError, match="line 2: a pitch of 95 degrees is none"):
        read_track(write(table(t, *circle(t), angles, names=names)))


def test_a_step_in_the_track_is_refused_with_its_place_and_size(write):
    """150 m up at t = 6 s and back: 300 m/s^2, 150 m off; none with noise of 30 m."""
    text = rows(lambda r: r[6].__setitem__(3, 650.0))
    track = read_track(write(text))
    said = r"a step at line 8 \(t = 6 s\): it would take 300 m/s\^2, 150 m off its neighbors"
    with pytest.raises(ValueError, match=said):
        SmoothTrack(track)
    SmoothTrack(track, "flat", 30.0)


def test_a_step_in_the_attitude_is_refused(write):
    t = np.arange(8.0)
    angles = np.zeros((8, 3))
    angles[4:, 0] = 170.0
    angles[4:, 2] = 170.0
    names = f"{PLACE},roll,pitch,heading"
    fast = table(t / 10, *circle(t / 10), angles, names=names)
    with pytest.raises(ValueError, match=r"the attitude has a step at line 6 \(t = 0.4 s\)"):
        SmoothTrack(read_track(write(fast)))


def test_no_attitude_is_derived_at_rest(write):
    def halt(changed):
        for row in changed:
            row[1] = 47.0

    with pytest.raises(ValueError, match=r"the speed is .* no attitude can be derived below 5"):
        SmoothTrack(read_track(write(rows(halt))))
