"""A shore seen in part, recognized from a prior, and what it measures."""

import numpy as np
import pytest
from scipy.stats import chi2

from terrafix.models.filters.lake import ORBIT
from terrafix.models.filters.shore import (
    ELEMENTS,
    MOST_VERTICES,
    Shore,
    match_shores,
    shore_observation,
)
from terrafix.models.geometry.geodesy import ecef
from terrafix.models.sensors.camera import Seen

R, V = np.array([3474049.999, -3751352.019, 4675038.16]), np.array([5554.06, 5165.94, 17.98])
GIVEN = {
    "focal": np.array([[1828.81]]),
    "principal": np.array([[160.0, 128.0]]),
    "earth_angle0": np.array([[np.pi / 6]]),
    "rotation_rate": np.array([[7.292115e-5]]),
    "t": np.array([[3.5]]),
}


@pytest.fixture(scope="module")
def points():
    """Seneca Lake's like: 50 km long, bent, Earth-fixed."""
    t = np.linspace(0.0, 1.0, 60)
    middle = -76.93 + 0.06 * np.sin(3 * t)
    width = 0.007 + 0.01 * np.sin(np.pi * t) * (1 + 0.4 * np.cos(20 * t))
    north = 42.41 + 0.45 * t
    ring = np.concatenate([np.c_[middle + width, north], np.c_[middle - width, north][::-1]])
    return np.asarray(ecef(np.radians(ring[:, 1]), np.radians(ring[:, 0]), 0.0))


def seen_from(points, x):
    return Seen({"r": x[None, :3], "v": x[None, 3:]}, GIVEN, points, points.mean(axis=0))


TRUE = np.concatenate([R, V])


def shore(points, rng, sigma=0.25, part=None):
    contour = seen_from(points, TRUE).pixels[0] + sigma * rng.normal(size=(len(points), 2))
    shown = np.ones(len(points), dtype=bool)
    if part is not None:
        inside = contour[:, 1] < np.quantile(contour[:, 1], part)
        shown = inside & np.roll(inside, -1)
    return Shore(contour, shown, sigma)


def matched(points, sigma_r, sigma_v, seed, **kinds):
    rng = np.random.default_rng(seed)
    sigma = np.repeat([sigma_r, sigma_v], 3)
    prior = TRUE + sigma * rng.normal(size=6)
    seen = shore(points, rng, **kinds)
    return match_one(prior, np.diag(sigma**2), points, seen)


def match_one(prior, P, points, seen):
    return match_shores(prior[None], P[None], GIVEN, points, points.mean(axis=0), [seen])[0]


def misfit(points, found):
    """Of what was told, at the truth [sigmas]."""
    return found.value - np.einsum(
        "jkc,kc->j", found.of_vertices, seen_from(points, TRUE).pixels[0]
    )


@pytest.mark.parametrize(("sigma_r", "sigma_v"), [(30.0, 1.0), (15e3, 100.0), (70e3, 100.0)])
def test_it_is_recognized_from_near_and_far_and_told_without_the_prior(points, sigma_r, sigma_v):
    """Mean square of six sums at the truth in the 99.9 % interval of 10 draws; not one is wrong."""
    z = [misfit(points, matched(points, sigma_r, sigma_v, seed)) for seed in range(10)]
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(z)) / len(z)
    assert low < np.mean(np.sum(np.square(z), axis=1)) < high
    assert np.abs(z).max() < 5.0


def test_a_part_of_it_suffices(points):
    """Four fifths of the shore, from 70 km."""
    z = [misfit(points, matched(points, 70e3, 100.0, seed, part=0.8)) for seed in range(5)]
    assert np.abs(z).max() < 5.0


def test_what_cannot_be_recognized_says_why(points):
    assert matched(points, 70e3, 100.0, 0, part=0.3) == "too little shore"
    near = np.concatenate([R + 20e3 * V / np.linalg.norm(V), V])  # 66 px off, and sure of itself
    P = np.diag(np.repeat([30.0, 1.0], 3) ** 2)
    seen = shore(points, np.random.default_rng(1))
    assert match_one(near, P, points, seen) == "not found"
    other = Shore(seen.contour[:, ::-1] + [20.0, -60.0], seen.shown, 0.25)  # another lake
    prior = np.diag(np.repeat([15e3, 1.0], 3) ** 2)
    assert match_one(TRUE, prior, points, other) == "not found"


def test_each_of_many_is_matched_as_it_is_alone(points):
    """From priors of all kinds, to the same bits; who sees nothing leaves the others alone."""
    rng = np.random.default_rng(5)
    sigmas = np.array([[30.0, 1.0], [15e3, 100.0], [30.0, 1.0], [70e3, 100.0], [30.0, 1.0]])
    sigma = np.repeat(sigmas, 3, axis=1)
    x0 = TRUE + sigma * rng.normal(size=sigma.shape)
    P0 = np.stack([np.diag(s**2) for s in sigma])
    seen = [shore(points, rng) for _ in sigma]
    seen[2] = Shore(seen[2].contour, np.zeros(len(points), dtype=bool), 0.25)
    given = {name: np.repeat(value, len(sigma), axis=0) for name, value in GIVEN.items()}
    together = match_shores(x0, P0, given, points, points.mean(axis=0), seen)
    for k, found in enumerate(together):
        alone = match_one(x0[k], P0[k], points, seen[k])
        if k == 2:
            assert found == alone == "too little shore"
        else:
            assert found.value.tobytes() == alone.value.tobytes()


def test_the_derivative_is_that_of_the_prediction(points):
    """Central differences of 10 m and 1 m/s: to 1e-5 of the largest."""
    found = matched(points, 30.0, 1.0, 3)
    observation = shore_observation(ORBIT)
    weights = np.zeros((ELEMENTS, MOST_VERTICES, 2))
    weights[:, : len(points)] = found.of_vertices
    n = 12
    given = {name: np.repeat(value, n, axis=0) for name, value in GIVEN.items()}
    given |= {
        "lake": np.zeros((n, 1)),
        "weights": np.repeat(weights.reshape(1, -1), n, axis=0),
        "vertices": points,
        "starts": np.array([0, len(points)]),
        "center": points.mean(axis=0)[None],
    }
    step = np.diag(np.repeat([10.0, 1.0], 3))
    x = TRUE + np.concatenate([step, -step])
    y = observation.predict({"r": x[:, :3], "v": x[:, 3:]}, given)
    numeric = ((y[:6] - y[6:]) / (2 * np.repeat([10.0, 1.0], 3)[:, None])).T
    at = np.tile(TRUE, (n, 1))
    exact = observation.derivative({"r": at[:, :3], "v": at[:, 3:]}, given)[0]
    assert (np.abs(exact - numeric) < 1e-5 * np.abs(exact).max(axis=0)).all()
