r"""Where an aperture's image lies on a geocoded reference: a fix in range and along the track.

The reference is warped into the image by the geometry that the navigator's estimate predicts, over
the terrain, so that but for errors of the estimate both show every place at the same pixel; the
shift that is left is found by correlation of amplitude (`terrafix.models.radar.correlation`). An
error of position shifts the far end of a swath by a tenth less than its near end: the reference is
warped once more with what the first shift says of the position, and only the rest is measured
there. Where the search is wide, it begins with coarse pixels.

This is another way than `terrafix.models.images.matching` goes for images from orbit. There the
estimate is a kilometer off and says little of rotation and scale, so features must find them; here
it says where every pixel lies to some meters, and what is sought is a shift alone. A hundred
meters of field have few features.

The fix is of one place :math:`p_t`, in the middle of the image, which the reference names, and

.. math:: z_r = \lVert p_t - p \rVert + b_r, \qquad
          z_c = -\frac{v^T (p_t - p)}{V} + b_c

for position and velocity in the middle of the aperture, :math:`V` the speed that formed the image,
a number. Their derivatives by position are :math:`-u^T` and :math:`l^T`, and by velocity 0 and
:math:`-(p_t - p)^T / V`. The paper's :math:`H_c` leaves that one out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray, Single
from terrafix.models.geometry.geolocation import Height
from terrafix.models.images.reference import Reference
from terrafix.models.radar.aperture_image import PixelGrid
from terrafix.models.radar.correlation import Shift, contrast, shift_between

GATE = 7.0
"""Height of the peak over the rms of the correlation surface, at least: of recorded images, those
that were matched wrongly had 5.6 to 6.6."""
PARTS = 2.7
"""Parts of the image that must hold the peak, of 16. On mirrored images, simulated and recorded,
peaks above the gate are held by 1 to 2.4; right ones by 6 and more over texture and points, and by
3 to 5 in fields with nothing but bright points, of which one in eight is refused."""
SHARE = (0.92, 1.36)
"""Of the standard deviations of z_r and z_c that the correlation surface tells."""
FLOOR = (0.02, 0.02)
"""What is added to them [m], as bright points of both passes fall between pixels. Both were fitted
to 860 fixes of flights in calm air and gusts (seeds 1 to 8, 11 to 18, 41, 42, 51 and 52 of
``benchmarks/aircraft_flights.py``)."""
DRIFT_SHARE = 0.82
"""Of the standard deviation of what map drift reads, by 808 of these; without a floor."""
SHEAR = (0.013, 0.014)
"""And of what the estimate is uncertain by: an error of position shears the image. So that what is
claimed holds of navigators that are off by 3 m, too: fitted to 57 fixes of
``benchmarks/aircraft_images.py --places 12``."""
NARROWEST = (25.0, 12.0)
"""Least reach of a search, along the track and in range [m]."""
WIDEST = (220.0, 60.0)
"""Largest reach of a search [m]."""
REASONS = (
    "accepted",
    "too little of it lies on the reference",
    "correlation has no peak that stands out",
    "the peak is on the border of what was searched",
    "one bright point alone holds the peak",
)
"""What became of an image."""
_SEEN = 0.6
"""Share of the image that must lie on the reference."""
_FINE = 0.7
"""Smoothing of what is correlated [pixels]."""
_TIE = 16
"""Pixels between those whose place is looked up."""
_NEWTON = 4
_COARSE = 3
"""Pixels averaged in one of a coarse search."""
_COARSE_FROM = 40.0
"""Reach from which a search begins with coarse pixels [m]."""


@dataclass(frozen=True)
class ApertureFix:
    """What an image says of where its aperture was.

    Parameters
    ----------
    place : ndarray, shape (3,)
        The point that it is about [m].
    measured : ndarray, shape (2,)
        Slant range from the middle of the line to it, and how far the line's middle was ahead of it
        [m]: z_r and z_c.
    residual : ndarray, shape (2,)
        Those, less what the estimate predicts [m].
    covariance : ndarray, shape (2, 2)
        Of both [m^2], from the correlation surface: `SHARE`, `FLOOR` and `SHEAR`.
    quality : float
        Height of the lowest peak over the rms of its correlation surface; NaN if none was sought.
    accepted : bool
    reason : str
        Why it was refused; ``"accepted"`` if it was not.
    """

    place: FloatArray
    measured: FloatArray
    residual: FloatArray
    covariance: FloatArray
    quality: float
    accepted: bool
    reason: str


def search_reach(covariance: ArrayLike, n_sigma: float = 3.0) -> tuple[float, float]:
    """Reach of a search along the track and in range [m].

    Parameters
    ----------
    covariance : array_like, shape (2, 2)
        Of the predicted (z_r, z_c), all errors of the estimate included [m^2].
    n_sigma : float
        Standard deviations that it must hold.
    """
    sigma = np.sqrt(np.diagonal(np.asarray(covariance, np.float64)))
    along, across = n_sigma * sigma[1], n_sigma * sigma[0]
    return (
        float(np.clip(along, NARROWEST[0], WIDEST[0])),
        float(np.clip(across, NARROWEST[1], WIDEST[1])),
    )


def recognized(shift: Shift) -> bool:
    """Whether a peak stands out, is not on the border, and is held by enough of the image."""
    return shift.inside and shift.quality >= GATE and shift.parts >= PARTS


def matched_aperture(
    amplitude: Single,
    image: PixelGrid,
    reference: Reference,
    terrain: Height,
    reach: tuple[float, float] = NARROWEST,
    expected: ArrayLike = ((0.0, 0.0), (0.0, 0.0)),
) -> ApertureFix:
    """Find where an image lies on a reference, or refuse to say.

    Parameters
    ----------
    amplitude : ndarray of float32, shape (n_rows, n_columns)
        Of the image.
    image : PixelGrid
        Where its pixels lie.
    reference : Reference
    terrain : callable
        Height [m] at latitudes and longitudes [rad], as the navigator knows it.
    reach : tuple of float
        Along the track and in range [m]: `search_reach`.
    expected : array_like, shape (2, 2)
        Covariance of z_r and z_c that the estimate claims [m^2].
    """
    middle = (amplitude.shape[0] - 1) / 2, (amplitude.shape[1] - 1) / 2
    offset, quality = np.zeros(3), np.nan
    # what is far off is found with coarse pixels; then twice with fine ones
    searches = [(reach, 1), (NARROWEST, 1)]
    if max(reach) > _COARSE_FROM:
        searches = [(reach, _COARSE), (NARROWEST, 1), (NARROWEST, 1)]
    for k, (one, coarse) in enumerate(searches):
        pixels = _in_pixels(image, amplitude.shape, one, coarse)
        warped, seen = _warped(image, reference, terrain, amplitude.shape, pixels, offset)
        if seen < _SEEN:
            return _refused(quality, REASONS[1])
        shift = _shift(amplitude, warped, pixels, coarse)
        quality = float(np.fmin(quality, shift.quality))
        if not shift.quality >= GATE:
            return _refused(quality, REASONS[2])
        if not shift.inside:
            return _refused(quality, REASONS[3])
        if not shift.parts >= PARTS:
            return _refused(quality, REASONS[4])
        if k < len(searches) - 1:
            offset = _corrected(image, middle, shift.pixels, terrain, offset)
    unsure = np.square(FLOOR) + np.square(SHEAR) * np.diagonal(np.asarray(expected, np.float64))
    return _fix(image, amplitude.shape, shift, terrain, offset, quality, unsure)


def pixel_steps(image: PixelGrid, shape: tuple[int, ...]) -> FloatArray:
    """Distance ahead and range between pixels in the middle of an image (2,) [m]."""
    middle = [(n - 1) / 2 for n in shape]
    rho, ahead = image.seen(middle[0] + np.array([0.0, 1.0, 0.0]), middle[1] + np.array([0, 0, 1]))
    return np.array([float(ahead[1] - ahead[0]), float(rho[2] - rho[0])])


def _in_pixels(
    image: PixelGrid, shape: tuple[int, ...], reach: tuple[float, float], coarse: int
) -> tuple[int, int]:
    """Reach in pixels, of which `coarse` make one."""
    steps = pixel_steps(image, shape)
    rows, columns = (
        int(np.ceil(m / s / coarse)) * coarse for m, s in zip(reach, steps, strict=True)
    )
    return rows, columns


def _warped(
    image: PixelGrid,
    reference: Reference,
    terrain: Height,
    shape: tuple[int, ...],
    reach: tuple[int, int],
    offset: FloatArray,
) -> tuple[Single, float]:
    """Reference in the frame of the image and beyond it, and the share of the image it covers."""
    wide = [n + 2 * k for n, k in zip(shape, reach, strict=True)]
    ties = [np.arange(-(-(n - 1) // _TIE) + 1) * float(_TIE) for n in wide]
    rows, columns = np.meshgrid(ties[0] - reach[0], ties[1] - reach[1], indexing="ij")
    p = image.places(rows, columns, terrain, offset)
    latitude, longitude, _ = image.ground.geodetic(p)
    i, j, inside = reference.pixel(latitude, longitude)
    x, y = (_between_ties(np.where(inside, a, -1e4), wide) for a in (j, i))
    warped = cv2.remap(reference.amplitude, x, y, cv2.INTER_LINEAR, borderValue=0.0)
    own = warped[reach[0] : reach[0] + shape[0], reach[1] : reach[1] + shape[1]]
    return np.asarray(warped), float((own > 0).mean())


def _between_ties(values: FloatArray, shape: list[int]) -> Single:
    """Linear interpolation of values at every `_TIE`-th pixel to all of an image."""
    y, x = (np.arange(n, dtype=np.float32) / _TIE for n in shape)
    i, j = (np.minimum(a.astype(np.intp), n - 2) for a, n in zip((y, x), values.shape, strict=True))
    u, w = (y - i)[:, None].astype(np.float32), (x - j)[None, :].astype(np.float32)
    rows = values[i] * (1 - u) + values[i + 1] * u
    return np.ascontiguousarray(rows[:, j] * (1 - w) + rows[:, j + 1] * w, np.float32)


def _shift(amplitude: Single, warped: Single, reach: tuple[int, int], coarse: int) -> Shift:
    if coarse == 1:
        return shift_between(contrast(amplitude, fine=_FINE), contrast(warped, fine=_FINE), reach)
    own = _averaged(amplitude, coarse)
    few = reach[0] // coarse, reach[1] // coarse
    wide = _averaged(warped, coarse)[: own.shape[0] + 2 * few[0], : own.shape[1] + 2 * few[1]]
    found = shift_between(contrast(own, 8.0), contrast(wide, 8.0), few)
    return Shift(
        coarse * found.pixels,
        coarse**2 * found.covariance,
        found.quality,
        found.inside,
        found.parts,
    )


def _averaged(image: Single, n: int) -> Single:
    rows, columns = (k // n for k in image.shape)
    part = image[: rows * n, : columns * n].reshape(rows, n, columns, n)
    return np.ascontiguousarray(part.mean(axis=(1, 3)), np.float32)


def _corrected(
    image: PixelGrid,
    middle: tuple[float, float],
    pixels: FloatArray,
    terrain: Height,
    offset: FloatArray,
) -> FloatArray:
    """Offset of the line's place [m] that explains a shift, within the plane of track and sight."""
    rho, ahead = image.seen(middle[0] + pixels[0], middle[1] + pixels[1])
    p = image.places(*middle, terrain, offset)
    for _ in range(_NEWTON):
        sight = p - image.line.r - offset
        distance = float(np.linalg.norm(sight))
        axes = np.stack([image.line.along, sight / distance])
        missing = axes @ sight - np.array([float(ahead), float(rho)])
        offset = offset + _in_plane(axes, missing)
    return offset


