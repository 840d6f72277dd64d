r"""Co-registration of a radar image with a larger reference, from what an orbit predicts.

Where every pixel of the image lies on the reference is predicted, and how far that can be off. The
reference is drawn in the image's frame, as far as the prediction can err and some way beyond, and
what is sought is a shift. Both are logarithms of amplitude, in which speckle is additive, less
their surroundings. The shift is where they correlate best,

.. math:: \rho = \frac{\sum (a - \bar a)(b - \bar b)}
                       {\sqrt{\sum (a - \bar a)^2 \sum (b - \bar b)^2}}.

**Whether it is the place.** Correlation has maxima at wrong shifts, too. Tails of their heights
fall off like those of a Gaussian field, so of the squares of wrong ones in falling order
:math:`E_1 > E_2 > \dots` the spacings :math:`i (E_i - E_{i+1})` are independent and exponential
with one mean [1]_. How much the first stands out of those after it has an F distribution, and the
chance of a wrong one that stands out as much follows, for any number of shifts searched. Besides,
the peak must be found again in several parts of the image, each by itself. Around the right peak
the reference resembles itself, along ridges and streets: what its own correlation explains is no
wrong peak, but a place that is half alike counts by how likely it is, :math:`e^{-\rho (\rho -
\rho_k) / \sigma^2}` with :math:`\sigma` the noise of correlation.

**How far it is off.** Near the peak the shift of the image and a linear map about its center,
:math:`\theta`, follow from the score of correlation,
:math:`g = \tfrac12 \sum (a\,\partial b - b\,\partial a)`, and its information,
:math:`H = \sum \partial a\,\partial b^T`: products of the two images, in which the speckle of
neither adds to it. The score is a sum over cells that are larger than speckle, and what it varies
by is told by the cells [2]_, each held against the others' estimate,

.. math:: G = \sum_c \tilde g_c \tilde g_c^T, \quad
          \tilde g_c = (1 - H_c H^{-1})^{-1} g_c, \qquad
          \mathrm{cov}\,\theta = (H G^{-1} H + \Lambda)^{-1},

:math:`G` is larger by :math:`\nu / (\nu - 2)`, the variance of Student's distribution, as cells
tell it with :math:`\nu = (\sum_c \tilde g_c^2)^2 / \sum_c \tilde g_c^4` degrees of freedom.
:math:`\Lambda` is what the prediction knows of the linear map: how an orbit's errors turn,
stretch and shear an image. So it is free where the image tells more of it than the prediction does,
and stays put where it does not: along a causeway nothing holds what is far from it but the
prediction.

Coordinates are (row, column), whole at the centers of pixels. A turn by an angle :math:`\varphi`
moves (row, column) by :math:`(-\varphi\,column, \varphi\,row)`.

References
----------
.. [1] A. Renyi, "On the theory of order statistics", Acta Mathematica Hungarica 4, 1953.
.. [2] H. White, "A Heteroskedasticity-Consistent Covariance Matrix Estimator and a Direct Test for
       Heteroskedasticity", Econometrica 48(4), 1980; the jackknife's form of it: J. G. MacKinnon,
       H. White, Journal of Econometrics 29(3), 1985.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binom

from terrafix.models.core.arrays import FloatArray, Single

REASONS = (
    "accepted",
    "it lies beyond the edge of the reference",
    "no place stands out of the others",
    "its parts do not agree on where it lies",
    "too little in it holds it in place",
    "it lies farther off than the prediction can be",
    "what is estimated sees no ground",
    "its place has no height",
    "its place on a map does not settle",
)
"""What became of an image."""

_SMALLEST = 96
"""Rows and columns that an image must have."""
_FINE, _COARSE, _BROAD = 1.0, 2.0, 10.0
"""Blur of what is aligned, of what is searched, of what is subtracted from both [pixels]."""
_LOOKS = 0.5
"""Blur of power before its logarithm: speckle falls, and what is bright stays narrow [pixels]."""
_DRAWN = 0.7
"""Blur of a reference before it is drawn: detected speckle is finer than its pixels, and what is
interpolated of it prefers some fractions of a pixel [pixels]."""
_STEP = 2
"""Pixels from one searched to the next, along each axis."""
_SIGMAS = 3.5
"""How far off the prediction may be [sigma]."""
_MARGIN = 64
"""Searched beyond that, to know how high wrong peaks are [pixels]."""
_SEEN = 0.8
"""Share of the image that must lie on the reference."""
_LOBE = 6
"""Half the side of a peak: no other is counted there [searched pixels]."""
_ALIKE = 0.5
"""Correlation of a reference with itself, from which on two places resemble each other."""
_SPACINGS = 16
"""Peaks that the first one is held against."""
_AMBIGUOUS = 1e-3
"""Chance that the highest of wrong peaks stands out so much: at most."""
_CHANCE = 1e-7
"""Chance of that and of so many parts that agree with it: at most."""
_CORNERS = 6.0
"""Most that a turn or stretch moves the image's corners between those tried [pixels]."""
_MOST = 41
"""Turns, and stretches, tried."""
_LOOSE = 4.0
_TURN_STEP, _GROWTH_STEP = float(np.radians(4.0)), 0.045
"""Blur [pixels], steps of turn and growth where an image is sought that is not as predicted."""
_CELL = 24
"""Side of cells whose speckle has nothing in common [pixels]."""
_STIFF = 1e-5
"""Least sigma of a linear map: a thousandth of a pixel in a hundred."""
_LINEAR = np.ix_([1, 2, 4, 5], [1, 2, 4, 5])
"""Of the six parameters of alignment, those that are a linear map."""
_LOOSELY = 0.1
"""What a linear map may move half way to the corners, beyond which blurred images are aligned first
[pixels]."""
_ROUNDS, _CLOSE, _STRIDE = 12, 0.01, 1.5
"""Of the alignment, its end, and its longest step [pixels]."""
_RIM = 3
"""Of the image, where slopes are not known [pixels]."""
_BLOCKS = 4
"""Parts along each axis that must find the peak again."""
_REACH = 8
"""How far they look for it [pixels]."""
_NEAR = 2.0
"""How close they must come [pixels]."""
_AGREE = 4
"""How many must."""
_BY_CHANCE = 0.1
"""Share that does at wrong places: those within 2 pixels are 0.04 of those looked at, and a peak of
the whole is where its parts are high. Measured at wrong places: 0.07."""
_SCATTER = 0.35
"""Largest standard error, along any direction [pixels]: what is held worse slides to maxima that
speckle makes on a ridge. Four of them are the 1.5 pixels that a fix may be off."""


