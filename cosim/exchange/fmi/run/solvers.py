"""Integration of an FMU for model exchange: CVode, from FMPy, or SciPy's DOP853."""

from __future__ import annotations

import ctypes as ct
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.exchange.fmi.run.archive import Archive
from terrafix.cosim.exchange.fmi.run.binding import FmuError, Instance, count_standing

SOLVERS = ("cvode", "dop853")
_LOOKS = 8  # at the event indicators in a step of dop853


def _as_nominal(values: FloatArray) -> FloatArray:
    """Make nominal values usable in place: a size, and 1 where 0 is given, which is none."""
    np.abs(values, out=values)
    values[values == 0.0] = 1.0
    return values


def _changed(before: FloatArray, after: FloatArray) -> bool:
    """Whether an indicator whose side is known is on the other one (FMI: > 0, or not)."""
    return bool(((before != 0.0) & ((before > 0.0) != (after > 0.0))).any())


def _failed(said: str) -> FmuError:
    return FmuError(f"the solver failed ({said}); another solver, tolerance or step may do")


def stop_at(solver: Any, t: float) -> None:
    """Forbid FMPy's CVode to look beyond a time [s]."""
    from fmpy.sundials.libraries import sundials_cvode

    forbid = sundials_cvode.CVodeSetStopTime
    forbid.argtypes, forbid.restype = [ct.c_void_p, ct.c_double], ct.c_int
    forbid(solver.cvode_mem, t)


class _NoInput:
    """Inputs are set before a step and stand still during it."""

    def apply(self, t: float) -> None:
        del t


