"""Chains: compiled steps of several components in one call of ``chain.c``, for one tick or many.

A component whose step is a function in C says so by `Compiled.compiled_step`. Where several of one
rate follow one another, nothing returns to Python between them. Where a step leaves something to
its component (a member that failed, a message to show), the chain stops there, and goes on once the
component has attended to it: what is seen from outside is what single steps would have left.
"""

from __future__ import annotations

import ctypes as ct
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.declare.component import Component
from terrafix.cosim.kernels import toolchain
from terrafix.cosim.kernels.compiled import EXPORT

COPIES = "copies.c"
_WORDS, _FLAGS, _FLAG_TO_DOUBLE, _DOUBLE_TO_FLAG, _SCALED = range(5)  # `enum how` of copies.c


class CompiledStep(NamedTuple):
    """Addresses of ``int64_t function(void *state, double t)`` and of its state.

    It does what `Component.step` does, up to time t. Where it does not return 0, it has stepped,
    and what then remains to be done is up to `Compiled.attend_compiled`.
    """

    function: int
    state: int


class Compiled(Component):
    """Base of components whose step may be one call of compiled code."""

    def compiled_step(self) -> CompiledStep | None:
        """The step, for the run that has been initialized; None where it is not compiled."""
        return None

    def begin_compiled(self) -> None:
        """Make the compiled step know of members that fly no more, and where the component is."""

    def attend_compiled(self) -> None:
        """Do what the compiled step has left to do."""

    def end_compiled(self) -> None:
        """Let the component know where its compiled steps have taken it."""


class Copy(ct.Structure):
    """``struct copy`` of ``copies.c``."""

    _fields_ = (
        ("from_", ct.c_void_p),
        ("to", ct.c_void_p),
        ("factor", ct.c_void_p),
        ("from_stride", ct.c_int64),
        ("to_stride", ct.c_int64),
        ("n_rows", ct.c_int64),
        ("n", ct.c_int64),
        ("how", ct.c_int64),
    )


class Copies:
    """Copies in their order, each of the rows of one array into another's.

    Attributes
    ----------
    at : int
        Address of the first.
    """

    def __init__(
        self, pairs: Sequence[tuple[NDArray[Any], NDArray[Any], FloatArray | None]]
    ) -> None:
        made = [_copy(*pair) for pair in pairs]
        self._kept = [*pairs]
        self._array = (Copy * max(len(made), 1))(*made)
        self.at = ct.addressof(self._array)

    def __len__(self) -> int:
        return len(self._kept)


def can_copy(target: NDArray[Any], source: NDArray[Any], factor: FloatArray | None = None) -> bool:
    """Whether `Copies` serve for two arrays of shape (n_members, n)."""
    if target.shape != source.shape or target.ndim != 2:
        return False
    if any(a.shape[1] > 1 and a.strides[1] != a.itemsize for a in (target, source)):
        return False
    if factor is not None:
        plain = target.dtype == source.dtype == np.float64
        return plain and factor.shape == target.shape[1:] and factor.flags.c_contiguous
    return _how(target, source) is not None


def _how(target: NDArray[Any], source: NDArray[Any]) -> int | None:
    kinds = source.dtype.kind, target.dtype.kind
    if source.dtype == target.dtype and source.dtype.itemsize == 8:
        return _WORDS
    return {
        ("b", "b"): _FLAGS,
        ("b", "f"): _FLAG_TO_DOUBLE if target.dtype == np.float64 else None,
        ("f", "b"): _DOUBLE_TO_FLAG if source.dtype == np.float64 else None,
    }.get(kinds)


def _copy(target: NDArray[Any], source: NDArray[Any], factor: FloatArray | None) -> Copy:
    n_rows, n = target.shape
    if factor is None and target.flags.c_contiguous and source.flags.c_contiguous:
        n_rows, n = 1, n_rows * n
    return Copy(
        from_=source.ctypes.data,
        to=target.ctypes.data,
        factor=None if factor is None else factor.ctypes.data,
        from_stride=source.strides[0],
        to_stride=target.strides[0],
        n_rows=n_rows,
        n=n,
        how=_how(target, source) if factor is None else _SCALED,
    )