_TURN, _GROWTH = np.array([0.0, -1.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0, 1.0])
"""Elements of a linear map of (row, column), first row first, of a turn and of growth."""


@dataclass(frozen=True)
class Prediction:
    """Where the pixels of an image lie on a reference, as an orbit predicts it.

    Parameters
    ----------
    rows, columns : ndarray, shape (n_i,) and (n_j,)
        Of the image's pixels whose places are given, increasing, at least two; between, places are
        interpolated, and beyond they go on as between the last two.
    places : ndarray, shape (n_i, n_j, 2)
        Row and column of those on the reference.
    covariance : ndarray, shape (2, 2)
        Of the shift of the image, in its own rows and columns [pixels^2].
    linear : ndarray, shape (4, 4)
        Of how far rows and columns of the image are off by its rows and columns from the center:
        of the elements of that matrix (2, 2), first row first [-].
    slant : bool
        Whether the reference shows relief as the image does: it is none in `places` then.
    """

    rows: FloatArray
    columns: FloatArray
    places: FloatArray
    covariance: FloatArray
    linear: FloatArray = field(default_factory=lambda: np.zeros((4, 4)))
    slant: bool = True

    def __post_init__(self) -> None:
        if self.places.shape != (len(self.rows), len(self.columns), 2):
            raise ValueError(
                f"places of {len(self.rows)} rows and {len(self.columns)} columns have shape "
                f"{self.places.shape}"
            )
        values = (self.rows, self.columns, self.places, self.covariance)
        if not all(np.isfinite(v).all() for v in values):
            raise ValueError("what is predicted of an image is not finite everywhere")
        if np.shape(self.covariance) != (2, 2) or np.linalg.eigvalsh(self.covariance)[0] < 0:
            raise ValueError("the covariance of an image's shift is no covariance (2, 2)")
        if np.shape(self.linear) != (4, 4):
            raise ValueError(f"the covariance 'linear' has shape {np.shape(self.linear)}")

    @staticmethod
    def affine(
        transform: ArrayLike,
        covariance: ArrayLike,
        rotation_sigma: float = 0.0,
        scale_sigma: float = 0.0,
    ) -> Prediction:
        """Prediction by a transform (2, 3) of (row, column, 1) of the image to the reference.

        With a covariance (2, 2) of its shift [pixels^2], and sigmas of the image's turn [rad] and
        growth about its center.
        """
        A, ends = np.asarray(transform, np.float64), np.array([0.0, 100.0])
        i, j = np.meshgrid(ends, ends, indexing="ij")
        places = np.stack([i, j, np.ones_like(i)], axis=-1) @ A.T
        covariance = np.asarray(covariance, np.float64)
        linear = rotation_sigma**2 * np.outer(_TURN, _TURN) + scale_sigma**2 * np.outer(
            _GROWTH, _GROWTH
        )
        return Prediction(ends, ends, places, covariance, linear)

    @property
    def rotation_sigma(self) -> float:
        """Of the image's turn about its center [rad]."""
        return float(np.sqrt(max(_TURN @ self.linear @ _TURN, 0.0))) / 2

    @property
    def scale_sigma(self) -> float:
        """Of its growth [-]."""
        return float(np.sqrt(max(_GROWTH @ self.linear @ _GROWTH, 0.0))) / 2

    def at(self, rows: ArrayLike, columns: ArrayLike) -> FloatArray:
        """Places on the reference, shape (n_rows, n_columns, 2), of rows and columns."""
        one, other = (
            _hats(np.asarray(x, np.float64), knots)
            for x, knots in ((rows, self.rows), (columns, self.columns))
        )
        return np.stack([one @ self.places[..., k] @ other.T for k in (0, 1)], axis=-1)

    def slope(self, row: float, column: float) -> FloatArray:
        """Rows and columns of the reference by those of the image (2, 2), at a pixel of it."""
        p = self.at([row - 0.5, row + 0.5], [column - 0.5, column + 0.5])
        down = (p[1] - p[0]).mean(axis=0)
        across = (p[:, 1] - p[:, 0]).mean(axis=0)
        return np.stack([down, across], axis=1)


