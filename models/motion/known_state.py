r"""What is still known of position and velocity when navigation begins.

.. math::
    \hat x = x + \sigma \circ n, \qquad P = \mathrm{diag}(\sigma)^2
"""

from __future__ import annotations

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.geometry.quaternion import from_rotation_vector, product
from terrafix.models.motion.strapdown import level_axes, rotation_rate


def known_state_model(
    position: str = "r_e", velocity: str = "v_e", told: tuple[str, str] = ("r_e", "v_e")
) -> Model:
    """Position and velocity with errors of given sigma, and their covariance.

    Parameters
    ----------
    position, velocity : str
        Names of the inputs.
    told : tuple of two str
        Names of the fields that tell them.

    Returns
    -------
    Model
        Inputs ``r_e`` [m] and ``v_e`` [m/s], (3,) each, or as named, the truth; parameters
        ``position_sigma`` [m] and ``velocity_sigma`` [m/s], (3,) each; noise ``error`` (6,).
        Outputs ``state.r_e``, ``state.v_e`` and ``state.P`` (6, 6) of both.
    """
    r, v, error = ca.SX.sym(position, 3), ca.SX.sym(velocity, 3), ca.SX.sym("error", 6)
    names = ("position_sigma", "velocity_sigma")
    parameters = {name: ca.SX.sym(name, 3) for name in names}
    position_sigma, velocity_sigma = parameters.values()
    sigma = ca.vertcat(position_sigma, velocity_sigma)
    return Model(
        "known_state",
        inputs={position: r, velocity: v},
        parameters=parameters,
        noise={"error": error},
        outputs={
            f"state.{told[0]}": r + position_sigma * error[:3],
            f"state.{told[1]}": v + velocity_sigma * error[3:],
            "state.P": ca.diag(sigma * sigma),
        },
    )


def known_flight_model(earth: str = "wgs84") -> Model:
    r"""Position, velocity and attitude of an aircraft with errors of given sigma in level axes.

    With :math:`C` from local level to e at the true position, and :math:`\theta` in e axes,

    .. math::
        (\delta r, \delta v, \theta) = \mathrm{diag}(C, C, C)\, (\sigma \circ n), \qquad
        \hat q_{be} = q_{be} \otimes \delta q(\theta).

    Parameters
    ----------
    earth : {"wgs84", "flat"}

    Returns
    -------
    Model
        Inputs ``r_e`` [m], ``v_e`` [m/s], ``q_be``, the truth; parameters ``position_sigma`` [m],
        ``velocity_sigma`` [m/s], ``attitude_sigma`` [rad], (3,) each: north, east, down. Outputs
        ``state.r_e``, ``state.v_e``, ``state.q_be`` and ``state.P`` (9, 9), in e axes.

    Raises
    ------
    ValueError
        If the Earth is not known.
    """
    rotation_rate(earth)
    r, v, q = ca.SX.sym("r_e", 3), ca.SX.sym("v_e", 3), ca.SX.sym("q_be", 4)
    names = ("position_sigma", "velocity_sigma", "attitude_sigma")
    parameters = {name: ca.SX.sym(name, 3) for name in names}
    error, sigma = ca.SX.sym("error", 9), ca.vertcat(*parameters.values())
    C = level_axes(r, earth).T
    off = ca.mtimes(ca.diagcat(C, C, C), sigma * error)
    root = ca.mtimes(ca.diagcat(C, C, C), ca.diag(sigma))
    return Model(
        f"known_flight_{earth}",
        inputs={"r_e": r, "v_e": v, "q_be": q},
        parameters=parameters,
        noise={"error": error},
        outputs={
            "state.r_e": r + off[:3],
            "state.v_e": v + off[3:6],
            "state.q_be": product(q, from_rotation_vector(off[6:])),
            "state.P": ca.densify(ca.mtimes(root, root.T)),
        },
    )
