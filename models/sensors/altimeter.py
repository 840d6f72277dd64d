r"""A barometric altimeter: height with a Gauss-Markov bias and white noise.

.. math::
    z = h + b + \sigma n, \qquad
    b^+ = \varphi\, b + \sigma_b \sqrt{1 - \varphi^2}\, n_b, \qquad \varphi = e^{-\Delta t / \tau}.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.motion.strapdown import height_of, rotation_rate


def wandering(bias: Any, sigma: Any, time: Any, drive: Any, dt: Any) -> Any:
    """Gauss-Markov bias after a step, exactly; at its start it is sigma times the drive."""
    kept = ca.exp(-dt / time)
    return kept * bias + sigma * ca.sqrt(1 - kept**2) * drive


def altimeter_model(earth: str = "wgs84") -> Model:
    """Height above the ellipsoid, or the ground of a flat Earth.

    Parameters
    ----------
    earth : {"wgs84", "flat"}

    Returns
    -------
    Model
        Input ``r_e`` [m]. Parameters ``sigma``, ``bias_sigma`` [m], ``bias_time`` [s]. Outputs
        ``fix.*`` as of `terrafix.models.filters.navigator.altimeter_observation`, and the true
        ``bias`` [m].

    Raises
    ------
    ValueError
        If the Earth is not known.
    """
    rotation_rate(earth)
    r_e, bias, dt = ca.SX.sym("r_e", 3), ca.SX.sym("bias"), ca.SX.sym("dt")
    names = ("sigma", "bias_sigma", "bias_time")
    sigma, bias_sigma, bias_time = (ca.SX.sym(name) for name in names)
    noise, drive = ca.SX.sym("noise"), ca.SX.sym("bias_noise")
    return Model(
        f"altimeter_{earth}",
        inputs={"r_e": r_e},
        states={"bias": bias},
        parameters=dict(zip(names, (sigma, bias_sigma, bias_time), strict=True)),
        noise={"noise": noise, "bias_noise": drive},
        next={"bias": wandering(bias, bias_sigma, bias_time, drive, dt)},
        initial={"bias": bias_sigma * drive},
        outputs={
            "fix.y": height_of(r_e, earth) + bias + sigma * noise,
            "fix.R": sigma**2,
            "fix.present": ca.SX(1),
            "fix.valid": ca.SX(1),
            "bias": bias,
        },
        step=dt,
    )
