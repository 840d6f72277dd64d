"""Particles: weights in closed form, the Kalman filter where all is linear, two peaks."""

import casadi as ca
import numpy as np
import pytest

from terrafix.models.filters import particles as module
from terrafix.models.filters.error_state import ErrorState, clone, rotation, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.particles import (
    Cloud,
    Particles,
    effective_number,
    kernel_width,
    normalized_weights,
    systematic,
)
from terrafix.models.filters.process import Process

STATE = ErrorState(vector("r", 2, unit="m"), vector("v", 2, unit="m/s"))
PROCESS = Process(rates=lambda x, _, w, __: {"r": x["v"], "v": w["a"]}, noise={"a": ("psd", 2)})
PSD = 0.5
ELEMENTS = {"a": "m", "b": "m"}


def draws(rng, k, n_particles, n):
    """What a component gives: normals and uniform numbers of a trial."""
    return lambda _: rng.normal(size=(k, n_particles, n)), lambda _: rng.random(k)


# -------------------------------------------------------------------------------- weights


def test_resampling_keeps_a_particle_as_often_as_its_weight_says():
    """Within one of N w, each; and N w on the average over u."""
    rng = np.random.default_rng(1)
    weights, _ = normalized_weights(rng.normal(size=(5, 40)))
    found = np.stack([
        np.stack([np.bincount(kept, minlength=40) for kept in systematic(weights, u)])
        for u in (np.arange(200)[:, None] + 0.5) / 200 * np.ones(5)
    ])  # fmt: skip
    assert (np.abs(found - 40 * weights) < 1).all()
    np.testing.assert_allclose(found.mean(axis=0), 40 * weights, atol=0.01)  # of 200 values of u


def test_what_is_not_a_number_has_no_weight():
    weights, some = normalized_weights(np.array([[0, np.nan, np.log(3)], [np.nan] * 3]))
    np.testing.assert_allclose(weights, [[0.25, 0, 0.75], [1 / 3] * 3])
    assert some.tolist() == [True, False]
    np.testing.assert_allclose(effective_number(weights), [1.6, 3.0])


def test_the_width_of_kernels_is_silverman_s():
    """(4 / (3 N))^(1/5) in one dimension: 1.06 N^(-1/5)."""
    assert kernel_width(1, 1000) == pytest.approx(1.0592 * 1000**-0.2, rel=1e-4)


@pytest.mark.parametrize("taken", [0.0, 0.97])
def test_without_kernels_weights_are_those_of_the_likelihood(taken, monkeypatch):
    """An angle beyond half a turn, an absent element, a mapped error; in one part, and in many.

    In many parts no particle moves, since it has no kernel: their product is the likelihood.
    """
    monkeypatch.setattr(module, "TAKEN", taken)
    monkeypatch.setattr(module, "RESAMPLED", 0.0)
    monkeypatch.setattr(module, "SMALLEST", 2.0**-4)
    observation = Observation(
        lambda x, given: ca.vertcat(
            ca.atan2(x["r"][1], x["r"][0]), given["scale"] * x["v"][0] * given["p"], x["v"][1]
        ),
        {"bearing": "rad", "b": "m", "c": "m/s"},
        fields=[vector("p", 1)],
        mapped={"p": "D"},
        angles=["bearing"],
        parameters={"scale": 1},
    )
    particles = Particles(STATE, PROCESS, observation)
    rng, k, n = np.random.default_rng(2), 3, 300
    r = np.array([-20.0, 0]) + 4 * rng.normal(size=(k, n, 2))
    v = 1 + rng.normal(size=(k, n, 2))
    cloud = Cloud({"r": r, "v": v}, np.zeros((k, n, 4, 4)), np.full((k, n), 1 / n))
    R = np.array([[0.04, 0.1, 9], [0.1, 4.0, 9], [9, 9, 1]])
    y, p, D, scale = np.array([3.1, 2.0, np.nan]), 1.3, 0.5, 2.0
    message = {"y": y, "p": [p], "R": R, "D": [[D]], "present": [1.0, 1, 0]}
    message = {name: np.tile(a, (k, *[1] * np.ndim(a))) for name, a in message.items()}
    before = {name: a.copy() for name, a in cloud.values.items()}
    effective, explained = particles.weighed(
        cloud, message, {"scale": np.full((k, 1), scale)}, *draws(rng, k, n, 4)
    )
    off = y[0] - np.arctan2(r[..., 1], r[..., 0])
    off = (off + np.pi) % (2 * np.pi) - np.pi
    residual = np.stack([off, y[1] - scale * v[..., 0] * p], axis=-1)
    S = np.tile(R[:2, :2], (k, n, 1, 1))
    S[..., 1, 1] += (scale * v[..., 0]) ** 2 * D
    square = np.einsum("kni,knij,knj->kn", residual, np.linalg.inv(S), residual)
    expected, _ = normalized_weights(-(square + np.log(np.linalg.det(S))) / 2)
    np.testing.assert_allclose(cloud.weights, expected, rtol=1e-9)
    assert explained.all()
    if not taken:
        np.testing.assert_allclose(effective, effective_number(expected), rtol=1e-9)
    for name, array in before.items():
        np.testing.assert_array_equal(cloud.values[name], array)


