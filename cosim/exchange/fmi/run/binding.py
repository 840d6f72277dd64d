"""The C interface of FMI 2 and 3, as far as terrafix calls it, under one set of names.

That of FMI 1 is in `terrafix.cosim.exchange.fmi.run.fmi1`.

One `Library` for each binary, however many instances: loading it once for each instance exhausts
the loader after a thousand. Status and messages of an instance become `FmuError`.
"""

from __future__ import annotations

import ctypes as ct
import math
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError
from terrafix.cosim.basics.scratch import shown
from terrafix.cosim.exchange.fmi.run.archive import Archive
from terrafix.cosim.exchange.fmi.run.clocks import Clocks
from terrafix.cosim.exchange.fmi.run.whole import limits

CO_SIMULATION, MODEL_EXCHANGE = "co-simulation", "model exchange"
MOST_EVENTS = 1000  # handled at one time, before it is said that time stands still
ENDED = "the FMU asks to end the simulation"
DISCARD = 2
_TERMINATED = 3  # of fmi2StatusKind
STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
_TYPES: dict[str, tuple[str, Any]] = {  # of the variable: (in function names, of ctypes)
    "Real": ("Real", ct.c_double),
    "Integer": ("Integer", ct.c_int),
    "Enumeration2": ("Integer", ct.c_int),
    "Boolean2": ("Boolean", ct.c_int),
    "Boolean1": ("Boolean", ct.c_uint8),
    "Float64": ("Float64", ct.c_double),
    "Float32": ("Float32", ct.c_float),
    "Int8": ("Int8", ct.c_int8),
    "UInt8": ("UInt8", ct.c_uint8),
    "Int16": ("Int16", ct.c_int16),
    "UInt16": ("UInt16", ct.c_uint16),
    "Int32": ("Int32", ct.c_int32),
    "UInt32": ("UInt32", ct.c_uint32),
    "Int64": ("Int64", ct.c_int64),
    "Enumeration": ("Int64", ct.c_int64),
    "UInt64": ("UInt64", ct.c_uint64),
    "Boolean": ("Boolean", ct.c_bool),
}

_MOST_SINGLE = float(np.finfo(np.float32).max)


class FmuError(TerrafixError):
    """A function of an FMU that did not succeed.

    Attributes
    ----------
    status : int
        As FMI numbers them: 1 warning, 2 discard, 3 error, 4 fatal.
    function : str
        Its name without ``fmi2`` or ``fmi3``.
    """

    def __init__(self, text: str, status: int = 3, function: str = "") -> None:
        super().__init__(text)
        self.status = status
        self.function = function


class FmuEndedError(FmuError):
    """An FMU that ended its simulation, as it may."""


def count_standing(before: int, begun: float, t: float) -> int:
    """Number of events since time went on; too many at one time are an error."""
    now = 0 if t > begun else before + 1
    if now > MOST_EVENTS:
        raise FmuError(f"it asks for event after event at t = {t:.9g} s: time stands still")
    return now


class _Environment(ct.Array[ct.c_longlong]):
    """Room for the C library's ``fenv_t``."""

    _type_ = ct.c_longlong
    _length_ = 16


def _mathematics() -> Any:
    names = {"win32": "ucrtbase.dll", "darwin": "libSystem.dylib", "linux": "libm.so.6"}
    try:
        return ct.CDLL(names.get(sys.platform))
    except OSError:  # a C library that holds its mathematics itself
        return ct.CDLL(None)


_get_environment, _set_environment = (_mathematics()[f"fe{name}env"] for name in ("get", "set"))


class Kept:
    """A block that calls foreign code.

    Afterwards the floating-point environment is ours again: rounding, the flushing of subnormals
    and traps belong to the thread, and foreign code sets them (a constructor of what ``-Ofast``
    linked, say). Where it forked, the copy of this process ends there.
    """

    def __enter__(self) -> None:
        self._process = os.getpid()
        self._ours = _Environment()
        _get_environment(self._ours)

    def __exit__(self, *_: object) -> None:
        _set_environment(self._ours)
        if os.getpid() != self._process:
            os._exit(0)


