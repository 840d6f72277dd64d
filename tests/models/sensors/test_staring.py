"""A camera that stares: signs, sizes and spread of the target's place in the frame."""

from dataclasses import astuple

import numpy as np
import pymap3d
import pytest

from terrafix.models.core.batch import over_members
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ecef
from terrafix.models.motion.elements import ELEMENTS, LOW_ORBIT, MOLNIYA_ORBIT
from terrafix.models.sensors.staring import (
    GEOMETRIES,
    ever_in_view,
    ground_view,
    line_of_sight_axes,
    nadir,
    off_nadir,
    staring_satellite_model,
    target_offset,
)

MU, RADIUS = 3.986e14, 6.378e6  # of the thesis [m^3/s^2], [m]
ORBITS = {  # elements, pixel, position and attitude sigma; sigma of orbit, attitude, both [px]
    "LEO": (LOW_ORBIT, 100.0, 500.0, 5e-4, 4.57, 3.00, 5.47),
    "MOL": (MOLNIYA_ORBIT, 1000.0, 50.0, 5e-5, 0.007, 1.947, 1.947),
}


def offset(geometry, pixel=100.0):
    """Pixels (..., 2) of positions, nominal positions, and pitch and roll."""

    def found(r, r_nominal, turned):
        values = {"r": r, "pitch": turned[0], "roll": turned[1]}
        given = {"pixel": pixel, "radius": RADIUS, "r_nominal": r_nominal}
        return target_offset(values, given | {"aim": nadir(r_nominal, geometry, RADIUS)}, geometry)

    return over_members(found, (3,), (3,), (2,))


nadir_array = over_members(lambda r: nadir(r, "wgs84"), (3,))


@pytest.mark.parametrize("name", ORBITS)
def test_the_target_is_as_uncertain_as_orbit_and_attitude_make_it(name):
    """One sigma per axis at t = 0: 5.47 px in the low orbit, 1.947 px in the high one."""
    orbit, pixel, position, attitude, by_orbit, by_attitude, both = ORBITS[name]
    r, _ = orbit.state(MU)
    f = offset("sphere", pixel)
    rng = np.random.default_rng(3)
    off, turned = rng.normal(0, position, (4000, 3)), rng.normal(0, attitude, (4000, 2))
    # 4000 draws of two axes: 1.1 percent each, four of these
    for got, want in (
        (f(r + off, r, [0, 0]), by_orbit),
        (f(r, r, turned), by_attitude),
        (f(r + off, r, turned), both),
    ):
        assert np.sqrt((got**2).mean()) == pytest.approx(want, rel=0.045, abs=1e-3)


@pytest.mark.parametrize("geometry", ["sphere", "wgs84"])
def test_of_a_satellite_too_far_north_the_target_lies_south(geometry):
    """Nominal minus true, north and east; a pitch of 1e-4 moves it by a ten thousandth of d_o."""
    r = np.array([7.0e6, 0.0, 0.0])
    f = offset(geometry)
    north, east = (
        f(r + np.array([0, 0, 700.0]), r, [0, 0]),
        f(r + np.array([0, 700.0, 0]), r, [0, 0]),
    )
    assert north[0] < -6.0
    assert abs(north[1]) < 1e-3
    assert east[1] < -6.0
    assert abs(east[0]) < 1e-3
    height = 7.0e6 - (RADIUS if geometry == "sphere" else EARTH.radius)
    np.testing.assert_allclose(f(r, r, [1e-4, -2e-4]), [height * 1e-6, -height * 2e-6], rtol=1e-9)


def test_on_the_ellipsoid_it_is_what_a_map_says():
    """Against pymap3d: east and north of the nominal nadir from the true one, to a millipixel."""
    r, _ = LOW_ORBIT.state(MU)
    true = r + np.array([300.0, -400.0, 250.0])
    here, there = (pymap3d.ecef2geodetic(*p, deg=False) for p in (true, r))
    east, north, _ = pymap3d.geodetic2enu(there[0], there[1], 0, here[0], here[1], 0, deg=False)
    np.testing.assert_allclose(
        offset("wgs84")(true, r, [0, 0]), [north / 100, east / 100], atol=1e-3
    )


def test_the_date_line_is_not_special():
    """A satellite on the other side of 180 degrees is a kilometer away, not the Earth around."""
    r = np.array([-7.0e6, 300.0, 0.0])
    np.testing.assert_allclose(
        offset("sphere")(r * [1, -1, 1], r, [0, 0]), [0.0, -600 * RADIUS / 7.0e8], rtol=1e-6
    )


