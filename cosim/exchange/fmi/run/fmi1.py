"""The calls of FMI 1.0 for co-simulation, under the names of FMI 2.

There is no initialization mode: inputs and start values are set before `fmiInitializeSlave`, and
outputs can be read afterwards alone. There is no state to get and set, and no event mode.
"""

from __future__ import annotations

import ctypes as ct
from typing import Any

from terrafix.cosim.exchange.fmi.run.binding import (
    SPEAKERS,
    FmuError,
    Instance,
    Library,
    callbacks_of_fmi2,
)

_MIME = b"application/x-fmu-sharedlibrary"
_NO, _YES = ct.c_uint8(0), ct.c_uint8(1)


class InstanceOfFmi1(Instance):
    """One instance of an FMU of FMI 1.0."""

    _FREE = "FreeSlaveInstance"

    def __init__(self, library: Library, name: str, *, event_mode: bool = False) -> None:
        super().__init__(library, name, event_mode=event_mode)
        assert self.pointer is not None
        SPEAKERS[self.pointer.value] = self.environment

    def _creation(self, name: str) -> tuple[Any, list[Any]]:
        from fmpy.fmi1 import fmi1CallbackFunctions

        given = callbacks_of_fmi2(self.environment)  # which begin as those of FMI 1
        functions = fmi1CallbackFunctions.from_buffer_copy(given)
        self._callbacks = given, functions
        self._name = f"{name}_{self.environment}".encode()  # all that a message says of its sender
        SPEAKERS[self._name] = self.environment
        archive = self.library.archive
        token, where = archive.description.guid or "", archive.folder.absolute().as_uri()
        return self.library["InstantiateSlave"], [
            *(self._name, token.encode(), where.encode(), _MIME),
            *(ct.c_double(0.0), _NO, _NO, functions, _YES),
        ]

    def begin(self, t: float, tolerance: float | None = None, stop: float | None = None) -> None:
        """Note the time of initialization [s]: until then, inputs and start values may be set."""
        del tolerance, stop
        self._start = t

    def finish(self) -> None:
        """Initialize."""
        self.call("InitializeSlave", ct.c_double(self._start), _NO, ct.c_double(0.0))

    def step(self, t: float, h: float) -> None:
        """Advance from `t` by `h` [s]."""
        self.call("DoStep", ct.c_double(t), ct.c_double(h), _YES)

    def reset(self) -> None:
        """Return to the state after instantiation."""
        self.call("ResetSlave")

    def terminate(self) -> None:
        """End the simulation."""
        self.call("TerminateSlave")

    def free(self) -> None:
        """Give the instance back; it cannot be used any more."""
        pointer = self.pointer
        super().free()
        for speaker in (self._name, *([pointer.value] if pointer is not None else [])):
            SPEAKERS.pop(speaker, None)

    def get_state(self, state: ct.c_void_p | None = None) -> ct.c_void_p:
        """FMI 1.0 has none."""
        raise FmuError("FMI 1.0 has no function to get or set the state of an FMU")
