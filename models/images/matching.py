r"""Co-registration of a radar image with a larger reference.

Features of both (SIFT on blurred logarithms of amplitude, in which speckle is additive) are
matched; random sampling finds the similarity or affine transform that most of them share. Speckle
leaves features uncertain by a pixel, so this only says where to look: the reference is warped into
the image's frame, shifted to where the two correlate best, and the affine transform that
maximizes their correlation

.. math:: \rho = \frac{\sum (a - \bar a)(b - \bar b)}
                       {\sqrt{\sum (a - \bar a)^2 \sum (b - \bar b)^2}}

is found by enhanced correlation coefficients [2]_, to a fraction of a pixel. Where all that two
images share lies along a line (a causeway, a coast), nothing holds stretch and shear across it, and
far from it they would move the image by pixels: shift and rotation alone are sought there.

Features agree by chance, too, and a straight shore correlates wherever it is moved along itself.
What these do not do is correlate at one shift in every part of the image: the peak of correlation
is found again without one block of the image at a time (jackknife), and its standard error says
how well the image is held in place. Right matches have 0.1 to 1 pixel, wrong ones 5 and more.

Coordinates are (row, column), whole at the centers of pixels.

References
----------
.. [1] D. G. Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", International
       Journal of Computer Vision 60(2), 2004.
.. [2] G. D. Evangelidis, E. Z. Psarakis, "Parametric Image Alignment Using Enhanced Correlation
       Coefficient Maximization", IEEE Trans. Pattern Analysis and Machine Intelligence 30(10),
       2008.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray, Single

KINDS = ("similarity", "affine")
"""Transforms between an image and a reference."""

REASONS = (
    "accepted",
    "too few features are shared",
    "features agree on no plausible transform",
    "it lies beyond the edge of the reference",
    "correlation finds no peak where features put it",
    "its parts do not agree on where it lies",
)
"""What became of an image."""

_BLUR = 2.0
"""Of the images in which features are sought [pixels]."""
_SMOOTH = 1.0
"""Of the images that are correlated [pixels]."""
_BROAD = 10.0
"""Of what is subtracted from them [pixels]."""
_REACH = 8
"""Largest shift that correlation looks for [pixels]."""
_SMALLEST = 96
"""Rows and columns that an image must have."""
_FEATURES = 4000
_RATIO = 0.95
"""Of the distances of the nearest and the second nearest feature, at most."""
_THRESHOLD = 3.0
"""How far off features may be [pixels]."""
_TURN, _GROWTH = float(np.radians(30.0)), 1.5
"""How much a feature may be turned and grown between the images."""
_FEWEST = 7
"""Features that must share a transform: fewer also share one by chance."""
_NARROW = 0.1
"""Share of the image's sides: tie points that scatter less along any direction are a line [-]. The
standard deviation of what is spread evenly is 0.29 of a side."""
_STRETCH = 1.08
"""Largest stretch along any direction, either way: image and reference have like pixels."""
_SEEN = 0.8
"""Share of the image that must lie on the reference."""
_ROUNDS, _CLOSE = 30, 1e-4
_BLOCKS = 4
"""Blocks along each axis that are left out in turn."""
_SCATTER = 0.6
"""Largest standard error of the peak [pixels]."""
_MOVED = 4.0
"""Largest move of the center by the alignment [pixels]."""
_OFF = 0.5
"""Largest distance of the peak of the blocks' correlation from the transform [pixels]."""


@dataclass(frozen=True)
class Match:
    """Where an image lies on a reference.

    Parameters
    ----------
    row, column : float
        Where the image's center lies on the reference [pixels]; NaN where nothing was found.
    transform : ndarray, shape (2, 3)
        From (row, column, 1) of the image to (row, column) of the reference.
    n_inliers : int
        Features that share the transform.
    correlation : float
        Of the whole image at the peak, -1 to 1.
    sigma : ndarray, shape (2,)
        Standard error of row and column that the parts of the image agree on [pixels].
    accepted : bool
    reason : str
        Why it was refused; ``"accepted"`` if it was not.
    inliers : ndarray, shape (n, 4)
        Row and column on the image and on the reference of the features that share it.
    """

    row: float
    column: float
    transform: FloatArray
    n_inliers: int
    correlation: float
    sigma: FloatArray
    accepted: bool
    reason: str
    inliers: FloatArray


