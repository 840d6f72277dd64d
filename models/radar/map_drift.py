r"""Map drift: the velocity that focuses an aperture, from the shift between two looks of it.

Two halves of an aperture of length :math:`T` see the same place at Doppler frequencies that differ
by :math:`f_1 - f_2 = K_a T / 2`. Compressed with the rate :math:`\hat K_a` in place of :math:`K_a`
they show it at times that differ by (eq. (14) of the aircraft paper)

.. math::
    \Delta\eta = \eta_1 - \eta_2 = (f_1 - f_2)\left(\frac{1}{\hat K_a} - \frac{1}{K_a}\right)
               = \frac{T}{2}\left(\frac{V^2}{\hat V^2} - 1\right),

so that (eqs. (15), (16)) :math:`V = \hat V \sqrt{1 + 2 \Delta\eta / T}`, at every range alike.

* The paper prints :math:`\Delta f_a = f_1 - f_1`; :math:`f_1 - f_2` is meant. The sign follows: too
  large a velocity gives a negative shift.
* The halves are those of *time*. Halves of the Doppler band are the same thing only where each
  target is seen over the whole band; with a beam wider than the aperture they show other places at
  other times, and the velocity is biased.
* What is measured is not the speed. A navigator that compensates its own motion takes its own
  acceleration for the true one, and an error :math:`\delta a` of it, along the line of sight
  :math:`u`, changes the Doppler rate as an error of velocity would:

  .. math:: V_{\mathrm{af}} - \hat V = l^T \delta v - \frac{R}{2 V} u^T \delta a .

  Errors are truth less estimate. At 1.5 km and 70 m/s the factor is 11 s, and an accelerometer off
  by 1 mg looks like 0.11 m/s. `map_drift_row` gives what it measures of velocity, attitude and
  accelerometer bias.

References
----------
.. [1] The aircraft paper, eqs. (14)-(16).
.. [2] W. G. Carrara, R. S. Goodman, R. M. Majewski, "Spotlight Synthetic Aperture Radar", Artech
       House, 1995, ch. 6: map drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray, Single
from terrafix.models.radar.correlation import Shift, contrast, shift_between
from terrafix.models.radar.focusing import Image, RangeDoppler, azimuth_looks, time_looks

GATE = 5.5
"""Height of the peak over the rms of the correlation of two looks, at least."""
ROUNDS = 3
_COLUMNS = 16
"""Range cells that looks are searched for beside each other: no true shift, only the rms."""
_CLOSE = 2e-3
"""Change of velocity [m/s] below which another round changes nothing."""


@dataclass(frozen=True)
class MapDrift:
    """What map drift found.

    Parameters
    ----------
    velocity : float
        That focuses the aperture [m/s]; where refused, that of the start.
    sigma : float
        Standard error that the parts of the image agree on [m/s].
    quality : float
        Height of the last peak over the rms of its correlation surface.
    n_rounds : int
    accepted : bool
    """

    velocity: float
    sigma: float
    quality: float
    n_rounds: int
    accepted: bool


def map_drift(
    domain: RangeDoppler,
    velocity: float,
    *,
    largest: float = 4.0,
    gate: float = GATE,
    rounds: int = ROUNDS,
    looks: str = "time",
) -> MapDrift:
    """Find the velocity that focuses an aperture.

    Parameters
    ----------
    domain : RangeDoppler
        Echo of the aperture, its migration removed.
    velocity : float
        That the navigator believes [m/s].
    largest : float
        Largest change that is looked for [m/s].
    gate : float
        Quality that is accepted.
    rounds : int
        Of forming both looks, at most.
    looks : {"time", "band"}
        What the looks are halves of; "band" is a control that is biased.

    Raises
    ------
    ValueError
        If nothing is focused, or `looks` is not a known choice.
    """
    if looks not in ("time", "band"):
        raise ValueError(f"looks must be halves of 'time' or of the 'band', got '{looks}'")
    split = time_looks if looks == "time" else azimuth_looks
    half = (domain.n_lines // 2) / domain.radar.prf
    own, sigma, k = velocity, np.inf, 0
    shift = None
    for k in range(1, rounds + 1):
        first, second = split(domain, own, 2)
        shift = _shift(first, second, own, half, largest + abs(own - velocity))
        if not (shift.inside and shift.quality >= gate):
            return MapDrift(velocity, np.inf, shift.quality, k, False)
        apart = float(shift.pixels[0]) / domain.radar.prf
        if looks == "band":
            half = _band_time(domain, own)
        better = own * np.sqrt(max(1 + apart / half, 0.25))
        sigma = own * np.sqrt(shift.covariance[0, 0]) / domain.radar.prf / (2 * half)
        change, own = better - own, better
        if abs(change) < _CLOSE:
            break
    quality = shift.quality if shift is not None else 0.0
    accepted = abs(own - velocity) <= largest
    return MapDrift(own if accepted else velocity, sigma, quality, k, accepted)


def _band_time(domain: RangeDoppler, velocity: float) -> float:
    """Time between the halves of the band, if all of it were seen [s]."""
    distance = float(domain.slant_range[domain.columns].mean())
    rate = 2 * velocity**2 / (domain.radar.wavelength * distance)
    return domain.radar.doppler_bandwidth / 2 / rate


def _shift(first: Image, second: Image, velocity: float, half: float, largest: float) -> Shift:
    """Shift of the first look against the second, in lines and cells."""
    one, other = (contrast(_amplitude(look)) for look in (first, second))
    rows = int(np.ceil(2 * largest / velocity * half * first.radar.prf)) + 4
    rows = min(rows, one.shape[0] // 4)
    inner = np.ascontiguousarray(one[rows:-rows, _COLUMNS:-_COLUMNS])
    return shift_between(inner, other, (rows, _COLUMNS))


def _amplitude(image: Image) -> Single:
    return np.abs(image.valid)


def map_drift_row(
    velocity: ArrayLike, sight: ArrayLike, force: ArrayLike, attitude: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    r"""What map drift measures, by errors (truth less estimate) of a navigator.

    .. math::
        V_{\mathrm{af}} - \hat V = l^T \delta v - \frac{R}{2V} u^T \delta a, \qquad
        \delta a = [f \times] \delta\theta - C \delta b_a,

    for :math:`C_\mathrm{true} = (I - [\delta\theta \times]) \hat C`.

    Parameters
    ----------
    velocity : array_like, shape (..., 3)
        [m/s]
    sight : array_like, shape (..., 3)
        From the antenna to the middle of what is seen [m].
    force : array_like, shape (..., 3)
        Specific force [m/s^2], in the frame of velocity and sight.
    attitude : array_like, shape (..., 3, 3)
        Body to that frame.

    Returns
    -------
    by_velocity, by_attitude, by_bias : ndarray, shape (..., 3)
    """
    v, line, f, C = (np.asarray(a, np.float64) for a in (velocity, sight, force, attitude))
    speed, distance = (np.linalg.norm(a, axis=-1, keepdims=True) for a in (v, line))
    lever = -(distance / (2 * speed)) * line / distance
    by_attitude = np.cross(lever, f)
    by_bias = -np.einsum("...i,...ij->...j", lever, C)
    return v / speed, by_attitude, by_bias
