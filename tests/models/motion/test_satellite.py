"""A satellite under forces of choice: against brahe, its conserved quantities, its maneuvers."""

import brahe
import brahe_reference
import numpy as np
import pytest

from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import earth_fixed_from_inertial_array
from terrafix.models.motion.gravity_field import SHIPPED, shipped_field
from terrafix.models.motion.kepler import circular_orbit
from terrafix.models.motion.maneuvers import Maneuver
from terrafix.models.motion.orbit import orbit_model
from terrafix.models.motion.satellite import Forces, satellite_model

RATE = EARTH.rotation_rate
PUSHED = {"radiation_coefficient": 1.3 * brahe_reference.COEFFICIENT}
SUN, MOON = brahe.ThirdBody.SUN, brahe.ThirdBody.MOON
START = {"mu": EARTH.mu, "radius": EARTH.radius, "j2": EARTH.j2, "rotation_rate": RATE}


@pytest.fixture(scope="module")
def orbit():
    brahe_reference.use_tables()
    return circular_orbit(7.07e6, 3.986004415e14, np.radians(98.0))


def advanced(model, states, n, step, **given):
    """States after `n` steps of a model without inputs."""
    function = model.step_function()
    names = [*model.states, *model.parameters]
    known = {"pole": np.zeros(2), "r0_e": np.zeros(3), "v0_e": np.zeros(3), "earth_angle0": 0.0}
    known |= START | states | given
    for k in range(1, n + 1):
        values = [np.asarray(known[name]) for name in names]
        results = function.call([*values, step, k * step])
        states = [np.asarray(x.full()).ravel() for x in results[len(model.outputs) :]]
        known |= dict(zip(model.states, states, strict=True))
    outputs = dict(
        zip(model.outputs, (np.asarray(x.full()).ravel() for x in results), strict=False)
    )
    return {name: known[name] for name in model.states}, outputs


@pytest.mark.parametrize(
    ("degree", "ours", "theirs"),
    [
        (20, {}, {}),
        (20, {"sun": True}, {"bodies": [SUN]}),
        (20, {"moon": True}, {"bodies": [MOON]}),
        (20, {"tide": True}, {"tide": True}),
        (20, {"radiation": True}, {"srp": True}),
        (
            20,
            dict.fromkeys(("sun", "moon", "tide", "radiation"), True),
            {"bodies": [SUN, MOON], "tide": True, "srp": True},
        ),
        (70, {}, {}),
    ],
    ids=["20x20", "Sun", "Moon", "tide", "radiation", "all", "70x70"],
)
def test_ten_minutes_against_brahe(orbit, degree, ours, theirs):
    """Same coefficients, Earth orientation, Sun and Moon; theirs is integrated to 1e-12.

    The field alone is 1.5 km from the two-body orbit by then, the Sun 2 m, the Moon 5 m, the tide
    10 cm, radiation 3 cm.
    """
    forces = Forces(shipped_field().cut(degree), **ours)
    step = 4.0
    end = brahe_reference.flown(forces, *orbit, 600.0, step, **PUSHED)
    (expected,) = brahe_reference.propagated(
        *orbit, [600.0], degree=degree, field=SHIPPED, **theirs
    )
    assert np.linalg.norm(end[:3] - expected[:3]) < 5e-4
    assert np.linalg.norm(end[3:] - expected[3:]) < 1e-6


def test_it_is_the_orbit_of_the_other_type(start_i):
    """Integrated in Earth-fixed axes about z, or in inertial ones: J2, a minute at 10 Hz."""
    r_i, v_i = start_i
    r_e, v_e = earth_fixed_from_inertial_array(r_i, v_i, 0.4, RATE)
    _, found = advanced(satellite_model(), {"r_e": r_e, "v_e": v_e}, 600, 0.1, earth_angle0=0.4)
    model = orbit_model()
    states = {"r_i": r_i, "v_i": v_i}
    for k in range(1, 601):
        outputs, states = model.advance(**states, **START, earth_angle0=0.4, step=0.1, time=0.1 * k)
    for name, atol in (("r_i", 1e-7), ("v_i", 1e-10), ("r_e", 1e-7), ("v_e", 1e-10)):
        np.testing.assert_allclose(found[name], outputs[name], rtol=0, atol=atol)


def test_the_pole_is_where_the_tables_say():
    """The rotation vector is w (x, -y, 1): a body at rest in space moves so in Earth-fixed axes."""
    x, y = 1.3e-6, -2.1e-6
    r = np.array([7e6, 1e5, 2e6])
    omega = RATE * np.array([x, -y, 1])
    _, found = advanced(
        satellite_model(Forces("two-body")),
        {"r_e": r, "v_e": -np.cross(omega, r)},
        1,
        1e-6,
        pole=[x, y],
        mu=0.0,
    )
    np.testing.assert_allclose(found["v_i"], 0.0, atol=1e-12)


