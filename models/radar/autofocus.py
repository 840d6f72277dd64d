r"""Autofocus: the effective velocity at which an image is sharpest, or the refusal to name one.

Sharpness is the normalized variance of intensity, :math:`s = \sigma_I^2 / \bar I^2` (Algorithm 1
of [1]_): one for speckle, larger where bright points stand out, largest in focus. It is taken of
the image's parts, and their geometric mean is climbed: of the whole, one slope that faces the radar
can have more variance than all that focus would bring out elsewhere. The climb walks along a grid
of velocities while sharpness grows. It begins with strides wider than the peak, which a ripple of
speckle on its slope does not stop, and halves them down to the grid. Where the peak that it ends on
is refused, the highest one within reach is tried.

The velocity comes of smaller blocks, each a measurement of its own. About the peak, with :math:`x`
the velocity in depths of focus,

.. math:: \ln s_b(x) \approx \ln s_b(0) + g_b\,x - \tfrac{1}{2} c_b\,x^2, \qquad
          g_b = c_b\,x_0 + \epsilon_b,

and :math:`x_0` is where all of them peak. Two things are in :math:`\epsilon_b`:

* Speckle. Of :math:`N_b` resolution cells, the logarithm of sharpness has the covariance
  :math:`4 \rho(x - x') / N_b` at two velocities, with :math:`\rho` the sharpness of a point out of
  focus (`point_sharpness`): what two images of one speckle share is what one point spreads.
* What shines is no point. A building shifts its phase center by a millimeter while it is seen, a
  ship moves: each recorded target has a velocity of its own, some `TARGETS` depths of focus off
  where it rests, and many times that where it moves.

Weights are those of both, and :math:`x_0` is Huber's estimate [2]_: a ship counts for no more than
a house that is somewhat off. Blocks whose curvature is not more than speckle makes it by chance
share their median one. The standard error follows from the residuals as they are, and is the
standard deviation of Student's distribution: few bright points are known to be few. Curvature that
speckle has by chance is refused against its known error.

What parts of a scene disagree by because the effective velocity changes from one to the other is
known: its growth with range is in the compression (`RangeDoppler.velocity_slope`), that along the
track is taken off each block. Only relief is left, 0.5 mm/s for each meter of height.

The depth of focus is where the quadratic phase at the edges of the band reaches a few radians,

.. math:: \phi(\Delta V) = \frac{\pi B^2}{4 K_a} \frac{2 \Delta V}{V}, \qquad
          K_a = \frac{2 V^2}{\lambda R}.

References
----------
.. [1] B. Pogorelsky, R. Zanetti, J. Chen, S. Jenkins, "Synthetic Aperture Radar Based Spacecraft
       Terrain Relative Navigation", section III, Algorithm 1. We differ: parts of the image,
       strides that shrink, an estimate from blocks with its standard error, and a refusal.
.. [2] P. J. Huber, E. M. Ronchetti, "Robust Statistics", 2nd ed., Wiley, 2009, ch. 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.radar.focusing import RangeDoppler, azimuth_compressed

REASONS = (
    "accepted",
    "no peak near the start",
    "nothing stands out of speckle",
    "too few parts of the image stand out",
    "parts of the image do not agree on a peak",
    "the peak is not where the parts of the image put it",
)
"""What became of a search for focus."""

PARTS = 4
"""Parts of an image along each axis, whose geometric mean is climbed."""
BLOCKS = 4
"""Blocks along each axis of a part, at most, of which the velocity is estimated."""
SMALLEST = 8
"""Pixels along each axis of a block, at least."""
STRIDE = 2.5
"""First stride of the climb, in depths of focus."""
DEPTH = 3.0
"""Quadratic phase at the band's edges that counts as out of focus [rad]."""
HALF_WIDTH = 0.5
"""Of the parabola about the peak, in depths of focus."""
TARGETS = 0.08
"""Scatter of the velocities of targets at rest, in depths of focus: 2.2 m/s of RADARSAT-1, 1 mm of
phase center. Measured on its five chunks; all that it does is to weigh."""
HUBER = 1.345
"""Residual, in standard deviations, beyond which a block counts no more [2]_."""
FAR = 3.0
"""Curvature in standard deviations of speckle from the median, that is a block's own."""
EVIDENCE = 6.0
"""Curvature of all blocks together, in its standard errors, at least: speckle on the peaks that a
climb finds in it has 2 to 4."""
AWAY = 0.75
"""From the grid point where most blocks are sharp to their peak, at most, in depths of focus."""
FEWEST = 5.0
"""Blocks that hold the velocity, effectively, at least."""
_CLOSE = 0.05
"""From the middle of the parabola to the peak, in depths of focus: from farther, it is taken anew
about the peak, since a peak is no parabola."""
_FINE = 64
"""Velocities of parabolas by depth of focus: few, so that starts share them."""
_OFFSETS = np.linspace(-HALF_WIDTH, HALF_WIDTH, 5)
_PARABOLA = np.linalg.pinv(
    np.stack([np.ones_like(_OFFSETS), _OFFSETS, -(_OFFSETS**2) / 2], axis=1)
)[1:]
"""Slope and curvature of values at `_OFFSETS`."""
_QUIET = 0.1
"""Share of blocks without targets, from which more than speckle is seen."""
_MEDIAN = 0.6745
"""Of the absolute value of a standard normal variable."""


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