def test_pointed_by_the_stars_at_the_nadir_it_sees_the_whole_shift():
    """Not levelled by the local vertical, it does not turn with the satellite about the Earth."""
    r = np.array([7.0e6, 0.0, 0.0])
    aim = np.array([EARTH.radius, 0.0, 0.0])
    angle = 1e-4

    def found(true, turned):
        values = {"r": true, "pitch": turned[0], "roll": turned[1]}
        given = {"r_nominal": r, "aim": aim, "pixel_angle": angle}
        return target_offset(values, given, "stars")

    f = over_members(found, (3,), (2,))
    distance = r[0] - aim[0]
    np.testing.assert_allclose(
        f(r + np.array([0, 0, 500]), [0, 0]), [-500 / distance / angle, 0], atol=1e-9
    )
    np.testing.assert_allclose(
        f(r + np.array([0, 500, 0]), [0, 0]), [0, -500 / distance / angle], atol=1e-9
    )
    np.testing.assert_allclose(f(r, [1e-4, 2e-4]), [1.0, 2.0], atol=1e-9)


def test_axes_of_a_line_of_sight_are_a_rotation_with_north_up():
    rng = np.random.default_rng(1)
    for _ in range(5):
        aim = ecef(*rng.uniform([-1, -3, 0], [1, 3, 1]))
        r = aim * 1.1 + rng.normal(0, 3e5, 3)
        axes = over_members(line_of_sight_axes, (3,), (3,))(r, aim)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert axes[0, 2] > 0.0
        assert axes[1, 2] == pytest.approx(0.0, abs=1e-12)
        # east, as seen from above: north x east points down, along the line of sight
        np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=1e-12)


def test_a_view_from_aside_foreshortens_by_the_angle_at_the_ground():
    """Seen 25 degrees off the nadir from 600 km: cos 27.5 along the slope, 1 across it."""
    aim = ecef(0.0, 0.0, 0.0)
    look, height = np.radians(25.0), 600e3
    sine = (EARTH.radius + height) / EARTH.radius * np.sin(look)
    ground = np.arcsin(sine)
    turn = ground - look  # about the center of the Earth
    r = (EARTH.radius + height) * np.array([np.cos(turn), np.sin(turn), 0.0])
    given = {"r_nominal": r, "aim": aim, "pixel_angle": 1e-4}
    view = over_members(lambda x: ground_view(x, given, "stars"), (3,))(r)
    distance = np.linalg.norm(aim - r)
    expected = np.diag([1.0, np.cos(ground)]) / (distance * 1e-4)
    np.testing.assert_allclose(view, expected, atol=2e-5 * expected[0, 0])
    angle = over_members(off_nadir, (3,), (3,))
    assert angle(r, aim) == pytest.approx(look, abs=1e-9)
    assert angle(-r, aim) == pytest.approx(np.pi)


def parameters(model, orbit, **others):
    zero = {name: np.zeros(s.shape[0]) for name, s in model.parameters.items()}
    told = dict(zip(ELEMENTS, astuple(orbit), strict=True))
    told |= {"mu": MU, "radius": RADIUS, "attitude_time": 600.0, "pixel": 100.0}
    told |= {"pixel_angle": 1e-4, "rotation_rate": EARTH.rotation_rate, **others}
    return {name: told.get(name, value) for name, value in zero.items()}


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_without_errors_the_target_stays_in_the_middle(geometry):
    model = staring_satellite_model(geometry)
    r, v = LOW_ORBIT.state(MU)
    states = {"r": r, "v": v, "r_nominal": r, "v_nominal": v}
    for _ in range(3):
        outputs, states = model.advance(
            **states, **parameters(model, LOW_ORBIT), step=1.0, **_clock(model)
        )
        np.testing.assert_allclose(outputs["target"], 0.0, atol=1e-7)


def _clock(model):
    return {} if model.time is None else {"time": 1.0}


def test_attitude_is_stationary_from_the_start():
    """Exact steps of any length keep sigma: 0.02865 deg, and 1/e is left after 600 s."""
    model = staring_satellite_model("sphere")
    given = parameters(model, LOW_ORBIT, attitude_sigma=5e-4)
    kept = model.advance(pitch=1.0, **given, step=600.0)[1]["pitch"]
    assert kept == pytest.approx(np.exp(-1.0))
    driven = model.advance(turn=[1.0, 0.0], **given, step=600.0)[1]["pitch"]
    assert np.hypot(kept * 5e-4, driven) == pytest.approx(5e-4)
    assert np.degrees(5e-4) == pytest.approx(0.02865, rel=1e-3)


def test_a_place_is_found_in_view_or_not():
    """Under the low orbit's apogee, and on the other side of the Earth."""
    model = staring_satellite_model("stars")
    r, _ = LOW_ORBIT.state(MU)
    latitude, longitude = np.arctan2(r[2], np.hypot(r[0], r[1])), np.arctan2(r[1], r[0])
    here = parameters(model, LOW_ORBIT, latitude=latitude, longitude=longitude)
    assert ever_in_view(model, here, 100.0)
    there = parameters(model, LOW_ORBIT, latitude=-latitude, longitude=longitude + np.pi)
    assert not ever_in_view(model, there, 100.0)
    assert ever_in_view(model, there, 3600.0)  # half a revolution later


def test_a_geometry_that_is_none_is_refused():
    with pytest.raises(ValueError, match="geometry must be one of"):
        staring_satellite_model("flat")