def _hats(x: FloatArray, knots: FloatArray) -> FloatArray:
    """Weights (n, n_knots) of linear interpolation."""
    k = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
    u = (x - knots[k]) / (knots[k + 1] - knots[k])
    weights = np.zeros((len(x), len(knots)))
    i = np.arange(len(x))
    weights[i, k], weights[i, k + 1] = 1 - u, u
    return weights


def _nowhere() -> FloatArray:
    return np.full(2, np.nan)


@dataclass(frozen=True)
class Match:
    """Where an image lies on a reference.

    Parameters
    ----------
    row, column : float
        Where the image's center lies on the reference [pixels]; NaN where nothing was found.
    covariance : ndarray, shape (2, 2)
        Of row and column [pixels^2]; NaN where nothing was found.
    accepted : bool
    reason : str
        Why it was refused; ``"accepted"`` if it was not.
    correlation : float
        Of the whole image at the peak, -1 to 1.
    chance : float
        That the highest of wrong peaks stands out as much, and as many parts agree with it.
    shift : ndarray, shape (2,)
        Of the center from where it was predicted, in the image's rows and columns [pixels].
    linear : ndarray, shape (2, 2)
        Of the image about its center, from the prediction: its rows and columns by those.
    outline : ndarray, shape (4, 2)
        Corners of the image on the reference, first row first, then clockwise.
    blocks : ndarray, shape (n, 4)
        Middles of the parts of the image that agree: row and column on it, and on the reference.
    """

    row: float
    column: float
    covariance: FloatArray
    accepted: bool
    reason: str
    correlation: float = 0.0
    chance: float = 1.0
    shift: FloatArray = field(default_factory=_nowhere)
    linear: FloatArray = field(default_factory=lambda: np.eye(2))
    outline: FloatArray = field(default_factory=lambda: np.full((4, 2), np.nan))
    blocks: FloatArray = field(default_factory=lambda: np.empty((0, 4)))

    @property
    def sigma(self) -> FloatArray:
        """Standard errors of row and column (2,) [pixels]."""
        return np.sqrt(np.diag(self.covariance))


class Searchable:
    """An amplitude image.

    Parameters
    ----------
    amplitude : array_like, shape (n_rows, n_columns)
        Not negative; zero where nothing was seen.

    Raises
    ------
    ValueError
        If it is not an image, too small, or holds what is no amplitude.
    """

    def __init__(self, amplitude: ArrayLike) -> None:
        image = np.asarray(amplitude, dtype=np.float32)
        if image.ndim != 2 or min(image.shape) < _SMALLEST:
            raise ValueError(
                f"an image to be matched has {_SMALLEST} rows and columns at least, "
                f"got shape {image.shape}"
            )
        if not (np.isfinite(image).all() and image.min() >= 0):
            raise ValueError("an image to be matched must be finite and not negative")
        self.amplitude = image

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.amplitude.shape[0], self.amplitude.shape[1]

    @cached_property
    def layers(self) -> _Layers:
        """What of it is searched and aligned."""
        return _Layers(*_nepers(self.amplitude))


