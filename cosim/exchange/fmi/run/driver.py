"""The compiled driver of co-simulation, ``driver.c``: what it is told of an FMU's instances."""

from __future__ import annotations

import ctypes as ct
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.exchange.fmi.run.binding import ANY_HEARD, Instance, Library, c_type
from terrafix.cosim.exchange.fmi.run.whole import INTEGER, MOST, limits
from terrafix.cosim.kernels import toolchain
from terrafix.cosim.kernels.chain import COPIES, CompiledStep, Copies

NOT_FINITE, ENDED, DISCARDED, NOT_OF_TYPE, TOO_LARGE = 4, 5, 6, 8, 9  # of `enum failure`
REASONS = {
    1: "Set: inputs were refused",
    2: "DoStep did not succeed",
    3: "Get: outputs could not be read",
    6: "DoStep did not succeed",
    7: "DoStep: the FMU returned early",
    NOT_OF_TYPE: "Set: an input is no value of its type",
    TOO_LARGE: "Get: an output is too large",
}
_TYPES = (
    *("Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32"),
    *("Int64", "UInt64", "Boolean2", "Boolean"),
)
"""In the order of `enum type`."""
DOUBLE = ("Real", "Float64")
_SAME = {"Real": "Float64", "Integer": "Int32", "Enumeration": "Int64", "Enumeration2": "Int32"}


class _Group(ct.Structure):
    """``struct group`` of ``driver.c``."""

    _fields_ = (
        ("access", ct.c_void_p),
        ("reference", ct.c_void_p),
        ("n_references", ct.c_size_t),
        ("n", ct.c_size_t),
        ("start", ct.c_int64),
        ("type", ct.c_int64),
        ("low", ct.c_int64),
        ("high", ct.c_int64),
        ("room", ct.c_void_p),
    )


class _Binding(ct.Structure):
    """``struct binding`` of ``driver.c``."""

    _fields_ = (
        ("t", ct.c_double),
        ("h", ct.c_double),
        ("version", ct.c_int64),
        ("n_members", ct.c_int64),
        ("instance", ct.c_void_p),
        ("active", ct.c_void_p),
        ("failed", ct.c_void_p),
        ("step", ct.c_void_p),
        ("input", ct.c_void_p),
        ("output", ct.c_void_p),
        ("n_input_groups", ct.c_size_t),
        ("n_output_groups", ct.c_size_t),
        ("n_inputs", ct.c_size_t),
        ("n_outputs", ct.c_size_t),
        ("plain", ct.c_int64),
        ("inputs", ct.c_void_p),
        ("outputs", ct.c_void_p),
        ("start_time", ct.c_double),
        ("steps", ct.c_int64),
        ("heard", ct.c_void_p),
        ("taken", ct.c_void_p),
        ("given", ct.c_void_p),
        ("n_taken", ct.c_size_t),
        ("n_given", ct.c_size_t),
    )


@cache
def load_driver() -> Any:
    """The compiled driver; None where no compiler serves."""
    try:
        own = Path(__file__).with_name("driver.c").read_text()
        return toolchain.load(toolchain.c_source(COPIES) + own)
    except toolchain.CompilationError:
        return None


class Driver:
    """One call that steps all instances of an FMU.

    Parameters
    ----------
    compiled : ctypes library
        From `load_driver`.
    library : Library
        Of the FMU.
    instances : sequence of Instance or None
    active, failed : ndarray of uint8, shape (n_members,)
        Who is to be stepped, and who failed and how; read and written in place, as are the rows.
    inputs, outputs : ndarray, shape (n_members, width)
    read, written : sequence of (Group, ctypes array)
        Variables that are set and those that are got, with their references.

    Attributes
    ----------
    call, at : callable and its argument
        Together the step, from `binding.t` over `binding.h`; how many members failed.
    """

    def __init__(
        self,
        compiled: Any,
        library: Library,
        instances: Sequence[Instance | None],
        active: NDArray[np.uint8],
        failed: NDArray[np.uint8],
        inputs: FloatArray,
        outputs: FloatArray,
        read: Sequence[tuple[Any, Any]],
        written: Sequence[tuple[Any, Any]],
    ) -> None:
        pointers = (ct.c_void_p * len(instances))(
            *(i.pointer.value if i is not None and i.pointer else None for i in instances)
        )
        b = self.binding = _Binding(version=library.version, n_members=len(instances))
        self._kept: list[Any] = [pointers, active, failed, inputs, outputs, read, written]
        b.instance = ct.addressof(pointers)
        b.active, b.failed = active.ctypes.data, failed.ctypes.data
        b.step = _address(library["DoStep"])
        b.inputs, b.n_inputs = inputs.ctypes.data, inputs.shape[1]
        b.outputs, b.n_outputs = outputs.ctypes.data, outputs.shape[1]
        b.input, b.n_input_groups = self._groups(library, "Set", read)
        b.output, b.n_output_groups = self._groups(library, "Get", written)
        b.plain = all(
            len(each) <= 1 and all(g.kind in DOUBLE and not g.start for g, _ in each)
            for each in (read, written)
        )
        self.at = ct.byref(b)
        self.call = compiled["terrafix_step_fmus"]
        self.call.restype = ct.c_int64
        self._component = compiled["terrafix_step_component"]

    def component_step(self, taken: Copies, given: Copies, start_time: float) -> CompiledStep:
        """The step of the component, from ports to ports."""
        b = self.binding
        self._kept += [taken, given]
        b.taken, b.n_taken, b.given, b.n_given = taken.at, len(taken), given.at, len(given)
        b.heard, b.start_time, b.steps = ct.addressof(ANY_HEARD), start_time, 0
        function = _address(self._component)
        assert function is not None
        return CompiledStep(function, ct.addressof(b))

    def _groups(
        self, library: Library, verb: str, groups: Sequence[tuple[Any, Any]]
    ) -> tuple[int, int]:
        made = [_made(library, verb, group, vr, self._kept) for group, vr in groups if group.size]
        array = (_Group * max(len(made), 1))(*made)
        self._kept.append(array)
        return ct.addressof(array), len(made)


def _made(library: Library, verb: str, group: Any, vr: Any, kept: list[Any]) -> _Group:
    name, ctype = c_type(library.version, group.kind)
    key = f"{group.kind}2" if library.version == 2 else group.kind
    key = next(k for k in (key, group.kind) if k in _SAME or k in _TYPES)
    room = (ctype * max(group.size, 1))()
    kept.append(room)
    low, high = limits(group.kind, library.version) if group.kind in INTEGER else (0, 0)
    return _Group(
        access=_address(library[f"{verb}{name}"]),
        reference=ct.addressof(vr),
        n_references=len(vr),
        n=group.size,
        start=group.start,
        type=_TYPES.index(_SAME.get(key, key)),
        low=low,
        high=min(high, MOST),
        room=ct.addressof(room),
    )


def _address(function: Any) -> int | None:
    return ct.cast(function, ct.c_void_p).value
