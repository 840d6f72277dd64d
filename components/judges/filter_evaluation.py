"""One evaluation for every filter: errors of its blocks, their sigma, NEES, and the fixes."""

from __future__ import annotations

from collections import Counter
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from terrafix.components.filters.family import (
    declare,
    estimate_fields,
    innovation_fields,
    says,
    value_field,
)
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.declare.component import Environment
from terrafix.cosim.declare.evaluation import Evaluation, History, Quantity, consistency
from terrafix.cosim.declare.ports import BundleInput, Input, MessageInput, Output
from terrafix.models.core.batch import over_members
from terrafix.models.core.model import Model
from terrafix.models.filters.consistency import normalized_square
from terrafix.models.filters.error_state import ErrorState, Values
from terrafix.models.filters.measurement import REASONS, Observation

Places = slice | list[int]
"""Elements of an error: a slice where they lie side by side, which takes no copy."""


class FilterEvaluation(Evaluation):
    """Errors (estimate minus truth) of every block, and what became of each fix: base.

    Its ports follow from the error state: an input for the truth of each block, under the block's
    name; the estimate; outputs ``NAME_error`` and ``NAME_sigma``. Of one measurement it reads
    ``innovation``; of several, ``NAME_innovation`` each, and publishes ``NAME_nis``, ``_nis_dof``,
    ``_accepted`` and ``_reason`` of each beside those of all. Corrections of one instant are made
    one after the other, so that their innovations are independent and their NIS add up.

    Attributes
    ----------
    error_state : ErrorState
    observation : Observation, optional
        Of the one correction whose innovations are judged.
    observations : dict of str to Observation
        Of several, by the names of the measurements, in the order of the chain.
    judged : tuple of str
        Blocks that NEES is taken over; all, if empty.
    called : dict of str to str
        Blocks whose errors go by another name.
    turned : dict of str to tuple of str
        Blocks of three elements whose errors are told in other axes, of which `rotation` is the
        transformation: frame and labels.
    """

    error_state: ClassVar[ErrorState]
    observation: ClassVar[Observation | None] = None
    observations: ClassVar[dict[str, Observation]] = {}
    judged: ClassVar[tuple[str, ...]] = ()
    called: ClassVar[dict[str, str]] = {}
    turned: ClassVar[dict[str, tuple[str, ...]]] = {}
    _names: ClassVar[tuple[str, ...]]
    _own: ClassVar[Places]
    _kept: ClassVar[Places]

    estimate: Any
    nees = Output(doc="normalized estimation error squared")
    nis = Output(doc="normalized innovation squared of this instant's accepted fixes")
    nis_dof = Output(doc="elements in those fixes")
    accepted = Output(doc="part of this instant's fixes that was accepted")
    reason = Output(doc="index into terrafix.models.filters.measurement.REASONS, of the last")

    def __init_subclass__(cls, **options: Any) -> None:
        if says(cls, "error_state", "observation", "observations", "judged", "called", "turned"):
            state, ports = cls.error_state.present, dict[str, Any]()
            _check(cls)
            for block in state:
                truth, name = value_field(block), cls.called.get(block.name, block.name)
                ports[block.name] = Input(
                    truth.fixed_shape, unit=truth.unit, frame=truth.frame, doc="truth"
                )
                frame, labels = block.frame, block.axes if block.size > 1 else ()
                if block.name in cls.turned:
                    frame, *axes = cls.turned[block.name]
                    labels = tuple(axes)
                for kind, doc in (("error", "estimate minus truth"), ("sigma", "predicted")):
                    ports[f"{name}_{kind}"] = Output(
                        (block.size,), unit=block.unit, frame=frame, labels=labels, doc=doc
                    )
            fields = estimate_fields(cls.error_state)
            ports["estimate"] = BundleInput(fields, doc="to be evaluated")
            ports["covariance"] = Output(
                (state.size, state.size),
                doc=f"predicted, in SI: {', '.join(dict.fromkeys(state.units))}",
            )
            ports |= _of_fixes(cls)
            declare(cls, **ports)
            cls.quantities = tuple(
                Quantity(
                    cls.called.get(b.name, b.name),
                    b.unit,
                    cls.turned.get(b.name, ("", *b.axes))[1:],
                )
                for b in state
            )
            cls.nees_axes = len(cls._judged())
            cls.measurements = tuple(cls.observations)
            cls.white = not any(block.considered for block in state)
            cls._names = tuple(block.name for block in state)
            own = [k for b in state for k in _elements(cls.error_state, b.name)]
            cls._own, cls._kept = _places(own), _places(cls._judged())
        super().__init_subclass__(**options)

    @classmethod
    def _measured(cls) -> dict[str, Observation]:
        """Observations by the prefix of their ports."""
        if cls.observation is not None:
            return {"": cls.observation}
        return {f"{name}_": seen for name, seen in cls.observations.items()}

    def rotation(self, truth: Values) -> Any:
        """Transformation (3, 3) from the axes of turned blocks to those they are told in.

        Parameters
        ----------
        truth : mapping of str to SX
            True values by block.
        """
        raise NotImplementedError(f"{type(self).__name__} must provide rotation()")

    def _turning(self, truth: Values) -> Any:
        """Derivative (n, n) of the errors as they are told by those of the error state."""
        state, C = self.error_state.present, self.rotation(truth)
        return ca.diagcat(*(C if b.name in self.turned else ca.SX.eye(b.size) for b in state))

    def _turn_arrays(self, truth: list[FloatArray]) -> FloatArray:
        """`_turning` of all members, (k, n, n)."""
        if self._turn is None:
            names = [block.name for block in self.error_state.present]
            shapes = [(block.value_size,) for block in self.error_state.present]
            self._turn = over_members(
                lambda *values: self._turning(dict(zip(names, values, strict=True))), *shapes
            )
        found: FloatArray = self._turn(*truth)
        return found

    _turn: Any = None

    def __getstate__(self) -> dict[str, Any]:
        """What goes to another process: without a function that is made there."""
        return {k: v for k, v in self.__dict__.items() if k != "_turn"}

    def bind(self, environment: Environment) -> None:
        """Begin with the choices of this run."""
        super().bind(environment)
        self._turn = None

    def _initialize_impl(self) -> None:
        self._evaluate()

    def _step_impl(self, t: float, dt: float) -> None:
        self._evaluate()

    def _evaluate(self) -> None:
        state, estimate, names = self.error_state.present, self.estimate, self._names
        P = _square(estimate.P, self._own)
        truth = [self.port_views[name] for name in names]
        own_values = [getattr(estimate, name) for name in names]
        if state.carried:
            # P is about the estimate, and so are the errors
            error = -state.difference_of_arrays(*truth, *own_values, estimate.age)
        else:
            error = state.difference_of_arrays(*own_values, *truth)
        if self.turned:
            J = self._turn_arrays(truth)
            error, P = np.einsum("kij,kj->ki", J, error), J @ P @ J.transpose(0, 2, 1)
        variance = np.diagonal(P, axis1=1, axis2=2)
        sigma = np.sqrt(np.where(variance > 0.0, variance, np.nan))
        for block, place in state.places.items():
            name = self.called.get(block, block)
            self.port_views[f"{name}_error"][...] = error[:, place]
            self.port_views[f"{name}_sigma"][...] = sigma[:, place]
        self.nees = normalized_square(error[:, self._kept], _square(P, self._kept))
        self.covariance = P
        self._judge_fixes()

    @classmethod
    def _judged(cls) -> list[int]:
        state = cls.error_state.present
        names = cls.judged or tuple(block.name for block in state)
        return [k for b in state if b.name in names for k in _elements(state, b.name)]

    def _judge_fixes(self) -> None:
        told = {prefix: self.port_views[f"{prefix}innovation"] for prefix in self._measured()}
        if not any(message.fresh.any() for message in told.values()):
            self._say_of_none()
            return
        n = self.n_members
        nis, dof, good, come = (np.zeros(n) for _ in range(4))
        reason = np.full(n, np.nan)
        at = 0
        for prefix, seen in self._measured().items():
            of = told[prefix]
            # a fix that was refused says why in `reason`, and nothing of the filter's consistency
            used = of.fresh & (of.accepted > 0.5)
            measured = used[:, None] & ((of.residual != 0.0) | (of.sigma != 1.0))
            self.port_views["normalized_innovation"][:, at : at + seen.size] = np.where(
                measured, of.residual / np.where(measured, of.sigma, 1.0), np.nan
            )
            at += seen.size
            nis += np.where(used, of.nis, 0.0)
            dof += np.where(used, of.dof, 0.0)
            good, come = good + used, come + of.fresh
            reason = np.where(of.fresh, of.reason, reason)
            if prefix:
                for name, values, given in (
                    ("nis", of.nis, used),
                    ("nis_dof", of.dof, used),
                    ("accepted", of.accepted, of.fresh),
                    ("reason", of.reason, of.fresh),
                ):
                    self.port_views[f"{prefix}{name}"][...] = np.where(given, values, np.nan)
        self.nis = np.where(good > 0, nis, np.nan)
        self.nis_dof = np.where(good > 0, dof, np.nan)
        self.accepted = np.where(come > 0, good / np.maximum(come, 1), np.nan)
        self.reason = reason

    def _say_of_none(self) -> None:
        """What there is to say where no fix came."""
        for prefix in ("", *(p for p in self._measured() if p)):
            for name in ("nis", "nis_dof", "accepted", "reason"):
                self.port_views[f"{prefix}{name}"][...] = np.nan
        if self._measured():
            self.port_views["normalized_innovation"][...] = np.nan

    def error_model(self) -> Model:
        """Errors of all quantities as a function of what the ports bring, for linearization."""
        state = self.error_state.present
        shapes = {block.name: (block.value_size, 1) for block in state}
        inputs = {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}
        given = {f"estimate.{n}": ca.SX.sym(f"estimate_{n}", *s) for n, s in shapes.items()}
        error = state.flat_difference(*given.values(), *inputs.values())
        if self.turned:
            error = ca.mtimes(self._turning(inputs), error)
        return Model("filter_error", inputs={**inputs, **given}, outputs={"error": error})

    def summarize(self, times: FloatArray, history: History) -> dict[str, Any]:
        """Summarize errors at the end, NEES and NIS over all fixes, and the fixes one by one."""
        summary = super().summarize(times, history)
        measured = self._measured()
        if not measured:
            return summary
        epochs = np.isfinite(history["accepted"]).any(axis=1)
        given = np.isfinite(history["accepted"][epochs])
        nees = np.where(given, history["nees"][epochs], np.nan)
        summary["nees"] = consistency(nees, float(len(self._judged())), independent_epochs=False)
        for prefix in ("", *(p for p in measured if p)):
            size = (
                sum(seen.size for seen in measured.values())
                if not prefix
                else measured[prefix].size
            )
            dof = history[f"{prefix}nis_dof"][epochs]
            mean = float(np.nanmean(dof)) if np.isfinite(dof).any() else float(size)
            values = history[f"{prefix}nis"][epochs]
            summary[f"{prefix}nis"] = consistency(values, mean, independent_epochs=self.white)
        summary["fixes"] = [
            {**fix, **({"of": prefix.rstrip("_")} if prefix else {})}
            for k in np.flatnonzero(epochs)
            for prefix in measured
            for fix in _fixes(
                times[k], *(history[f"{prefix}{n}"][k] for n in ("accepted", "reason"))
            )
        ]
        return summary


