"""What a reference has of itself elsewhere: shoulders of the right peak, and places that repeat."""

import numpy as np
from scipy.ndimage import gaussian_filter

from terrafix.models.images.matching import Match, Prediction, Searchable, matched


def found(nepers: np.ndarray, rng: np.random.Generator) -> Match:
    """A part of a map under speckle of two looks, expected 10 and 7 pixels beside."""
    amplitude = np.exp(0.5 * nepers / nepers.std())
    part = amplitude[120:280, 120:280]
    image = part * np.sqrt(rng.gamma(2.0, 0.5, part.shape))
    expected = [[1, 0, 130], [0, 1, 113]]
    predicted = Prediction.affine(expected, 20.0**2 * np.eye(2))
    return matched(Searchable(image), Searchable(amplitude), predicted)


def test_shoulders_along_ridges_are_no_wrong_places():
    """Ridges are 8 times as long as wide; shoulders counted as places leave chances of 1e-7."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        match = found(gaussian_filter(rng.standard_normal((400, 400)), (25, 3)), rng)
        assert match.chance < 1e-15
        assert abs(match.row - 199.5) < 4 * match.sigma[0]
        assert abs(match.column - 199.5) < 4 * match.sigma[1] + 0.05


def test_a_map_that_repeats_itself_says_nothing_of_the_place():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        tile = gaussian_filter(rng.standard_normal((40, 40)), 2, mode="wrap")
        match = found(np.tile(tile, (10, 10)), rng)
        assert match.reason == "no place stands out of the others"