def track_offset(image: PixelGrid, fix: ApertureFix) -> FloatArray:
    """What a fix says the track is off by (3,) [m], in the plane of track and sight.

    NaN where it was refused.
    """
    if not fix.accepted:
        return np.full(3, np.nan)
    sight = fix.place - image.line.r
    axes = np.stack([sight / np.linalg.norm(sight), -image.line.along])
    return _in_plane(axes, -fix.residual)


def _in_plane(axes: FloatArray, components: FloatArray) -> FloatArray:
    """Vector (3,) in the plane of two unit vectors (2, 3) that has some components along them."""
    return np.asarray(axes.T @ np.linalg.solve(axes @ axes.T, components))


def _fix(
    image: PixelGrid,
    shape: tuple[int, ...],
    shift: Shift,
    terrain: Height,
    offset: FloatArray,
    quality: float,
    unsure: FloatArray,
) -> ApertureFix:
    middle = (shape[0] - 1) / 2, (shape[1] - 1) / 2
    place = image.places(*middle, terrain, offset)
    rho, ahead = image.seen(middle[0] + shift.pixels[0], middle[1] + shift.pixels[1])
    predicted = image.predicted(place)
    measured = np.array([float(rho), -float(ahead)])
    steps = pixel_steps(image, shape)
    to_meters = np.array([[0.0, SHARE[0] * steps[1]], [-SHARE[1] * steps[0], 0.0]])
    covariance = to_meters @ shift.covariance @ to_meters.T + np.diag(unsure)
    residual = measured - np.array([float(predicted[0]), -float(predicted[1])])
    return ApertureFix(place, measured, residual, covariance, quality, True, REASONS[0])


def _refused(quality: float, reason: str) -> ApertureFix:
    nowhere = np.full(3, np.nan), np.full(2, np.nan), np.full(2, np.nan), np.full((2, 2), np.inf)
    return ApertureFix(*nowhere, quality, False, reason)
