r"""Sun and horizon sensors: a direction in body axes.

.. math::
    \tilde u = e^{-[\delta \times]} u, \qquad \delta = b + \sigma n,

with the true direction :math:`u` and a bias :math:`b`, Gauss-Markov, or constant where its time is
infinite. Only what :math:`\delta` turns across :math:`u` is seen: the covariance of the measured
direction is :math:`R = (\sigma^2 + \sigma_b^2)(I - \tilde u \tilde u^T)`, of rank two; a filter may
take :math:`(\sigma^2 + \sigma_b^2) I` and two degrees of freedom [1]_.

References
----------
.. [1] M. D. Shuster, "Kalman filtering of spacecraft attitude and the QUEST model", J. Astronaut.
       Sci. 38(3), 1990.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.geometry.quaternion import from_rotation_vector, rotation_matrix
from terrafix.models.motion.surroundings import (
    published_inputs,
    published_symbols,
    surroundings_at,
)
from terrafix.models.sensors.altimeter import wandering
from terrafix.models.sensors.sky import angle_between, hidden, unit

_NAMES = ("half_angle", "sigma", "bias_sigma", "bias_time")


def sun_sensor_model() -> Model:
    """Direction to the Sun, where it is in the field and the Earth does not hide it.

    Returns
    -------
    Model
        Inputs ``r_e`` [m], ``q_be``, ``surroundings.*``. Parameters ``boresight_b`` (3,),
        ``half_angle`` of the field, ``sigma``, ``bias_sigma`` [rad], ``bias_time`` [s]. Outputs
        ``fix.y``, ``fix.R``, ``fix.valid``, and ``lit``, 1 where the Earth does not hide the Sun.
    """
    time = ca.SX.sym("time")
    published, r_e = published_symbols(), ca.SX.sym("r_e", 3)
    there = unit(surroundings_at(published, time).sun_e - r_e)
    lit = ca.logic_not(hidden(there, r_e))
    inputs = {
        "r_e": r_e,
        **published_inputs(published, "time", "omega_e", "sun_e", "sun_rate_e"),
    }
    return _direction("sun_sensor", inputs, there, lit, {"lit": lit}, time)


def horizon_sensor_model() -> Model:
    """Direction to the Earth's center, as a sensor of its whole limb finds it.

    The Earth is a sphere: its flattening and the height of what radiates in the infrared are in
    the bias.

    Returns
    -------
    Model
        As of `sun_sensor_model`, without an environment and ``lit``.
    """
    r_e = ca.SX.sym("r_e", 3)
    return _direction("horizon_sensor", {"r_e": r_e}, -unit(r_e), 1, {}, None)


def _direction(
    name: str, inputs: dict[str, Any], there_e: Any, seen: Any, told: dict[str, Any], time: Any
) -> Model:
    """A sensor of a direction (3,), Earth-fixed, that is seen or not."""
    q_be, dt = ca.SX.sym("q_be", 4), ca.SX.sym("dt")
    p = {n: ca.SX.sym(n) for n in _NAMES}
    p["boresight_b"] = ca.SX.sym("boresight_b", 3)
    bias, drive, white = (ca.SX.sym(n, 3) for n in ("bias", "bias_noise", "white"))
    u = ca.mtimes(rotation_matrix(q_be), there_e)
    y = ca.mtimes(rotation_matrix(from_rotation_vector(bias + p["sigma"] * white)), u)
    within = angle_between(unit(p["boresight_b"]), u) < p["half_angle"]
    variance = p["sigma"] ** 2 + p["bias_sigma"] ** 2
    return Model(
        name,
        inputs={"q_be": q_be, **inputs},
        states={"bias": bias},
        parameters=p,
        noise={"white": white, "bias_noise": drive},
        initial={"bias": p["bias_sigma"] * drive},
        next={"bias": wandering(bias, p["bias_sigma"], p["bias_time"], drive, dt)},
        outputs={
            "fix.y": y,
            "fix.R": variance * (ca.SX.eye(3) - ca.mtimes(y, y.T)),
            "fix.valid": ca.logic_and(within, seen),
            **told,
        },
        step=dt,
        time=time,
    )