class Searchable:
    """An amplitude image whose features are found once.

    Parameters
    ----------
    amplitude : array_like, shape (n_rows, n_columns)
        Not negative.

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
        if not (np.isfinite(image).all() and (image >= 0).all()):
            raise ValueError("an image to be matched must be finite and not negative")
        self.amplitude = image

    @cached_property
    def nepers(self) -> Single:
        """Logarithm of amplitude; what is nearly black is lifted to a thousandth of the mean."""
        floor = 1e-3 * max(float(self.amplitude.mean()), 1e-30)
        return np.log(np.maximum(self.amplitude, np.float32(floor)))

    @cached_property
    def smooth(self) -> Single:
        """What is correlated: details, without trends that correlate wherever they are moved."""
        fine, broad = (cv2.GaussianBlur(self.nepers, (0, 0), s) for s in (_SMOOTH, _BROAD))
        return np.asarray(fine - broad)

    @cached_property
    def features(self) -> tuple[FloatArray, Single]:
        """Row, column, size, angle [rad] of features (n, 4), and what they look like (n, 128)."""
        blurred = cv2.GaussianBlur(self.nepers, (0, 0), _BLUR)
        low, high = np.percentile(blurred, [0.5, 99.5])
        gray = np.clip((blurred - low) * (255 / max(float(high - low), 1e-6)), 0, 255)
        opencv: Any = cv2  # its stubs lack some of what it has
        sift = opencv.SIFT_create(nfeatures=_FEATURES, contrastThreshold=0.01)
        points, descriptors = sift.detectAndCompute(gray.astype(np.uint8), None)
        if descriptors is None:
            return np.empty((0, 4)), np.empty((0, 128), np.float32)
        found = [(p.pt[1], p.pt[0], p.size, np.radians(p.angle)) for p in points]
        return np.array(found), descriptors


def matched(
    image: Searchable,
    reference: Searchable,
    center: tuple[float, float] | None = None,
    *,
    kind: str = "similarity",
) -> Match:
    """Find where an image lies on a reference, or refuse to say.

    Parameters
    ----------
    image, reference : Searchable
    center : tuple of float, optional
        Row and column of the image that is sought on the reference; its middle by default.
    kind : {"similarity", "affine"}
        Transform between them.

    Raises
    ------
    ValueError
        If `kind` is not a known choice.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {KINDS}, got '{kind}'")
    middle = tuple((n - 1) / 2 for n in image.amplitude.shape)
    center = middle if center is None else center
    transform, inliers = _shared_transform(image, reference, kind)
    if transform is None:
        return _refused("too few features are shared", inliers)
    if not _plausible(transform):
        return _refused("features agree on no plausible transform", inliers)
    rigid = _is_line(inliers[:, :2], image.amplitude.shape)
    if rigid:
        transform = _rotation_and_shift(inliers)
    warped, seen = _warped(reference, transform, image.amplitude.shape)
    if seen < _SEEN:
        return _refused("it lies beyond the edge of the reference", inliers)
    shift, _ = _peak(_block_correlations(image.smooth, warped).sum(axis=0))
    transform[:, 2] += transform[:, :2] @ shift
    aligned, correlation = _aligned(image, reference, transform, rigid=rigid)
    if aligned is None or not _plausible(aligned):
        return _refused("correlation finds no peak where features put it", inliers)
    moved = np.linalg.norm((aligned - transform) @ [*middle, 1.0])
    warped, seen = _warped(reference, aligned, image.amplitude.shape)
    shift, sigma = _held(_block_correlations(image.smooth, warped))
    aligned[:, 2] += aligned[:, :2] @ shift
    row, column = aligned @ [*center, 1.0]
    reason = "accepted"
    if seen < _SEEN:
        reason = "it lies beyond the edge of the reference"
    elif moved > _MOVED or np.abs(shift).max() > _OFF:
        reason = "correlation finds no peak where features put it"
    elif sigma.max() > _SCATTER:
        reason = "its parts do not agree on where it lies"
    accepted = reason == "accepted"
    return Match(
        float(row),
        float(column),
        aligned,
        len(inliers),
        correlation,
        sigma,
        accepted,
        reason,
        inliers,
    )


def _refused(reason: str, inliers: FloatArray) -> Match:
    nowhere, never = np.full((2, 3), np.nan), np.full(2, np.inf)
    return Match(np.nan, np.nan, nowhere, len(inliers), 0.0, never, False, reason, inliers)


def _plausible(transform: FloatArray) -> bool:
    """Whether a transform neither mirrors nor stretches beyond what a view can."""
    linear = transform[:, :2]
    stretch = np.linalg.svd(linear, compute_uv=False)
    return bool(np.linalg.det(linear) > 0 and stretch[0] < _STRETCH and stretch[1] > 1 / _STRETCH)


def _is_line(points: FloatArray, shape: tuple[int, ...]) -> bool:
    """Whether points (n, 2) of an image scatter too little along some direction."""
    least = np.sqrt(max(float(np.linalg.eigvalsh(np.cov(points.T))[0]), 0.0))
    return bool(least < _NARROW * min(shape))


def _rotation_and_shift(inliers: FloatArray) -> FloatArray:
    """Transform (2, 3) without stretch and shear that fits features best (Kabsch)."""
    here, there = inliers[:, :2], inliers[:, 2:]
    middles = here.mean(axis=0), there.mean(axis=0)
    left, _, right = np.linalg.svd((there - middles[1]).T @ (here - middles[0]))
    turn = left @ np.diag([1.0, np.linalg.det(left @ right)]) @ right
    return np.column_stack([turn, middles[1] - turn @ middles[0]])


