r"""Inertial measurement unit with every error that a data sheet names.

The chain of one triad, from the ideal increment to the number on the bus; :math:`\Delta` stands
for :math:`\Delta v` or :math:`\Delta\theta` over a step of length :math:`h`:

1. Lever arm (accelerometers). At :math:`l` from the point whose increments are given,

   .. math:: \Delta v \mathrel{+}= (\omega^+ - \omega^-) \times l
             + h\; \bar\omega \times (\bar\omega \times l), \qquad \bar\omega = \Delta\theta / h.

   The first term is the integral of :math:`\dot\omega \times l` in turning axes, exactly; the rate
   at the end is :math:`\omega^+ = (3 \bar\omega_k - \bar\omega_{k-1}) / 2`, exact where the rate
   is linear over two steps (in the first step it is taken as constant). The second is exact for a
   constant rate and of second order in :math:`h` otherwise.
2. Time. The interval ends at :math:`t + \delta_k`, :math:`\delta_k = \sigma_j n - \lambda`, with
   jitter :math:`\sigma_j` and latency :math:`\lambda`, one clock for both triads:

   .. math:: \Delta_k \mathrel{+}= r_k \delta_k - r_{k-1} \delta_{k-1}, \qquad r_k = \Delta_k / h,

   exact where the rate is constant over each step. What one interval takes the next one lacks: the
   sum of increments is the integral to :math:`t + \delta_k`, and with jitter alone at constant rate
   the variance of an increment is :math:`2 r^2 \sigma_j^2`. Nothing is known before the start; the
   first increment begins there.
3. Scale and axes, :math:`\Delta \leftarrow (I + \mathrm{diag}(s + e_s) + A + E_m)\, \Delta`, with
   the fixed :math:`s, A` and errors :math:`e_s, E_m` (off the diagonal) drawn once per member.
   :math:`A_{ij}` is the angle by which the axis of sensor :math:`i` leans toward :math:`j`.
4. Nonlinearity: a scale factor error that grows with the rate to :math:`\kappa` at full range
   :math:`R`, :math:`\kappa |r| / R`; and of accelerometers the quadratic :math:`K_2 r^2` of [2]_.
   Both take the mean rate of the step for the rate.
5. Gyroscopes: :math:`\Delta\theta \mathrel{+}= (G + E_g)\, \Delta v` with the specific force of
   steps 1 and 2.
6. Bias :math:`b^+ h` and white noise :math:`N \sqrt h\, n` as in `imu_model`; the bias has a part
   of flicker noise besides (below).
7. Full range: :math:`|\Delta| \le R h`, and what is cut is said by ``saturated``.
8. Quantization to :math:`q` with the residue carried, as integrating sensors do: the sum of
   increments is never off by more than half a quantum. Its Allan deviation is that of white angle
   noise of variance :math:`q^2 / 12`, :math:`\sqrt 3\, Q / T` with :math:`Q = q / \sqrt{12}`.

Bias instability. Flicker noise of coefficient :math:`B` has the density :math:`B^2 / (2\pi f)` and
an Allan deviation that is flat at :math:`\sqrt{2 \ln 2 / \pi}\, B = 0.664\, B`; this floor is what
data sheets print, and the setting here. Since

.. math:: \int_0^\infty \frac{2\tau}{1 + (2\pi f \tau)^2}\, \frac{d\tau}{\tau} = \frac{1}{2 f},

it is the sum of Gauss-Markov processes of variance :math:`(B^2/\pi)\, d \ln\tau`. Three of them, at
:math:`\tau / 10`, :math:`\tau` and :math:`10\, \tau`, each of

.. math:: \sigma = B \sqrt{\ln 10 / \pi} = \mathrm{floor} \cdot \sqrt{\ln 10 / (2 \ln 2)},

give 0.99 of the floor at the averaging time :math:`1.89\, \tau` and at least 0.90 of it from 0.2 to
19 times :math:`\tau`; below and above the deviation falls. They start in their steady state.

A parameter of zero leaves its term out; no term is divided by it.

References
----------
.. [1] IEEE Std 952-1997, annexes B and C (models and Allan variances of gyroscopes).
.. [2] IEEE Std 1293-1998 (model equation of accelerometers: K2).
.. [3] IEEE Std 1559-2009 (terms of inertial systems).
"""

from __future__ import annotations

from math import log, sqrt
from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.sensors.imu import TRIADS, Draft, add_bias, add_markov, white_noise

FLICKER = sqrt(log(10) / (2 * log(2)))
"""Sigma of each of three Gauss-Markov processes, a decade apart, over the Allan floor."""
AXES_OFF = [(i, j) for i in range(3) for j in range(3) if i != j]


