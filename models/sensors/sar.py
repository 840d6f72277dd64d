r"""What a synthetic aperture radar tells a navigator: two boresight tangents, range and speed.

The pixel at the center line, at the azimuth time of zero Doppler, lies on the antenna's boresight,
so its two measured tangents are zero by construction. Predicted from an estimate they are not:

.. math::
    r^s = T(\delta\mu)\, T(q_\mu)\, T(q_{sb})\, T(q_{be})\, (r_f - r), \qquad
    y = \begin{bmatrix} x_s / z_s & y_s / z_s & \lVert r_f - r \rVert & \lVert v \rVert
        \end{bmatrix}^T

with :math:`r_f` the pixel's position and :math:`q_\mu` the misalignment of the antenna, whose
error rotates from the left, :math:`T(\delta\mu) \approx I - [\delta\mu \times]`.

Autofocus does not measure the speed but the effective velocity
(`terrafix.models.sensors.effective_velocity`), which depends on position too; with
``in_track="effective"`` the fourth element is that, and its derivatives follow.

Antenna axes: z along the boresight, x along the track, y across it.

References
----------
.. [1] B. S. Pogorelsky, R. Zanetti, J. Chen, S. Jenkins, "Synthetic Aperture Radar Based
       Spacecraft Terrain Relative Navigation", eqs. (16)-(34). The component :math:`z_s` is
       called the slant range there; it equals it only at zero residual. The conference version
       omits :math:`T(q_{be})`.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.geometry.antenna import boresight_direction, nominal_antenna
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ellipsoid_intersection
from terrafix.models.geometry.quaternion import (
    from_rotation_vector,
    from_small_rotation_vector,
    normalized,
    product,
    rotation_matrix,
)
from terrafix.models.sensors.effective_velocity import effective_velocity

BORESIGHTS = ("true", "nominal")
"""Which boresight the synthetic pixel lies on."""

IN_TRACK = ("speed", "effective")
"""What the fourth element is: the speed, or the effective velocity that focuses an image."""


def in_track_velocity(r_e: Any, v_e: Any, r_f_e: Any, in_track: str) -> Any:
    """Fourth element of the measurement [m/s].

    Parameters
    ----------
    r_e, v_e : SX, shape (3,)
        Position [m] and velocity [m/s] of the spacecraft, Earth-fixed.
    r_f_e : SX, shape (3,)
        Position of the pixel [m], Earth-fixed.
    in_track : {"speed", "effective"}

    Raises
    ------
    ValueError
        If `in_track` is not a known choice.
    """
    if in_track == "speed":
        return ca.sqrt(ca.dot(v_e, v_e))
    if in_track != "effective":
        raise ValueError(f"in_track must be one of {IN_TRACK}, got '{in_track}'")
    constants = (EARTH.mu, EARTH.radius, EARTH.j2, EARTH.rotation_rate)
    return effective_velocity(r_e, v_e, r_f_e, *constants)


def predicted_measurement(
    r_e: Any,
    v_e: Any,
    q_mu: Any,
    dmu: Any,
    q_be: Any,
    q_sb: Any,
    r_f_e: Any,
    in_track: str = "speed",
) -> Any:
    """Measurement (4,) predicted at a state: two tangents [-], range [m], velocity [m/s].

    Eqs. (18)-(22) of [1]_. Undefined where the pixel lies across the boresight.

    Parameters
    ----------
    r_e, v_e : SX, shape (3,)
        Position [m] and velocity [m/s] of the spacecraft, Earth-fixed.
    q_mu : SX, shape (4,)
        Misalignment of the antenna, nominal to actual axes.
    dmu : SX, shape (3,)
        Error of the misalignment, a rotation vector in actual antenna axes [rad].
    q_be, q_sb : SX, shape (4,)
        Earth-fixed to body, and body to nominal antenna axes.
    r_f_e : SX, shape (3,)
        Position of the pixel [m], Earth-fixed.
    in_track : {"speed", "effective"}
        What the fourth element is.
    """
    line_e = r_f_e - r_e
    q_se = product(q_mu, product(q_sb, q_be))
    line_s = ca.mtimes(rotation_matrix(q_se), line_e)
    line_s = ca.mtimes(rotation_matrix(from_rotation_vector(dmu)), line_s)
    return ca.vertcat(
        line_s[0] / line_s[2],
        line_s[1] / line_s[2],
        ca.sqrt(ca.dot(line_e, line_e)),
        in_track_velocity(r_e, v_e, r_f_e, in_track),
    )


def sar_measurement_model(in_track: str = "speed") -> Model:
    """Four-element measurement as a function of the state, its error and the pixel.

    Parameters
    ----------
    in_track : {"speed", "effective"}
        What the fourth element is.

    Returns
    -------
    Model
        Inputs as the arguments of `predicted_measurement`; output ``y`` (4,). Jacobians by
        ``r_e``, ``v_e``, ``dmu`` and ``r_f_e``.
    """
    inputs = {
        name: ca.SX.sym(name, 4 if name.startswith("q_") else 3)
        for name in ("r_e", "v_e", "q_mu", "dmu", "q_be", "q_sb", "r_f_e")
    }
    return Model(
        "sar_measurement",
        inputs=inputs,
        outputs={"y": predicted_measurement(**inputs, in_track=in_track)},
        jacobians=[("y", "r_e"), ("y", "v_e"), ("y", "dmu"), ("y", "r_f_e")],
    )


def antenna_mount_model() -> Model:
    r"""Misalignment of the true antenna: a draw at the start, then a random walk.

    .. math::
        q_\mu^+ = \delta q(\sigma_w \sqrt{\Delta t}\, n) \otimes q_\mu, \qquad
        q_{\mu,0} = \delta q(\mu_0 + \sigma_0 n)

    Returns
    -------
    Model
        Parameters ``misalignment`` (3,) [rad], ``misalignment_sigma0`` [rad] and
        ``misalignment_walk`` [rad/sqrt(s)], per axis; output ``q_mu`` (4,).
    """
    q_mu, noise, dt = ca.SX.sym("q_mu", 4), ca.SX.sym("misalignment_noise", 3), ca.SX.sym("dt")
    sigma0, walk = ca.SX.sym("misalignment_sigma0"), ca.SX.sym("misalignment_walk")
    mean = ca.SX.sym("misalignment", 3)
    increment = from_small_rotation_vector(walk * ca.sqrt(dt) * noise)
    return Model(
        "antenna_mount",
        states={"q_mu": q_mu},
        parameters={
            "misalignment": mean,
            "misalignment_sigma0": sigma0,
            "misalignment_walk": walk,
        },
        noise={"misalignment_noise": noise},
        next={"q_mu": normalized(product(increment, q_mu))},
        initial={"q_mu": from_rotation_vector(mean + sigma0 * noise)},
        outputs={"q_mu": q_mu},
        step=dt,
    )


def synthetic_fix_model(boresight: str = "true", in_track: str = "speed") -> Model:
    r"""Fix without an image: where the boresight meets the ellipsoid, with given errors.

    The measured tangents are exactly zero. The range is that to the true pixel; the error of
    geolocation enters the pixel's reported position alone.

    Parameters
    ----------
    boresight : {"true", "nominal"}
        Whether the pixel lies on the misaligned boresight, as it does, or on the nominal one:
        a mistake that the innovations do not show, kept as a negative control.
    in_track : {"speed", "effective"}
        What the fourth element is.

    Returns
    -------
    Model
        Inputs ``r_e`` [m], ``v_e`` [m/s], (3,), ``q_be``, ``q_mu``, (4,). Parameters ``look``,
        ``squint`` [rad], ``range_sigma`` [m], ``speed_sigma`` [m/s], ``geolocation_sigma`` and
        ``geolocation_bias`` (3,) Earth-fixed [m], ``error_scale``, the size of the random errors
        relative to the reported one, ``radius`` [m], ``flattening``. Outputs
        ``fix.y`` (4,), ``fix.r_f_e`` (3,) [m], ``fix.R`` (4, 4), ``fix.D`` (3, 3),
        ``fix.present`` (4,) ones, and ``fix.valid``, 1 where the boresight meets the ellipsoid.

    Raises
    ------
    ValueError
        If a choice is not known.
    """
    if boresight not in BORESIGHTS:
        raise ValueError(f"boresight must be one of {BORESIGHTS}, got '{boresight}'")
    r_e, v_e = ca.SX.sym("r_e", 3), ca.SX.sym("v_e", 3)
    q_be, q_mu = ca.SX.sym("q_be", 4), ca.SX.sym("q_mu", 4)
    scalars = ("look", "squint", "range_sigma", "speed_sigma", "error_scale")
    parameters = {name: ca.SX.sym(name) for name in (*scalars, "radius", "flattening")}
    look, squint, range_sigma, speed_sigma, scale, radius, flattening = parameters.values()
    sigma, bias = ca.SX.sym("geolocation_sigma", 3), ca.SX.sym("geolocation_bias", 3)
    range_noise, speed_noise = ca.SX.sym("range_noise"), ca.SX.sym("speed_noise")
    noise = ca.SX.sym("geolocation_noise", 3)
    q_pixel = q_mu if boresight == "true" else ca.SX([0, 0, 0, 1])
    direction = boresight_direction(q_be, nominal_antenna(look, squint), q_pixel)
    r_f_e, hit = ellipsoid_intersection(r_e, direction, radius, flattening)
    line = r_f_e - r_e
    y = ca.vertcat(
        0,
        0,
        ca.sqrt(ca.dot(line, line)) + scale * range_sigma * range_noise,
        in_track_velocity(r_e, v_e, r_f_e, in_track) + scale * speed_sigma * speed_noise,
    )
    return Model(
        "synthetic_fix",
        inputs={"r_e": r_e, "v_e": v_e, "q_be": q_be, "q_mu": q_mu},
        parameters={**parameters, "geolocation_sigma": sigma, "geolocation_bias": bias},
        noise={
            "range_noise": range_noise,
            "speed_noise": speed_noise,
            "geolocation_noise": noise,
        },
        outputs={
            "fix.y": y,
            "fix.r_f_e": r_f_e + scale * sigma * noise + bias,
            "fix.R": ca.diag(ca.vertcat(0, 0, range_sigma**2, speed_sigma**2)),
            "fix.D": ca.diag(sigma**2),
            "fix.present": ca.SX.ones(4),
            "fix.valid": hit,
        },
    )