def test_the_constant_of_jacobi_is_conserved(orbit):
    """v^2/2 - |w x r|^2/2 - U of a field that turns uniformly, six orbits at 10 s steps."""
    field = shipped_field().cut(8)
    model = satellite_model(Forces(field))
    r_e, v_e = orbit[0], orbit[1] - np.cross([0, 0, RATE], orbit[0])

    def potential(r):
        """By brahe's coefficients and SciPy's functions: independent of how it is flown."""
        from scipy.special import assoc_legendre_p_all

        distance = np.linalg.norm(r)
        p = assoc_legendre_p_all(8, 8, r[2] / distance)[0]
        total = 0.0
        for n in range(9):
            for m in range(n + 1):
                norm = np.sqrt(
                    (2 - (m == 0)) * (2 * n + 1) / np.prod(np.arange(n - m + 1.0, n + m + 1))
                )
                longitude = np.arctan2(r[1], r[0])
                wave = field.C[n, m] * np.cos(m * longitude) + field.S[n, m] * np.sin(m * longitude)
                total += (field.radius / distance) ** n * norm * (-1) ** m * p[n, m] * wave
        return field.mu / distance * total

    def jacobi(r, v):
        return v @ v / 2 - RATE**2 * (r[0] ** 2 + r[1] ** 2) / 2 - potential(r)

    states, errors = {"r_e": r_e, "v_e": v_e}, []
    for _ in range(48):
        states, _ = advanced(model, states, 74, 10.0)
        errors.append(abs(jacobi(states["r_e"], states["v_e"]) - jacobi(r_e, v_e)))
    # of 2.8e7 m^2/s^2, while the field beyond J2 does 1e2 m^2/s^2 of work on the way: it swings
    # with the square of the step, and does not grow
    assert max(errors[:24]) < 0.04
    assert max(errors[24:]) < 0.04


def test_a_step_back_leads_back(orbit):
    """Symmetric: what remains is the error of Runge-Kutta's method, of order five."""
    model = satellite_model(Forces(shipped_field().cut(8)))
    start = {"r_e": orbit[0], "v_e": orbit[1] - np.cross([0, 0, RATE], orbit[0])}
    there, _ = advanced(model, start, 1, 10.0)
    back, _ = advanced(model, there, 1, -10.0)
    np.testing.assert_allclose(back["r_e"], start["r_e"], rtol=0, atol=2e-6)
    np.testing.assert_allclose(back["v_e"], start["v_e"], rtol=0, atol=2e-9)


def test_the_split_is_of_order_two_and_small(orbit):
    """Halving the step divides the error by four; at 10 s it is millimeters after 10 min."""
    model = satellite_model(Forces(shipped_field().cut(20)))
    start = {"r_e": orbit[0], "v_e": orbit[1] - np.cross([0, 0, RATE], orbit[0])}
    ends = {h: advanced(model, start, round(600 / h), h)[0]["r_e"] for h in (10.0, 5.0, 1.25)}
    coarse, fine = (np.linalg.norm(ends[h] - ends[1.25]) for h in (10.0, 5.0))
    assert 3.5 < coarse / fine < 7
    assert coarse < 1e-2


def test_derivatives_are_those_of_the_flow(orbit):
    """What model exchange integrates, and what a step does: equal in the limit of short steps."""
    model = satellite_model(Forces(shipped_field().cut(8)))
    start = {"r_e": orbit[0], "v_e": orbit[1] - np.cross([0, 0, RATE], orbit[0])}
    known = start | START | {"pole": np.zeros(2), "r0_e": np.zeros(3), "v0_e": np.zeros(3)}
    function = model.rate_function()
    values = [known.get(n, 0.0) for n in [*model.states, *model.parameters]]
    rates = function.call([*values, 0.0, 0.0])[len(model.outputs) :]
    ahead, _ = advanced(model, start, 1, 0.5)
    behind, _ = advanced(model, start, 1, -0.5)
    for name, rate in zip(model.derivatives, rates, strict=True):
        slope = (ahead[name] - behind[name]) / 1.0
        # the third derivative leaves (n h)^2 / 6 of it
        expected = np.asarray(rate.full()).ravel()
        np.testing.assert_allclose(slope, expected, rtol=0, atol=3e-3)


def test_the_velocity_in_inertial_space_goes_on_where_the_rotation_is_published_anew():
    model = satellite_model(Forces("two-body"), surrounded=True, told=True)
    function = model.step_function()
    before, now = RATE * np.array([1e-6, 2e-6, 1.0]), RATE * np.array([3e-6, 0.0, 1.0 + 1e-8])
    r, v = np.array([7e6, 1e5, 2e6]), np.array([-200.0, 7000.0, 900.0])
    given = {"surroundings.omega_e": now, "surroundings.q_ei": [0, 0, 0, 1.0]}
    given |= {"r_e": r, "v_e": v, "omega_e": before}
    sizes = [*model.inputs.items(), *model.states.items(), *model.parameters.items()]
    values = [np.asarray(given.get(n, np.zeros(s.numel()))) for n, s in sizes]
    results = function.call([*values, 1e-7, 1e-7])
    v_e = np.asarray(results[3].full()).ravel()
    np.testing.assert_allclose(v_e + np.cross(now, r), v + np.cross(before, r), atol=1e-9)
    assert np.linalg.norm(v_e - v) > 5e-4


