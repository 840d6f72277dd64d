"""Navigation evaluation: errors against truth, NEES and NIS of the spacecraft filter."""

from __future__ import annotations

from collections import Counter
from typing import Any

import casadi as ca
import numpy as np

from terrafix.components.fields import ESTIMATE, INNOVATION, XYZ
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.evaluation import Evaluation, History, Quantity, consistency
from terrafix.cosim.declare.ports import BundleInput, Input, MessageInput, Output
from terrafix.models.core.model import Model
from terrafix.models.filters.consistency import normalized_square
from terrafix.models.filters.measurement import REASONS
from terrafix.models.filters.spacecraft import (
    STATE,
    navigation_error,
    navigation_error_array,
)


class NavigationEvaluation(Evaluation):
    """Errors (estimate minus truth), predicted sigma, NEES, and what became of each fix."""

    default_rate = Rate("8.2")
    quantities = (
        Quantity("position", "m", XYZ),
        Quantity("velocity", "m/s", XYZ),
        Quantity("misalignment", "rad", XYZ),
    )

    r_e = Input((3,), unit="m", frame="e", doc="true position")
    v_e = Input((3,), unit="m/s", frame="e", doc="true velocity relative to the Earth")
    q_mu = Input((4,), unit="1", frame="s", doc="true misalignment")
    estimate = BundleInput(ESTIMATE, doc="estimate to be evaluated")
    innovation = MessageInput(fields=INNOVATION, optional=True, doc="of the filter's corrections")

    position_error = Output((3,), unit="m", frame="e", labels=XYZ)
    position_sigma = Output((3,), unit="m", frame="e", labels=XYZ)
    velocity_error = Output((3,), unit="m/s", frame="e", labels=XYZ)
    velocity_sigma = Output((3,), unit="m/s", frame="e", labels=XYZ)
    misalignment_error = Output((3,), unit="rad", frame="s", labels=XYZ)
    misalignment_sigma = Output((3,), unit="rad", frame="s", labels=XYZ)
    covariance = Output((9, 9), unit="1", doc="predicted, in SI: m, m/s, rad")
    normalized_innovation = Output(
        (4,), doc="innovation of this instant's accepted fix over its sigma; NaN where not measured"
    )
    nees = Output(doc="normalized estimation error squared, 9 degrees of freedom")
    nis = Output(doc="normalized innovation squared of this instant's fix, if accepted")
    nis_dof = Output(doc="elements in that fix")
    accepted = Output(doc="1 if that fix was accepted, 0 if not")
    reason = Output(doc="index into terrafix.models.filters.measurement.REASONS")

    def _initialize_impl(self) -> None:
        self._evaluate()

    def _step_impl(self, t: float, dt: float) -> None:
        self._evaluate()

    def _evaluate(self) -> None:
        estimate = self.estimate
        error = navigation_error_array(
            self.r_e, self.v_e, self.q_mu, estimate.r_e, estimate.v_e, estimate.q_mu
        )
        variance = np.diagonal(estimate.P, axis1=1, axis2=2)
        sigma = np.sqrt(np.where(variance > 0.0, variance, np.nan))
        for i, quantity in enumerate(self.quantities):
            part = slice(3 * i, 3 * i + 3)
            self.port_views[f"{quantity.name}_error"][...] = error[:, part]
            self.port_views[f"{quantity.name}_sigma"][...] = sigma[:, part]
        self.nees = normalized_square(error, estimate.P)
        self.covariance = estimate.P
        fresh = self.innovation.fresh
        # a fix that was refused says why in `reason`, and nothing of the filter's consistency
        used = fresh & (self.innovation.accepted > 0.5)
        residual, sigma = self.innovation.residual, self.innovation.sigma
        measured = used[:, None] & ((residual != 0.0) | (sigma != 1.0))
        self.normalized_innovation = np.where(
            measured, residual / np.where(measured, sigma, 1.0), np.nan
        )
        self.nis = np.where(used, self.innovation.nis, np.nan)
        self.nis_dof = np.where(used, self.innovation.dof, np.nan)
        self.accepted = np.where(fresh, self.innovation.accepted, np.nan)
        self.reason = np.where(fresh, self.innovation.reason, np.nan)

    def error_model(self) -> Model:
        """Errors of all quantities as a function of what the ports bring, for linearization."""
        inputs = {"r_e": (3, 1), "v_e": (3, 1), "q_mu": (4, 1)}
        inputs |= {f"estimate.{name}": STATE.shapes[name] for name in ("r_e", "v_e", "q_mu")}
        symbols = {name: ca.SX.sym(name.replace(".", "_"), *s) for name, s in inputs.items()}
        return Model(
            "navigation_error",
            inputs=symbols,
            outputs={"error": navigation_error(*symbols.values())},
        )

    def summarize(self, times: FloatArray, history: History) -> dict[str, Any]:
        """Summarize errors at the end, NEES and NIS over all fixes, and the fixes one by one."""
        summary = super().summarize(times, history)
        epochs = np.isfinite(history["accepted"]).any(axis=1)
        given = np.isfinite(history["accepted"][epochs])
        nees = np.where(given, history["nees"][epochs], np.nan)
        summary["nees"] = consistency(nees, 9.0, independent_epochs=False)
        dof = history["nis_dof"][epochs]
        mean_dof = float(np.nanmean(dof)) if np.isfinite(dof).any() else 4.0
        summary["nis"] = consistency(history["nis"][epochs], mean_dof, independent_epochs=True)
        summary["fixes"] = [
            _fix(t, accepted[valid], reason[valid])
            for t, accepted, reason, valid in zip(
                times[epochs],
                history["accepted"][epochs],
                history["reason"][epochs],
                given,
                strict=True,
            )
        ]
        return summary


def _fix(t: float, accepted: FloatArray, reason: FloatArray) -> dict[str, Any]:
    counts = Counter(REASONS[int(r)] for r in reason)
    fraction = float(accepted.mean())
    return {
        "t_s": float(t),
        "accepted": bool(fraction) if len(accepted) == 1 else fraction,
        "reason": counts.most_common(1)[0][0] if len(counts) == 1 else dict(counts),
    }
