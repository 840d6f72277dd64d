r"""Where one frame lies in another: what a camera that stares is used for.

A template T of a frame is sought in a larger image S within a gate of shifts s, by one of

.. math::
    \sum_p (T(p) - S(p + s))^2, \qquad
    \frac{\sum (T - \bar T)(S_s - \bar S_s)}
         {\sqrt{\sum (T - \bar T)^2 \sum (S_s - \bar S_s)^2}}, \qquad
    \mathcal{F}^{-1}\left[ \frac{\hat S \hat T^*}{|\hat S \hat T^*|} \right](s),

the first of which is thrown by a change of light. Between whole pixels the peak is that of a
parabola through it and its neighbors, along rows and along columns: its error depends on the part
of a pixel by which the images are shifted, and lasts as long as that does. From there least squares
go on [2]_: with g the slopes of S, and S, or T, shown anew where they were found,

.. math::
    s = \Big(\sum_p g g^T\Big)^{-1} \sum_p g\, (T(p) - S(p)),

which is zero where they are alike, wherever that is, and whose covariance is
:math:`\sigma^2 (\sum g g^T)^{-1}` by the noise of T.

Where the images differ by far in a part of the template (a cloud in one of them), it is sought
again without that part. If two clouds hide so much that the peak is theirs, it is sought where a
quantile of differences is least, which does not mind what the others are [3]_.

Images have rows downward and columns to the right.

References
----------
.. [1] C. D. Kuglin, D. C. Hines, "The phase correlation image alignment method", Proc. IEEE
       Conference on Cybernetics and Society, 1975.
.. [2] B. D. Lucas, T. Kanade, "An iterative image registration technique with an application to
       stereo vision", Proc. IJCAI, 1981.
.. [3] P. J. Rousseeuw, "Least median of squares regression", J. Am. Stat. Assoc. 79, 1984; here
       of a quantile.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import Single

METHODS = ("ssd", "ncc", "phase")
"""Sum of squared differences, normalized correlation, phase correlation."""

REASONS = (
    "accepted",
    "no texture",
    "the peak lies at the edge of the gate",
    "the images are not alike",
    "beyond the edge of the image",
    "its parts do not agree",
    "too much is hidden",
)
"""What became of a match."""

LEAST_TEXTURE = 2.0
"""Standard deviation of a template, at least, in those of its noise: below, nothing is matched."""

ALIKE, _CLEAR = 0.9, 0.97
"""Correlations below which a match is looked through for what hides a part of the ground: of a
search, and of least squares, which a strip of a cloud throws by a tenth of a pixel."""
_OUTLIER, _LEAST_SEEN, _ALL_SEEN = 4.0, 0.3, 0.98
"""Differences beyond, in robust sigmas, are of what hides it; parts of a template that is seen."""
_SURE, _SURE_SIGMA = 0.35, 0.4538
"""So many pixels are seen at least; such a part of a normal distribution lies within, in sigmas."""
_COARSE = 2
"""Pixels by which a search among hidden ones goes."""
_DISAGREE = 40.0
"""What quarters of a template may gain, in squares of what is left: chi-square of 6, whose mean is
6, and room for what is not white."""
_SMOOTH = 1e-6
"""Smallest spread [codes], and share of a determinant, that is not zero."""


@dataclass(frozen=True)
class FrameMatch:
    """Where a template lies in an image.

    Parameters
    ----------
    row, column : float
        Shift of the template from the middle of the image [px]; NaN where it was refused.
    correlation : float
        Of the template with the image there, -1 to 1; NaN where there is no texture.
    reason : int
        Index into `REASONS`; 0 where it was accepted.
    sigma_row, sigma_column : float
        What noise makes of the shift in this texture [px]: that of both images, or by least squares
        that of the template; 0 for phase correlation.
    """

    row: float
    column: float
    correlation: float
    reason: int
    sigma_row: float = 0.0
    sigma_column: float = 0.0


def match_frame(
    template: Single,
    image: Single,
    *,
    method: str = "ssd",
    subpixel: bool = True,
    noise: float = 0.0,
    least: float = 0.5,
) -> FrameMatch:
    """Seek a template in an image, at shifts up to half of what the image is larger.

    Parameters
    ----------
    template : ndarray of float32, shape (h, w)
    image : ndarray of float32, shape (h + 2 g, w + 2 k)
    method : str
        Of `METHODS`.
    subpixel : bool
        Whether to go on between whole pixels.
    noise : float
        Standard deviation of the template's noise; `LEAST_TEXTURE` is in its units.
    least : float
        Correlation that an accepted match has.

    Raises
    ------
    ValueError
        If `method` is none of `METHODS`, or the template is larger than the image, or differs from
        it by an odd number of rows or columns.
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, got '{method}'")
    room = [a - b for a, b in zip(image.shape, template.shape, strict=True)]
    if min(room) < 2 or any(n % 2 for n in room):
        raise ValueError(
            f"a template of {template.shape[0]} x {template.shape[1]} pixels cannot be sought in "
            f"an image of {image.shape[0]} x {image.shape[1]}: the image is larger, evenly on "
            "all sides"
        )
    reach = [n // 2 for n in room]
    spread = float(cv2.meanStdDev(template)[1][0, 0])
    if spread <= max(LEAST_TEXTURE * noise, _SMOOTH):
        return FrameMatch(np.nan, np.nan, np.nan, REASONS.index("no texture"))
    rows, columns = template.shape
    surface = _surface(template, image, method)
    i, j = divmod(int(surface.argmax()), surface.shape[1])
    found = image[i : i + rows, j : j + columns]
    alike = _correlation(template, found)
    if alike < ALIKE:
        surface, (i, j), alike = _hidden_in_part(template, image, method, surface, (i, j), alike)
    if i in (0, 2 * reach[0]) or j in (0, 2 * reach[1]):
        return FrameMatch(
            np.nan, np.nan, np.nan, REASONS.index("the peak lies at the edge of the gate")
        )
    if not alike >= least:
        return FrameMatch(np.nan, np.nan, alike, REASONS.index("the images are not alike"))
    row, column = float(i - reach[0]), float(j - reach[1])
    lines = (surface[:, j], i), (surface[i], j)
    if subpixel:
        row, column = (
            whole + _vertex(*(float(line[at + k]) for k in (-1, 0, 1)))
            for whole, (line, at) in zip((row, column), lines, strict=True)
        )
    unit = {"ssd": 1.0, "ncc": 2.0 * spread * spread * rows * columns, "phase": 0.0}[method]
    sigmas = (_noise_sigma(line, at, noise, unit, rows * columns) for line, at in lines)
    return FrameMatch(row, column, alike, 0, *sigmas)


def _noise_sigma(score: Single, at: int, noise: float, unit: float, n_pixels: int) -> float:
    r"""What noise of two images makes of the vertex of a parabola through their score.

    With :math:`q` the sum of squared differences, :math:`b = q_1 - 2 q_0 + q_{-1}`, the vertex has
    the variance :math:`2 \sigma^2 (q_2 - q_0 + N \sigma^2) / b^2`, where :math:`q_2 - q_0` is
    :math:`2 b` in a texture that is smooth over two pixels, and less in others.
    """
    bend = unit * float(2 * score[at] - score[at - 1] - score[at + 1])
    if unit == 0.0 or bend <= 0.0:
        return 0.0
    fall = 2.0 * bend
    if 2 <= at < len(score) - 2:
        fall = min(fall, unit * float(score[at] - (score[at - 2] + score[at + 2]) / 2))
    return noise * float(np.sqrt(2.0 * (max(fall, 0.0) + n_pixels * noise * noise))) / bend


def least_squares_shift(
    template: Single, image: Single, *, noise: float = 0.0, least: float = 0.5, light: bool = False
) -> FrameMatch:
    """Shift of a template in an image that is larger by two pixels on all sides, if it is small.

    Slopes are differences of fourth order: those of second order are too small in fine texture, and
    tell too large a sigma.

    Parameters
    ----------
    template : ndarray of float32, shape (h, w)
    image : ndarray of float32, shape (h + 4, w + 4)
    noise : float
        Standard deviation of the template's noise.
    least : float
        Correlation that an accepted match has.
    light : bool
        Whether mean and contrast may differ.
    """
    middle, across, along = image[2:-2, 2:-2], image[:, 2:-2], image[2:-2]
    down = (8 * (across[3:-1] - across[1:-3]) - (across[4:] - across[:-4])) / 12
    right = (8 * (along[:, 3:-1] - along[:, 1:-3]) - (along[:, 4:] - along[:, :-4])) / 12
    alike, seen = _correlation(template, middle), None
    if alike < _CLEAR:
        seen = _seen_in_both(template, middle)
        # what is left is alike where something hides the rest, and not where all is another image
        if seen is not None and _correlation(template[seen], middle[seen]) < ALIKE:
            seen = None
        if seen is not None and seen.mean() < _LEAST_SEEN:
            return FrameMatch(np.nan, np.nan, alike, REASONS.index("too much is hidden"))
    T, S, u, v = (
        np.asarray(x.ravel() if seen is None else x[seen], np.float32)
        for x in (template, middle, down, right)
    )
    if seen is not None:
        alike = _correlation(T, S)
        noise *= float(np.sqrt(2.0))  # pixels are others each time, and the image's noise is, too
    if not alike >= least:
        return FrameMatch(np.nan, np.nan, alike, REASONS.index("the images are not alike"))
    if light:
        T = np.asarray((T - T.mean()) * (S.std() / T.std()) + S.mean(), np.float32)
        noise = noise * float(S.std() / template.std())
    off = T - S
    a, b, c = float(u @ u), float(u @ v), float(v @ v)
    det = a * c - b * b
    if not det > _SMOOTH * a * c:
        return FrameMatch(np.nan, np.nan, alike, REASONS.index("no texture"))
    down_off, right_off = float(u @ off), float(v @ off)
    row, column = (c * down_off - b * right_off) / det, (a * right_off - b * down_off) / det
    if max(abs(row), abs(column)) > 1.0:
        return FrameMatch(np.nan, np.nan, alike, REASONS.index("the images are not alike"))
    pixels = (T, S, u, v)
    if seen is not None and not _parts_agree(template, seen, pixels, (row, column), noise):
        return FrameMatch(np.nan, np.nan, alike, REASONS.index("its parts do not agree"))
    sigmas = (noise * float(np.sqrt(x / det)) for x in (c, a))
    return FrameMatch(row, column, alike, 0, *sigmas)


def _parts_agree(
    template: Single,
    seen: NDArray[np.bool_],
    pixels: tuple[Single, ...],
    shift: tuple[float, float],
    noise: float,
) -> bool:
    """Whether quarters of a template, shifted each by itself, leave as much as all together.

    Two clouds that lie alike on two images hold them together where the ground does not.
    """
    T, S, u, v = pixels
    left = T - S - shift[0] * u - shift[1] * v
    rows, columns = np.nonzero(seen)
    quarter = 2 * (rows >= template.shape[0] // 2) + (columns >= template.shape[1] // 2)
    gain = 0.0
    for k in range(4):
        here = quarter == k
        g, off = np.stack([u[here], v[here]]), left[here]
        A, b = g @ g.T, g @ off
        if float(np.linalg.det(A)) > _SMOOTH * float(A[0, 0] * A[1, 1]):
            gain += float(b @ np.linalg.solve(A, b))
    return gain < _DISAGREE * max(float(np.mean(left * left)), noise * noise)


def _hidden_in_part(
    template: Single,
    image: Single,
    method: str,
    surface: Single,
    at: tuple[int, int],
    alike: float,
) -> tuple[Single, tuple[int, int], float]:
    """Score, peak and correlation of a template without what hides a part of it, if that is so."""
    rows, columns = template.shape
    best = surface, at, alike
    for look in range(2):
        i, j = at if look == 0 else _of_sure_pixels(template, image)
        both = _seen_in_both(template, image[i : i + rows, j : j + columns])
        if both is None or both.mean() < _LEAST_SEEN:
            continue
        surface = _masked_surface(template, image, method, both)
        i, j = divmod(int(surface.argmax()), surface.shape[1])
        alike = _correlation(template[both], image[i : i + rows, j : j + columns][both])
        if alike > best[2]:
            best = surface, (i, j), alike
        if alike >= ALIKE:
            break
    return best


def _of_sure_pixels(template: Single, image: Single) -> tuple[int, int]:
    """Where the pixels that are most alike differ least, by a quantile of the differences."""
    part = template[::_COARSE, ::_COARSE]
    windows = np.lib.stride_tricks.sliding_window_view(image, template.shape)
    off = np.abs(windows[..., ::_COARSE, ::_COARSE] - part).reshape(*windows.shape[:2], -1)
    k = int(_SURE * part.size)
    score = np.partition(off, k, axis=-1)[..., k]
    i, j = divmod(int(score.argmin()), score.shape[1])
    return i, j


def _seen_in_both(template: Single, found: Single) -> NDArray[np.bool_] | None:
    """Pixels at which neither image shows what hides the ground; None where that is all.

    They differ there by more than `_OUTLIER` standard deviations from the others, which are told by
    the shortest interval that has `_SURE` of all differences.
    """
    off = template - found
    line = np.sort(off, axis=None)
    k = int(_SURE * line.size)
    widths = line[k:] - line[: line.size - k]
    at = int(widths.argmin())
    middle, half = (line[at] + line[at + k]) / 2, widths[at] / 2
    both: NDArray[np.bool_] = np.abs(off - middle) <= _OUTLIER / _SURE_SIGMA * half
    whole = cv2.erode(both.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return whole if whole.mean() < _ALL_SEEN else None


def _masked_surface(
    template: Single, image: Single, method: str, seen: NDArray[np.bool_]
) -> Single:
    """Score at every shift of the pixels of a template that are seen, higher where it is better."""
    kind, sign = (cv2.TM_SQDIFF, -1) if method == "ssd" else (cv2.TM_CCOEFF_NORMED, 1)
    score = cv2.matchTemplate(image, template, kind, mask=seen.astype(np.float32))
    return np.asarray(sign * np.nan_to_num(score), np.float32)


def _correlation(one: Single, other: Single) -> float:
    """Of two images of one shape, -1 to 1; 0 where one is the same everywhere."""
    a, b = one.ravel(), other.ravel()
    a, b = (x - np.add.reduce(x) / x.size for x in (a, b))  # half the time of mean()
    size = float(a @ a) * float(b @ b)
    return float(a @ b) / np.sqrt(size) if size > 0 else 0.0


def _surface(template: Single, image: Single, method: str) -> Single:
    """Score at every shift, higher where it is better."""
    if method == "ssd":
        return np.asarray(-cv2.matchTemplate(image, template, cv2.TM_SQDIFF))
    if method == "ncc":
        return np.asarray(cv2.matchTemplate(image, template, cv2.TM_CCOEFF_NORMED))
    (rows, columns), reach = template.shape, (np.array(image.shape) - template.shape) // 2
    middle = image[reach[0] : reach[0] + rows, reach[1] : reach[1] + columns]
    window = np.outer(np.hanning(rows), np.hanning(columns)).astype(np.float32)
    S, T = (np.fft.rfft2((a - a.mean()) * window) for a in (middle, template))
    cross = S * T.conj()
    surface = np.fft.irfft2(cross / np.maximum(np.abs(cross), _SMOOTH), (rows, columns))
    i, j = (np.arange(-r, r + 1) % n for r, n in zip(reach, (rows, columns), strict=True))
    return np.asarray(surface[np.ix_(i, j)], np.float32)


def _vertex(before: float, peak: float, after: float) -> float:
    """Where a parabola through three values has its vertex, from the middle one."""
    bend = before - 2 * peak + after
    return 0.0 if bend >= 0 else min(max((before - after) / (2 * bend), -0.5), 0.5)
