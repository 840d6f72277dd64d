r"""Two tests of a filter's innovations while it runs: their size, and their mean.

Where filter and sensor are what they are said to be, innovations are white, and normal with the
covariance predicted. Over the last :math:`N` fixes, the sum of normalized squares

.. math::
    q = \sum_{j=1}^{N} \nu_j^T S_j^{-1} \nu_j

is chi-square with as many degrees of freedom as elements were measured, [1]_: an alarm where it
exceeds the quantile that a stated share of sound windows exceeds. Of each element, with
:math:`z = \nu_i / \sqrt{S_{ii}}`, the two sums of [2]_,

.. math::
    g_+ \leftarrow \max(0,\; g_+ + z - k), \qquad g_- \leftarrow \max(0,\; g_- - z - k),

give an alarm beyond :math:`h`: with :math:`k = \delta / 2` the quickest test for a shift of the
mean by :math:`\delta` sigma. On sound innovations the two sums give one alarm in 465 fixes with
:math:`k = 0.5, h = 5`, in 168 with :math:`h = 4`; a shift of one sigma is found after 10.4 and 8.4
fixes.

Fixes that the gate refused count: a sensor gone bad is refused. Those with nothing measured, of
another instant than the estimate, or whose covariance is none say nothing of the sensor, and do not
count. After an alarm its statistic starts anew with the next fix, the window empty, both sums of
the element at zero; the other statistics go on.

References
----------
.. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
       Navigation", Wiley, 2001, section 5.4.
.. [2] D. C. Montgomery, "Introduction to Statistical Quality Control", Wiley, chapter on cumulative
       sums.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.core.model import Model
from terrafix.models.filters.measurement import REASONS
from terrafix.models.filters.updates import nth

ALARMS = ("chi-square", "mean high", "mean low")
"""Tests of a monitor, indexed by ``alarm.test``."""

NO_ELEMENT = -1
"""``alarm.element`` of a test of all elements together."""


def monitor_model(name: str, elements: int, window: int, false_alarm: float) -> Model:
    """Tests of innovations: chi-square over a window, and cumulative sums.

    Parameters
    ----------
    name : str
        Of the model.
    elements : int
        Of the measurement, m.
    window : int
        Fixes in the sum of normalized squares, N; tested once there are so many.
    false_alarm : float
        Share of sound windows that give an alarm.

    Returns
    -------
    Model
        Inputs ``innovation.*``, as `correct_model` gives it, and ``innovation.fresh``. Parameters
        ``allowance``, k, and ``decision_interval``, h [sigma]. Outputs ``chi_square``,
        ``chi_square_dof`` and ``chi_square_threshold`` of the window; ``mean_high`` and
        ``mean_low`` (m,), the cumulative sums; ``alarms`` (3,), how often each test gave an alarm;
        ``alarm.test``, ``.element``, ``.statistic``, ``.threshold`` and ``.valid``: of several at a
        time, the one furthest beyond its threshold, as a ratio.

    Raises
    ------
    ValueError
        If the share is not between 0 and 1, or there are no elements or an empty window.
    """
    if not 0 < false_alarm < 1:
        raise ValueError(f"false_alarm must be between 0 and 1, got {false_alarm}")
    if elements < 1 or window < 1:
        raise ValueError(
            f"a monitor of {elements} elements over {window} fixes has nothing to test"
        )
    from scipy.special import chdtri

    table = [float(chdtri(n, false_alarm)) for n in range(1, window * elements + 1)]
    shapes = {"residual": elements, "sigma": elements, "nis": 1, "dof": 1, "reason": 1, "fresh": 1}
    told = {key: ca.SX.sym(f"innovation_{key}", size) for key, size in shapes.items()}
    k, h = ca.SX.sym("allowance"), ca.SX.sym("decision_interval")
    sizes = {"squares": window, "dofs": window, "high": elements, "low": elements, "alarms": 3}
    own = {key: ca.SX.sym(key, size) for key, size in sizes.items()}
    judged = ca.logic_or(*(told["reason"] == REASONS.index(r) for r in ("accepted", "gate")))
    judged = ca.logic_and(ca.logic_and(told["fresh"] > 0.5, told["dof"] > 0.5), judged)
    # an absent element has a residual of zero and a sigma of one
    measured = ca.logic_or(told["residual"] != 0, told["sigma"] != 1)
    measured = ca.logic_and(measured, ca.repmat(judged, elements))

    def too_large(state: dict[str, Any]) -> Any:
        full = state["dofs"][window - 1] > 0.5  # the oldest fix
        dof = ca.sum1(state["dofs"])
        return ca.logic_and(full, ca.sum1(state["squares"]) > nth(table, dof))

    anew = too_large(own)
    moved = {}
    for key, latest in (("squares", told["nis"]), ("dofs", told["dof"])):
        shifted = ca.vertcat(latest, ca.if_else(anew, 0.0, own[key]))[:window]
        moved[key] = ca.if_else(judged, shifted, own[key])
    z = told["residual"] / ca.if_else(told["sigma"] > 0, told["sigma"], 1.0)
    beyond = ca.fmax(own["high"], own["low"]) > h
    for key, ahead in (("high", z), ("low", -z)):
        summed = ca.fmax(0.0, ca.if_else(beyond, 0.0, own[key]) + ahead - k)
        moved[key] = ca.if_else(measured, summed, own[key])

    def given(state: dict[str, Any]) -> list[tuple[int, int, Any, Any, Any]]:
        """Test, element, whether it gives an alarm now, statistic and threshold, of all tests."""
        q, limit = ca.sum1(state["squares"]), nth(table, ca.sum1(state["dofs"]))
        found = [(0, NO_ELEMENT, ca.logic_and(judged, too_large(state)), q, limit)]
        for test, key in ((1, "high"), (2, "low")):
            for i in range(elements):
                g = state[key][i]
                found.append((test, i, ca.logic_and(measured[i], g > h), g, h))
        return found

    counts = [sum(now for test, _, now, *_ in given(moved) if test == i) for i in range(3)]
    moved["alarms"] = own["alarms"] + ca.vertcat(*counts)
    furthest, valid = ca.SX(0), ca.SX(0)
    chosen = {key: ca.SX(0) for key in ("test", "element", "statistic", "threshold")}
    for test, element, now, statistic, threshold in given(own):
        ratio = ca.if_else(now, statistic / ca.if_else(now, threshold, 1.0), 0.0)
        values = (test, element, statistic, threshold)
        for key, value in zip(chosen, values, strict=True):
            chosen[key] = ca.if_else(ratio > furthest, value, chosen[key])
        furthest, valid = ca.fmax(furthest, ratio), ca.logic_or(valid, now)
    nothing = [ca.SX.zeros(symbol.shape) for symbol in own.values()]
    initial = ca.substitute(list(moved.values()), [own[key] for key in moved], nothing)
    return Model(
        name,
        inputs={f"innovation.{key}": symbol for key, symbol in told.items()},
        states=own,
        parameters={"allowance": k, "decision_interval": h},
        next=moved,
        initial=dict(zip(moved, initial, strict=True)),
        outputs={
            "chi_square": ca.sum1(own["squares"]),
            "chi_square_dof": ca.sum1(own["dofs"]),
            "chi_square_threshold": nth(table, ca.sum1(own["dofs"])),
            "mean_high": own["high"],
            "mean_low": own["low"],
            "alarms": own["alarms"],
            **{f"alarm.{key}": value for key, value in chosen.items()},
            "alarm.valid": valid,
        },
    )