def _shared_transform(
    image: Searchable, reference: Searchable, kind: str
) -> tuple[FloatArray | None, FloatArray]:
    """Transform that most features share, in (row, column), and the features that do."""
    (here, look), (there, like) = image.features, reference.features
    least = 3 if kind == "affine" else 2
    none = np.empty((0, 4))
    if len(here) < least or len(there) < 2:
        return None, none
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(look, like, k=2)
    good = [a for a, b in pairs if a.distance < _RATIO * b.distance]
    one, other = (
        x[[getattr(m, k) for m in good]] for x, k in ((here, "queryIdx"), (there, "trainIdx"))
    )
    turn = np.angle(np.exp(1j * (other[:, 3] - one[:, 3])))
    growth = np.abs(np.log(other[:, 2] / one[:, 2]))
    alike = (np.abs(turn) < _TURN) & (growth < np.log(_GROWTH))
    places = np.hstack([one[alike, :2], other[alike, :2]])
    if len(places) < least:
        return None, none
    cv2.setRNGSeed(0)
    estimate: Any = cv2.estimateAffine2D if kind == "affine" else cv2.estimateAffinePartial2D
    found, kept = estimate(
        places[:, 1::-1],
        places[:, :1:-1],
        method=cv2.RANSAC,
        ransacReprojThreshold=_THRESHOLD,
        maxIters=5000,
        confidence=0.999,
    )
    if found is None or int(kept.sum()) < _FEWEST:
        return None, none
    swapped = found[::-1][:, [1, 0, 2]]  # from (x, y) to (row, column)
    return np.ascontiguousarray(swapped), places[kept.ravel() > 0]


def _warped(
    reference: Searchable, transform: FloatArray, shape: tuple[int, int]
) -> tuple[Single, float]:
    """Reference in the frame of the image, and the share of the image that it covers."""
    xy = np.ascontiguousarray(transform[::-1][:, [1, 0, 2]])
    size = (shape[1], shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(
        reference.smooth, xy, size, flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    inside = cv2.warpAffine(np.ones_like(reference.smooth), xy, size, flags=flags)
    return np.asarray(warped), float(inside.mean())


def _aligned(
    image: Searchable, reference: Searchable, transform: FloatArray, *, rigid: bool
) -> tuple[FloatArray | None, float]:
    """Transform near a given one that maximizes correlation, and the correlation."""
    xy = np.ascontiguousarray(transform[::-1][:, [1, 0, 2]], np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _ROUNDS, _CLOSE)
    try:
        opencv: Any = cv2
        motion = cv2.MOTION_EUCLIDEAN if rigid else cv2.MOTION_AFFINE
        correlation, found = opencv.findTransformECC(
            image.smooth, reference.smooth, xy, motion, criteria, None, 1
        )
    except cv2.error:  # it raises where the images do not overlap or do not correlate
        return None, 0.0
    if not np.isfinite(found).all():
        return None, 0.0
    return np.ascontiguousarray(found[::-1][:, [1, 0, 2]], np.float64), float(correlation)


def _block_correlations(image: Single, warped: Single) -> FloatArray:
    """Correlation of every block with the warped reference, at shifts up to `_REACH` either way.

    Shape (n_blocks, 2 * _REACH + 1, 2 * _REACH + 1), not normalized: their sum is the whole's.
    """
    surfaces = []
    for a, b in zip(_blocks(image), _blocks(warped), strict=True):
        inner = np.ascontiguousarray(a[_REACH:-_REACH, _REACH:-_REACH])
        surfaces.append(cv2.matchTemplate(b, inner, cv2.TM_CCOEFF))
    return np.array(surfaces, np.float64)


def _blocks(image: Single) -> list[Single]:
    return [
        np.ascontiguousarray(block)
        for band in np.array_split(image, _BLOCKS, 0)
        for block in np.array_split(band, _BLOCKS, 1)
    ]


def _peak(surface: FloatArray) -> tuple[FloatArray, float]:
    """Shift (2,) at the peak of correlation, by parabolas through it, and its height."""
    i, j = (int(k) for k in np.unravel_index(surface.argmax(), surface.shape))
    peak = np.array([i, j], np.float64)
    for axis, (k, line) in enumerate(((i, surface[:, j]), (j, surface[i, :]))):
        if 0 < k < len(line) - 1:
            curvature = line[k - 1] - 2 * line[k] + line[k + 1]
            if curvature < 0:
                peak[axis] += (line[k - 1] - line[k + 1]) / (2 * curvature)
    return peak - _REACH, float(surface[i, j])


def _held(surfaces: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Shift (2,) that all blocks agree on, and its jackknife standard error (2,)."""
    total, n = surfaces.sum(axis=0), len(surfaces)
    without = np.array([_peak(total - s)[0] for s in surfaces])
    spread = np.sum((without - without.mean(axis=0)) ** 2, axis=0)
    return _peak(total)[0], np.sqrt((n - 1) / n * spread)
