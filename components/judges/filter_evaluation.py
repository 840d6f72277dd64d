"""One evaluation for every filter: errors of its blocks, their sigma, NEES, and the fixes."""

from __future__ import annotations

from collections import Counter
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from terrafix.components.filters.family import estimate_fields, innovation_fields, value_field
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.declare.evaluation import Evaluation, History, Quantity, consistency
from terrafix.cosim.declare.ports import BundleInput, Input, MessageInput, Output
from terrafix.models.core.batch import over_members
from terrafix.models.core.model import Model
from terrafix.models.filters.consistency import normalized_square
from terrafix.models.filters.error_state import ErrorState
from terrafix.models.filters.measurement import REASONS, Observation


class FilterEvaluation(Evaluation):
    """Errors (estimate minus truth) of every block, and what became of each fix: base.

    Its ports follow from the error state: an input for the truth of each block, under the block's
    name; the estimate; outputs ``NAME_error`` and ``NAME_sigma``.

    Attributes
    ----------
    error_state : ErrorState
    observation : Observation, optional
        Of the correction whose innovations are judged; of a chain, its last.
    judged : tuple of str
        Blocks that NEES is taken over; all, if empty.
    """

    error_state: ClassVar[ErrorState]
    observation: ClassVar[Observation | None] = None
    judged: ClassVar[tuple[str, ...]] = ()

    estimate: Any
    innovation: Any
    nees = Output(doc="normalized estimation error squared")
    nis = Output(doc="normalized innovation squared of this instant's fix, if accepted")
    nis_dof = Output(doc="elements in that fix")
    accepted = Output(doc="1 if that fix was accepted, 0 if not")
    reason = Output(doc="index into terrafix.models.filters.measurement.REASONS")

    def __init_subclass__(cls, **options: Any) -> None:
        if "error_state" in vars(cls):
            state, ports = cls.error_state.present, dict[str, Any]()
            for block in state:
                truth = value_field(block)
                ports[block.name] = Input(
                    truth.fixed_shape, unit=truth.unit, frame=truth.frame, doc="truth"
                )
                labels = block.axes if block.size > 1 else ()
                for kind in ("error", "sigma"):
                    ports[f"{block.name}_{kind}"] = Output(
                        (block.size,), unit=block.unit, frame=block.frame, labels=labels
                    )
            fields = estimate_fields(cls.error_state)
            ports["estimate"] = BundleInput(fields, doc="to be evaluated")
            ports["covariance"] = Output((state.size, state.size), doc="predicted, in SI")
            if cls.observation is not None:
                fields = innovation_fields(cls.observation)
                ports["innovation"] = MessageInput(fields=fields, optional=True, doc="of the fixes")
                ports["normalized_innovation"] = Output(
                    (cls.observation.size,), doc="of an accepted fix, over its sigma"
                )
            for name, port in ports.items():
                if name not in vars(cls):
                    setattr(cls, name, port)
                    port.__set_name__(cls, name)
            cls.quantities = tuple(Quantity(b.name, b.unit, b.axes) for b in state)
            shapes = [(b.value_size,) for b in state]
            cls._difference = staticmethod(over_members(_errors(state), *shapes, *shapes))
        super().__init_subclass__(**options)

    _difference: ClassVar[Any]

    def _initialize_impl(self) -> None:
        self._evaluate()

    def _step_impl(self, t: float, dt: float) -> None:
        self._evaluate()

    def _evaluate(self) -> None:
        state, estimate = self.error_state.present, self.estimate
        own = [k for b in state for k in _elements(self.error_state, b.name)]
        P = estimate.P[:, own][:, :, own]
        names = [block.name for block in state]
        truth = [self.port_views[name] for name in names]
        error = self._difference(*(getattr(estimate, name) for name in names), *truth)
        variance = np.diagonal(P, axis1=1, axis2=2)
        sigma = np.sqrt(np.where(variance > 0.0, variance, np.nan))
        for name, place in state.places.items():
            self.port_views[f"{name}_error"][...] = error[:, place]
            self.port_views[f"{name}_sigma"][...] = sigma[:, place]
        kept = self._judged()
        self.nees = normalized_square(error[:, kept], P[:, kept][:, :, kept])
        self.covariance = P
        if self.observation is None:
            self.nis = self.nis_dof = self.accepted = self.reason = np.nan
        else:
            self._judge_fix()

    def _judged(self) -> list[int]:
        state = self.error_state.present
        names = self.judged or tuple(block.name for block in state)
        return [k for b in state if b.name in names for k in _elements(state, b.name)]

    def _judge_fix(self) -> None:
        told = self.innovation
        # a fix that was refused says why in `reason`, and nothing of the filter's consistency
        used = told.fresh & (told.accepted > 0.5)
        measured = used[:, None] & ((told.residual != 0.0) | (told.sigma != 1.0))
        self.normalized_innovation = np.where(
            measured, told.residual / np.where(measured, told.sigma, 1.0), np.nan
        )
        self.nis = np.where(used, told.nis, np.nan)
        self.nis_dof = np.where(used, told.dof, np.nan)
        self.accepted = np.where(told.fresh, told.accepted, np.nan)
        self.reason = np.where(told.fresh, told.reason, np.nan)

    def error_model(self) -> Model:
        """Errors of all quantities as a function of what the ports bring, for linearization."""
        state = self.error_state.present
        shapes = {block.name: (block.value_size, 1) for block in state}
        inputs = {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}
        given = {f"estimate.{n}": ca.SX.sym(f"estimate_{n}", *s) for n, s in shapes.items()}
        error = _errors(state)(*given.values(), *inputs.values())
        return Model("filter_error", inputs={**inputs, **given}, outputs={"error": error})

    def summarize(self, times: FloatArray, history: History) -> dict[str, Any]:
        """Summarize errors at the end, NEES and NIS over all fixes, and the fixes one by one."""
        summary = super().summarize(times, history)
        epochs = np.isfinite(history["accepted"]).any(axis=1)
        if not epochs.any():
            return summary
        given = np.isfinite(history["accepted"][epochs])
        nees = np.where(given, history["nees"][epochs], np.nan)
        dof = history["nis_dof"][epochs]
        summary["nees"] = consistency(nees, float(len(self._judged())), independent_epochs=False)
        expected = float(np.nanmean(dof)) if np.isfinite(dof).any() else 1.0
        summary["nis"] = consistency(history["nis"][epochs], expected, independent_epochs=True)
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


def _elements(state: ErrorState, name: str) -> range:
    """Where a block's error lies."""
    place = state.places[name]
    return range(place.start, place.stop)


def _errors(state: ErrorState) -> Any:
    """Estimate minus truth, of the values of all blocks, one after the other."""

    def errors(*values: Any) -> Any:
        names = [block.name for block in state]
        estimate = dict(zip(names, values[: len(names)], strict=True))
        truth = dict(zip(names, values[len(names) :], strict=True))
        return state.difference(estimate, truth)

    return errors


def _fix(t: float, accepted: FloatArray, reason: FloatArray) -> dict[str, Any]:
    counts = Counter(REASONS[int(r)] for r in reason)
    fraction = float(accepted.mean())
    return {
        "t_s": float(t),
        "accepted": bool(fraction) if len(accepted) == 1 else fraction,
        "reason": counts.most_common(1)[0][0] if len(counts) == 1 else dict(counts),
    }
