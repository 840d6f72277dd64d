"""Error of an inertial navigator: against matrices typed by hand, and against two flights."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import chi2

from terrafix.models.core.batch import over_members
from terrafix.models.filters.error_state import ErrorState, rotation, vector
from terrafix.models.filters.inertial import INERTIAL, TRANSITIONS, inertial_process
from terrafix.models.filters.process import propagate
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.quaternion import rotation_matrix_array
from terrafix.models.motion.strapdown import EARTHS, from_level

STATE = ErrorState(*INERTIAL, vector("altimeter_bias", 1, unit="m"))
DECAYS = {
    "accel_bias_b": ("accel_time", "accel_sigma"),
    "gyro_bias_b": ("gyro_time", "gyro_sigma"),
    "altimeter_bias": ("altimeter_time", "altimeter_sigma"),
}
GIVEN = {
    "delta_v_b": np.array([0.03, 0.01, -0.098]),  # [m/s] in 10 ms
    "delta_theta_b": np.array([2e-4, 5e-4, 1e-3]),  # [rad]
    "velocity_random_walk": 1e-3,
    "angle_random_walk": 2e-3,  # coarse, so that it shows in velocity within a step
    "accel_time": 300.0,
    "accel_sigma": 3e-3,
    "gyro_time": 200.0,
    "gyro_sigma": 5e-6,
    "altimeter_time": 100.0,
    "altimeter_sigma": 0.8,
}
DT = 0.01
PLACES = STATE.places


def start(earth):
    """Values 47 degrees north, banked in a turn."""
    make = over_members(
        lambda a, b, h, v, rph: tuple(from_level(a, b, h, v, rph, earth)), (), (), (), (3,), (3,)
    )
    motion = make(0.82, 0.15, 1000.0, [50.0, 49.0, -2.0], [0.5, 0.05, 0.8])
    biases = (np.array([5e-3, -2e-3, 3e-3]), np.array([1e-5, 2e-5, -1e-5]), np.array([0.5]))
    return dict(zip([b.name for b in STATE], (*motion, *biases), strict=True))


def symbolic_step(earth, transition="closed"):
    """A step of the estimate as a function of its values: values, transition, noise."""
    values = {b.name: ca.SX.sym(b.name, b.value_size) for b in STATE}
    process = inertial_process(STATE, earth, decays=DECAYS, transition=transition)
    moved = propagate(STATE, process, values, GIVEN, DT, 0.0)
    results = [*(moved.values[n] for n in values), moved.transition, moved.spread]
    return ca.Function("step", [*values.values()], [ca.SX(r) for r in results])


def built(earth, transition="closed"):
    """The same of arrays by name."""
    function = symbolic_step(earth, transition)

    def step(at):
        *end, phi, Q = (r.full() for r in function(*at.values()))
        return dict(zip(at, (e.ravel() for e in end), strict=True)), phi, Q

    return step


def typed(earth, at):
    """A and G S G' of the docstring, in NumPy: rates at the start of the step."""

    def cross(v):
        return np.cross(v, np.eye(3)).T

    rate = EARTH.rotation_rate if earth == "wgs84" else 0.0
    C = rotation_matrix_array(at["q_be"]).T
    f = C @ (GIVEN["delta_v_b"] / DT - at["accel_bias_b"])
    w = cross(np.array([0, 0, rate]))
    A, noise = np.zeros((2, 16, 16))
    r, v, q, a, g, h = (PLACES[b.name] for b in STATE)
    if earth == "wgs84":
        up = at["r_e"] / np.linalg.norm(at["r_e"])
        pull = EARTH.mu / np.linalg.norm(at["r_e"]) ** 3
        A[v, r] = pull * (3 * np.outer(up, up) - np.eye(3)) - w @ w
    A[r, v], A[v, v], A[v, q] = np.eye(3), -2 * w, -cross(f)
    A[v, a], A[q, q], A[q, g] = -C, -w, -C
    for place, name in ((a, "accel"), (g, "gyro"), (h, "altimeter")):
        time, sigma = GIVEN[f"{name}_time"], GIVEN[f"{name}_sigma"]
        A[place, place] = -np.eye(place.stop - place.start) / time
        noise[place, place] = 2 * sigma**2 / time * np.eye(place.stop - place.start)
    noise[v, v] = GIVEN["velocity_random_walk"] ** 2 * np.eye(3)
    noise[q, q] = GIVEN["angle_random_walk"] ** 2 * np.eye(3)
    return A, noise


