r"""Attitude of a satellite that flies level, and the sensor that measures it.

Body axes: z to the center of the Earth, y to the right (against the orbit normal), x forward,

.. math::
    \hat z = -\frac{r}{\lVert r \rVert}, \qquad
    \hat y = -\frac{r \times u}{\lVert r \times u \rVert}, \qquad
    \hat x = \hat y \times \hat z.

It is undefined, and not a number, where u is zero or within a microradian of r.

With :math:`u` the Earth-fixed velocity the body is steered in yaw, and a side-looking antenna has
zero squint and a Doppler centroid near zero; with the inertial velocity it is up to 4 degrees off
(for an L-band radar in a polar orbit, a centroid of 2 kHz instead of 54 Hz).
"""

from __future__ import annotations

from math import nan
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafix.models.core.batch import over_members
from terrafix.models.core.model import Model
from terrafix.models.geometry.frames import earth_rate_cross
from terrafix.models.geometry.quaternion import (
    from_matrix,
    from_matrix_near,
    from_small_rotation_vector,
    inverse,
    product,
    rotation_vector,
)

_LEAST_SINE = 1e-6
"""Of the angle between position and velocity: below, rounding decides where "right" is."""

VELOCITIES = ("earth-fixed", "inertial")
"""Names of the velocity that the x axis follows."""


def lvlh_matrix(r: Any, u: Any) -> Any:
    """Build the transformation (3, 3) to level body axes from those of r and u, (3,) each."""
    z = -r / ca.sqrt(ca.dot(r, r))
    normal = ca.cross(u, r)
    squared = ca.dot(normal, normal)
    defined = squared > _LEAST_SINE**2 * ca.dot(u, u) * ca.dot(r, r)
    y = normal / ca.sqrt(squared) * ca.if_else(defined, 1.0, nan)
    return ca.horzcat(ca.cross(y, z), y, z).T


def level_is_defined(r: ArrayLike, u: ArrayLike) -> NDArray[np.bool_]:
    """Whether a position and the velocity that is followed, (..., 3) each, have level axes."""
    normal = np.linalg.norm(np.cross(np.asarray(u), np.asarray(r)), axis=-1)
    return np.asarray(
        normal > _LEAST_SINE * np.linalg.norm(u, axis=-1) * np.linalg.norm(r, axis=-1)
    )


def lvlh_quaternion(r: Any, u: Any) -> Any:
    """Quaternion (4,) of `lvlh_matrix`, scalar not negative."""
    return from_matrix(lvlh_matrix(r, u))


lvlh_quaternion_array = over_members(lvlh_quaternion, (3,), (3,))


def lvlh_attitude_model(velocity: str = "earth-fixed") -> Model:
    r"""Level attitude along a trajectory, and what an ideal inertial sensor makes of it.

    The rotation of the body relative to inertial space over a step of the Earth-fixed
    quaternion :math:`q` is that of

    .. math::
        q^+ \otimes q_z(\omega\, \Delta t) \otimes q^{-1}.

    Parameters
    ----------
    velocity : {"earth-fixed", "inertial"}
        The velocity that the x axis follows.

    Returns
    -------
    Model
        Inputs ``r_e`` [m], ``v_e`` [m/s] and ``delta_v_e`` [m/s], (3,) each; parameter
        ``rotation_rate`` [rad/s]. Outputs ``q_be`` (4,), continuous in sign, not a number half a
        turn from the last; ``delta_v_b`` (3,)
        [m/s], the non-gravitational velocity increment in the body axes at the step's end, and
        ``delta_theta_b`` (3,) [rad], the rotation relative to inertial space over the step.

    Raises
    ------
    ValueError
        If `velocity` is not a known choice.
    """
    if velocity not in VELOCITIES:
        raise ValueError(f"velocity must be one of {VELOCITIES}, got '{velocity}'")
    r_e, v_e, delta_v_e = (ca.SX.sym(name, 3) for name in ("r_e", "v_e", "delta_v_e"))
    q_be, delta_theta_b = ca.SX.sym("q_be", 4), ca.SX.sym("delta_theta_b", 3)
    rate, dt = ca.SX.sym("rotation_rate"), ca.SX.sym("dt")
    followed = v_e if velocity == "earth-fixed" else v_e + earth_rate_cross(rate, r_e)
    matrix = lvlh_matrix(r_e, followed)
    q_next = from_matrix_near(matrix, q_be)
    half_turn = rate * dt / 2
    earth_turn = ca.vertcat(0, 0, ca.sin(half_turn), ca.cos(half_turn))
    turn = product(product(q_next, earth_turn), inverse(q_be))
    return Model(
        "lvlh_attitude",
        inputs={"r_e": r_e, "v_e": v_e, "delta_v_e": delta_v_e},
        states={"q_be": q_be, "delta_theta_b": delta_theta_b},
        parameters={"rotation_rate": rate},
        next={"q_be": q_next, "delta_theta_b": rotation_vector(turn)},
        initial={"q_be": from_matrix(matrix)},
        outputs={
            "q_be": q_be,
            "delta_v_b": ca.mtimes(matrix, delta_v_e),
            "delta_theta_b": delta_theta_b,
        },
        step=dt,
    )


def attitude_sensor_model() -> Model:
    r"""Attitude determination system: the true attitude behind a constant and a white rotation.

    .. math::
        q_{be}^{meas} = \delta q(b + \sigma n) \otimes q_{be}, \qquad b = \sigma_b n_0

    Returns
    -------
    Model
        Input ``q_be_true`` (4,); output ``q_be`` (4,); parameters ``noise_sigma`` and
        ``bias_sigma``, per axis and body-fixed [rad]. The noise ``bias_draw`` (3,) is used at the
        start alone.

    Notes
    -----
    For angles far below a radian: the rotation is short by a twelfth of its cube.
    """
    q_true, bias = ca.SX.sym("q_be_true", 4), ca.SX.sym("bias_b", 3)
    white, draw = ca.SX.sym("white", 3), ca.SX.sym("bias_draw", 3)
    noise_sigma, bias_sigma = ca.SX.sym("noise_sigma"), ca.SX.sym("bias_sigma")
    error = from_small_rotation_vector(bias + noise_sigma * white)
    return Model(
        "attitude_sensor",
        inputs={"q_be_true": q_true},
        states={"bias_b": bias},
        parameters={"noise_sigma": noise_sigma, "bias_sigma": bias_sigma},
        noise={"white": white, "bias_draw": draw},
        initial={"bias_b": bias_sigma * draw},
        outputs={"q_be": product(error, q_true)},
    )
