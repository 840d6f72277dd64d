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
  by 1 mg looks like 0.11 m/s. `terrafix.models.sensors.aperture.shift_of` is what a filter
  expects of it.

References
----------
.. [1] The aircraft paper, eqs. (14)-(16).
.. [2] W. G. Carrara, R. S. Goodman, R. M. Majewski, "Spotlight Synthetic Aperture Radar", Artech
       House, 1995, ch. 6: map drift.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from terrafix.models.core.arrays import Single
from terrafix.models.radar.correlation import Shift, contrast, shift_between
from terrafix.models.radar.focusing import RangeDoppler, azimuth_looks, time_looks

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
        Its standard error, from the correlation surface [m/s].
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


@dataclass(frozen=True)
class Looks:
    """Two images of the same pixels, from two parts of an aperture.

    Parameters
    ----------
    first, second : ndarray of float32, shape (n_rows, n_columns)
        Amplitudes; rows go along the track.
    row_time : float
        Time of flight between rows [s].
    apart : float
        Between the middles of both parts [s].
    """

    first: Single
    second: Single
    row_time: float
    apart: float


def drifted(
    looks_at: Callable[[float], Looks], start: float, largest: float, rounds: int = ROUNDS
) -> MapDrift:
    """Change a velocity until two looks formed with it show the same.

    Parameters
    ----------
    looks_at : callable
        Looks of a velocity [m/s].
    start : float
        Velocity that the navigator believes [m/s].
    largest : float
        Largest change that is looked for [m/s].
    rounds : int
        Of forming both looks, at most.
    """
    own = start
    for k in range(1, rounds + 1):
        looks = looks_at(own)
        shift = _shift(looks, (largest + abs(own - start)) / own)
        if not (shift.inside and shift.quality >= GATE):
            return MapDrift(start, np.inf, shift.quality, k, False)
        apart = float(shift.pixels[0]) * looks.row_time / looks.apart
        sigma = own * np.sqrt(shift.covariance[0, 0]) * looks.row_time / (2 * looks.apart)
        before, own = own, own * np.sqrt(max(1 + apart, 0.25))
        if abs(own - before) < _CLOSE:
            break
    accepted = bool(abs(own - start) <= largest)
    return MapDrift(own if accepted else start, sigma, shift.quality, k, accepted)


def _shift(looks: Looks, share: float) -> Shift:
    """Shift of the first look against the second, for velocities off by a share."""
    one, other = contrast(looks.first), contrast(looks.second)
    rows = int(np.ceil(2 * share * looks.apart / looks.row_time)) + 4
    rows = min(rows, one.shape[0] // 4)
    inner = np.ascontiguousarray(one[rows:-rows, _COLUMNS:-_COLUMNS])
    return shift_between(inner, other, (rows, _COLUMNS))


def map_drift(
    domain: RangeDoppler,
    velocity: float,
    *,
    largest: float = 4.0,
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
    prf, half = domain.radar.prf, (domain.n_lines // 2) / domain.radar.prf

    def looks_at(own: float) -> Looks:
        split = time_looks if looks == "time" else azimuth_looks
        first, second = (np.abs(image.valid) for image in split(domain, own, 2))
        return Looks(first, second, 1 / prf, half if looks == "time" else _band_time(domain, own))

    return drifted(looks_at, velocity, largest, rounds)


def _band_time(domain: RangeDoppler, velocity: float) -> float:
    """Time between the halves of the band, if all of it were seen [s]."""
    distance = float(domain.slant_range[domain.columns].mean())
    rate = 2 * velocity**2 / (domain.radar.wavelength * distance)
    return domain.radar.doppler_bandwidth / 2 / rate
