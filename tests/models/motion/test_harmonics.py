"""Gravity fields: the file's format, and the acceleration of spherical harmonics."""

import brahe
import casadi as ca
import numpy as np
import pytest

from terrafix.models.core.batch import over_members
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.gravity import j2_acceleration
from terrafix.models.motion.gravity_field import SHIPPED, read_gfc, shipped_field
from terrafix.models.motion.harmonics import harmonic_acceleration, harmonics_beyond_j2

SMALL = """Any words stand here.
begin_of_head
product_type gravity_field
modelname small
earth_gravity_constant 0.3986004415D+15
radius 0.63781363E+07
max_degree 2
norm fully_normalized
tide_system zero_tide
end_of_head ====
gfc 0 0 1.0d0 0.0d0
gfc 2 0 -0.484165D-03 0.0
gfc 2 1 -2.0e-10 1.4e-09
gfc 2 2 2.4e-06 -1.4e-06
"""
POLES = [[0, 0, 7e6], [0, 0, -7e6], [1e-3, 0, 7e6], [7e6, 0, 0], [0, 7e6, 0]]


def evaluated(expression, r):
    return over_members(expression, (3,))(np.asarray(r, float))


@pytest.fixture(scope="module")
def oracle():
    return brahe.GravityModel.from_file(str(SHIPPED))


@pytest.fixture(scope="module")
def places():
    """Above all of the Earth, from 120 km to geostationary orbits, the poles among them."""
    rng = np.random.default_rng(18)
    directions = rng.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return np.vstack([directions * rng.uniform(6.5e6, 4.3e7, (60, 1)), POLES])


@pytest.mark.parametrize("degree", [2, 8, 20, 36, 70])
def test_against_brahe(oracle, places, degree):
    """Brahe sums by Clenshaw's rule, we by columns: they agree to rounding."""
    field = shipped_field().cut(degree)
    ours = evaluated(lambda r: harmonic_acceleration(r, field), places)
    theirs = np.array(
        [
            brahe.accel_gravity_spherical_harmonics(p, np.eye(3), oracle, degree, degree)
            for p in places
        ]
    )
    error = np.linalg.norm(ours - theirs, axis=1) / np.linalg.norm(theirs, axis=1)
    assert error.max() < 1e-14


def test_the_parts_are_the_whole(places):
    field = shipped_field().cut(8)
    whole = evaluated(lambda r: harmonic_acceleration(r, field), places)
    parts = evaluated(lambda r: harmonics_beyond_j2(r, field), places)
    parts += evaluated(lambda r: j2_acceleration(r, field.mu, field.radius, field.j2), places)
    np.testing.assert_allclose(parts, whole, rtol=1e-14, atol=1e-15)


def test_the_gradient_is_symmetric_and_without_trace():
    """Gravity is the gradient of a harmonic function (Laplace), also at the poles."""
    r = ca.SX.sym("r", 3)
    g = harmonic_acceleration(r, shipped_field().cut(12))
    gradient = ca.Function("gradient", [r], [ca.jacobian(g, r)])
    for place in [*POLES, [-1104646.3, -6096830.4, 3395727.4]]:
        G = gradient(place).full()
        size = np.abs(G).max()
        np.testing.assert_allclose(G, G.T, atol=1e-14 * size)
        assert abs(np.trace(G)) < 1e-14 * size


def test_the_shipped_field_is_egm2008():
    """Numbers of Pavlis et al. (2012), table 3: C20 tide-free, and constants of the model."""
    field = shipped_field()
    assert field.max_degree == 70
    assert field.tide_system == "tide_free"
    assert (field.mu, field.radius) == (3.986004415e14, 6378136.3)
    assert field.C[2, 0] == -0.484165143790815e-03
    assert field.j2 == pytest.approx(EARTH.j2, rel=1e-6)
    assert str(field.cut(20)) == "EGM2008 to degree 20 (tide-free)"


def test_tide_systems_as_brahe_converts_them(tmp_path):
    """C20 of a zero-tide field, made tide-free: the permanent tide is not counted twice."""
    for tide in ("zero_tide", "mean_tide", "tide_free"):
        path = tmp_path / f"{tide}.gfc"
        path.write_text(SMALL.replace("zero_tide", tide))
        theirs = brahe.GravityModel.from_file(str(path))
        theirs.convert_tide_system(theirs.tide_system, brahe.GravityModelTideSystem.TideFree)
        ours = read_gfc(path).without_permanent_tide()
        assert ours.C[2, 0] == pytest.approx(theirs.get(2, 0)[0], rel=1e-15, abs=0)
        assert ours.tide_system == "tide_free"


def test_a_small_file(tmp_path):
    path = tmp_path / "small.gfc"
    path.write_text(SMALL)
    field = read_gfc(path)
    assert (field.name, field.tide_system, field.max_degree) == ("small", "zero_tide", 2)
    assert field.mu == 3.986004415e14
    assert field.C[2].tolist() == [-0.484165e-3, -2e-10, 2.4e-6]
    assert field.S[2].tolist() == [0.0, 1.4e-9, -1.4e-6]
    assert field.C[:2].tolist() == [[1, 0, 0], [0, 0, 0]]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("fully_normalized", "unnormalized", "coefficients of another normalization"),
        ("end_of_head", "end", "has no 'end_of_head'"),
        ("zero_tide", "no_tide", "tide_system is 'no_tide', none of"),
        ("radius 0.63781363E+07\n", "", "head has no 'radius'"),
        ("0.63781363E+07", "-1", "has -1 for radius, which must be positive"),
        ("0.63781363E+07", "six", "has 'six' for radius, not a number"),
        ("gfc 2 1 -2.0e-10 1.4e-09\n", "", "no coefficient of degree 2 and order 1"),
        ("gfc 2 1 -2.0e-10 1.4e-09", "gfc 2 1 -2.0e-10", "line 13 is damaged"),
        ("gfc 2 1", "gfct 2 1", "line 13 is 'gfct', of a field that changes in time"),
        ("gfc 2 1", "gfc 3 1", "has degree 3, order 1"),
        ("gfc 2 1", "gfx 2 1", "'gfx', where 'gfc' was expected"),
    ],
)
def test_files_that_are_refused(tmp_path, old, new, message):
    path = tmp_path / "bad.gfc"
    path.write_text(SMALL.replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_gfc(path)


def test_degrees_that_are_not_there():
    with pytest.raises(ValueError, match="EGM2008 has degrees 2 to 70"):
        shipped_field().cut(71)
    with pytest.raises(ValueError, match="EGM2008 has degrees 2 to 70"):
        shipped_field().cut(1)


def test_an_unknown_tide_system_takes_no_tide(tmp_path):
    path = tmp_path / "unknown.gfc"
    path.write_text(SMALL.replace("tide_system zero_tide\n", ""))
    with pytest.raises(ValueError, match="does not say which permanent tide it holds"):
        read_gfc(path).without_permanent_tide()
