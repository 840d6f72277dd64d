r"""Autofocus: the effective velocity at which an image is sharpest, or the refusal to name one.

Sharpness is the normalized variance of intensity, :math:`\sigma_I^2 / \bar I^2` (Algorithm 1 of
[1]_): one for speckle, larger where bright points stand out, largest in focus. It is taken of the
image's parts, and their geometric mean is climbed: of the whole, one slope that faces the radar
can have more variance than all that focus would bring out elsewhere. The climb walks along a grid
of velocities while sharpness grows. It begins with strides wider than the peak, which a ripple of
speckle on its slope does not stop, and halves them down to the grid; a parabola about the peak
refines it.

Whether the peak means anything is asked of the parts again: a parabola as wide as the depth of
focus gives a velocity; leaving out one part at a time (jackknife) gives its standard error.
Featureless speckle has curves without a common peak and an error of tens of meters per second.

The depth of focus is where the quadratic phase at the edges of the band reaches a few radians,

.. math:: \phi(\Delta V) = \frac{\pi B^2}{4 K_a} \frac{2 \Delta V}{V}, \qquad
          K_a = \frac{2 V^2}{\lambda R}.

References
----------
.. [1] B. Pogorelsky, R. Zanetti, J. Chen, S. Jenkins, "Synthetic Aperture Radar Based Spacecraft
       Terrain Relative Navigation", section III, Algorithm 1. We differ: parts of the image,
       strides that shrink, sub-step refinement, a standard error, and a refusal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray
from terrafix.models.radar.focusing import RangeDoppler, azimuth_compressed

BLOCKS = (4, 4)
"""Parts of an image, in azimuth and range, that must agree."""
STRIDE = 2.5
"""First stride of the climb, in depths of focus."""
DEPTH = 3.0
"""Quadratic phase at the band's edges that counts as out of focus [rad]."""


def normalized_variance(intensity: ArrayLike) -> float:
    """Variance of intensity over the square of its mean; NaN where there is no intensity."""
    image = np.asarray(intensity, dtype=np.float64)
    mean = image.mean()
    return float(image.var() / mean**2) if mean > 0 else float("nan")


def depth_of_focus(domain: RangeDoppler, velocity: float) -> float:
    """Velocity error [m/s] at which the phase at the band's edges reaches `DEPTH`."""
    radar = domain.radar
    distance = float(domain.slant_range[domain.columns].mean())
    rate = 2 * velocity**2 / (radar.wavelength * distance)
    return DEPTH * velocity * 2 * rate / (np.pi * radar.doppler_bandwidth**2)


class SharpnessCurve:
    """Sharpness of one echo as a function of velocity, each value computed once.

    Velocities are multiples of a step, so that an ensemble of starts on the same echo shares them.

    Parameters
    ----------
    domain : RangeDoppler
        Echo, compressed in range and with its migration removed.
    step : float
        Grid of velocities [m/s].
    rows, columns : slice, optional
        Part of the image that is judged; what is fully focused at `domain.velocity` by default.
        A row shows the same echo at every velocity.

    Raises
    ------
    ValueError
        If the step is not positive, or the part is too small to be divided into blocks.
    """

    def __init__(
        self,
        domain: RangeDoppler,
        step: float = 1.0,
        rows: slice | None = None,
        columns: slice | None = None,
    ) -> None:
        if not (np.isfinite(step) and step > 0):
            raise ValueError(f"a step of {step} m/s is not positive")
        self.domain, self.step = domain, step
        whole = azimuth_compressed(domain, domain.velocity)
        self.rows, self.columns = rows or whole.rows, columns or whole.columns
        shape = whole.data[self.rows, self.columns].shape
        if shape[0] < 8 * BLOCKS[0] or shape[1] < 8 * BLOCKS[1]:
            raise ValueError(
                f"an image of {shape[0]} x {shape[1]} pixels is too small to be judged: "
                f"{8 * BLOCKS[0]} x {8 * BLOCKS[1]} at least"
            )
        self._known: dict[int, FloatArray] = {}

    @property
    def n_images(self) -> int:
        """Number of images formed so far."""
        return len(self._known)

    def nearest(self, velocity: float) -> int:
        """Grid point next to a velocity."""
        return round(velocity / self.step)

    def at(self, index: int) -> float:
        """Sharpness at a grid point: the geometric mean of the blocks' normalized variances."""
        return float(np.exp(self.blocks(index).mean()))

    def blocks(self, index: int) -> FloatArray:
        """Logarithm of the normalized variance of every block at a grid point."""
        if index not in self._known:
            image = azimuth_compressed(self.domain, index * self.step)
            amplitude = image.data[self.rows, self.columns]
            intensity = amplitude.real**2 + amplitude.imag**2
            parts = [
                normalized_variance(part)
                for band in np.array_split(intensity, BLOCKS[0], axis=0)
                for part in np.array_split(band, BLOCKS[1], axis=1)
            ]
            self._known[index] = np.log(parts)
        return self._known[index]


