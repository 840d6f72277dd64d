r"""What the atmosphere does to an image of the ground: turbulence and refraction.

Turbulence after Hufnagel and Valley, of height h above the ground [m],

.. math::
    C_n^2(h) = 0.00594 \left(\tfrac{w}{27}\right)^2 (10^{-5} h)^{10} e^{-h/1000}
        + 2.7 \times 10^{-16} e^{-h/1500} + A\, e^{-h/100},

with :math:`w = 21` m/s and :math:`A = 1.7 \times 10^{-14}` m^(-2/3): coherence of 5 cm and an
isoplanatic angle of 7 microradians for a vertical path at 500 nm, hence "HV 5/7".

Light from a point on the ground is a spherical wave; at a satellite at height H the turbulence that
it met counts by

.. math::
    \mu = \int_0^H C_n^2(h) \left(\frac{h}{H}\right)^{5/3} dh, \qquad
    r_0 = (0.423\, k^2 \sec\zeta\, \mu)^{-3/5}, \qquad
    \langle\beta^2\rangle = 2.91\, \mu \sec\zeta\, D^{-1/3}.

Refraction: along a ray in a spherically layered atmosphere :math:`n r \sin z` is constant.

References
----------
.. [1] L. C. Andrews, R. L. Phillips, "Laser Beam Propagation through Random Media", 2nd ed., SPIE,
       2005, chapters 6 and 12.
.. [2] "Satellite-Based Fusion of Image/Inertial Sensors for Precise Geolocation", AFIT thesis,
       eqs. (2.52) to (2.69). We differ: a spherical wave has the weight :math:`(h/H)^{5/3}`, not
       1; the variance of the angle of arrival is no root mean square; the path moment is
       integrated to convergence (steps of H / 200, which are 195 km for its high orbit, see
       nothing of the atmosphere, and its 1e-34 pixels come of that); heights are in meters, the
       wavelength of the refractive index in micrometers.
"""

from __future__ import annotations

from itertools import pairwise
from math import pi

import numpy as np
from numpy.typing import ArrayLike

from terrafix.models.core.arrays import FloatArray

WIND = 21.0
"""Root mean square of the wind from 5 to 20 km that the 5/7 model is defined with [m/s]."""
GROUND = 1.7e-14
"""Structure parameter at the ground [m^(-2/3)]."""
TOP = 1.0e5
"""Above this height nothing is left of turbulence [m]."""
_PANELS = np.array([0.0, 100.0, 300.0, 1e3, 3e3, 5e3, 1e4, 1.5e4, 2e4, 3e4, 5e4, TOP])
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)

TROPOPAUSE, CEILING = 11.0e3, 20.0e3
"""Where the temperature stops falling, and where the thesis lets the atmosphere end [m]."""


def hufnagel_valley(h: ArrayLike) -> FloatArray:
    """Structure parameter of the refractive index [m^(-2/3)] at heights [m], shape (...)."""
    h = np.asarray(h, np.float64)
    high = 0.00594 * (WIND / 27) ** 2 * (1e-5 * h) ** 10 * np.exp(-h / 1000)
    return np.asarray(high + 2.7e-16 * np.exp(-h / 1500) + GROUND * np.exp(-h / 100))


def bufton_wind(
    h: ArrayLike, ground: float = 5.0, height: float = 9400.0, jet: float = 30.0
) -> FloatArray:
    """Speed of the wind after Bufton [m/s] at heights [m]: `ground`, and a jet about `height`."""
    h = np.asarray(h, np.float64)
    return np.asarray(ground + jet * np.exp(-(((h - height) / 4800.0) ** 2)))


def rms_wind(ground: float = 5.0, height: float = 9400.0) -> float:
    """Root mean square of Bufton's wind from 5 to 20 km [m/s]."""
    h, w = _quadrature(np.linspace(5e3, 20e3, 6))
    return float(np.sqrt(w @ bufton_wind(h, ground, height) ** 2 / 15e3))


def path_moment(power: float, scale: float = 1.0, top: float = TOP) -> float:
    r"""Integral of :math:`C_n^2(h) (h / \mathrm{scale})^{\mathrm{power}}` from 0 to `top` [m].

    By Gauss and Legendre in panels that follow the profile: converged to 1e-10.
    """
    panels = np.append(_PANELS[top > _PANELS], min(top, TOP))
    h, w = _quadrature(panels)
    return float(w @ (hufnagel_valley(h) * (h / scale) ** power))


def uplink_moment(height: float) -> float:
    """Path moment [m^(1/3)] of light from the ground as it comes to a satellite at a height [m]."""
    return path_moment(5 / 3, height, height)


def fried_parameter(moment: float, wavelength: float, zenith: float = 0.0) -> float:
    """Coherence width [m] of light of a wavelength [m] at an angle off the vertical [rad]."""
    k = 2 * pi / wavelength
    return float((0.423 * k * k / np.cos(zenith) * moment) ** (-3 / 5))


