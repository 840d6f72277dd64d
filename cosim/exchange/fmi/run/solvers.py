"""Integration of an FMU for model exchange: CVode, from FMPy, or SciPy's DOP853."""

from __future__ import annotations

import ctypes as ct
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.exchange.fmi.run.archive import Archive
from terrafix.cosim.exchange.fmi.run.binding import MOST_EVENTS, FmuError, Instance

SOLVERS = ("cvode", "dop853")


def _as_nominal(values: FloatArray) -> FloatArray:
    """Make nominal values usable in place: a size, and 1 where 0 is given, which is none."""
    np.abs(values, out=values)
    values[values == 0.0] = 1.0
    return values


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

    Raises
    ------
    ConfigurationError
        If the solver cannot treat the FMU.
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
        if solver == "dop853" and self._n_indicators:
            raise ConfigurationError(
                f"'{archive.path}' has {self._n_indicators} event indicators, which dop853 does "
                'not watch\n  write solver = "cvode"'
            )
        self._events()  # it is in event mode since its initialization, and knows the time
        self._cvode: Any = None
        if solver == "cvode" and (self._n or self._n_indicators):
            self._cvode = self._make_cvode(t)

    def _count(self, name: str, otherwise: int) -> int:
        if self._fmu.library.version == 2:
            return otherwise
        n = ct.c_size_t()
        self._fmu.call(name, ct.byref(n))
        return int(n.value)

    def _events(self) -> None:
        """Handle events of the present time, in event mode already."""
        _, self._next_event = self._fmu.discrete_update()
        self._fmu.call("EnterContinuousTimeMode")

    def handle(self, t: float, change: Callable[[], None] | None = None) -> None:
        """Handle events at the present time, and what `change` sets in event mode.

        The solver goes on as it was where the equations did not change.
        """
        before = self._moment()
        self._fmu.call("EnterEventMode")
        if change is not None:
            change()
        self._events()
        if not np.array_equal(before, self._moment()):
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

    def advance(self, t: float, h: float) -> None:
        """Integrate from `t` over `h` [s].

        Raises
        ------
        FmuError
            If the FMU or the solver fails.
        """
        end = t + h
        if self._next_event is not None and abs(self._next_event - end) <= 1e-9 * h:
            end = self._next_event  # the same moment, added up in another way
        if self._stale and self._cvode is not None:
            self._cvode.reset(t)
            self._stale = False
        handled = 0
        try:
            while t < end:
                begun = t
                due = self._next_event is not None and self._next_event <= end
                stop = float(self._next_event) if due and self._next_event is not None else end
                stop = max(stop, t)
                state_event = False
                if stop > t:
                    state_event, t = self._integrate(t, stop)
                step_event = self._fmu.completed_step()
                if state_event or step_event or (due and t >= stop):
                    self.handle(t)
                    handled = 0 if t > begun else handled + 1
                    if handled > MOST_EVENTS:
                        raise FmuError(
                            f"it asks for event after event at t = {t:.9g} s: time stands still"
                        )
        except RuntimeError as error:  # of FMPy's CVode
            raise FmuError(f"the solver failed: {error}") from error

    def _integrate(self, t: float, stop: float) -> tuple[bool, float]:
        if self._cvode is not None:
            event, _, t = self._cvode.step(t, stop)
            self._fmu.set_time(t)
            return bool(event), stop if not event and math.isclose(t, stop, rel_tol=1e-14) else t
        if self._n:
            from scipy.integrate import solve_ivp

            x = self._fmu.get_vector("GetContinuousStates", self._n)
            nominal = _as_nominal(self._fmu.get_vector("GetNominalsOfContinuousStates", self._n))
            found = solve_ivp(
                self._rates, (t, stop), x, "DOP853",
                rtol=max(self._tolerance, 3e-14), atol=self._tolerance * nominal,
            )  # fmt: skip
            if not found.success:
                raise FmuError(f"the solver failed: {found.message}")
            self._fmu.set_time(stop)
            self._fmu.set_states(np.ascontiguousarray(found.y[:, -1]))
        else:
            self._fmu.set_time(stop)
        return False, stop

    def _rates(self, t: float, x: FloatArray) -> FloatArray:
        self._fmu.set_time(t)
        self._fmu.set_states(np.ascontiguousarray(x))
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
