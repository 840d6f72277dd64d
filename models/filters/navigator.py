r"""The navigator of an aircraft: an inertial state, biases of its aids, and what these measure.

Error state, 18 elements of now: position, velocity, attitude and the biases of both triads
(`terrafix.models.filters.inertial`), and those of altimeter, range and cross-range, Gauss-Markov
all of them; besides, position and velocity as they were at the center of an aperture.

A radar image of one aperture measures up to three things about a ground point of known position
:math:`p_t`, with :math:`d = p_t - p` and :math:`u = d / |d|` at the center of the aperture:

.. math::
    z_r = |d| + b_r, \qquad
    z_c = -\frac{d^T v}{\hat V} + b_c, \qquad
    z_v = |v| - \frac{|d|}{2 |v|}\, u^T a.

The second is what the Doppler frequency of the point is to an image former that turns frequencies
into meters by one speed :math:`\hat V`, the navigator's; it is the along-track distance by which
the aperture's center is ahead of the point. Its derivative by velocity is :math:`-d / \hat V`,
whole, also where the beam is squinted; the paper's :math:`H_c` lacks it. The third is what map
drift measures: the curvature of range, :math:`(|v|^2 - d^T a) / |d|`, read as a speed. So it is no
speed: a hovering accelerometer error of 1 mg is 0.11 m/s at 1560 m and 70 m/s. The acceleration is
that of the estimate, :math:`a = C_{eb} (f_b - b_a) + \gamma - 2 \omega \times v`, from the mean
specific force of the aperture in the body axes of its end, which the fix tells.

References
----------
.. [1] The aircraft paper (`docs/aircraft.md`), eqs. (45)-(61).
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.filters.error_state import ErrorState, Values, clone, vector
from terrafix.models.filters.inertial import INERTIAL, inertial_process
from terrafix.models.filters.measurement import Observation
from terrafix.models.filters.process import Process
from terrafix.models.geometry.frames import earth_rate_cross
from terrafix.models.geometry.quaternion import rotation_matrix
from terrafix.models.motion.strapdown import gravity, height_of, rotation_rate
from terrafix.models.sensors.aperture import CENTER, shift_of

APERTURE = "aperture"
"""The instant of the clones: an aperture's center."""

DRIFTING = ErrorState(*INERTIAL, vector("altimeter_bias", 1, unit="m"))
"""What an aircraft without a radar estimates."""

LOCATED = ErrorState(*DRIFTING, vector("gnss_bias", 3, unit="m", frame="e"))
"""What an aircraft with a GNSS receiver estimates: what lasts of the error of its positions."""

NAVIGATOR = ErrorState(
    *DRIFTING,
    vector("range_bias", 1, unit="m"),
    vector("cross_range_bias", 1, unit="m"),
    *(clone(block, APERTURE) for block in INERTIAL[:2]),
)
"""What an aircraft that navigates by radar images estimates."""

DECAYS = {
    "accel_bias_b": ("accel_bias_time", "accel_bias_sigma"),
    "gyro_bias_b": ("gyro_bias_time", "gyro_bias_sigma"),
    "altimeter_bias": ("altimeter_bias_time", "altimeter_bias_sigma"),
    "gnss_bias": ("gnss_bias_time", "gnss_bias_sigma"),
    "range_bias": ("range_bias_time", "range_bias_sigma"),
    "cross_range_bias": ("cross_range_bias_time", "cross_range_bias_sigma"),
}
"""Time and sigma of each Gauss-Markov process."""


def navigator_process(state: ErrorState, earth: str) -> Process:
    """Strapdown mechanization on an Earth, biases that are Gauss-Markov.

    Parameters
    ----------
    state : ErrorState
        `DRIFTING`, `LOCATED` or `NAVIGATOR`.
    earth : {"wgs84", "flat"}

    Raises
    ------
    ValueError
        If the Earth is not known.
    """
    names = [block.name for block in state]
    decays = {name: parameters for name, parameters in DECAYS.items() if name in names}
    return inertial_process(state, earth, decays=decays)


def altimeter_observation(earth: str) -> Observation:
    """Height above the ellipsoid (or a flat ground), with a bias that is estimated."""
    rotation_rate(earth)
    return Observation(
        lambda x, _: height_of(x["r_e"], earth) + x["altimeter_bias"], {"height": "m"}
    )


def gnss_observation() -> Observation:
    """Position, with a bias that is estimated, and velocity, Earth-fixed."""
    units = {f"{what}_{axis}": unit for what, unit in (("r", "m"), ("v", "m/s")) for axis in "xyz"}
    return Observation(lambda x, _: ca.vertcat(x["r_e"] + x["gnss_bias"], x["v_e"]), units)


def shift_observation(earth: str) -> Observation:
    """What the image of an aperture measures: range, cross-range, and what map drift reads.

    The fix tells the point (``p_t_e``), the speed that the image was formed with (``speed``), the
    mean specific force of the aperture (``f_b``, in the body axes of its end, its white noise in
    ``F``) and the time of the aperture's center (``t_center``).
    """
    rate = rotation_rate(earth)

    def predict(x: Values, given: Values) -> Any:
        r, v = x["r_e_at_aperture"], x["v_e_at_aperture"]
        force = ca.mtimes(rotation_matrix(x["q_be"]).T, given["f_b"] - x["accel_bias_b"])
        a = force + gravity(r, earth) - 2 * earth_rate_cross(rate, v)
        bias = ca.vertcat(x["range_bias"], x["cross_range_bias"], 0)
        return shift_of(given["p_t_e"] - r, v, a, given["speed"]) + bias

    return Observation(
        predict,
        {"range": "m", "cross_range": "m", "map_drift": "m/s"},
        fields=[
            vector("p_t_e", unit="m", frame="e"),
            vector("speed", 1, unit="m/s"),
            vector("f_b", unit="m/s^2", frame="b"),
            vector(CENTER, 1, unit="s"),
        ],
        mapped={"f_b": "F"},
        instant=APERTURE,
        valid_at=CENTER,
    )