def isoplanatic_angle(wavelength: float, zenith: float = 0.0) -> float:
    """Angle [rad] over which turbulence is the same, seen from the ground."""
    k = 2 * pi / wavelength
    return float((2.914 * k * k * np.cos(zenith) ** (-8 / 3) * path_moment(5 / 3)) ** (-3 / 5))


def tilt(height: float, aperture: float, zenith: float = 0.0) -> float:
    """Root mean square of the angle [rad] at which light from the ground comes to a satellite.

    Parameters
    ----------
    height : float
        Of the satellite [m].
    aperture : float
        Diameter of its lens [m].
    zenith : float
        Angle of the path off the vertical [rad].
    """
    variance = 2.91 * uplink_moment(height) / np.cos(zenith) * aperture ** (-1 / 3)
    return float(np.sqrt(variance))


def image_motion(height: float, aperture: float, focal: float, zenith: float = 0.0) -> float:
    """Root mean square motion of an image [m] in the focal plane of a lens of focal length [m]."""
    return focal * tilt(height, aperture, zenith)


def ground_motion(height: float, aperture: float, zenith: float = 0.0) -> float:
    """The same on the ground [m], over a flat Earth's slant range."""
    return tilt(height, aperture, zenith) * height / float(np.cos(zenith))


def pressure(h: ArrayLike) -> FloatArray:
    """Pressure of the thesis' atmosphere [mbar] at heights [m]; zero above 44 km."""
    h = np.asarray(h, np.float64)
    return np.asarray(1e3 * np.maximum(1 - 2.26e-5 * h, 0.0) ** 5.32)


def temperature(h: ArrayLike) -> FloatArray:
    """Temperature of the thesis' atmosphere [K] at heights [m]: 6.81 K/km up to the tropopause."""
    h = np.asarray(h, np.float64)
    return np.asarray(293.0 - 6.81e-3 * np.minimum(h, TROPOPAUSE))


def refractive_index(h: ArrayLike, wavelength: float) -> FloatArray:
    """Refractive index of air at heights [m] for a wavelength [m]."""
    dispersion = 1 + 7.52e-3 / (wavelength * 1e6) ** 2
    return np.asarray(1 + 77.6e-6 * dispersion * pressure(h) / temperature(h))


def refraction(distance: float, nadir: float, wavelength: float, radius: float = 6.378e6) -> float:
    r"""How far refraction moves the place where a line of sight from a satellite meets the ground.

    The ray keeps :math:`p = n r \sin z`; its angle about the center of the Earth is the integral of
    :math:`p / (r \sqrt{n^2 r^2 - p^2})`, and the straight line's is the same with n = 1. Their
    difference, over the atmosphere alone, times the radius.

    Parameters
    ----------
    distance : float
        Of the satellite from the center of the Earth [m].
    nadir : float
        Angle of the line of sight off the nadir, at the satellite [rad].
    wavelength : float
        [m]
    radius : float
        Of the Earth [m].

    Returns
    -------
    float
        Along the ground, toward the satellite's nadir [m].

    Raises
    ------
    ValueError
        If the line of sight misses the Earth.
    """
    p = distance * np.sin(nadir)
    if p >= radius:
        raise ValueError(
            f"a line of sight {np.degrees(nadir):.2f} deg off the nadir misses the Earth"
        )
    h, w = _quadrature(np.linspace(0.0, 44e3, 23))
    r, n = radius + h, refractive_index(h, wavelength)
    bent = 1 / np.sqrt((n * r) ** 2 - p * p)
    straight = 1 / np.sqrt(r * r - p * p)
    return float(radius * (w @ (p / r * (straight - bent))))


def printed_refraction(height: float, zenith: float, wavelength: float) -> float:
    """Equation (2.69) of the thesis [m], which is not what refraction moves on the ground.

    It is how much farther a ray that leaves the ground at a given angle crosses the satellite's
    height for being bent in two flat layers, each of its mean refractive index: 40 to 200 times
    what a line of sight from the satellite is displaced by (`refraction`).

    Parameters
    ----------
    height : float
        Of the satellite [m].
    zenith : float
        Angle at which the ray leaves the ground [rad].
    wavelength : float
        [m]
    """
    borders = np.array([0.0, TROPOPAUSE, CEILING])
    means = []
    for low, high in pairwise(borders):
        h, w = _quadrature(np.linspace(low, high, 5))
        means.append(w @ refractive_index(h, wavelength) / (high - low))
    sine = np.sin(zenith) * means[0] / np.array([*means, 1.0])
    depth = np.append(np.diff(borders), height - CEILING)
    return float(depth @ (sine / np.sqrt(1 - sine**2)) - height * np.tan(zenith))


def _quadrature(panels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights of Gauss and Legendre, panel by panel."""
    low, half = panels[:-1, None], np.diff(panels)[:, None] / 2
    return (low + half * (1 + _NODES)).ravel(), (half * _WEIGHTS).ravel()