class Integrator:
    """One instance for model exchange, advanced from one communication point to the next.

    Parameters
    ----------
    instance : Instance
        Initialized.
    archive : Archive
    t : float
        Time [s].
    solver : {"cvode", "dop853"}
    tolerance : float
        Relative; the absolute one is this times the nominal value of each state.

    Attributes
    ----------
    next_event : float or None
        Time of the next event that the FMU asked for [s].
    """

    def __init__(
        self, instance: Instance, archive: Archive, t: float, solver: str, tolerance: float
    ) -> None:
        description = archive.description
        self._fmu = instance
        self._solver = solver
        self._tolerance = tolerance
        self._n = self._count("GetNumberOfContinuousStates", len(description.derivatives))
        n_indicators = description.numberOfEventIndicators or len(description.eventIndicators)
        self._n_indicators = self._count("GetNumberOfEventIndicators", n_indicators)
        self._events(t)  # it is in event mode since its initialization, and knows the time
        self._cvode: Any = None
        if solver == "cvode" and (self._n or self._n_indicators):
            self._cvode = self._make_cvode(t)

    def _count(self, name: str, otherwise: int) -> int:
        if self._fmu.library.version == 2:
            return otherwise
        n = ct.c_size_t()
        self._fmu.call(name, ct.byref(n))
        return int(n.value)

    def _events(self, t: float) -> None:
        """Handle events of the present time, in event mode already."""
        self.next_event = self._fmu.events_at(t)
        self._fmu.call("EnterContinuousTimeMode")

    def handle(self, t: float, change: Callable[[], None] | None = None) -> None:
        """Handle events at the present time, and what `change` sets in event mode.

        The solver begins anew, whatever states and derivatives are now: equations that differ may
        tell later, and a solver of many steps has looked ahead with those before. It goes on where
        it was told the time of the event, and has not looked beyond, if nothing was set and states
        and derivatives stand.
        """
        before = self._moment() if change is None and self._not_beyond == t else None
        self._fmu.call("EnterEventMode")
        if change is not None:
            change()
        self._events(t)
        if before is None or not np.array_equal(before, self._moment()):
            self.restart(t)

    def _moment(self) -> FloatArray:
        """Continuous states and their derivatives, now."""
        if not self._n:
            return np.empty(0)
        states = self._fmu.get_vector("GetContinuousStates", self._n)
        return np.concatenate([states, self._fmu.rates(self._n)])

    def restart(self, t: float | None = None) -> None:
        """Begin anew from the present states."""
        if self._cvode is not None and t is not None:
            self._cvode.reset(t)
        elif self._cvode is not None:
            self._stale = True

    _stale = False
    _not_beyond: float | None = None
    """Where the solver stands, if it was told to stop there [s]."""

    def advance(self, t: float, h: float) -> None:
        """Integrate from `t` over `h` [s].

        Raises
        ------
        FmuError
            If the FMU or the solver fails.
        """
        end = t + h
        if self.next_event is not None and abs(self.next_event - end) <= 1e-9 * h:
            end = self.next_event  # the same moment, added up in another way
        if self._stale and self._cvode is not None:
            self._cvode.reset(t)
            self._stale = False
        standing = 0
        try:
            while t < end:
                begun = t
                due = self.next_event is not None and self.next_event <= end
                stop = float(self.next_event) if due and self.next_event is not None else end
                stop = max(stop, t)
                state_event = False
                if stop > t:
                    state_event, t = self._integrate(t, stop)
                step_event = self._fmu.completed_step()
                if state_event or step_event or (due and t >= stop):
                    self.handle(t)
                    standing = count_standing(standing, begun, t)
        except RuntimeError as error:  # of FMPy's CVode
            said = re.sub(r", function \S+: ", ": ", str(error))  # of the machine that built it
            raise _failed(f"CVode, {said}") from error

    def _integrate(self, t: float, stop: float) -> tuple[bool, float]:
        self._not_beyond = None
        if self._cvode is not None:
            due = self.next_event
            if due is not None and due > t:
                stop_at(self._cvode, due)
            _, roots, t = self._cvode.step(t, stop)
            event = bool(roots.any())
            if not event and math.isclose(t, stop, rel_tol=1e-14):
                t = stop
            if not event and t == due:
                self._not_beyond = t
            self._fmu.set_time(t)
            return event, t
        if self._n:
            return self._by_dop853(t, stop)
        none = np.empty(0)
        at = self._first_change(t, stop, lambda _: none, self._signs(t, none))
        self._fmu.set_time(stop if at is None else at)
        return (False, stop) if at is None else (True, at)

    def _by_dop853(self, t: float, stop: float) -> tuple[bool, float]:
        """Integrate until an event at the latest; whether there is one, and when."""
        from scipy.integrate import DOP853

        x = self._fmu.get_vector("GetContinuousStates", self._n)
        nominal = _as_nominal(self._fmu.get_vector("GetNominalsOfContinuousStates", self._n))
        relative = max(self._tolerance, 3e-14)
        solver = DOP853(self._rates, t, x, stop, rtol=relative, atol=self._tolerance * nominal)
        signs = self._signs(t, x)
        while solver.status == "running":
            message = solver.step()
            if solver.status == "failed":
                raise _failed(f"DOP853, {message}")
            if self._n_indicators:
                path = solver.dense_output()
                at = self._first_change(solver.t_old, solver.t, path, signs)
                if at is not None:
                    self._move(at, path(at))
                    return True, at
            self._move(solver.t, solver.y)
            if solver.status == "running" and self._fmu.completed_step():
                return True, float(solver.t)
        return False, stop

    def _first_change(
        self, start: float, end: float, path: Callable[[float], FloatArray], signs: FloatArray
    ) -> float | None:
        """First time, to the last bit, at which an indicator is on its other side (> 0, or not).

        `signs` are those at `start`, and kept up to date. An indicator that is 0 there takes the
        side to which it leaves.
        """
        if not self._n_indicators:
            return None
        before = start
        for after in np.linspace(start, end, _LOOKS + 1)[1:].tolist():
            found = self._signs(after, path(after))
            if _changed(signs, found):
                while before < (middle := 0.5 * (before + after)) < after:
                    if _changed(signs, self._signs(middle, path(middle))):
                        after = middle
                    else:
                        before = middle
                return float(after)
            before = after
            signs[...] = np.where(signs == 0.0, found, signs)
        return None

    def _signs(self, t: float, x: FloatArray) -> FloatArray:
        """Signs of the event indicators."""
        if not self._n_indicators:
            return np.empty(0)
        self._move(t, x)
        return np.sign(self._fmu.get_vector("GetEventIndicators", self._n_indicators))

    def _move(self, t: float, x: FloatArray) -> None:
        self._fmu.set_time(t)
        if self._n:
            self._fmu.set_states(np.ascontiguousarray(x))

    def _rates(self, t: float, x: FloatArray) -> FloatArray:
        self._move(t, x)
        return self._fmu.rates(self._n).copy()

    def _make_cvode(self, t: float) -> Any:
        from fmpy.sundials import CVodeSolver

        fmu = self._fmu
        version = fmu.library.version
        rates = "GetDerivatives" if version == 2 else "GetContinuousStateDerivatives"

        def vector(name: str) -> Any:
            return lambda pointer, n: fmu.call(name, pointer, ct.c_size_t(n))

        def nominals(pointer: Any, n: int) -> None:
            fmu.call("GetNominalsOfContinuousStates", pointer, ct.c_size_t(n))
            _as_nominal(np.ctypeslib.as_array(pointer, (n,)))

        return CVodeSolver(
            nx=self._n,
            nz=self._n_indicators,
            get_x=vector("GetContinuousStates"),
            set_x=vector("SetContinuousStates"),
            get_dx=vector(rates),
            get_z=vector("GetEventIndicators"),
            get_nominals=nominals,
            set_time=fmu.set_time,
            input=_NoInput(),
            startTime=t,
            relativeTolerance=self._tolerance,
            maxNumSteps=100_000,
        )