def burned(maneuvers, duration, step, orbit):
    model = satellite_model(Forces("two-body", maneuvers=maneuvers))
    states = {
        "r_e": orbit[0],
        "v_e": orbit[1] - np.cross([0, 0, RATE], orbit[0]),
        "felt_v_e": np.zeros(3),
    }
    function = model.step_function()
    names = [*model.states, *model.parameters]
    known = {"pole": np.zeros(2), "r0_e": np.zeros(3), "v0_e": np.zeros(3), "earth_angle0": 0.0}
    known |= START | states
    felt = []
    for k in range(1, round(duration / step) + 1):
        results = function.call([np.asarray(known[n]) for n in names] + [step, k * step])
        shaped = [np.asarray(x.full()).ravel() for x in results]
        known |= dict(zip(model.states, shaped[len(model.outputs) :], strict=True))
        felt.append(shaped[list(model.outputs).index("delta_v_e")])
    return shaped[0], shaped[1], np.array(felt)


def test_an_impulse_changes_the_orbit_as_kepler_says(orbit):
    """One along the track raises the other side: da = 2 a dv / v; it is felt once, whole."""
    r, v, felt = burned((Maneuver(1.0, 0.0, (0.0, 1.0, 0.0)),), 3.0, 0.5, orbit)
    mu = EARTH.mu

    def axis(r, v):
        return 1 / (2 / np.linalg.norm(r) - v @ v / mu)

    speed, a = np.linalg.norm(orbit[1]), axis(*orbit)
    # vis-viva of the speed after it
    expected = 1 / (2 / np.linalg.norm(orbit[0]) - (speed + 1.0) ** 2 / mu)
    assert axis(r, v) - a == pytest.approx(expected - a, rel=2e-6)
    sizes = np.linalg.norm(felt, axis=1)
    assert sizes.max() == pytest.approx(1.0, abs=1e-9)
    assert np.flatnonzero(sizes > 1e-9).tolist() == [2]


def test_a_burn_does_not_depend_on_how_the_steps_lie_to_it(orbit):
    """11 s of thrust, in steps of 0.1 s and of 4 s: the same orbit after 20 s, felt whole."""
    burn = (Maneuver(2.3, 11.0, (0.5, 2.0, -1.0)),)
    ends = [burned(burn, 20.0, step, orbit) for step in (0.1, 4.0)]
    np.testing.assert_allclose(ends[0][0], ends[1][0], rtol=0, atol=2e-3)
    np.testing.assert_allclose(ends[0][1], ends[1][1], rtol=0, atol=2e-4)
    idle = (Maneuver(2.3, 11.0, (0.0, 0.0, 0.0)),)
    coast, _, nothing = burned(idle, 20.0, 0.1, orbit)
    assert np.abs(nothing).max() == 0.0
    assert np.linalg.norm(ends[0][0] - coast) == pytest.approx(
        np.linalg.norm([0.5, 2.0, -1.0]) * (20.0 - 2.3 - 5.5), rel=1e-2
    )
    for _, _, felt in ends:
        assert np.linalg.norm(felt, axis=1).sum() == pytest.approx(
            np.linalg.norm([0.5, 2.0, -1.0]), rel=1e-5
        )


def test_drag_is_felt_in_the_axes_at_the_end():
    """-rho CdA/m v^2 / 2 along the velocity relative to the air, over a step."""
    model = satellite_model(Forces("j2", drag="exponential"))
    r, v = np.array([7.078137e6, 0.0, 0.0]), np.array([0.0, 1000.0, 7400.0])
    air = {"density": 1e-12, "density_height": 700e3, "scale_height": 90e3}
    _, outputs = advanced(
        model,
        {"r_e": r, "v_e": v, "felt_v_e": np.zeros(3)},
        1,
        0.1,
        ballistic_coefficient=0.02,
        **air,
    )
    expected = -0.5 * 1e-12 * 0.02 * np.linalg.norm(v) * v * 0.1
    np.testing.assert_allclose(outputs["delta_v_e"], expected, rtol=3e-4, atol=5e-12)


def test_what_cannot_be():
    with pytest.raises(ValueError, match="need the surroundings"):
        satellite_model(Forces(sun=True))
    with pytest.raises(ValueError, match='goes with gravity = "harmonics"'):
        Forces(tide=True)
    with pytest.raises(ValueError, match="drag must be one of"):
        Forces(drag="air")
    with pytest.raises(ValueError, match="wind must be one of"):
        Forces(wind="west")
    with pytest.raises(ValueError, match="gravity must be one of"):
        Forces("j3")
    with pytest.raises(ValueError, match="before the run"):
        Maneuver(-1.0, 0.0, (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="a duration is not negative"):
        Maneuver(1.0, -1.0, (0.0, 0.0, 0.0))
    model = satellite_model(Forces(maneuvers=(Maneuver(1.0, 0.0, (0.0, 1.0, 0.0)),)))
    assert not model.derivatives, "an impulse has no derivative: model exchange cannot have it"