def test_with_kernels_weights_of_a_linear_measurement_are_exact(monkeypatch):
    """N(y; H x, H B H' + R), of kernels that differ, whatever was drawn; the kernels' part is kept.

    What was drawn has the covariance (1 - c) (I - K H) B about x + K r: of 400 particles alike, its
    variances are within 4 sqrt(2 / 400) = 0.28.
    """
    monkeypatch.setattr(module, "TAKEN", 0.0)
    monkeypatch.setattr(module, "RESAMPLED", 0.0)
    rng, k, n = np.random.default_rng(8), 2, 400
    B = rng.normal(size=(k, n, 4, 4)) * np.exp(rng.normal(size=(k, n, 1, 1)))
    B = B @ B.transpose(0, 1, 3, 2)
    r, v = rng.normal(size=(2, k, n, 2))
    r[1], v[1], B[1] = r[1, 0], v[1, 0], B[1, 0]  # all alike
    x = np.concatenate([r, v], axis=-1)
    cloud = Cloud({"r": r.copy(), "v": v.copy()}, B.copy(), np.full((k, n), 1 / n))
    R, y = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([0.7, -0.4])
    message = {"y": y, "R": R, "present": np.ones(2)}
    message = {name: np.tile(a, (k, *[1] * np.ndim(a))) for name, a in message.items()}
    Particles(STATE, PROCESS, LINEAR).weighed(cloud, message, {}, *draws(rng, k, n, 4))
    S, off = H @ B @ H.T + R, y - x @ H.T
    square = np.einsum("kni,knij,knj->kn", off, np.linalg.inv(S), off)
    expected, _ = normalized_weights(-(square + np.log(np.linalg.det(S))) / 2)
    np.testing.assert_allclose(cloud.weights, expected, rtol=1e-9)
    K = B @ H.T @ np.linalg.inv(S)
    after = (np.eye(4) - K @ H) @ B
    np.testing.assert_allclose(cloud.kernels, module.KEPT * after, rtol=1e-6, atol=1e-9)
    drawn = np.concatenate([cloud.values["r"], cloud.values["v"]], axis=-1)[1]
    drawn -= x[1] + (K[1] @ off[1, ..., None])[..., 0]
    root = np.linalg.inv(np.linalg.cholesky((1 - module.KEPT) * after[1, 0]))
    np.testing.assert_allclose(np.cov(root @ drawn.T), np.eye(4), atol=0.28)