def point_sharpness(x: ArrayLike) -> FloatArray:
    r"""Sharpness of a point out of focus by `x` depths, relative to that in focus, shape (...).

    The autocorrelation of a band :math:`-1 \le t \le 1` under the phase :math:`a t^2` is
    :math:`A(s) = \sin(a s (2 - s)) / (a s)`, and sharpness :math:`\int_0^2 A(s)^2 ds`.
    """
    s = (np.arange(200) + 0.5) / 100
    a = DEPTH * np.abs(np.asarray(x, np.float64))[..., None]
    A = (2 - s) * np.sinc(a * s * (2 - s) / np.pi)
    return np.asarray(np.mean(A**2, axis=-1) / np.mean((2 - s) ** 2))


_NOISE = np.diag(_PARABOLA @ point_sharpness(_OFFSETS[:, None] - _OFFSETS) @ _PARABOLA.T)
"""Variances of slope and curvature, where a value has the variance one."""


_SEEN = float(np.divide(*(_PARABOLA @ np.log(point_sharpness(_OFFSETS - _CLOSE))))) / _CLOSE
"""Share of a small shift that the parabola through the sharpness of a point sees."""


def _independent(share: float) -> float:
    """Independent samples of speckle by sample, where a band fills a share of the sampled one."""
    return float(1 / np.sum(np.sinc(share * np.arange(-32, 33)) ** 4))


class SharpnessCurve:
    """Sharpness of one echo as a function of velocity, each value computed once.

    A velocity is told as a multiple of a step. The climb takes whole ones, so that an ensemble of
    starts on the same echo shares them.

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
        smallest = PARTS * SMALLEST
        if min(shape) < smallest:
            raise ValueError(
                f"an image of {shape[0]} x {shape[1]} pixels is too small to be judged: "
                f"{smallest} x {smallest} at least"
            )
        first, last = whole.t[self.rows][[0, -1]]
        self.middle = float(first + last) / 2
        """Time of zero Doppler in the middle of the part [s]."""
        counts = [PARTS * min(BLOCKS, n // smallest) for n in shape]
        self._edges = [
            np.linspace(0, n, k + 1).astype(np.intp) for n, k in zip(shape, counts, strict=True)
        ]
        self._pixels = np.outer(*(np.diff(edges) for edges in self._edges)).astype(np.float64)
        self._known: dict[float, tuple[FloatArray, float]] = {}

    @property
    def n_images(self) -> int:
        """Number of images formed so far."""
        return len(self._known)

    @property
    def cells(self) -> FloatArray:
        """Independent samples of speckle in every block, shape (n_blocks,)."""
        radar = self.domain.radar
        along = _independent(radar.doppler_bandwidth / radar.prf)
        return (self._pixels * along * _independent(radar.bandwidth / radar.sample_rate)).ravel()

    @property
    def times(self) -> FloatArray:
        """Time of every block, from the middle of the part [s], shape (n_blocks,)."""
        edges = self._edges[0]
        rows = (edges[:-1] + edges[1:] - edges[-1]) / 2
        return np.repeat(rows / self.domain.radar.prf, len(self._edges[1]) - 1)

    def nearest(self, velocity: float) -> int:
        """Grid point next to a velocity."""
        return round(velocity / self.step)

    def at(self, index: float) -> float:
        """Geometric mean of the parts' normalized variances at a multiple of the step."""
        return self._value(index)[1]

    def blocks(self, index: float) -> FloatArray:
        """Logarithm of the normalized variance of every block, shape (n_blocks,)."""
        return self._value(index)[0]

    def _value(self, index: float) -> tuple[FloatArray, float]:
        if index not in self._known:
            image = azimuth_compressed(self.domain, index * self.step)
            amplitude = image.data[self.rows, self.columns]
            intensity = amplitude.real**2 + amplitude.imag**2
            sums = self._summed(intensity), self._summed(intensity**2), self._pixels
            parts = _log_variance(*(_of_parts(x) for x in sums))
            self._known[index] = _log_variance(*sums).ravel(), float(np.exp(parts.mean()))
        return self._known[index]

    def _summed(self, values: NDArray[np.float32]) -> FloatArray:
        """Sums over blocks."""
        along = np.add.reduceat(values, self._edges[0][:-1], axis=0, dtype=np.float64)
        return np.asarray(np.add.reduceat(along, self._edges[1][:-1], axis=1))