class _EventInfo2(ct.Structure):
    _fields_ = (
        ("again", ct.c_int),
        ("terminate", ct.c_int),
        ("nominals_changed", ct.c_int),
        ("states_changed", ct.c_int),
        ("time_defined", ct.c_int),
        ("time", ct.c_double),
    )


_messages: dict[int, list[str]] = {}
SPEAKERS: dict[Any, int] = {}
"""Environments of instances that a message names by other means (FMI 1): pointer, or name."""
HEARD: dict[int, list[tuple[int, str]]] = {}
"""By environment, what an instance logged, status and text, until a fleet takes it."""
ANY_HEARD = ct.c_int64(0)
"""Not 0 once something was logged, for compiled code to see."""
_MOST_HEARD = 100


def _note(environment: int | None, status: int, text: bytes | None) -> None:
    said = (text or b"").decode(errors="replace").strip()
    if not said:
        return
    found = _messages.setdefault(environment or 0, [])
    if len(found) < _MOST_HEARD:
        found.append(said)
    heard = HEARD.setdefault(environment or 0, [])
    if len(heard) < _MOST_HEARD:
        heard.append((int(status), said))
        ANY_HEARD.value = 1


def note_what_waits() -> None:
    """Let compiled code know whether anything that was logged waits to be shown."""
    ANY_HEARD.value = 0
    ANY_HEARD.value = bool(HEARD)


def _log_of_fmi2(environment: Any, name: Any, status: Any, category: Any, text: Any) -> None:
    del category
    if SPEAKERS:
        environment = SPEAKERS.get(environment, SPEAKERS.get(name, environment))
    _note(environment, status, text)


def _log_of_fmi3(environment: Any, status: Any, category: Any, text: Any) -> None:
    del category
    _note(environment, status, text)


_log2 = ct.CFUNCTYPE(None, ct.c_void_p, ct.c_char_p, ct.c_int, ct.c_char_p, ct.c_char_p)(
    _log_of_fmi2
)
_log3 = ct.CFUNCTYPE(None, ct.c_void_p, ct.c_int, ct.c_char_p, ct.c_char_p)(_log_of_fmi3)


def callbacks_of_fmi2(environment: int) -> Any:
    """FMI 2's callbacks; a proxy of FMPy's formats the variadic message."""
    import fmpy.fmi2 as fmi2

    given = fmi2.fmi2CallbackFunctions()
    given.logger = ct.cast(_log2, fmi2.fmi2CallbackLoggerTYPE)
    given.allocateMemory = fmi2.defaultCallbacks.allocateMemory
    given.freeMemory = fmi2.defaultCallbacks.freeMemory
    given.componentEnvironment = environment
    with suppress(ImportError, OSError):  # without its library the message stands unformatted
        from fmpy.logging import addLoggerProxy

        addLoggerProxy(ct.byref(given))
    return given


def _why_not(path: Path, error: OSError) -> str:
    if hasattr(os, "statvfs") and os.statvfs(path).f_flag & os.ST_NOEXEC:
        return (
            f"the temporary folder {tempfile.gettempdir()} is mounted noexec\n"
            "  let TMPDIR name one from which programs may be run"
        )
    return str(error)


class Library:
    """The binary of one FMU."""

    def __init__(self, archive: Archive, kind: str) -> None:
        interface = (
            archive.description.coSimulation
            if kind == CO_SIMULATION
            else archive.description.modelExchange
        )
        assert interface is not None
        self.archive = archive
        self.kind = kind
        self.version = archive.version
        self.interface = interface
        first = f"{interface.modelIdentifier}_fmi" if archive.version == 1 else ""
        self.prefix = first or f"fmi{archive.version}"
        self.instantiated = False
        path = archive.binary(interface.modelIdentifier)
        here = Path.cwd()
        try:
            os.chdir(path.parent)  # what it needs may lie beside it
            with Kept():
                self._dll = ct.CDLL(str(path))
        except OSError as error:
            raise ConfigurationError(
                f"the binary of '{shown(archive.path)}' cannot be loaded: {_why_not(path, error)}"
            ) from error
        finally:
            os.chdir(here)

    def __getitem__(self, name: str) -> Any:
        """A function by its name without ``fmi2`` or ``fmi3``."""
        full = f"{self.prefix}{name}"
        try:
            return getattr(self._dll, full)
        except AttributeError:
            raise ConfigurationError(
                f"'{shown(self.archive.path)}' does not export {full}\n"
                "  its binary is not one of FMI "
                f"{self.version}: terrafix check-fmu {shown(self.archive.path)} says more"
            ) from None

    def has(self, name: str) -> bool:
        """Whether the binary exports a function."""
        return hasattr(self._dll, f"{self.prefix}{name}")