def full_imu_model(bias: str = "walk") -> Model:
    """Accelerometer and gyroscope triads with all errors of a data sheet.

    Parameters
    ----------
    bias : {"walk", "gauss-markov", "both"}
        As of `imu_model`.

    Returns
    -------
    Model
        Ports of `imu_model`; ``saturated`` (6,) is one where an axis is at its full range,
        accelerometers first. Increments at the start are zero. Its parameters, and besides
        ``time_jitter``, ``latency`` [s], ``lever_arm_b`` (3,) [m], ``accel_quadratic`` (3,)
        [s^2/m], ``gyro_g_sensitivity`` (3, 3) and ``gyro_g_sensitivity_sigma`` [s/m rad], and for
        each of ``accel`` [m/s] and ``gyro`` [rad]: ``_scale_factor_sigma`` (3,), ``_misalignment``
        (3, 3) and ``_misalignment_sigma`` [rad], ``_nonlinearity`` (3,), ``_range`` (3,) [of the
        rate], ``_quantum`` (3,) [of the increment], ``_bias_instability`` (3,) [of the rate] and
        ``_bias_instability_time`` [s].

    Raises
    ------
    ValueError
        If `bias` is not a known process.
    """
    draft = Draft()
    delta_v = draft.input("delta_v_b_true", 3)
    delta_theta = draft.input("delta_theta_b_true", 3)
    jitter, latency = draft.parameter("time_jitter"), draft.parameter("latency")
    shift = jitter * draft.noise("clock_noise", 1) - latency
    force = _shifted(draft, "delta_v_b", delta_v + _lever(draft, delta_theta), shift)
    turn = _shifted(draft, "delta_theta_b", delta_theta, shift)
    curved = draft.parameter("accel_quadratic", 3) * force * force / draft.dt
    felt = {
        "accel": _scaled(draft, "accel", force) + curved,
        "gyro": _scaled(draft, "gyro", turn) + ca.mtimes(_g_sensitivity(draft), force),
    }
    over = [_read_out(draft, kind, felt[kind], bias) for kind in TRIADS]
    draft.next["saturated"] = ca.vertcat(*over)
    draft.outputs["saturated"] = draft.state("saturated", 6)
    return draft.model("imu_full")


def _lever(draft: Draft, delta_theta: Any) -> Any:
    """Increment of specific force of a sensor away from the point that is flown."""
    arm = draft.parameter("lever_arm_b", 3)
    before, at_start = draft.state("lever_rate", 3), draft.state("lever_rate_end", 3)
    begun = draft.state("lever_begun", 1)
    rate = delta_theta / draft.dt
    at_end = ca.if_else(begun, (3 * rate - before) / 2, rate)
    change = at_end - ca.if_else(begun, at_start, rate)
    draft.next |= {"lever_rate": rate, "lever_rate_end": at_end, "lever_begun": ca.SX(1)}
    return ca.cross(change, arm) + ca.cross(rate, ca.cross(rate, arm)) * draft.dt


def _shifted(draft: Draft, name: str, increment: Any, shift: Any) -> Any:
    """Increment over an interval that ends `shift` later, from where the last one ended."""
    beyond = draft.state(f"{name}_beyond", 3)
    draft.next[f"{name}_beyond"] = now = increment / draft.dt * shift
    return increment + now - beyond


def _scaled(draft: Draft, kind: str, increment: Any) -> Any:
    """Increment as an instrument's scale factors and axes show it."""
    scale = _drawn(draft, f"{kind}_scale_factor", 3, draft.parameter(f"{kind}_scale_factor", 3))
    lean = _drawn(draft, f"{kind}_misalignment", 6)
    axes = draft.parameter(f"{kind}_misalignment", 3, 3) + ca.SX.eye(3) + ca.diag(scale)
    for place, (i, j) in enumerate(AXES_OFF):
        axes[i, j] += lean[place]
    limit = draft.parameter(f"{kind}_range", 3)
    slope = ca.if_else(limit > 0, draft.parameter(f"{kind}_nonlinearity", 3) / limit, 0)
    return ca.mtimes(axes, increment) + slope * ca.fabs(increment) * increment / draft.dt


def _g_sensitivity(draft: Draft) -> Any:
    """Rate that a gyroscope shows under specific force, (3, 3)."""
    drawn = _drawn(draft, "gyro_g_sensitivity", 9)
    return draft.parameter("gyro_g_sensitivity", 3, 3) + ca.reshape(drawn, 3, 3).T


def _drawn(draft: Draft, name: str, size: int, fixed: Any = 0) -> Any:
    """Errors drawn once for a member, of a sigma of their own, about what is fixed."""
    sigma = draft.parameter(f"{name}_sigma", size if size == 3 else 1)
    error = draft.state(f"{name}_error", size)
    draft.initial[f"{name}_error"] = sigma * draft.noise(f"{name}_noise", size)
    draft.next[f"{name}_error"] = error
    return error + fixed


def _read_out(draft: Draft, kind: str, felt: Any, bias: str) -> Any:
    """Add bias and noise, limit, quantize; which axes were limited."""
    name, walk = TRIADS[kind]
    now, following = _bias(draft, kind, bias)
    total = felt + following * draft.dt + white_noise(draft, kind, walk)
    limit = draft.parameter(f"{kind}_range", 3) * draft.dt
    over = ca.logic_and(limit > 0, ca.fabs(total) > limit)
    quantum, residue = draft.parameter(f"{kind}_quantum", 3), draft.state(f"{kind}_residue", 3)
    held = ca.if_else(over, ca.sign(total) * limit, total) + residue
    rounded = ca.if_else(quantum > 0, quantum * ca.floor(held / quantum + 0.5), held)
    draft.next |= {f"{kind}_residue": held - rounded, name: rounded}
    draft.outputs |= {name: draft.state(name, 3), f"{kind}_bias_b": now}
    return over


def _bias(draft: Draft, kind: str, bias: str) -> tuple[Any, Any]:
    """Bias of a triad with its instability: now, and at the end of the step."""
    parts = [add_bias(draft, kind, bias)]
    sigma = FLICKER * draft.parameter(f"{kind}_bias_instability", 3)
    tau = draft.parameter(f"{kind}_bias_instability_time")
    for place, factor in enumerate((0.1, 1, 10)):
        parts.append(add_markov(draft, f"{kind}_flicker_{place}", sigma, factor * tau))
    return sum(now for now, _ in parts), sum(following for _, following in parts)
