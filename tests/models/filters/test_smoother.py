"""The smoother: equal to batch least squares where all is linear, and on rotations consistent."""

import numpy as np
import pytest

from terrafix.models.filters.error_state import ErrorState, considered, rotation, vector
from terrafix.models.filters.smoother import Estimates, smooth

RNG = np.random.default_rng(31)


def linear_run(*, n_steps=30, every=3, n_members=4):
    """A car under white acceleration, filtered by the textbook: its records, and the problem."""
    F = np.array([[1.0, 0.5], [0.0, 1.0]])
    Q = 0.3 * np.array([[0.5**3 / 3, 0.5**2 / 2], [0.5**2 / 2, 0.5]])
    H, R, P0 = np.array([[1.0, 0.2]]), 0.7, np.diag([9.0, 4.0])
    y = RNG.normal(size=(n_steps + 1, n_members)) * 3
    x, P = np.zeros((n_members, 2)), P0
    records = {name: [] for name in ("prior", "P-", "posterior", "P+", "phi", "since")}
    phi, since = np.eye(2), 0
    for k in range(n_steps + 1):
        if k:
            x, P, phi = x @ F.T, F @ P @ F.T + Q, F @ phi
        rows = (x, np.tile(P, (n_members, 1, 1)), phi, since)
        for name, value in zip(("prior", "P-", "phi", "since"), rows, strict=True):
            records[name].append(value)
        if k and k % every == 0:
            K = P @ H.T / (H @ P @ H.T + R)
            x = x + (y[k][:, None] - x @ H.T) @ K.T
            P = (np.eye(2) - K @ H) @ P
            phi, since = np.eye(2), k
        records["posterior"].append(x)
        records["P+"].append(np.tile(P, (n_members, 1, 1)))
    return {k: np.array(v, dtype=float) for k, v in records.items()}, (F, Q, H, R, P0, y, every)


def batch(F, Q, H, R, P0, y, every):
    """All states at once: weighted least squares of the prior, every step and every measurement."""
    n = len(y)
    rows, values, weights = [], [], []

    def add(blocks, value, covariance):
        row = np.zeros((len(covariance), 2 * n))
        for k, block in blocks:
            row[:, 2 * k : 2 * k + 2] = block
        W = np.linalg.inv(np.linalg.cholesky(covariance))
        rows.append(W @ row)
        values.append(W @ value)
        weights.append(W)

    members = y.shape[1]
    add([(0, np.eye(2))], np.zeros((2, members)), P0)
    for k in range(1, n):
        add([(k, np.eye(2)), (k - 1, -F)], np.zeros((2, members)), Q)
        if k % every == 0:
            add([(k, H)], y[k][None], np.array([[R]]))
    A, b = np.vstack(rows), np.vstack(values)
    P = np.linalg.inv(A.T @ A)
    return (P @ A.T @ b).T.reshape(members, n, 2).transpose(1, 0, 2), P


STATE = ErrorState(vector("r", 1), vector("v", 1))


def estimates(x, P):
    return Estimates({"r": x[..., :1], "v": x[..., 1:]}, P)


def test_it_is_the_batch_least_squares_solution():
    """At every fix, the start and the end; in between there is none."""
    records, problem = linear_run()
    found = smooth(
        STATE,
        np.arange(31.0),
        estimates(records["prior"], records["P-"]),
        estimates(records["posterior"], records["P+"]),
        np.repeat(records["phi"][:, None], 4, axis=1),
        np.repeat(records["since"][:, None], 4, axis=1),
    )
    x, P = batch(*problem)
    nodes = np.arange(0, 31, 3)
    smoothed = np.concatenate([found.values["r"], found.values["v"]], axis=2)
    np.testing.assert_allclose(smoothed[nodes], x[nodes], rtol=1e-9, atol=1e-9)
    for k in nodes:
        own = P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        np.testing.assert_allclose(found.P[k, 0], own, rtol=1e-9, atol=1e-12)
    assert np.isnan(np.delete(smoothed, nodes, axis=0)).all()