_libraries: dict[tuple[str, str], Library] = {}


def load_library(archive: Archive, kind: str) -> Library:
    """The binary of an FMU, loaded once."""
    key = (str(archive.folder), kind)
    if key not in _libraries:
        _libraries[key] = Library(archive, kind)
    return _libraries[key]


def was_instantiated(archive: Archive, kind: str) -> bool:
    """Whether this process has had an instance of an FMU."""
    found = _libraries.get((str(archive.folder), kind))
    return found is not None and found.instantiated


def references(values: Sequence[int]) -> Any:
    """Value references as C takes them."""
    return (ct.c_uint32 * len(values))(*values)


def c_type(version: int, kind: str) -> tuple[str, Any]:
    """How functions name the type of a variable, and what C has for it."""
    own = "Enumeration2" if kind == "Enumeration" else f"{kind}{version}"
    return _TYPES[own if version < 3 and own in _TYPES else kind]


class Instance:
    """One instance of an FMU.

    Raises
    ------
    FmuError
        From every method whose function does not succeed, with what the FMU said.
    """

    _FREE = "FreeInstance"
    _next = 1
    _start = 0.0

    def __init__(self, library: Library, name: str, *, event_mode: bool = False) -> None:
        self.library = library
        self._event_mode = event_mode
        self.next_event: float | None = None  # in event mode of co-simulation [s]
        self._version = library.version
        self.clocks = Clocks(library.archive.clocks)
        self.environment = Instance._next
        Instance._next += 1
        _messages[self.environment] = []
        self.pointer: ct.c_void_p | None = None
        function, arguments = self._creation(name)
        function.restype = ct.c_void_p
        library.instantiated = True
        with Kept():
            made = function(*arguments)
        if not made:
            raise FmuError(f"the FMU could not be instantiated{self.said()}", 3, "Instantiate")
        self.pointer = ct.c_void_p(made)

    def _creation(self, name: str) -> tuple[Any, list[Any]]:
        """The function that makes an instance, and its arguments."""
        library, event_mode = self.library, self._event_mode
        token = library.archive.description.guid or ""
        resources = library.archive.folder / "resources"
        co_simulation = library.kind == CO_SIMULATION
        if self._version == 2:
            function = library["Instantiate"]
            self._callbacks = callbacks_of_fmi2(self.environment)
            arguments: list[Any] = [
                name.encode(),
                int(co_simulation),
                token.encode(),
                resources.absolute().as_uri().encode(),
                ct.byref(self._callbacks),
                0,
                1,
            ]
        else:
            kind = "CoSimulation" if co_simulation else "ModelExchange"
            function = library[f"Instantiate{kind}"]
            where = str(resources.absolute()) + os.sep
            arguments = [name.encode(), token.encode(), where.encode(), ct.c_bool(False)]
            arguments.append(ct.c_bool(True))
            if co_simulation:
                arguments += [ct.c_bool(event_mode), ct.c_bool(event_mode)]  # and early return
                arguments += [None, ct.c_size_t(0)]
            arguments += [ct.c_void_p(self.environment), _log3]
            arguments += [None] if co_simulation else []
        return function, arguments

    def said(self) -> str:
        """What the FMU logged since it was last asked, for an error."""
        found = _messages.get(self.environment, [])
        shown = list(dict.fromkeys(found))[-3:]
        found.clear()
        return ": " + "; ".join(shown) if shown else ""

    def call(self, name: str, *arguments: Any, accept: int = 1) -> int:
        """Call a function of the instance and refuse a status above `accept`."""
        function = self.library[name]
        function.restype = ct.c_int
        with Kept():
            status = int(function(self.pointer, *arguments))
        if status > accept:
            what = STATUS[status] if 0 <= status < len(STATUS) else f"status {status}"
            full = f"{self.library.prefix}{name}"
            raise FmuError(f"{full} returned {what}{self.said()}", status, name)
        return status

    # ------------------------------------------------------------------ life cycle

    def begin(self, t: float, tolerance: float | None = None, stop: float | None = None) -> None:
        """Enter initialization mode at a time [s]; with the tolerance of its own solver, if any.

        `stop` is the time after which nothing is asked of it; none is told if absent.
        """
        self._start = t
        self.clocks.begin(t)
        time, given = ct.c_double(t), ct.c_double(tolerance or 0.0)
        flag = ct.c_int if self._version == 2 else ct.c_bool
        end = flag(stop is not None), ct.c_double(stop or 0.0)
        if self._version == 2:
            self.call("SetupExperiment", flag(bool(tolerance)), given, time, *end)
            self.call("EnterInitializationMode")
        else:
            self.call("EnterInitializationMode", flag(bool(tolerance)), given, time, *end)

    def finish(self) -> None:
        """Leave initialization mode."""
        self.call("ExitInitializationMode")
        if self._event_mode:
            self._update(self._start)

    def _update(self, t: float) -> None:
        self.next_event = self.events_at(t)
        self.call("EnterStepMode")

    def events_at(self, t: float) -> float | None:
        """Let clocks tick and update discrete states, in event mode; the time of the next event."""
        if self.clocks:
            self.clocks.tick(self, t)
        _, due = self.discrete_update()
        if self.clocks:
            self.clocks.update(self, t)
            due = min((x for x in (due, self.clocks.next) if x is not None), default=None)
        return due

    def handle(self, t: float, change: Callable[[], None] | None = None) -> None:
        """Handle events of co-simulation (FMI 3), and what `change` sets in event mode."""
        self.call("EnterEventMode")
        if change is not None:
            change()
        self._update(t)

    def reset(self) -> None:
        """Return to the state after instantiation."""
        self.call("Reset")

    def terminate(self) -> None:
        """End the simulation."""
        self.call("Terminate")

    def free(self) -> None:
        """Give the instance back; it cannot be used any more."""
        if self.pointer is not None:
            function = self.library[self._FREE]
            function.restype = None
            with Kept():
                function(self.pointer)
            self.pointer = None
        _messages.pop(self.environment, None)
        HEARD.pop(self.environment, None)

    # ------------------------------------------------------------------ variables

    def get(self, kind: str, vr: Any, n: int) -> NDArray[Any]:
        """Values of variables of one type, `n` numbers in all."""
        name, ctype = c_type(self._version, kind)
        values = (ctype * max(n, 1))()
        sizes = () if self._version < 3 else (ct.c_size_t(n),)
        self.call(f"Get{name}", vr, ct.c_size_t(len(vr)), values, *sizes)
        return np.array(values[:n])

    def set(self, kind: str, vr: Any, values: Any) -> None:
        """Set variables of one type."""
        name, ctype = c_type(self._version, kind)
        flat = self.of_type(kind, vr, values)
        array = (ctype * max(len(flat), 1))(*flat)
        sizes = () if self._version < 3 else (ct.c_size_t(len(flat)),)
        self.call(f"Set{name}", vr, ct.c_size_t(len(vr)), array, *sizes)

    def of_type(self, kind: str, vr: Any, values: Any) -> list[Any]:
        """Values as numbers of a type, each of them inside it."""
        _, ctype = c_type(self._version, kind)
        flat: list[Any] = np.asarray(values).ravel().tolist()
        if ctype is ct.c_double:
            return flat
        return (self._singles if ctype is ct.c_float else self._wholes)(kind, vr, flat)

    def _wholes(self, kind: str, vr: Any, values: list[Any]) -> list[int]:
        low, high = limits(kind, self._version)
        for k, value in enumerate(values):
            if not low <= value <= high or value != int(value):
                raise FmuError(
                    f"'{self._name_of(kind, vr, k)}' ({kind}) is set to {value!r}; it takes "
                    f"whole numbers from {low} to {high}"
                )
        return [int(value) for value in values]

    def _singles(self, kind: str, vr: Any, values: list[Any]) -> list[float]:
        for k, value in enumerate(values):
            if math.isfinite(value) and abs(value) > _MOST_SINGLE:
                raise FmuError(
                    f"'{self._name_of(kind, vr, k)}' ({kind}) is set to {value!r}; it takes "
                    f"numbers up to {_MOST_SINGLE:.7g}"
                )
        return values

    def _name_of(self, kind: str, vr: Any, place: int) -> str:
        """Name of the variable that a value among those of several references belongs to."""
        of_kind = {
            int(v.valueReference): v
            for v in reversed(self.library.archive.description.modelVariables)
            if v.type == kind
        }
        for reference in vr:
            variable = of_kind.get(int(reference))
            size = math.prod(int(n) for n in getattr(variable, "shape", None) or ())
            if place < size:
                return variable.name if variable is not None else f"value reference {reference}"
            place -= size
        return "a variable"

    def set_texts(self, vr: Any, texts: Sequence[str]) -> None:
        """Set variables of text."""
        array = (ct.c_char_p * max(len(texts), 1))(*(text.encode() for text in texts))
        sizes = () if self._version < 3 else (ct.c_size_t(len(texts)),)
        self.call("SetString", vr, ct.c_size_t(len(vr)), array, *sizes)

    # ------------------------------------------------------------------ co-simulation

    def step(self, t: float, h: float) -> None:
        """Advance from `t` by `h` [s]."""
        if self._version == 2:
            try:
                self.call("DoStep", ct.c_double(t), ct.c_double(h), 1)
            except FmuError as error:
                if error.status == DISCARD and self.ended():
                    raise FmuEndedError(ENDED) from error
                raise
            return
        if self._event_mode:
            self._step_with_events(t, t + h)
            return
        _, early, last = self._step3(t, h)
        if early and last < t + h:
            raise FmuError(f"the FMU returned early, at t = {last:.9g} s")

    def _step3(self, t: float, h: float) -> tuple[bool, bool, float]:
        """Step as FMI 3 has it; whether there is an event, it returned early, and when."""
        flags = [ct.c_bool() for _ in range(3)]
        last = ct.c_double()
        self.call("DoStep", ct.c_double(t), ct.c_double(h), ct.c_bool(True),
                  *(ct.byref(f) for f in flags), ct.byref(last))  # fmt: skip
        if flags[1].value:
            raise FmuEndedError(f"the FMU asks to end the simulation at t = {last.value:.9g} s")
        return bool(flags[0].value), bool(flags[2].value), float(last.value)

    def _step_with_events(self, t: float, end: float) -> None:
        """Step to a time, stopping at events: where the FMU returns, and where it asked to."""
        tolerance, standing = 1e-9 * (end - t), 0
        while end - t > tolerance:
            due = self.next_event
            stop = end if due is None or due > end - tolerance else max(due, t)
            begun, event = t, False
            if stop > t:
                event, early, last = self._step3(t, stop - t)
                t = last if early and last < stop else stop
            if event or (due is not None and t >= due - tolerance):
                self.handle(t)
            standing = count_standing(standing, begun, t)

    def ended(self) -> bool:
        """Whether it ended its simulation with the step that it discarded (FMI 2)."""
        if self._version != 2 or not self.library.has("GetBooleanStatus"):
            return False
        value = ct.c_int()
        try:
            self.call("GetBooleanStatus", _TERMINATED, ct.byref(value))
        except FmuError:
            return False
        return bool(value.value)

    # ------------------------------------------------------------------ state

    @property
    def _state(self) -> str:
        return "FMUstate" if self._version == 2 else "FMUState"

    def get_state(self, state: ct.c_void_p | None = None) -> ct.c_void_p:
        """Copy the state; into `state` if one is given."""
        state = state if state is not None else ct.c_void_p()
        self.call(f"Get{self._state}", ct.byref(state))
        return state

    def set_state(self, state: ct.c_void_p) -> None:
        """Return to a state."""
        self.call(f"Set{self._state}", state)

    def free_state(self, state: ct.c_void_p) -> None:
        """Give a state back."""
        self.call(f"Free{self._state}", ct.byref(state))

    def serialize(self) -> bytes:
        """The present state as bytes."""
        state = self.get_state()
        try:
            size = ct.c_size_t()
            self.call(f"Serialized{self._state}Size", state, ct.byref(size))
            data = (ct.c_ubyte * size.value)()
            self.call(f"Serialize{self._state}", state, data, size)
            return bytes(data)
        finally:
            self.free_state(state)

    def deserialize(self, data: bytes) -> None:
        """Return to a state that `serialize` gave."""
        state = ct.c_void_p()
        array = (ct.c_ubyte * len(data)).from_buffer_copy(data)
        name = "DeSerializeFMUstate" if self._version == 2 else "DeserializeFMUState"
        self.call(name, array, ct.c_size_t(len(data)), ct.byref(state))
        try:
            self.set_state(state)
        finally:
            self.free_state(state)

    # ------------------------------------------------------------------ derivatives

    def directional(
        self, unknowns: Any, knowns: Any, seed: Sequence[float], n_out: int
    ) -> FloatArray:
        """Directional derivative of unknowns by knowns along `seed`."""
        seeds = (ct.c_double * max(1, len(seed)))(*seed)
        out = (ct.c_double * max(1, n_out))()
        n = [ct.c_size_t(len(v)) for v in (unknowns, knowns)]
        if self._version == 2:
            self.call("GetDirectionalDerivative", unknowns, n[0], knowns, n[1], seeds, out)
        else:
            self.call("GetDirectionalDerivative", unknowns, n[0], knowns, n[1], seeds,
                      ct.c_size_t(len(seed)), out, ct.c_size_t(n_out))  # fmt: skip
        return np.array(out[:n_out])

    # ------------------------------------------------------------------ model exchange

    def discrete_update(self) -> tuple[bool, float | None]:
        """Update discrete states until they stand; (states changed, time of the next event)."""
        changed = False
        for _ in range(MOST_EVENTS):
            if self._version == 2:
                info = _EventInfo2()
                self.call("NewDiscreteStates", ct.byref(info))
                again, end = info.again, info.terminate
                changed |= bool(info.states_changed)
                defined, time = info.time_defined, info.time
            else:
                flags = [ct.c_bool() for _ in range(5)]
                next_time = ct.c_double()
                self.call(
                    "UpdateDiscreteStates", *(ct.byref(f) for f in flags), ct.byref(next_time)
                )
                again, end = flags[0].value, flags[1].value
                changed |= bool(flags[3].value)
                defined, time = flags[4].value, next_time.value
            if end:
                raise FmuEndedError(ENDED)
            if not again:
                return changed, (float(time) if defined else None)
        raise FmuError(f"discrete states did not settle in {MOST_EVENTS} updates")

    def set_time(self, t: float) -> None:
        """Set the time [s]."""
        self.call("SetTime", ct.c_double(t))

    def completed_step(self) -> bool:
        """Say that an integrator step is complete; whether events must be handled."""
        kind = ct.c_int if self._version == 2 else ct.c_bool
        event, end = kind(), kind()
        true = 1 if self._version == 2 else ct.c_bool(True)
        self.call("CompletedIntegratorStep", true, ct.byref(event), ct.byref(end))
        if end.value:
            raise FmuEndedError(ENDED)
        return bool(event.value)

    def get_vector(self, name: str, n: int) -> FloatArray:
        """Continuous states, derivatives, nominals or event indicators, by the function's name."""
        out = np.empty(max(1, n))
        self.call(name, ct.c_void_p(out.ctypes.data), ct.c_size_t(n))
        return out[:n]

    def set_states(self, x: FloatArray) -> None:
        """Set the continuous states."""
        self.call("SetContinuousStates", ct.c_void_p(x.ctypes.data), ct.c_size_t(len(x)))

    def rates(self, n: int) -> FloatArray:
        """Derivatives of the continuous states."""
        return self.get_vector(
            "GetDerivatives" if self._version == 2 else "GetContinuousStateDerivatives", n
        )
