r"""What a navigator expects an aperture's image to measure, and how well it knows that.

An image is formed with the navigator's own track, and tells how far what it measures is from what
that track predicts. A filter wants the measurement itself, :math:`y = h(\hat x) + r`, with
:math:`h` the observation that corrects it (`terrafix.models.filters.navigator.shift_observation`):
so what differs between the track and the clone, a fit over the aperture and its middle, cancels.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from terrafix.models.core.arrays import FloatArray
from terrafix.models.core.batch import over_members
from terrafix.models.core.model import Model
from terrafix.models.filters.navigator import NAVIGATOR, shift_observation

_SIZES = {
    "r_e_at_aperture": 3,
    "v_e_at_aperture": 3,
    "q_be": 4,
    "accel_bias_b": 3,
    "range_bias": 1,
    "cross_range_bias": 1,
}
_CLONES = ("r_e_at_aperture", "v_e_at_aperture")
_BIASES = ("range_bias", "cross_range_bias")


@cache
def _expected(earth: str) -> Any:
    seen = shift_observation(earth)

    def expression(p_t: Any, speed: Any, f_b: Any, *values: Any) -> tuple[Any, Any]:
        x = dict(zip(_SIZES, values, strict=True))
        y = seen.predict(x, {"p_t_e": p_t, "speed": speed, "f_b": f_b})
        H = ca.jacobian(y[:2], ca.vertcat(*(x[name] for name in (*_CLONES, *_BIASES))))
        return y, ca.densify(H)

    return over_members(expression, (3,), (1,), (3,), *((n,) for n in _SIZES.values()))


def expected_shift(
    earth: str, estimate: Any, p_t_e: FloatArray, speed: FloatArray, f_b: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What an estimate expects of an image, and the covariance of (z_r, z_c) that it claims.

    Parameters
    ----------
    earth : {"wgs84", "flat"}
    estimate : object
        With the blocks of `NAVIGATOR` and ``P`` as attributes, members first.
    p_t_e : ndarray, shape (n, 3)
        Points on the ground [m].
    speed : ndarray, shape (n,)
        By which images turn frequencies into meters [m/s].
    f_b : ndarray, shape (n, 3)
        Mean specific force of the aperture, in body axes of its end [m/s^2].

    Returns
    -------
    y : ndarray, shape (n, 3)
        Range, cross-range [m], and what map drift reads [m/s].
    S : ndarray, shape (n, 2, 2)
        Covariance of the first two by the estimate's error [m^2].
    """
    values = [np.asarray(getattr(estimate, name)) for name in _SIZES]
    y, H = _expected(earth)(p_t_e, np.asarray(speed)[:, None], f_b, *values)
    places = [NAVIGATOR.places[name] for name in (*_CLONES, *_BIASES)]
    at = np.concatenate([np.arange(p.start, p.stop) for p in places])
    P = np.asarray(estimate.P)[:, at[:, None], at]
    return y, np.asarray(H @ P @ H.transpose(0, 2, 1))


def estimated_track_model() -> Model:
    """Position and attitude of a navigator's estimate, each by itself.

    Returns
    -------
    Model
        Inputs ``prior.r_e`` (3,) [m], ``prior.q_be`` (4,). Outputs ``r_e`` and ``q_be``.
    """
    r, q = ca.SX.sym("r_e", 3), ca.SX.sym("q_be", 4)
    return Model(
        "estimated_track",
        inputs={"prior.r_e": r, "prior.q_be": q},
        outputs={"r_e": r, "q_be": q},
    )
