r"""What is still known of position and velocity when navigation begins.

.. math::
    \hat x = x + \sigma \circ n, \qquad P = \mathrm{diag}(\sigma)^2
"""

from __future__ import annotations

import casadi as ca

from terrafix.models.core.model import Model


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