def _of_parts(sums: FloatArray) -> FloatArray:
    """Sums over parts from those over their blocks."""
    n, m = (k // PARTS for k in sums.shape)
    return np.asarray(sums.reshape(PARTS, n, PARTS, m).sum(axis=(1, 3)))


def _log_variance(first: FloatArray, second: FloatArray, n: FloatArray) -> FloatArray:
    """Logarithm of normalized variance from the sums of n values and of their squares."""
    variance = n * second - first**2
    safe = (variance > 0) & (first > 0)
    return np.log(np.where(safe, variance, 1.0) / np.where(safe, first**2, 1.0))


@dataclass(frozen=True)
class Focus:
    """What autofocus found.

    Parameters
    ----------
    velocity : float
        Effective velocity that focuses the middle of the judged part [m/s].
    sharpness : float
        Geometric mean of normalized variances at the best grid point.
    sigma : float
        Standard error of the velocity [m/s]; relief is not in it.
    accepted : bool
    reason : str
        One of `REASONS`.
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
    max_change: float = 150.0,
    velocity_rate: float = 0.0,
    thorough: bool = True,
) -> Focus:
    """Climb from a velocity to the next peak of sharpness, and judge it.

    Parameters
    ----------
    curve : SharpnessCurve
    start : float
        Velocity that the navigator believes [m/s].
    max_scatter : float
        Largest standard error that is accepted, in depths of focus: recorded echo shows 0.01 to
        0.03.
    max_change : float
        Largest change from `start` [m/s].
    velocity_rate : float
        How much the effective velocity grows from row to row of the scene [m/s^2].
    thorough : bool
        Whether all velocities within `max_change` are looked at where the climb finds none.
    """
    search = _Search(curve, start, max_scatter, max_change, velocity_rate)
    found = search.judged(search.climbed(search.first, STRIDE))
    if found.accepted or not thorough:
        return found
    other = search.judged(search.climbed(search.highest(), 0.5))
    return other if other.accepted else found


@dataclass(frozen=True)
class _Peak:
    """Where blocks peak, from the middle of a parabola, and its standard error [depths]."""

    shift: float
    sigma: float
    evidence: float
    n_blocks: float


class _Search:
    """Of a velocity, from a start."""

    def __init__(
        self, curve: SharpnessCurve, start: float, scatter: float, change: float, rate: float
    ) -> None:
        self.curve, self.scatter, self.rate = curve, scatter, rate
        self.first, self.limit = curve.nearest(start), change / curve.step
        self.depth = depth_of_focus(curve.domain, curve.domain.velocity) / curve.step

    def climbed(self, best: int, stride: float) -> int:
        """Peak above a grid point; a first stride in depths of focus."""
        at, steps = self.curve.at, max(1, round(stride * self.depth))
        while steps and abs(best - self.first) <= self.limit:
            better = max((best - steps, best + steps), key=at)
            if at(better) > at(best):
                best = better
            else:
                steps //= 2
        return best

    def highest(self) -> int:
        """Highest of all grid points within reach, half a depth of focus apart."""
        steps = max(1, round(self.depth / 2))
        n = int(self.limit // steps)
        return max((self.first + k * steps for k in range(-n, n + 1)), key=self.curve.at)

    def judged(self, best: int) -> Focus:
        step, sharpness = self.curve.step, self.curve.at(best)
        if abs(best - self.first) > self.limit:
            return Focus(best * step, sharpness, np.inf, False, REASONS[1])
        best, guess = self._most(best)
        peak = self._peak(best, guess)
        velocity, sigma = (best + peak.shift * self.depth) * step, peak.sigma * self.depth * step
        refusals = (
            (peak.evidence < EVIDENCE, REASONS[2]),
            (peak.n_blocks < FEWEST, REASONS[3]),
            (peak.sigma > self.scatter, REASONS[4]),
            (abs(peak.shift) > AWAY, REASONS[5]),
        )
        reason = next((why for refused, why in refusals if refused), REASONS[0])
        return Focus(velocity, sharpness, sigma, reason == REASONS[0], reason)

    def _most(self, best: int) -> tuple[int, float]:
        """Grid point where most blocks are sharp, and from there to their peak [depths].

        A few ships that outshine the rest of a scene make a peak of the parts of their own.
        """
        stride = max(1, round(self.depth / 2))
        sharp = [float(self.curve.blocks(best + k * stride).mean()) for k in range(-2, 3)]
        k = int(np.argmax(sharp))
        shift = 0.0
        if 0 < k < 4:
            low, middle, high = sharp[k - 1 : k + 2]
            curvature = low - 2 * middle + high
            shift = (low - high) / (2 * curvature) if curvature else 0.0
        return best + (k - 2) * stride, shift * stride / self.depth

    def _peak(self, best: int, guess: float) -> _Peak:
        """Peak of the blocks, from a grid point, by parabolas that are moved to it."""
        moved = round(guess * _FINE)
        for _ in range(4):
            found = self._parabolas(best + moved * self.depth / _FINE)
            peak = replace(found, shift=found.shift + moved / _FINE)
            if not abs(found.shift) > _CLOSE or abs(peak.shift) > AWAY:
                break
            moved = round(peak.shift * _FINE)
        return peak

    def _parabolas(self, center: float) -> _Peak:
        """Peak that parabolas about a multiple of the step put it at."""
        values = np.stack([self.curve.blocks(center + x * self.depth) for x in _OFFSETS])
        slope, curvature = _PARABOLA @ values
        slope -= curvature * self.rate * self.curve.times / (self.depth * self.curve.step)
        variance = 4 / self.curve.cells
        own = _speckle(slope, curvature, variance)
        shared = max(float(np.median(curvature)), 0.0)
        sigma = np.sqrt(own * _NOISE[1])
        far = np.abs(curvature - shared) > FAR * sigma
        weight = np.where(far, np.maximum(curvature, 0.0), shared)
        if not weight.any():
            return _Peak(0.0, np.inf, 0.0, 0.0)
        evidence = float(weight @ curvature / np.linalg.norm(weight * sigma))
        total = np.sqrt(own * _NOISE[0] + (TARGETS * weight) ** 2)
        return _agreed(slope, curvature, weight, total, evidence)


def _speckle(slope: FloatArray, curvature: FloatArray, variance: FloatArray) -> FloatArray:
    """Variance of the values of blocks, raised to what slopes of blocks without targets show.

    Texture adds to what speckle does; blocks without targets are those in which it outweighs them.
    """
    sigma = np.sqrt(variance * _NOISE[0])
    quiet = TARGETS * curvature < sigma
    if np.mean(quiet) < _QUIET:
        return variance
    growth = float(np.median(np.abs(slope[quiet]) / sigma[quiet])) / _MEDIAN
    return variance * max(growth, 1.0) ** 2


def _agreed(
    slope: FloatArray, curvature: FloatArray, weight: FloatArray, sigma: FloatArray, evidence: float
) -> _Peak:
    """Huber's estimate of what slopes share, by weights that are iterated.

    Parameters
    ----------
    slope, curvature : ndarray, shape (n,)
    weight : ndarray, shape (n,)
        Curvature as far as it is known.
    sigma : ndarray, shape (n,)
        Of slopes, up to a common factor, which is taken from the residuals.
    evidence : float
    """
    held = weight * curvature / sigma**2
    shift = 0.0
    for _ in range(50):
        residual = (slope - curvature * shift) / sigma
        reach = HUBER * _weighted_median(np.abs(residual), held) / _MEDIAN
        counted = np.minimum(1.0, reach / np.maximum(np.abs(residual), 1e-12))
        total = counted @ held
        if not total > 0:
            return _Peak(0.0, np.inf, evidence, 0.0)
        before, shift = shift, float(counted @ (weight * slope / sigma**2) / total)
        if abs(shift - before) < 1e-6:
            break
    inside = np.where(counted < 1.0, 0.0, held)
    if not inside.sum() > 0:
        return _Peak(shift, np.inf, evidence, 0.0)
    n = float(inside.sum() ** 2 / (inside @ inside))
    spread = np.linalg.norm(counted * residual * weight / sigma) / inside.sum()
    student = np.sqrt(n / (n - 3)) if n > FEWEST else np.inf
    return _Peak(shift / _SEEN, float(spread * student) / _SEEN, evidence, n)


def _weighted_median(values: FloatArray, weight: FloatArray) -> float:
    order = np.argsort(values)
    total = np.cumsum(np.maximum(weight, 0.0)[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])