def blocks(matrix):
    """Every block by its names."""
    return {(i, j): matrix[PLACES[i], PLACES[j]] for i in PLACES for j in PLACES}


@pytest.mark.parametrize("earth", EARTHS)
@pytest.mark.parametrize("transition", TRANSITIONS)
def test_the_transition_is_the_exponential_of_the_printed_equations(earth, transition):
    """Block by block to 2e-3 of its size: half the turn of a step, 6e-4 rad, times its neighbors.

    Position by gyro bias is left out: of the third order in h. The gradient of gravity is that of
    a sphere, 1 percent from that of the oblate Earth.
    """
    at = start(earth)
    phi = built(earth, transition)(at)[1]
    expected = expm(typed(earth, at)[0] * DT)
    for name, block in blocks(expected).items():
        share = 1e-2 if name == ("v_e", "r_e") else 2e-3
        if name != ("r_e", "gyro_bias_b"):
            np.testing.assert_allclose(
                blocks(phi)[name],
                block,
                rtol=0,
                atol=share * np.abs(block).max() + 1e-12,
                err_msg=str(name),
            )


@pytest.mark.parametrize("earth", EARTHS)
def test_the_noise_is_van_loans(earth):
    """To 2e-3 of the sigmas, but for what the biases' noise of a step does within that step."""
    at = start(earth)
    A, noise = typed(earth, at)
    n = len(A)
    big = expm(np.block([[-A, noise], [np.zeros((n, n)), A.T]]) * DT)
    expected = big[n:, n:].T @ big[:n, n:]
    Q = built(earth)(at)[2]
    np.testing.assert_allclose(Q, Q.T, rtol=0, atol=1e-30)
    assert np.linalg.eigvalsh(Q / np.sqrt(np.outer(np.diag(Q), np.diag(Q)))).min() > -1e-14
    driven = {("accel_bias_b", "r_e"), ("accel_bias_b", "v_e"), ("gyro_bias_b", "q_be")}
    driven |= {("gyro_bias_b", "v_e"), ("gyro_bias_b", "r_e")}
    sigma = np.sqrt(np.diag(expected))
    for name, block in blocks(expected / np.outer(sigma, sigma)).items():
        if name not in driven and name[::-1] not in driven:
            found = blocks(Q / np.outer(sigma, sigma))[name]
            np.testing.assert_allclose(found, block, rtol=0, atol=2e-3, err_msg=str(name))


@pytest.mark.parametrize("earth", EARTHS)
@pytest.mark.parametrize("transition", TRANSITIONS)
def test_small_errors_grow_as_the_transition_says(earth, transition):
    """A minute in a turn: two flights that differ by little, and the product of the transitions."""
    step = symbolic_step(earth, transition)
    error = np.concatenate(
        [[1.0, -2.0, 1.5, 0.02, 0.03, -0.01], [2e-5, -1e-5, 3e-5], [1e-4] * 3, [1e-6] * 3, [0.1]]
    )
    x, e = (ca.SX.sym(n, s) for n, s in (("x", sum(b.value_size for b in STATE)), ("e", 16)))
    ends = np.cumsum([0] + [b.value_size for b in STATE])
    split = {b.name: x[ends[k] : ends[k + 1]] for k, b in enumerate(STATE)}
    off = ca.Function("off", [x, e], [ca.vertcat(*STATE.retract(split, e).values())])
    y = ca.SX.sym("y", x.numel())
    other = {b.name: y[ends[k] : ends[k + 1]] for k, b in enumerate(STATE)}
    apart = ca.Function("apart", [y, x], [STATE.difference(other, split)])

    def moved(flat):
        *end, phi, _ = step(*ca.vertsplit(flat, ends.tolist()))
        return ca.vertcat(*end), phi

    (ahead, phi), (behind, _) = moved(x), moved(y)
    both = ca.Function("both", [ca.vertcat(x, y, e)], [ca.vertcat(ahead, behind, phi @ e)])
    estimate = np.concatenate([*start(earth).values()])
    truth = off(estimate, error).full().ravel()
    flown = both.fold(6000)(np.concatenate([estimate, truth, error])).full().ravel()
    estimate, truth, error = np.split(flown, [x.numel(), 2 * x.numel()])
    found = apart(truth, estimate)
    for place in PLACES.values():
        size = np.abs(error[place]).max()
        np.testing.assert_allclose(
            found.full().ravel()[place], error[place], rtol=0, atol=2e-3 * size
        )


