r"""What is still known of position and velocity when navigation begins.

.. math::
    \hat x = x + \sigma \circ n, \qquad P = \mathrm{diag}(\sigma)^2
"""

from __future__ import annotations

import casadi as ca

from terrafix.models.core.model import Model


def known_state_model() -> Model:
    """Position and velocity with errors of given sigma, and their covariance.

    Returns
    -------
    Model
        Inputs ``r_e`` [m] and ``v_e`` [m/s], (3,) each, the truth; parameters
        ``position_sigma`` [m] and ``velocity_sigma`` [m/s], (3,) each; noise ``error`` (6,).
        Outputs ``state.r_e``, ``state.v_e`` and ``state.P`` (6, 6) of both.
    """
    r_e, v_e, error = ca.SX.sym("r_e", 3), ca.SX.sym("v_e", 3), ca.SX.sym("error", 6)
    names = ("position_sigma", "velocity_sigma")
    parameters = {name: ca.SX.sym(name, 3) for name in names}
    position_sigma, velocity_sigma = parameters.values()
    sigma = ca.vertcat(position_sigma, velocity_sigma)
    return Model(
        "known_state",
        inputs={"r_e": r_e, "v_e": v_e},
        parameters=parameters,
        noise={"error": error},
        outputs={
            "state.r_e": r_e + position_sigma * error[:3],
            "state.v_e": v_e + velocity_sigma * error[3:],
            "state.P": ca.diag(sigma * sigma),
        },
    )