class _Layers:
    """Details of a logarithm of amplitude, without trends that correlate wherever they are moved.

    What was not seen is zero in them, as is what does not differ from its surroundings.
    """

    def __init__(self, nepers: Single, seen: Single, blurred: float = 0.0) -> None:
        self.seen, self._blurred = seen, blurred
        broad = self._mean(nepers, _BROAD)
        self.fine, self.coarse = (
            np.asarray((self._mean(nepers, s) - broad) * seen, np.float32) for s in (_FINE, _COARSE)
        )

    def _mean(self, nepers: Single, blur: float) -> Single:
        """Of what was seen about each pixel."""
        blur = float(np.sqrt(blur**2 - self._blurred**2))
        if self.seen.all():
            return np.asarray(cv2.GaussianBlur(nepers, (0, 0), blur), np.float32)
        weight = cv2.GaussianBlur(self.seen, (0, 0), blur)
        total = cv2.GaussianBlur(nepers * self.seen, (0, 0), blur)
        return np.asarray(total / np.maximum(weight, 1e-3), np.float32)


def _nepers(amplitude: Single) -> tuple[Single, Single]:
    """Logarithm of amplitude; nearly black is lifted to a thousandth of the mean. What was seen."""
    seen = (amplitude > 0).astype(np.float32)
    power = cv2.GaussianBlur(amplitude * amplitude, (0, 0), _LOOKS)
    floor = 1e-6 * max(float(power.mean()), 1e-30)
    return np.float32(0.5) * np.log(np.maximum(power, np.float32(floor))), seen


@dataclass(frozen=True)
class _Drawn:
    """The reference in the frame of the image, from a row and a column of that on."""

    layers: _Layers
    first: FloatArray


@dataclass(frozen=True)
class _Peak:
    """Of the search: shift (2,) of the image's middle, its turn, its growth, its chance."""

    shift: FloatArray
    turn: float
    growth: float
    chance: float


@dataclass(frozen=True)
class _Aligned:
    """From the image to the drawn reference, and the covariance (2, 2) of its shift."""

    transform: FloatArray
    covariance: FloatArray
    correlation: float
    linear: FloatArray


def matched(
    image: Searchable,
    reference: Searchable,
    predicted: Prediction,
    center: tuple[float, float] | None = None,
) -> Match:
    """Find where an image lies on a reference, or refuse to say.

    Parameters
    ----------
    image, reference : Searchable
    predicted : Prediction
    center : tuple of float, optional
        Row and column of the image that is sought on the reference; its middle by default.
    """
    middle = np.array([(n - 1) / 2 for n in image.shape])
    c = middle if center is None else np.asarray(center, np.float64)
    drawn = _drawn(image.shape, reference, predicted)
    if drawn is None:
        return refused("it lies beyond the edge of the reference")
    peak = _searched(image, drawn, predicted)
    if peak is None:
        return refused("no place stands out of the others")
    if peak.chance > _AMBIGUOUS:
        return refused("no place stands out of the others", peak.chance)
    aligned = _aligned(image, drawn, predicted, peak, c)
    if aligned is None:
        return refused("too little in it holds it in place", peak.chance)
    return _judged(image, drawn, predicted, peak, aligned, c)


def misplaced(
    image: Searchable, reference: Searchable, predicted: Prediction
) -> tuple[float, float] | None:
    """Turn [rad] and growth [-] with which an image is recognized that is not as predicted.

    For a message: what a reference shows then does not belong to the places that it says. Turns all
    around are tried and growths to a fifth; None if none of them stands out.
    """
    drawn = _drawn(image.shape, reference, predicted)
    if drawn is None:
        return None
    a, b = (
        np.ascontiguousarray(cv2.GaussianBlur(layers.coarse, (0, 0), _LOOSE)[::4, ::4], np.float32)
        for layers in (image.layers, drawn.layers)
    )
    if a.std() < 1e-6 or b.shape[0] < a.shape[0] or b.shape[1] < a.shape[1]:
        return None
    best: tuple[float, float, float] | None = None
    for growth in np.arange(-4, 5) * _GROWTH_STEP:
        for turn in np.arange(-45, 45) * _TURN_STEP:
            surface = cv2.matchTemplate(b, _turned(a, turn, growth), cv2.TM_CCOEFF_NORMED)
            found = _standing_out(np.asarray(surface, np.float32), np.ones(surface.shape, np.bool_))
            if found is not None and (best is None or found[2] < best[0]):
                best = found[2], float(turn), float(growth)
    if best is None or best[0] > _CHANCE or best[1:] == (0.0, 0.0):
        return None
    return best[1], best[2]


def refused(reason: str, chance: float = 1.0) -> Match:
    """No match, for one of `REASONS`."""
    return Match(np.nan, np.nan, np.full((2, 2), np.nan), False, reason, chance=chance)