def test_a_fix_whose_noise_is_not_positive_definite_explains_nothing():
    particles = Particles(STATE, PROCESS, Observation(lambda x, _: x["r"], ELEMENTS))
    rng = np.random.default_rng(3)
    start = {"r": np.zeros((2, 2)), "v": np.zeros((2, 2))}
    cloud = particles.drawn(start, np.tile(np.eye(4), (2, 1, 1)), rng.normal(size=(2, 50, 4)))
    R = np.stack([np.eye(2), np.diag([1.0, 0.0])])
    message = {"y": np.zeros((2, 2)), "R": R, "present": np.ones((2, 2))}
    _, explained = particles.weighed(cloud, message, {}, *draws(rng, 2, 50, 4))
    assert explained.tolist() == [True, False]


# ------------------------------------------------------------------------------- all is linear

H, NOISE = np.array([[1, 0.5, 0, 0], [0, 1, 0, 0]]), np.diag([400.0, 900.0])
P0, START = np.diag([1e4, 1e4, 25.0, 25.0]), np.array([10.0, 20.0, 1.0, 2.0])
LINEAR = Observation(lambda x, _: ca.mtimes(ca.DM(H[:, :2]), x["r"]), ELEMENTS)


def compared(linear, n_particles, *, k=50, fixes=5, seed=4):
    """Errors against the Kalman filter: means and covariances (k, ...), in its sigmas; sum 1/N."""
    particles = Particles(STATE, PROCESS, LINEAR, linear)
    rng = np.random.default_rng(seed)
    start = {"r": np.tile(START[:2], (k, 1)), "v": np.tile(START[2:], (k, 1))}
    normals = rng.normal(size=(k, n_particles, 4))
    cloud = particles.drawn(start, np.tile(P0, (k, 1, 1)), normals)
    F = np.eye(4)
    F[0, 2] = F[1, 3] = 1.0
    Q = PSD * np.kron([[1 / 3, 1 / 2], [1 / 2, 1]], np.eye(2))
    m, P, truth = np.tile(START, (k, 1)), P0, START + rng.normal(size=(k, 4)) @ np.sqrt(P0)
    variance = np.zeros(k)
    for i in range(fixes):
        normals = rng.normal(size=(k, n_particles, 4))
        cloud = particles.moved(cloud, {"psd": np.full((k, 1), PSD)}, 1.0, i + 1.0, normals)
        m, P = m @ F.T, F @ P @ F.T + Q
        truth = truth @ F.T + rng.multivariate_normal(np.zeros(4), Q, size=k)
        y = truth @ H.T + rng.normal(size=(k, 2)) @ np.sqrt(NOISE)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + NOISE)
        m, P = m + (y - m @ H.T) @ K.T, (np.eye(4) - K @ H) @ P
        message = {"y": y, "R": np.tile(NOISE, (k, 1, 1)), "present": np.ones((k, 2))}
        effective, _ = particles.weighed(cloud, message, {}, *draws(rng, k, n_particles, 4))
        variance += 1 / effective
    mean, C = particles.moments(cloud)
    root = np.linalg.inv(np.linalg.cholesky(P))
    return (np.hstack(list(mean.values())) - m) @ root.T, root @ C @ root.T - np.eye(4), variance


@pytest.mark.parametrize("linear", [(), ("v",)])
def test_where_all_is_linear_particles_are_the_kalman_filter(linear):
    """Mean and covariance of 50 members after 5 fixes, by 2000 particles each.

    In sigmas, an error of a weighted mean has the variance 1 / N of the effective number N, at each
    fix anew: a root of 0.08 here. Resampling adds up to as much, and members in a tail have fewer
    than their weights say: twice that, in the root of the mean square. Covariances likewise. What
    is systematic is of the order 1 / N: not seen beyond four standard errors of 50 members or 0.03.
    """
    d, C, variance = compared(linear, 2000)
    expected = np.sqrt(variance.mean())
    assert 0.06 < expected < 0.1
    for errors in (d, C):
        rms = np.sqrt((errors**2).mean(axis=0))
        assert np.sqrt((errors**2).mean()) < 2 * expected
        assert (np.abs(errors.mean(axis=0)) < np.maximum(0.03, 4 * rms / np.sqrt(len(d)))).all()
    assert np.sqrt((d**2).mean()) > 0.2 * expected  # it is not the Kalman filter itself


