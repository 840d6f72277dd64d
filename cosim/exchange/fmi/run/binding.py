"""The C interface of FMI 2 and 3, as far as terrafix calls it, under one set of names.

One `Library` for each binary, however many instances: loading it once for each instance exhausts
the loader after a thousand. Status and messages of an instance become `FmuError`.
"""

from __future__ import annotations

import ctypes as ct
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError
from terrafix.cosim.exchange.fmi.run.archive import Archive

CO_SIMULATION, MODEL_EXCHANGE = "co-simulation", "model exchange"
STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
_TYPES: dict[str, tuple[str, Any]] = {  # of the variable: (in function names, of ctypes)
    "Real": ("Real", ct.c_double),
    "Integer": ("Integer", ct.c_int),
    "Enumeration2": ("Integer", ct.c_int),
    "Boolean2": ("Boolean", ct.c_int),
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


class FmuError(TerrafixError):
    """A function of an FMU that did not succeed.

    Attributes
    ----------
    status : int
        As FMI numbers them: 1 warning, 2 discard, 3 error, 4 fatal.
    """

    def __init__(self, text: str, status: int = 3) -> None:
        super().__init__(text)
        self.status = status


class _Logger2(ct.Structure):
    _fields_ = (
        ("logger", ct.c_void_p),
        ("allocate", ct.c_void_p),
        ("free", ct.c_void_p),
        ("finished", ct.c_void_p),
        ("environment", ct.c_void_p),
    )


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


def _note(environment: int | None, category: bytes | None, text: bytes | None) -> None:
    said = (text or b"").decode(errors="replace").strip()
    found = _messages.setdefault(environment or 0, [])
    if said and len(found) < 100:
        found.append(said)
    del category


def _log_of_fmi2(environment: Any, name: Any, status: Any, category: Any, text: Any) -> None:
    del name, status
    _note(environment, category, text)


def _log_of_fmi3(environment: Any, status: Any, category: Any, text: Any) -> None:
    del status
    _note(environment, category, text)


_log2 = ct.CFUNCTYPE(None, ct.c_void_p, ct.c_char_p, ct.c_int, ct.c_char_p, ct.c_char_p)(
    _log_of_fmi2
)
_log3 = ct.CFUNCTYPE(None, ct.c_void_p, ct.c_int, ct.c_char_p, ct.c_char_p)(_log_of_fmi3)


def _callbacks2(environment: int) -> Any:
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
        self.prefix = f"fmi{archive.version}"
        path = archive.binary(interface.modelIdentifier)
        here = Path.cwd()
        try:
            os.chdir(path.parent)  # what it needs may lie beside it
            self._dll = ct.CDLL(str(path))
        except OSError as error:
            raise ConfigurationError(
                f"the binary of '{archive.path}' cannot be loaded: {error}"
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
                f"'{self.archive.path}' does not export {full}\n"
                "  its binary is not one of FMI "
                f"{self.version}: terrafix check-fmu {self.archive.path} says more"
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


def references(values: Sequence[int]) -> Any:
    """Value references as C takes them."""
    return (ct.c_uint32 * len(values))(*values)


class Instance:
    """One instance of an FMU.

    Raises
    ------
    FmuError
        From every method whose function does not succeed, with what the FMU said.
    """

    _next = 1

    def __init__(self, library: Library, name: str) -> None:
        self.library = library
        self._version = library.version
        self._environment = Instance._next
        Instance._next += 1
        _messages[self._environment] = []
        self.pointer: ct.c_void_p | None = None
        token = library.archive.description.guid or ""
        resources = library.archive.folder / "resources"
        co_simulation = library.kind == CO_SIMULATION
        if self._version == 2:
            function = library["Instantiate"]
            self._callbacks = _callbacks2(self._environment)
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
                arguments += [ct.c_bool(False), ct.c_bool(False), None, ct.c_size_t(0)]
            arguments += [ct.c_void_p(self._environment), _log3]
            arguments += [None] if co_simulation else []
        function.restype = ct.c_void_p
        made = function(*arguments)
        if not made:
            raise FmuError(f"the FMU could not be instantiated{self.said()}")
        self.pointer = ct.c_void_p(made)

    def said(self) -> str:
        """What the FMU logged since it was last asked, for an error."""
        found = _messages.get(self._environment, [])
        shown = list(dict.fromkeys(found))[-3:]
        found.clear()
        return ": " + "; ".join(shown) if shown else ""

    def call(self, name: str, *arguments: Any, accept: int = 1) -> int:
        """Call a function of the instance and refuse a status above `accept`."""
        function = self.library[name]
        function.restype = ct.c_int
        status = int(function(self.pointer, *arguments))
        if status > accept:
            what = STATUS[status] if 0 <= status < len(STATUS) else f"status {status}"
            full = f"{self.library.prefix}{name}"
            raise FmuError(f"{full} returned {what}{self.said()}", status)
        return status

    # ------------------------------------------------------------------ life cycle

    def begin(self, t: float) -> None:
        """Enter initialization mode at a time [s]."""
        none, time = ct.c_double(0.0), ct.c_double(t)
        if self._version == 2:
            self.call("SetupExperiment", 0, none, time, 0, none)
            self.call("EnterInitializationMode")
        else:
            no = ct.c_bool(False)
            self.call("EnterInitializationMode", no, none, time, no, none)

    def finish(self) -> None:
        """Leave initialization mode."""
        self.call("ExitInitializationMode")

    def reset(self) -> None:
        """Return to the state after instantiation."""
        self.call("Reset")

    def terminate(self) -> None:
        """End the simulation."""
        self.call("Terminate")

    def free(self) -> None:
        """Give the instance back; it cannot be used any more."""
        if self.pointer is not None:
            function = self.library["FreeInstance"]
            function.restype = None
            function(self.pointer)
            self.pointer = None
        _messages.pop(self._environment, None)

    # ------------------------------------------------------------------ variables

    def _type(self, kind: str) -> tuple[str, Any]:
        if self._version == 2 and f"{kind}2" in _TYPES:
            kind = f"{kind}2"
        return _TYPES[kind]

    def get(self, kind: str, vr: Any, n: int) -> NDArray[Any]:
        """Values of variables of one type, `n` numbers in all."""
        name, ctype = self._type(kind)
        values = (ctype * max(n, 1))()
        sizes = () if self._version == 2 else (ct.c_size_t(n),)
        self.call(f"Get{name}", vr, ct.c_size_t(len(vr)), values, *sizes)
        return np.array(values[:n])

    def set(self, kind: str, vr: Any, values: Any) -> None:
        """Set variables of one type."""
        name, ctype = self._type(kind)
        flat = np.asarray(values).ravel().tolist()
        convert: Any = float if ctype in (ct.c_double, ct.c_float) else int
        converted = [convert(value) for value in flat]
        array = (ctype * max(len(flat), 1))(*converted)
        sizes = () if self._version == 2 else (ct.c_size_t(len(flat)),)
        self.call(f"Set{name}", vr, ct.c_size_t(len(vr)), array, *sizes)

    def set_text(self, reference: int, text: str) -> None:
        """Set a variable of text."""
        array = (ct.c_char_p * 1)(text.encode())
        sizes = () if self._version == 2 else (ct.c_size_t(1),)
        self.call("SetString", references([reference]), ct.c_size_t(1), array, *sizes)

    # ------------------------------------------------------------------ co-simulation

    def step(self, t: float, h: float) -> None:
        """Advance from `t` by `h` [s]."""
        if self._version == 2:
            self.call("DoStep", ct.c_double(t), ct.c_double(h), 1)
            return
        flags = [ct.c_bool() for _ in range(3)]
        last = ct.c_double()
        self.call("DoStep", ct.c_double(t), ct.c_double(h), ct.c_bool(True),
                  *(ct.byref(f) for f in flags), ct.byref(last))  # fmt: skip
        if flags[1].value:
            raise FmuError(f"the FMU asks to end the simulation at t = {last.value:.9g} s")
        if flags[2].value and last.value < t + h:
            raise FmuError(f"the FMU returned early, at t = {last.value:.9g} s")

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
        for _ in range(1000):
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
                raise FmuError("the FMU asks to end the simulation")
            if not again:
                return changed, (float(time) if defined else None)
        raise FmuError("discrete states did not settle in 1000 updates")

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
            raise FmuError("the FMU asks to end the simulation")
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