def _judged(
    image: Searchable,
    drawn: _Drawn,
    predicted: Prediction,
    peak: _Peak,
    aligned: _Aligned,
    center: FloatArray,
) -> Match:
    """The match that an alignment is, accepted or not."""
    W = aligned.transform
    found = W @ [*center, 1.0] + drawn.first
    shift = found - center
    covariance = W[:, :2] @ aligned.covariance @ W[:, :2].T
    slope = predicted.slope(*found)
    row, column = predicted.at(found[:1], found[1:])[0, 0]
    agreeing = _agreeing(image, drawn, W)
    chance = peak.chance * float(binom.sf(len(agreeing) - 1, _BLOCKS**2, _BY_CHANCE))
    reason = "accepted"
    if np.linalg.eigvalsh(covariance)[1] > _SCATTER**2:
        reason = "too little in it holds it in place"
    elif len(agreeing) < _AGREE or chance > _CHANCE:
        reason = "its parts do not agree on where it lies"
    elif _far(shift, predicted.covariance + covariance):
        reason = "it lies farther off than the prediction can be"
    n, m = image.shape
    corners = np.array([[0, 0, 1], [0, m - 1, 1], [n - 1, m - 1, 1], [n - 1, 0, 1]])
    parts = np.column_stack([agreeing, np.ones(len(agreeing))])
    return Match(
        float(row),
        float(column),
        slope @ covariance @ slope.T,
        reason == "accepted",
        reason,
        aligned.correlation,
        chance,
        shift,
        aligned.linear,
        _placed(predicted, corners @ W.T + drawn.first),
        np.column_stack([agreeing, _placed(predicted, parts @ W.T + drawn.first)]),
    )


def _placed(predicted: Prediction, pixels: FloatArray) -> FloatArray:
    """Places on the reference (n, 2) of pixels (n, 2)."""
    return np.reshape([predicted.at([i], [j])[0, 0] for i, j in pixels], (-1, 2))


def _far(shift: FloatArray, covariance: FloatArray) -> bool:
    """Whether a shift is larger than its covariance allows."""
    covariance = covariance + 0.25 * np.eye(2)
    return bool(shift @ np.linalg.solve(covariance, shift) > (_SIGMAS + 0.5) ** 2)


def searched_span(n: int, sigma: float) -> tuple[int, int]:
    """Rows, or columns, that are searched about an image of `n` for a sigma of its shift."""
    reach = int(np.ceil(_SIGMAS * sigma)) + _MARGIN
    return -reach, n + reach


def _drawn(shape: tuple[int, int], reference: Searchable, predicted: Prediction) -> _Drawn | None:
    """The reference in the frame of the image, as far as it may be shifted and is there."""
    sigmas = np.sqrt(np.diag(predicted.covariance))
    spans = [searched_span(n, float(s)) for n, s in zip(shape, sigmas, strict=True)]
    axes = [np.arange(low, high + 8, 8.0) for low, high in spans]
    inside = _inside(predicted.at(*axes), reference.shape)
    if not inside.any():
        return None
    for k, n in enumerate(shape):
        there = axes[k][inside.any(axis=1 - k)]
        spare = int((1 - _SEEN) * n)
        low, high = int(there[0]) - 8 - spare, int(there[-1]) + 8 + spare
        spans[k] = max(spans[k][0], low), min(spans[k][1], high)
        if spans[k][1] - spans[k][0] < n:
            return None
    place = predicted.at(*(np.arange(*s) for s in spans)).astype(np.float32)
    seen = _inside(place, reference.shape)
    if not seen.any():
        return None
    ends = [(float(own.min()), float(own.max())) for own in (place[seen, 0], place[seen, 1])]
    first = [max(int(np.floor(end[0])) - 2, 0) for end in ends]
    own = tuple(slice(k, int(np.ceil(end[1])) + 3) for k, end in zip(first, ends, strict=True))
    part = _averaged(reference.amplitude[own], predicted, shape)
    nepers, known = _nepers(part)
    x, y = (np.ascontiguousarray(place[..., k] - first[k], np.float32) for k in (1, 0))
    smooth = cv2.GaussianBlur(nepers, (0, 0), _DRAWN)
    drawn = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    if not known.all():
        seen &= cv2.remap(known, x, y, cv2.INTER_LINEAR) > 0.5
    layers = _Layers(np.asarray(drawn), seen.astype(np.float32), _DRAWN)
    return _Drawn(layers, np.array([float(s[0]) for s in spans]))