class _Stage(ct.Structure):
    _fields_ = (
        ("step", ct.c_void_p),
        ("state", ct.c_void_p),
        ("before", ct.c_void_p),
        ("n_before", ct.c_int64),
    )


class _Chain(ct.Structure):
    _fields_ = (
        ("stages", ct.c_void_p),
        ("latches", ct.c_void_p),
        ("n_stages", ct.c_int64),
        ("n_latches", ct.c_int64),
        ("numerator", ct.c_int64),
        ("denominator", ct.c_int64),
        ("spacing", ct.c_int64),
        ("tick", ct.c_int64),
        ("last", ct.c_int64),
        ("stage", ct.c_int64),
        ("latched", ct.c_int64),
        ("t", ct.c_double),
    )


@cache
def _driver() -> Any:
    source = "".join(toolchain.c_source(name) for name in (COPIES, "chain.c"))
    library = toolchain.load(EXPORT + source)
    start, on = library["terrafix_chain"], library["terrafix_chain_on"]
    start.restype = on.restype = ct.c_int64
    start.argtypes = (ct.c_void_p, ct.c_int64, ct.c_int64, ct.c_double, ct.c_int64)
    on.argtypes = (ct.c_void_p,)
    return start, on


class Chain:
    """Components that step one after another, whose steps are compiled.

    Parameters
    ----------
    components : sequence of Compiled
    steps : sequence of CompiledStep
        Of each.
    before : sequence of Copies
        What is copied before each steps.
    latches : Copies or None
        What is copied once all have stepped; None where that is not for a chain to do, which then
        flies a tick at a time.
    active : ndarray of bool, shape (n_members,)
        Members that fly.
    spacing : int
        Ticks from one step to the next.
    seconds_per_tick : (int, int)
        Numerator and denominator.

    Attributes
    ----------
    aloft : bool
        Whether the compiled steps know more than the components.
    most : int
        Ticks that one call should take, so that Python is heard of now and then.
    """

    def __init__(
        self,
        components: Sequence[Compiled],
        steps: Sequence[CompiledStep],
        before: Sequence[Copies],
        latches: Copies | None,
        active: NDArray[np.bool_],
        spacing: int,
        seconds_per_tick: tuple[int, int],
    ) -> None:
        self.components = tuple(components)
        self.latches = latches
        self.aloft = False
        self.most = 2
        self._active, self._flying = active, b""
        self._kept = steps, before
        self._stages = (_Stage * len(steps))(
            *(
                _Stage(step.function, step.state, copies.at, len(copies))
                for step, copies in zip(steps, before, strict=True)
            )
        )
        numerator, denominator = seconds_per_tick
        self._call = _Chain(
            stages=ct.addressof(self._stages),
            latches=None if latches is None else latches.at,
            n_stages=len(steps),
            n_latches=0 if latches is None else len(latches),
            numerator=numerator,
            denominator=denominator,
            spacing=spacing,
        )
        self._at = ct.addressof(self._call)
        self._start, self._on = _driver()

    def ready(self) -> None:
        """Take off, or see who has fallen out since."""
        flying = self._active.tobytes()
        if self.aloft and flying == self._flying:
            return
        self.land()
        for component in self.components:
            component.begin_compiled()
        self.aloft, self._flying = True, flying

    def land(self) -> None:
        """Let all components know where they are."""
        if self.aloft:
            for component in self.components:
                component.end_compiled()
        self.aloft = False

    def start(self, tick: int, last: int, t: float, *, latched: bool) -> bool:
        """Fly from a tick, which is at `t` [s], to another; whether it stops on the way."""
        return bool(self._start(self._at, tick, last, t, latched))

    def go_on(self) -> bool:
        """Fly on behind the component that has attended; whether it stops again."""
        return bool(self._on(self._at))

    def stop_after_this_tick(self) -> None:
        """Let the tick at which it stands be the last."""
        self._call.last = self._call.tick

    @property
    def tick(self) -> int:
        """Where it stands."""
        tick: int = self._call.tick
        return tick

    @property
    def stage(self) -> int:
        """Number of the component that it stopped for."""
        following: int = self._call.stage
        return following - 1
