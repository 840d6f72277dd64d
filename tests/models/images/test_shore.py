"""Shores seen in part: distances along normals, what they tell, and where an outline may lie."""

import numpy as np
import pytest

from terrafix.models.images.shore import crossings, outward_normals, places, weights


def lake(n=150):
    """Some 180 px long and 12 wide, bent, with bays, at some 150, 100."""
    t = np.linspace(0.0, 1.0, n // 2)
    middle = 100.0 + 25.0 * np.sin(3 * t)
    width = 2.0 + 5.0 * np.sin(np.pi * t) * (1 + 0.4 * np.cos(20 * t))
    x = 60.0 + 180.0 * t
    return np.concatenate([np.c_[x, middle - width], np.c_[x, middle + width][::-1]])


def every(contour):
    return np.ones(len(contour), dtype=bool)


def one(outline, contour, shown, reach):
    return crossings([outline], [contour], [shown], [reach])[0]


@pytest.mark.parametrize("turn", [1, -1])
def test_a_shifted_square_lies_its_shift_along_each_normal(turn):
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])[::turn]
    shift = np.array([0.3, -0.2])
    found = one(square, square + shift, every(square), 1.0)
    assert len(found.edge) == 4
    np.testing.assert_allclose(found.distance, outward_normals(square) @ shift, atol=1e-12)
    middle = (square + np.roll(square, -1, axis=0)) / 2
    assert ((middle[found.edge] - 5.0) * found.normal > -1e-12).all()  # they point outward


def test_what_was_not_seen_is_not_crossed():
    own = lake()
    shown = own[:, 0] < 150.0
    found = one(own, own, shown, 2.0)
    assert set(found.segment) <= set(np.flatnonzero(shown))
    assert len(found.edge) == pytest.approx(shown.sum(), abs=3)


def test_many_are_crossed_each_with_its_own():
    """Outlines that lie on each other and have other numbers of vertices: the bits of each alone.

    One of them is not seen at all, and each has a reach of its own.
    """
    rng = np.random.default_rng(3)
    outlines = [lake(n) + rng.normal(size=2) for n in (150, 90, 150, 120)]
    contours = [lake(n) for n in (120, 150, 100, 150)]
    shown = [every(contour) for contour in contours]
    shown[1] = ~shown[1]
    reach = [4.0, 4.0, 1.0, 2.5]
    together = crossings(outlines, contours, shown, reach)
    assert len(together[1].edge) == 0
    for found, *asked in zip(together, outlines, contours, shown, reach, strict=True):
        alone = one(*asked)
        for name, values in vars(alone).items():
            assert getattr(found, name).tobytes() == values.tobytes()
    assert min(len(together[i].edge) for i in (0, 2, 3)) > 60


def drawn(sigma, draws, what):
    """Means and standard deviations of what is made of noisy contours, and errors of the means."""
    rng = np.random.default_rng(7)
    own = lake()
    values = np.array([what(own, own + sigma * rng.normal(size=own.shape)) for _ in range(draws)])
    spread = values.std(axis=0)
    return values.mean(axis=0), spread, spread / np.sqrt(draws)


def test_sums_are_white_and_their_noise_has_no_bias():
    """Unit variance within 4 of its standard errors, mean zero within 4 of its own."""

    def sums(own, contour):
        told = weights(one(own, contour, every(own), 4.0), own, 0.25, len(own))
        assert told.told.all()
        return told.value - np.einsum("jkc,kc->j", told.of_vertices, own)

    mean, spread, error = drawn(0.25, 600, sums)
    assert (np.abs(mean) < 4 * error).all(), mean / error
    np.testing.assert_allclose(spread, 1.0, atol=4 / np.sqrt(2 * 600))


def test_a_straight_shore_tells_its_distance_and_its_slope():
    """Along it nothing is known: two of six sums."""
    x = np.linspace(0.0, 100.0, 51)
    shore = np.concatenate([np.c_[x, np.zeros(51)], [[50.0, 60.0]]])
    shown = np.arange(len(shore)) < 50
    told = weights(one(shore, shore, shown, 2.0), shore, 0.25, len(shore))
    assert told.told.sum() == 2


def test_too_few_crossings_are_refused():
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    with pytest.raises(ValueError, match="six crossings or more, got 4"):
        weights(one(square, square, every(square), 1.0), square, 0.25, 4)


@pytest.mark.parametrize("part", [1.0, 0.6])
def test_an_outline_is_found_from_far(part):
    """Of all points, or those of one end, to the grid of 6 px and the scales that are tried."""
    own = lake()
    center = own.mean(axis=0)
    shift, scale = np.array([137.0, -88.0]), 1.1
    seen = center + shift + scale * (own - center)
    points = seen[own[:, 0] < 60.0 + 180.0 * part + 1.0]
    found = places(own, points, np.array([300.0, 300.0]), np.array([0.8, 1.1, 1.4]))
    assert np.abs(found.shift[0] - shift).max() <= 6.0
    assert found.scale[0] == 1.1
    assert found.cost[0] < 4.0
    assert (np.diff(found.cost) >= 0).all()
    apart = np.hypot(*(found.shift[1:] - found.shift[0]).T)
    assert (apart >= 36.0).all()
