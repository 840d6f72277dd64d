r"""A barometer: pressure in an atmosphere with a day of its own, and the height that it means.

In each layer of the standard atmosphere, from geopotential height :math:`H_b` on, with temperature
:math:`T_b`, its slope :math:`L_b` and pressure :math:`p_b`,

.. math::
    p = p_b \left(1 + \frac{L_b}{T_b} (H - H_b)\right)^{-g_0 / (R L_b)}, \qquad
    p = p_b\, e^{-g_0 (H - H_b) / (R T_b)} \quad (L_b = 0),
    \qquad H = \frac{r_0 h}{r_0 + h}.

The day has a pressure at sea level and a temperature of its own. The reading is

.. math::
    \tilde p = (1 + s)\, p + b + w + \sigma n, \qquad
    w^+ = w + \sigma_w \sqrt{\Delta t}\, n_w,

and the height told is that of the standard atmosphere for it: pressure altitude, as an altimeter
set to 1013.25 hPa reads.

References
----------
.. [1] "U.S. Standard Atmosphere, 1976", NOAA-S/T 76-1562, table 4 and eqs. (18), (33a), (33b).
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from terrafix.models.core.model import Model
from terrafix.models.motion.strapdown import height_of, rotation_rate

GRAVITY, GAS, RADIUS = 9.80665, 8314.32 / 28.9644, 6356766.0
"""Of the standard atmosphere: [m/s^2], [J/kg/K], [m]."""
BASES = (0.0, 11e3, 20e3, 32e3, 47e3, 51e3, 71e3)
"""Geopotential heights where layers begin [m]; the last one ends at 84.852 km."""
SLOPES = (-6.5e-3, 0.0, 1e-3, 2.8e-3, 0.0, -2.8e-3, -2e-3)
"""Of temperature in each layer [K/m]."""
SEA_LEVEL = (101325.0, 288.15)
"""Pressure [Pa] and temperature [K]."""
TOP, LEAST = 84.852e3, 0.3734
"""Geopotential height [m] where it ends, and the pressure there [Pa]."""

_TEMPERATURES = tuple(
    SEA_LEVEL[1] + float(np.dot(np.diff(BASES)[:k], SLOPES[:k])) for k in range(len(BASES))
)


def _layers(pressure0: Any, warmer: Any) -> list[tuple[float, float, Any, Any]]:
    """Base height, slope, temperature and pressure of each layer."""
    found: list[tuple[float, float, Any, Any]] = []
    p = pressure0
    for k, (base, slope, temperature) in enumerate(zip(BASES, SLOPES, _TEMPERATURES, strict=True)):
        if k:
            p = _within(found[-1], base)
        found.append((base, slope, temperature + warmer, p))
    return found


def _within(layer: tuple[float, float, Any, Any], height: Any) -> Any:
    base, slope, temperature, p = layer
    if slope == 0.0:
        return p * ca.exp(-GRAVITY * (height - base) / (GAS * temperature))
    return p * (1 + slope / temperature * (height - base)) ** (-GRAVITY / (GAS * slope))


def pressure_at(height: Any, pressure0: Any = SEA_LEVEL[0], warmer: Any = 0.0) -> Any:
    """Pressure [Pa] at a geometric height [m], up to 86 km.

    Parameters
    ----------
    height : SX
    pressure0 : SX or float
        At sea level [Pa].
    warmer : SX or float
        By how much the air is warmer than the standard atmosphere [K], at every height.
    """
    H = ca.fmin(RADIUS * height / (RADIUS + height), TOP)
    layers = _layers(pressure0, warmer)
    p = _within(layers[0], H)
    for layer in layers[1:]:
        base = layer[0]
        p = ca.if_else(base <= H, _within(layer, ca.fmax(H, base)), p)
    return p


def pressure_height(pressure: Any) -> Any:
    """Geometric height [m] of the standard atmosphere at a pressure [Pa]."""
    layers = _layers(*SEA_LEVEL[:1], 0.0)
    H: Any = 0.0
    for base, slope, temperature, p in layers:
        at = pressure / p
        if slope == 0.0:
            inside = base - GAS * temperature / GRAVITY * ca.log(at)
        else:
            inside = base + temperature / slope * (at ** (-GAS * slope / GRAVITY) - 1)
        H = inside if base == 0.0 else ca.if_else(pressure <= p, inside, H)
    return RADIUS * H / (RADIUS - H)


def barometer_model(earth: str = "wgs84") -> Model:
    """Pressure, and the height that it means.

    Parameters
    ----------
    earth : {"wgs84", "flat"}

    Returns
    -------
    Model
        Input ``r_e`` [m]. Parameters ``sea_level_pressure`` [Pa], ``temperature_offset`` [K],
        ``sigma``, ``bias_sigma`` [Pa], ``scale_sigma`` [-], ``drift`` [Pa/s^0.5]. Outputs
        ``pressure`` [Pa], and ``fix.*`` as of an altimeter: the height [m] and its variance by
        noise, bias, scale and drift, which grows. There is none from a pressure that no height has.

    Raises
    ------
    ValueError
        If the Earth is not known.
    """
    rotation_rate(earth)
    r_e, dt, time = ca.SX.sym("r_e", 3), ca.SX.sym("dt"), ca.SX.sym("time")
    day, errors = (
        ("sea_level_pressure", "temperature_offset"),
        ("sigma", "bias_sigma", "scale_sigma", "drift"),
    )
    p = {n: ca.SX.sym(n) for n in (*day, *errors)}
    bias, scale, wander = (ca.SX.sym(n) for n in ("bias", "scale", "wander"))
    streams = ("white", "bias_noise", "scale_noise", "drift_noise")
    white, n_bias, n_scale, n_drift = noise = [ca.SX.sym(n) for n in streams]
    true = pressure_at(height_of(r_e, earth), p["sea_level_pressure"], p["temperature_offset"])
    read = (1 + scale) * true + bias + wander + p["sigma"] * white
    symbol, told = ca.SX.sym("pressure"), ca.fmax(read, LEAST)
    slope = ca.substitute(ca.jacobian(pressure_height(symbol), symbol), symbol, told)
    variance = p["sigma"] ** 2 + p["bias_sigma"] ** 2 + (p["scale_sigma"] * read) ** 2
    return Model(
        f"barometer_{earth}",
        inputs={"r_e": r_e},
        states={"bias": bias, "scale": scale, "wander": wander},
        parameters=p,
        noise=dict(zip(streams, noise, strict=True)),
        initial={"bias": p["bias_sigma"] * n_bias, "scale": p["scale_sigma"] * n_scale},
        next={"wander": wander + p["drift"] * ca.sqrt(dt) * n_drift},
        outputs={
            "pressure": read,
            "fix.y": pressure_height(told),
            "fix.R": slope**2 * (variance + p["drift"] ** 2 * time),
            "fix.present": ca.SX(1),
            "fix.valid": read > LEAST,
        },
        step=dt,
        time=time,
    )