def _inside(place: NDArray[np.floating], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Which places (..., 2) are on an image of a shape."""
    row, column = place[..., 0], place[..., 1]  # reductions over two elements are slow
    return np.asarray(
        (row >= 0) & (column >= 0) & (row <= shape[0] - 1) & (column <= shape[1] - 1), np.bool_
    )


def _averaged(amplitude: Single, predicted: Prediction, shape: tuple[int, int]) -> Single:
    """Amplitude of a reference, blurred to pixels of the image where its own are smaller."""
    slope = predicted.slope(*((n - 1) / 2 for n in shape))
    sizes = np.linalg.norm(slope, axis=1)
    if sizes.max() < 1.5:
        return amplitude
    blur = 0.5 * np.sqrt(np.maximum(sizes**2 - 1, 1e-4))
    power = cv2.GaussianBlur(amplitude**2, (0, 0), sigmaX=blur[1], sigmaY=blur[0])
    return np.asarray(np.sqrt(power), np.float32)


def _tried(sigma: float, corner: float) -> FloatArray:
    """Turns, or growths, that are tried where corners so far off would be moved too much."""
    n = min(int(np.ceil(_SIGMAS * sigma * corner / _CORNERS - 0.5)), _MOST // 2)
    return np.asarray(np.arange(-max(n, 0), max(n, 0) + 1) * (_CORNERS / corner), np.float64)


def _linear(turn: float, growth: float) -> FloatArray:
    """Turn and growth of (row, column), shape (2, 2)."""
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray((1 + growth) * np.array([[c, -s], [s, c]]), np.float64)


def _xy(transform: FloatArray) -> FloatArray:
    """A transform (2, 3) of (row, column), of (x, y)."""
    return np.ascontiguousarray(transform[::-1][:, [1, 0, 2]])


def _searched(image: Searchable, drawn: _Drawn, predicted: Prediction) -> _Peak | None:
    """Shift at which the image correlates best, among those that the prediction allows."""
    a = np.ascontiguousarray(image.layers.coarse[::_STEP, ::_STEP])
    b = np.ascontiguousarray(drawn.layers.coarse[::_STEP, ::_STEP])
    if a.std() < 1e-6 or b.shape[0] < a.shape[0] or b.shape[1] < a.shape[1]:
        return None
    seen = cv2.matchTemplate(
        np.ascontiguousarray(drawn.layers.seen[::_STEP, ::_STEP]),
        np.full(a.shape, 1 / a.size, np.float32),
        cv2.TM_CCORR,
    )
    corner = float(np.hypot(*image.shape)) / 2
    best = np.full(seen.shape, -np.inf, np.float32)
    tried = [
        (turn, growth)
        for turn in _tried(predicted.rotation_sigma, corner)
        for growth in _tried(predicted.scale_sigma, corner)
    ]
    which = np.zeros(seen.shape, np.int32)
    for k, (turn, growth) in enumerate(tried):
        surface = cv2.matchTemplate(b, _turned(a, turn, growth), cv2.TM_CCOEFF_NORMED)
        higher = surface > best
        best[higher], which[higher] = surface[higher], k
    best[(seen < _SEEN) | ~np.isfinite(best)] = 0.0
    shifts = [np.arange(n) * float(_STEP) + f for n, f in zip(best.shape, drawn.first, strict=True)]
    found = _standing_out(best, _allowed(shifts, predicted.covariance), b)
    if found is None:
        return None
    i, j, chance = found
    at = _vertex(best, i, j) * _STEP + drawn.first
    turn, growth = tried[which[i, j]]
    return _Peak(at, float(turn), float(growth), chance)


def _turned(a: Single, turn: float, growth: float) -> Single:
    """An image turned and grown about its middle."""
    if turn == 0 and growth == 0:
        return a
    middle = np.array([(n - 1) / 2 for n in a.shape])
    back = np.linalg.inv(_linear(turn, growth))
    transform = np.column_stack([back, middle - back @ middle])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(a, _xy(transform), a.shape[::-1], flags=flags))


def _allowed(shifts: list[FloatArray], covariance: FloatArray) -> NDArray[np.bool_]:
    """Which shifts the prediction allows, and those a peak's width beyond."""
    grown = covariance + (_STEP * _LOBE / _SIGMAS) ** 2 * np.eye(2)
    i, j = np.meshgrid(*shifts, indexing="ij")
    one = np.linalg.inv(grown)
    square = one[0, 0] * i * i + 2 * one[0, 1] * i * j + one[1, 1] * j * j
    return np.asarray(square <= _SIGMAS**2)


def _standing_out(
    surface: Single, allowed: NDArray[np.bool_], drawn: Single | None = None
) -> tuple[int, int, float] | None:
    """The highest allowed peak, and the chance that a wrong one stands out as much.

    Without the drawn reference, what it has of itself elsewhere counts as wrong.
    """
    where = np.where(allowed, surface, -np.inf)
    i, j = (int(k) for k in np.unravel_index(where.argmax(), where.shape))
    if not (0 < i < surface.shape[0] - 1 and 0 < j < surface.shape[1] - 1) or where[i, j] <= 0:
        return None
    if drawn is None:
        return i, j, _spaced_out(_elsewhere(surface, i, j), float(surface[i, j]))
    # what the reference has of itself about the peak is no other place
    shape = [n - m + 1 for n, m in zip(drawn.shape, surface.shape, strict=True)]
    part = np.ascontiguousarray(drawn[i : i + shape[0], j : j + shape[1]])
    alike = cv2.matchTemplate(drawn, part, cv2.TM_CCOEFF_NORMED)
    alike[~np.isfinite(alike)] = 0.0
    others = np.where(surface == 0, 0, surface - surface[i, j] * alike)
    noise = float(others[surface != 0].std())
    chance = _spaced_out(_elsewhere(others, i, j), float(surface[i, j]))
    # how much likelier the place is than others that resemble it
    again = _elsewhere(np.where(alike > _ALIKE, surface, 0), i, j)
    ahead = float(surface[i, j]) * (float(surface[i, j]) - again) / max(noise, 1e-6) ** 2
    return i, j, min(chance + float(np.exp(-np.clip(ahead, 0, 700)).sum()), 1.0)


def _elsewhere(surface: Single, i: int, j: int) -> FloatArray:
    """Peaks but the one at a place, the highest first."""
    side = np.ones((2 * _LOBE + 1, 2 * _LOBE + 1), np.uint8)
    highest = (surface >= cv2.dilate(surface, side)) & (surface > 0)
    highest[max(i - _LOBE, 0) : i + _LOBE + 1, max(j - _LOBE, 0) : j + _LOBE + 1] = False
    return np.sort(surface[highest])[::-1].astype(np.float64)


def _spaced_out(others: FloatArray, peak: float) -> float:
    """Chance that the highest of wrong peaks stands out so much."""
    E = others[: _SPACINGS + 1] ** 2
    if len(E) < 3:
        return 1.0
    n = len(E) - 1
    mean = float(np.mean(np.arange(2, n + 2) * -np.diff(E)))
    ahead = (peak**2 - E[0]) / max(mean, 1e-12)
    return float((1 + max(ahead, 0.0) / n) ** -n)


def _vertex(surface: Single, i: int, j: int) -> FloatArray:
    """Row and column (2,) of a peak, by parabolas through it."""
    peak = np.array([i, j], np.float64)
    for axis, (k, line) in enumerate(((i, surface[:, j]), (j, surface[i, :]))):
        if 0 < k < len(line) - 1:
            curvature = float(line[k - 1]) - 2 * float(line[k]) + float(line[k + 1])
            if curvature < 0:
                peak[axis] += (float(line[k - 1]) - float(line[k + 1])) / (2 * curvature)
    return peak


def _aligned(
    image: Searchable, drawn: _Drawn, predicted: Prediction, peak: _Peak, center: FloatArray
) -> _Aligned | None:
    """Shift and linear map about the center that maximize correlation, from the peak on."""
    middle = np.array([(n - 1) / 2 for n in image.shape])
    A = _linear(peak.turn, peak.growth)
    start = middle + peak.shift - drawn.first
    transform = np.column_stack([A, start - A @ middle])
    unit = float(np.hypot(*image.shape)) / 4
    known = np.zeros((6, 6))
    known[_LINEAR] = np.linalg.inv(unit**2 * (predicted.linear + _STIFF**2 * np.eye(4)))
    off = np.zeros(6)
    off[_LINEAR[0].ravel()] = unit * (peak.turn * _TURN + peak.growth * _GROWTH)
    loose = off.any() or unit * np.sqrt(np.diag(predicted.linear).max()) > _LOOSELY
    for level in ("coarse", "fine") if loose else ("fine",):
        a, b = getattr(image.layers, level), getattr(drawn.layers, level)
        patch = _Patch(a, center, unit)
        for _ in range(_ROUNDS):
            score, H, G = patch.held_against(_warped(b, transform, a.shape))
            if np.linalg.eigvalsh(H[np.ix_([0, 3], [0, 3])])[0] <= 0:
                return None
            weight = H @ np.linalg.inv(G)
            covariance = np.linalg.inv(weight @ H + known)
            step = covariance @ (weight @ score - known @ off)
            if not np.isfinite(step).all():
                return None
            step *= min(1.0, _STRIDE / max(float(np.abs(step).max()), 1e-9))
            off = off + step * [0, 1, 1, 0, 1, 1]
            transform = _moved(transform, step, center, unit)
            if np.abs(step).max() < _CLOSE:
                break
    if np.abs(step).max() > 10 * _CLOSE:
        return None
    warped = _warped(b, transform, a.shape)
    correlation = float(np.corrcoef(a.ravel(), warped.ravel())[0, 1])
    linear = np.asarray(transform[:, :2], np.float64)
    of_shift = np.asarray(covariance[np.ix_([0, 3], [0, 3])], np.float64)
    return _Aligned(transform, of_shift, correlation, linear)


def _moved(transform: FloatArray, step: FloatArray, center: FloatArray, unit: float) -> FloatArray:
    """A transform (2, 3) of an image that is first shifted and deformed about its center."""
    shift, slopes = step.reshape(2, 3)[:, 0], step.reshape(2, 3)[:, 1:]
    A = np.eye(2) + slopes / unit
    t = center + shift - A @ center
    return np.column_stack([transform[:, :2] @ A, transform[:, :2] @ t + transform[:, 2]])


def _warped(b: Single, transform: FloatArray, shape: tuple[int, ...], rim: int = 0) -> Single:
    """A drawn reference where an image is on it, and some pixels about."""
    transform = transform.copy()
    transform[:, 2] -= transform[:, :2] @ [rim, rim]
    size = (shape[1] + 2 * rim, shape[0] + 2 * rim)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(b, _xy(transform), size, flags=flags))