def test_a_state_that_begins_otherwise_is_refused():
    turned = ErrorState(*INERTIAL[:2], rotation("q_be", side="left"), *INERTIAL[3:])
    with pytest.raises(ValueError, match="begins with r_e, v_e, q_be, accel_bias_b, gyro_bias_b"):
        inertial_process(turned)
    with pytest.raises(ValueError, match="transition must be one of"):
        inertial_process(STATE, transition="exact")
    with pytest.raises(ValueError, match="earth must be one of"):
        inertial_process(STATE, "round")


@pytest.mark.parametrize("earth", EARTHS)
def test_drift_is_as_large_as_its_covariance_says(earth):
    """Increments with noise and biases, 100 members, 6 s: NEES of 15 within 99.9 percent."""
    n, members, dt = 150, 100, 0.04
    state = ErrorState(*INERTIAL)
    parameters = {"velocity_random_walk": 1e-2, "angle_random_walk": 1e-4, "t": 30.0}
    sigmas = {"accel_bias_b": 0.02, "gyro_bias_b": 1e-4}
    P0 = np.diag(np.repeat([3.0, 0.1, 1e-3, 0.02, 1e-4], 3) ** 2)
    inputs = {k: ca.SX.sym(k, 3) for k in ("delta_v_b", "delta_theta_b")}
    x = {b.name: ca.SX.sym(b.name, b.value_size) for b in state}
    P = ca.SX.sym("P", 15, 15)
    process = inertial_process(
        state, earth, decays={name: ("t", f"{name}_sigma") for name in sigmas}
    )
    given = inputs | parameters | {f"{k}_sigma": v for k, v in sigmas.items()}
    moved = propagate(state, process, x, given, dt, 0.0)
    ends = [moved.values[k] for k in x]
    step = ca.Function("step", [*x.values(), P, *inputs.values()], [*ends, moved.covariance(P)])
    e, y = ca.SX.sym("e", 15), {k: ca.SX.sym(f"{k}_y", s.numel()) for k, s in x.items()}
    retract = ca.Function("r", [*x.values(), e], [*state.retract(x, e).values()])
    apart = ca.Function("d", [*y.values(), *x.values()], [state.difference(y, x)])

    rng = np.random.default_rng(17)
    at = start(earth)
    truth = [np.tile(at[k][:, None], members) for k in x]
    error = np.sqrt(np.diag(P0))[:, None] * rng.standard_normal((15, members))
    flown = [r.full() for r in retract.map(members)(*truth, -error)]
    # the biases of the truth are walked here, and begin where they are drawn
    biases = [truth[3], truth[4]]
    P = np.tile(P0, members)
    ideal = {k: np.tile(dt / DT * GIVEN[k][:, None], members) for k in inputs}
    quiet = [np.zeros((3, members))] * 2
    for _ in range(n):
        truth = [r.full() for r in step.map(members)(*truth[:3], *quiet, P, *ideal.values())[:3]]
        noisy = []
        for k, (name, walk) in enumerate(
            zip(inputs, ("velocity_random_walk", "angle_random_walk"), strict=True)
        ):
            white = parameters[walk] * np.sqrt(dt) * rng.standard_normal((3, members))
            noisy.append(ideal[name] + dt * biases[k] + white)
        *flown, P = (r.full() for r in step.map(members)(*flown, P, *noisy))
        kept = np.exp(-dt / parameters["t"])
        biases = [
            kept * b + s * np.sqrt(1 - kept**2) * rng.standard_normal((3, members))
            for b, s in zip(biases, sigmas.values(), strict=True)
        ]
    off = apart.map(members)(*truth, *biases, *flown).full().T
    each = P.reshape(15, members, 15).transpose(1, 0, 2)
    nees = np.einsum("mi,mij,mj->m", off, np.linalg.inv(each), off)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 15 * members) / members
    assert low < nees.mean() < high
    ratio = off.std(axis=0) / np.sqrt(np.diagonal(each, axis1=1, axis2=2)).mean(axis=0)
    assert np.all(np.abs(ratio - 1) < 0.28)  # four standard errors of a sigma