def test_a_member_without_a_fix_goes_on_to_its_next():
    """One of two members refuses the fix at step 6: its transition counts from step 3."""
    records, problem = linear_run(n_members=2)
    full = smooth(
        STATE,
        np.arange(31.0),
        estimates(records["prior"], records["P-"]),
        estimates(records["posterior"], records["P+"]),
        np.repeat(records["phi"][:, None], 2, axis=1),
        np.repeat(records["since"][:, None], 2, axis=1),
    )
    since = np.repeat(records["since"][:, None], 2, axis=1)
    phi = np.repeat(records["phi"][:, None], 2, axis=1)
    F = problem[0]
    for k in (7, 8, 9):
        since[k, 1], phi[k, 1] = 3, np.linalg.matrix_power(F, k - 3)
    found = smooth(
        STATE,
        np.arange(31.0),
        estimates(records["prior"], records["P-"]),
        estimates(records["posterior"], records["P+"]),
        phi,
        since,
    )
    assert np.isnan(found.values["r"][6, 1])
    assert np.isfinite(found.values["r"][3, 1])
    np.testing.assert_array_equal(found.values["r"][:, 0], full.values["r"][:, 0])


def test_what_is_known_exactly_stays_as_it_is():
    """A constant without variance: a prior that is singular, and of other units by 1e12."""
    records, _ = linear_run()
    state = ErrorState(*STATE, vector("known", 1))

    def with_constant(x, P):
        wide = np.zeros((*P.shape[:2], 3, 3))
        wide[..., :2, :2] = P * np.array([[1, 1e-12], [1e-12, 1e-24]])
        values = {"r": x[..., :1], "v": 1e-12 * x[..., 1:]}
        return Estimates(values | {"known": np.full_like(x[..., :1], 7.0)}, wide)

    phi = np.zeros((31, 4, 3, 3))
    phi[..., :2, :2] = records["phi"][:, None] * np.array([[1, 1e12], [1e-12, 1]])
    phi[..., 2, 2] = 1
    since = np.repeat(records["since"][:, None], 4, axis=1)
    found = smooth(
        state,
        np.arange(31.0),
        with_constant(records["prior"], records["P-"]),
        with_constant(records["posterior"], records["P+"]),
        phi,
        since,
    )
    plain = smooth(
        STATE,
        np.arange(31.0),
        estimates(records["prior"], records["P-"]),
        estimates(records["posterior"], records["P+"]),
        phi[..., :2, :2] / np.array([[1, 1e12], [1e-12, 1]]),
        since,
    )
    np.testing.assert_allclose(found.values["r"], plain.values["r"], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(found.values["v"], 1e-12 * plain.values["v"], rtol=1e-8, atol=1e-21)
    nodes = np.isfinite(found.values["r"])
    np.testing.assert_array_equal(found.values["known"][nodes], 7.0)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_rotation_is_smoothed_on_its_side(side):
    """A turn of 0.2 rad about z that is learned later: the start turns by it, too.

    The variance is the same before and after the step, so that the gain is one, and the later one
    becomes that of the start, brought about the prior and back.
    """
    state = ErrorState(rotation("q", side=side))
    turn = lambda angle: np.array([0, 0, np.sin(angle / 2), np.cos(angle / 2)])  # noqa: E731
    identity, s2 = turn(0.0), 0.01
    prior = Estimates(
        {"q": np.array([[identity], [identity]])}, np.full((2, 1, 1, 1), s2) * np.eye(3)
    )
    posterior = Estimates(
        {"q": np.array([[identity], [turn(0.2)]])},
        np.array([[s2 * np.eye(3)], [s2 / 4 * np.eye(3)]]),
    )
    found = smooth(
        state,
        np.array([0.0, 1.0]),
        prior,
        posterior,
        np.tile(np.eye(3), (2, 1, 1, 1)),
        np.zeros((2, 1)),
    )
    np.testing.assert_allclose(found.values["q"][0, 0], turn(0.2), atol=1e-15)
    np.testing.assert_allclose(found.P[0, 0], s2 / 4 * np.eye(3), rtol=1e-12, atol=1e-18)


def test_what_is_considered_cannot_be_smoothed():
    state = ErrorState(vector("r", 1), considered(vector("b", 1)))
    empty = Estimates({}, np.zeros((0, 0, 2, 2)))
    with pytest.raises(ValueError, match="b is considered, not corrected"):
        smooth(state, np.zeros(0), empty, empty, np.zeros((0, 0, 2, 2)), np.zeros((0, 0)))


def test_blocks_are_read_as_they_are_written():
    state = ErrorState(vector("r_e"), rotation("q", side="right"), vector("b", 1))
    assert state.text == "r_e 3, q right, b 1"
    again = ErrorState.from_text(state.text)
    assert [(b.name, b.size, b.side) for b in again] == [
        ("r_e", 3, ""),
        ("q", 3, "right"),
        ("b", 1, ""),
    ]
    with pytest.raises(ValueError, match="'r_e three' is no block"):
        ErrorState.from_text("r_e three")