@dataclass(frozen=True)
class Focus:
    """What autofocus found.

    Parameters
    ----------
    velocity : float
        Effective velocity at the peak, refined between grid points [m/s].
    sharpness : float
        Geometric mean of normalized variances at the best grid point.
    sigma : float
        Standard error of the velocity that the blocks agree on [m/s].
    accepted : bool
    reason : str
        Why it was refused; ``"accepted"`` if it was not.
    """

    velocity: float
    sharpness: float
    sigma: float
    accepted: bool
    reason: str


def autofocus(
    curve: SharpnessCurve,
    start: float,
    *,
    max_scatter: float = 0.08,
    max_change: float = 100.0,
) -> Focus:
    """Climb from a velocity to the next peak of sharpness, and judge it.

    Parameters
    ----------
    curve : SharpnessCurve
    start : float
        Velocity that the navigator believes [m/s].
    max_scatter : float
        Largest standard error that is accepted, in depths of focus: recorded echo shows 0.02 to
        0.04, speckle 0.09 and more.
    max_change : float
        Largest change from `start` [m/s].
    """
    best = first = curve.nearest(start)
    limit = round(max_change / curve.step)
    depth = depth_of_focus(curve.domain, start)
    stride = max(1, round(STRIDE * depth / curve.step))
    while stride:
        better = max((best - stride, best + stride), key=curve.at)
        if not curve.at(better) > curve.at(best):
            stride //= 2
            continue
        best = better
        if abs(best - first) > limit:
            return Focus(best * curve.step, curve.at(best), np.inf, False, "no peak near the start")
    velocity = _refined(curve, best)
    agreed, sigma, curvature = _agreement(curve, best)
    depth = depth_of_focus(curve.domain, velocity)
    reason = "accepted"
    if not (curvature < 0 and sigma <= max_scatter * depth):
        reason = "parts of the image do not agree on a peak"
    elif abs(agreed - velocity) > depth / 2:
        reason = "the peak is not where the parts of the image put it"
    return Focus(velocity, curve.at(best), sigma, reason == "accepted", reason)


def _refined(curve: SharpnessCurve, best: int) -> float:
    """Peak of a parabola through the logarithm of sharpness, half a depth of focus to each side.

    Through few points over the whole width of the peak: neighbors on a fine grid differ by less
    than speckle makes them uncertain.
    """
    width = max(1, round(depth_of_focus(curve.domain, best * curve.step) / curve.step / 2))
    stride = max(1, width // 3)
    offsets = np.arange(-(width // stride), width // stride + 1) * stride
    values = np.log([curve.at(best + int(k)) for k in offsets])
    curvature, slope, _ = np.polyfit(offsets, values, 2)
    shift = -slope / (2 * curvature) if curvature < 0 else 0.0
    return float((best + np.clip(shift, -width, width)) * curve.step)


def _vertex(low: float, middle: float, high: float) -> tuple[float, float]:
    """Curvature of three equidistant values, and where their parabola peaks, in steps."""
    curvature = low - 2 * middle + high
    return curvature, (low - high) / (2 * curvature) if curvature else 0.0


def _agreement(curve: SharpnessCurve, best: int) -> tuple[float, float, float]:
    """Velocity that the blocks agree on [m/s], its jackknife standard error, and the curvature."""
    width = max(1, round(depth_of_focus(curve.domain, best * curve.step) / curve.step))
    values = np.array([curve.blocks(best + k * width) for k in (-1, 0, 1)])
    n = values.shape[1]
    curvature, whole = _vertex(*values.mean(axis=1))
    total = values.sum(axis=1)
    without = [_vertex(*((total - values[:, i]) / (n - 1)))[1] for i in range(n)]
    scatter = float(np.sqrt((n - 1) / n * np.sum((np.array(without) - np.mean(without)) ** 2)))
    scale = width * curve.step
    return best * curve.step + whole * scale, scatter * scale, curvature