class _Patch:
    """An image whose correlation with another is a function of six parameters.

    Of rows, then of columns: their shift, and how it grows by rows and by columns from the center,
    in pixels of those `unit` away from it. Within a cell the shift is taken as one.
    """

    def __init__(self, a: Single, center: FloatArray, unit: float) -> None:
        self._inner = (slice(_RIM, -_RIM),) * 2
        self._a, self._slopes = self._normalized(a)
        y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in a.shape), indexing="ij")
        inner = np.stack([np.ones_like(y), y - center[0], x - center[1]])[
            (slice(None), *self._inner)
        ]
        one, down, across = _cells(inner)
        self._where = np.stack([np.ones_like(one), down / one / unit, across / one / unit])

    def _normalized(self, a: Single) -> tuple[Single, Single]:
        """An image and its slopes down and across (2, ...), of unit power."""
        slopes = np.stack([np.gradient(a, axis=k)[self._inner] for k in (0, 1)])
        inner = a[self._inner]
        scale = np.float32(1 / np.sqrt(max(float(np.mean(inner * inner)), 1e-12)))
        return inner * scale, slopes * scale

    def held_against(self, b: Single) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Score (6,) of correlation, its information and its covariance (6, 6) each."""
        other, slopes = self._normalized(b)
        own, q = self._slopes, self._where
        g = np.einsum("kn,pn->nkp", _cells(self._a * slopes - other * own) / 2, q).reshape(-1, 6)
        (rr, cc), rc = _cells(own * slopes), _cells(own[0] * slopes[1] + own[1] * slopes[0]) / 2
        h = np.array([[rr, rc], [rc, cc]])
        H = np.einsum("kln,pn,qn->nkplq", h, q, q).reshape(-1, 6, 6)
        score, total = g.sum(axis=0), H.sum(axis=0)
        share = H @ np.linalg.pinv(total)
        size = np.linalg.norm(share, axis=(1, 2))
        share *= np.minimum(1, 0.9 / np.maximum(size, 1e-9))[:, None, None]
        alone = np.linalg.solve(np.eye(6) - share, g[..., None])[..., 0]
        power = np.sum(alone[:, [0, 3]] ** 2, axis=1)
        freedom = float(power.sum()) ** 2 / max(float(np.sum(power**2)), 1e-30)
        few = freedom / max(freedom - 2, 0.5)
        floor = 1e-9 * max(float(np.trace(total)), 1e-9) * np.eye(6)
        return score, total, few * (alone.T @ alone) + floor


def _cells(x: Single) -> FloatArray:
    """Sums over cells, shape (..., n_cells), of what is of shape (..., n_rows, n_columns)."""
    n, m = x.shape[-2:]
    rows, columns = (np.arange(0, max(k - _CELL // 2, 1), _CELL) for k in (n, m))
    sums = np.add.reduceat(np.add.reduceat(x, rows, axis=-2), columns, axis=-1)
    return sums.reshape(*x.shape[:-2], -1).astype(np.float64)


def _agreeing(image: Searchable, drawn: _Drawn, transform: FloatArray) -> FloatArray:
    """Middles (n, 2) of the parts of an image that find the common peak by themselves."""
    wide = _warped(drawn.layers.fine, transform, image.shape, _REACH)
    found = []
    for rows in np.array_split(np.arange(image.shape[0]), _BLOCKS):
        for columns in np.array_split(np.arange(image.shape[1]), _BLOCKS):
            i, j, n, m = rows[0], columns[0], len(rows), len(columns)
            part = np.ascontiguousarray(image.layers.fine[i : i + n, j : j + m])
            about = np.ascontiguousarray(wide[i : i + n + 2 * _REACH, j : j + m + 2 * _REACH])
            surface = np.asarray(cv2.matchTemplate(about, part, cv2.TM_CCOEFF), np.float32)
            p, q = (int(k) for k in np.unravel_index(surface.argmax(), surface.shape))
            if np.hypot(*(_vertex(surface, p, q) - _REACH)) < _NEAR:
                found.append([i + (n - 1) / 2, j + (m - 1) / 2])
    return np.reshape(found, (-1, 2))