def _check(cls: type[FilterEvaluation]) -> None:
    """Raise ValueError if names of a subclass do not fit its error state."""
    names = [block.name for block in cls.error_state.present]
    kinds = (("judged", cls.judged), ("called", cls.called), ("turned", cls.turned))
    for kind, given in kinds:
        for name in given:
            if name not in names:
                raise ValueError(
                    f"{cls.__name__}.{kind} names '{name}', which is no block of its error state; "
                    f"the blocks are {', '.join(names)}"
                )
    if cls.turned and cls.rotation is FilterEvaluation.rotation:
        raise ValueError(
            f"{cls.__name__} tells errors of {', '.join(cls.turned)} in other axes: it needs a "
            "method `rotation` that transforms to these"
        )
    if cls.observation is not None and cls.observations:
        raise ValueError(
            f"{cls.__name__} has one observation or several observations by name, not both"
        )


def _of_fixes(cls: type[FilterEvaluation]) -> dict[str, Any]:
    """Ports about the fixes."""
    ports: dict[str, Any] = {}
    measured = cls._measured()
    for prefix, seen in measured.items():
        ports[f"{prefix}innovation"] = MessageInput(
            fields=innovation_fields(seen), optional=True, doc="of the fixes"
        )
        if prefix:
            of = f"of {prefix.rstrip('_')}"
            ports[f"{prefix}nis"] = Output(doc=f"normalized innovation squared {of}, if accepted")
            ports[f"{prefix}nis_dof"] = Output(doc=f"elements in the fix {of}")
            ports[f"{prefix}accepted"] = Output(doc=f"1 if the fix {of} was accepted, 0 if not")
            ports[f"{prefix}reason"] = Output(doc=f"index into REASONS, {of}")
    if measured:
        ports["normalized_innovation"] = Output(
            (sum(seen.size for seen in measured.values()),),
            doc="of this instant's accepted fixes, over its sigma; NaN where not measured",
        )
    return ports


def _places(elements: list[int]) -> Places:
    """A slice of elements that lie side by side, or the elements."""
    begin, end = elements[0], elements[-1] + 1
    return slice(begin, end) if elements == list(range(begin, end)) else elements


def _square(P: FloatArray, places: Places) -> FloatArray:
    """Rows and columns of covariances."""
    return P[:, places][:, :, places]


def _elements(state: ErrorState, name: str) -> range:
    """Where a block's error lies."""
    place = state.places[name]
    return range(place.start, place.stop)


def _fixes(t: float, accepted: FloatArray, reason: FloatArray) -> list[dict[str, Any]]:
    """The fix of an instant, in a list; none, where no member had one."""
    given = np.isfinite(accepted)
    if not given.any():
        return []
    counts = Counter(REASONS[int(r)] for r in reason[given])
    fraction = float(accepted[given].mean())
    return [
        {
            "t_s": float(t),
            "accepted": bool(fraction) if given.sum() == 1 else fraction,
            "reason": counts.most_common(1)[0][0] if len(counts) == 1 else dict(counts),
        }
    ]