@pytest.mark.campaign
def test_errors_fall_as_the_root_of_the_number_of_particles():
    """From 250 to 4000: by 4, within a factor of 1.8, for means of 50 members with tails."""
    few, many = (np.sqrt((compared((), n, seed=7)[0] ** 2).mean()) for n in (250, 4000))
    assert 4 / 1.8 < few / many < 4 * 1.8


def test_a_prior_is_what_its_particles_and_kernels_say():
    """To the error of 4000: 4 / sqrt(4000) = 0.06 sigma, and 0.09 of a variance; as correlated."""
    state = ErrorState(vector("b", 1), rotation("q", side="right"), vector("v", 2))
    particles = Particles(state, Process(), Observation(lambda x, _: x["b"], {"b": "1"}), ("b",))
    rng = np.random.default_rng(5)
    root = np.tril(rng.normal(size=(6, 6))) + 3 * np.eye(6)
    root[1:4] *= 0.02  # of a rotation, small
    P, half = root @ root.T, np.sqrt(0.5)
    start = {"b": [[7.0]], "q": [[half, 0, 0, half]], "v": [[1.0, -2.0]]}
    start = {name: np.array(value) for name, value in start.items()}
    cloud = particles.drawn(start, P[None], rng.normal(size=(1, 4000, 6)))
    assert (np.linalg.eigvalsh(cloud.kernels[0, ::100]) > -1e-9).all()
    mean, C = particles.moments(cloud)
    whiten = np.linalg.inv(root)
    off = particles.state.difference(
        *({n: ca.DM(v[0]) for n, v in values.items()} for values in (mean, start))
    )
    assert (np.abs(whiten @ np.array(ca.evalf(off)).ravel()) < 0.06).all()
    np.testing.assert_allclose(whiten @ C[0] @ whiten.T, np.eye(6), atol=0.09)


def test_a_step_adds_the_noise_of_the_process():
    """Kernels by the transition, particles by draws: the covariance is F P F' + Q, as above."""
    particles = Particles(STATE, PROCESS, LINEAR)
    rng, dt = np.random.default_rng(6), 3.0
    start = {"r": np.zeros((1, 2)), "v": np.zeros((1, 2))}
    P = np.diag([1.0, 1, 0, 0])
    cloud = particles.drawn(start, P[None], rng.normal(size=(1, 4000, 4)))
    cloud = particles.moved(
        cloud, {"psd": np.full((1, 1), PSD)}, dt, dt, rng.normal(size=(1, 4000, 4))
    )
    Q = PSD * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
    root = np.linalg.inv(np.linalg.cholesky(P + Q))
    C = particles.moments(cloud)[1][0]
    np.testing.assert_allclose(root @ C @ root.T, np.eye(4), atol=0.09)


# ----------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("state", "more", "linear", "said"),
    [
        (ErrorState(*STATE, clone(STATE.blocks[0], "then")), {}, (), "no clones; .* 'then'"),
        (STATE, {"instant": "then"}, (), "of now; the observation is of the instant 'then'"),
        (STATE, {}, ("w",), "linear blocks are 'w', of the blocks r, v: particles are of one"),
        (STATE, {}, ("r", "v"), "linear blocks are 'r, v', of the blocks r, v"),
    ],
)
def test_what_particles_cannot_do_is_refused(state, more, linear, said):
    with pytest.raises(ValueError, match=said):
        Particles(state, PROCESS, Observation(lambda x, _: x["r"], ELEMENTS, **more), linear)
