"""Stretches: several ticks of several vector kernels in one call of the driver ``stretch.c``.

The driver keeps a tile of members in scratch memory while it steps them, where arrays that
components share (a port that one writes and another reads) are one place. What is seen from
outside, once it returns, is what a call per component and tick would have left.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.machine import processors
from terrafix.cosim.kernels import toolchain
from terrafix.cosim.kernels.base import BoundArrays, Kernel
from terrafix.cosim.kernels.compiled import EXPORT

_ALIGNMENT = 8  # doubles: a register, a cache line
_TILES_PER_THREAD = 4  # below, starting a thread costs more than it saves
_AHEAD = 4  # steps whose noise is drawn at once, as in stretch.c
CLOCK = ("step", "time")


class _Array(ctypes.Structure):
    _fields_ = (
        ("base", ctypes.c_void_p),
        ("stride", ctypes.c_int64),
        ("size", ctypes.c_int64),
        ("offset", ctypes.c_int64),
        ("read", ctypes.c_int64),
        ("written", ctypes.c_int64),
    )


class _Stage(ctypes.Structure):
    _fields_ = (
        ("prepare", ctypes.c_void_p),
        ("draw", ctypes.c_void_p),
        ("tile", ctypes.c_void_p),
        ("step", ctypes.c_int64),
        ("n_arguments", ctypes.c_int64),
        ("n_results", ctypes.c_int64),
        ("n_noise", ctypes.c_int64),
        ("argument", ctypes.c_void_p),
        ("result", ctypes.c_void_p),
        ("noise_argument", ctypes.c_void_p),
        ("noise_size", ctypes.c_void_p),
        ("keys", ctypes.c_void_p),
        ("read", ctypes.c_void_p),
        ("all", ctypes.c_void_p),
        ("invariant", ctypes.c_int64),
        ("pointers", ctypes.c_int64),
    )


class _Stretch(ctypes.Structure):
    _fields_ = (
        ("lanes", ctypes.c_int64),
        ("n_members", ctypes.c_int64),
        ("n_arrays", ctypes.c_int64),
        ("n_stages", ctypes.c_int64),
        ("arrays", ctypes.c_void_p),
        ("stages", ctypes.c_void_p),
        ("members", ctypes.c_void_p),
        ("active", ctypes.c_void_p),
        ("failed", ctypes.c_void_p),
        ("failed_tick", ctypes.c_void_p),
        ("failed_stage", ctypes.c_void_p),
        ("time_at", ctypes.c_int64),
        ("dt_at", ctypes.c_int64),
        ("dt", ctypes.c_double),
        ("t", ctypes.c_double),
        ("tick", ctypes.c_int64),
        ("spacing", ctypes.c_int64),
        ("n_ticks", ctypes.c_int64),
        ("numerator", ctypes.c_int64),
        ("denominator", ctypes.c_int64),
        ("n_tiles", ctypes.c_int64),
        ("next_tile", ctypes.c_int64),
    )


class Failure(NamedTuple):
    """Members that failed at one tick of a stretch in one stage: how many ticks after the first."""

    tick: int
    stage: int
    members: NDArray[np.bool_]


class Stage:
    """One vector kernel with its arrays, ready to be part of a stretch."""

    def __init__(
        self, kernel: Kernel, library: ctypes.CDLL, n_invariants: int, arrays: BoundArrays
    ) -> None:
        self.kernel = kernel
        self.arrays = arrays
        self.n_invariants = n_invariants
        self.lanes = ctypes.c_int32.in_dll(library, "terrafix_lanes").value
        self.functions = [
            ctypes.cast(library[name], ctypes.c_void_p).value
            for name in ("terrafix_prepare", "terrafix_draw", "terrafix_tile")
        ]
        keys = [arrays.noise_keys[a.name] for a in kernel.noise]
        self.keys = np.array([*keys, 0], dtype=np.uint64)
        self.clock = {a.kind: arrays.arguments[a.name] for a in kernel.arguments if a.kind in CLOCK}


@cache
def _driver() -> Any:
    source = toolchain.c_source("stretch.c")
    function = toolchain.load(EXPORT + source)["terrafix_stretch"]
    function.restype = ctypes.c_int64
    function.argtypes = (ctypes.c_void_p, ctypes.c_void_p)
    return function


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(available_threads(), thread_name_prefix="terrafix")


def available_threads() -> int:
    """How many threads step members side by side: ``TERRAFIX_THREADS``, or one per processor."""
    chosen = os.environ.get("TERRAFIX_THREADS", "")
    if chosen.isdigit() and int(chosen) > 0:
        return int(chosen)
    return processors()


class Stretch:
    """Stages in the order in which they step, laid out in one tile.

    Parameters
    ----------
    stages : sequence of Stage
        Bound to the same members and the same mask of active ones.

    Raises
    ------
    ValueError
        If an array of one stage lies across that of another, so that it has no place of its own.
    """

    def __init__(self, stages: Sequence[Stage]) -> None:
        self.stages = list(stages)
        first = stages[0].arrays
        self._lanes = stages[0].lanes
        self._n_members = len(first.members)
        self._size = 0
        self._places: dict[tuple[int, int], int] = {}
        self._written: set[tuple[int, int]] = set()
        self._rows: dict[tuple[int, int], FloatArray] = {}
        time_at, dt_at = self._room(1), self._room(1)
        self._clock_at = {"time": time_at, "step": dt_at}
        self._kept: list[Any] = []
        self._read = {
            self._key(stage.arrays.arguments[a.name])
            for stage in stages
            for a in stage.kernel.arguments
            if a.name in stage.arrays.arguments
        }
        self._stages = (_Stage * len(stages))(*(self._lay_out(stage) for stage in stages))
        if len(stages) > 1:
            self._refuse_overlaps()
        self._arrays = (_Array * len(self._rows))(
            *(
                _Array(
                    rows.ctypes.data,
                    0 if len(rows) == 1 else rows.strides[0],
                    rows.shape[1],
                    self._places[key],
                    key in self._read,
                    key in self._written,
                )
                for key, rows in self._rows.items()
            )
        )
        single = len(stages) == 1
        self._failed = first.failed if single else np.zeros(self._n_members, dtype=np.uint8)
        self._failed_tick = np.zeros(self._n_members, dtype=np.int64)
        self._failed_stage = np.zeros(self._n_members, dtype=np.int64)
        self._call = _Stretch(
            lanes=self._lanes,
            n_members=self._n_members,
            n_arrays=len(self._rows),
            n_stages=len(stages),
            arrays=ctypes.addressof(self._arrays),
            stages=ctypes.addressof(self._stages),
            members=first.members.ctypes.data,
            active=first.active.ctypes.data,
            failed=self._failed.ctypes.data,
            failed_tick=self._failed_tick.ctypes.data,
            failed_stage=self._failed_stage.ctypes.data,
            time_at=time_at,
            dt_at=dt_at,
            numerator=1,
            denominator=1,
        )
        self._at = ctypes.addressof(self._call)
        n_tiles = -(-self._n_members // self._lanes)
        n_threads = 1 if single else max(1, min(available_threads(), n_tiles // _TILES_PER_THREAD))
        self._call.n_tiles = n_tiles
        self._scratches = [self._scratch() for _ in range(n_threads)]
        self._fly = _driver()

    def _room(self, vectors: int) -> int:
        place = self._size
        self._size += vectors * self._lanes
        return place

    def _lay_out(self, stage: Stage) -> _Stage:
        kernel, arrays = stage.kernel, stage.arrays
        arguments: list[int] = []
        noise: list[tuple[int, int]] = []
        for argument in kernel.arguments:
            if argument.kind == "noise":
                even = argument.size + argument.size % 2
                noise.append((len(arguments), even))
                arguments.append(self._room(even * _AHEAD))
            elif argument.kind in CLOCK:
                arguments.append(self._clock_at[argument.kind])
            else:
                arguments.append(self._place(arrays.arguments[argument.name]))
        results = []
        for result in kernel.results:
            rows = arrays.results[result.name]
            results.append(self._place(rows))
            self._written.add(self._key(rows))
        drawn, sizes = [n for n, _ in noise], [size for _, size in noise]
        tables = [
            np.array([*numbers, 0], dtype=np.int64)
            for numbers in (arguments, results, drawn, sizes)
        ]
        keys = [self._key(arrays.results[r.name]) for r in kernel.results]
        wanted = [
            np.array([*flags, 0], dtype=np.uint8)
            for flags in ([key in self._read for key in keys], [1] * len(keys))
        ]
        self._kept += [*tables, *wanted, stage]
        pointers = self._size
        n_pointers = len(arguments) + len(results) + len(noise)
        self._size += -(-n_pointers // _ALIGNMENT) * _ALIGNMENT
        return _Stage(
            prepare=stage.functions[0],
            draw=stage.functions[1],
            tile=stage.functions[2],
            n_arguments=len(arguments),
            n_results=len(results),
            n_noise=len(noise),
            argument=tables[0].ctypes.data,
            result=tables[1].ctypes.data,
            noise_argument=tables[2].ctypes.data,
            noise_size=tables[3].ctypes.data,
            keys=stage.keys.ctypes.data,
            read=wanted[0].ctypes.data,
            all=wanted[1].ctypes.data,
            invariant=self._room(stage.n_invariants),
            pointers=pointers,
        )

    @staticmethod
    def _key(rows: FloatArray) -> tuple[int, int]:
        return rows.ctypes.data, rows.shape[1]

    def _place(self, rows: FloatArray) -> int:
        key = self._key(rows)
        if key not in self._places:
            self._places[key] = self._room(max(rows.shape[1], 1))
            self._rows[key] = rows
        return self._places[key]

    def _refuse_overlaps(self) -> None:
        end = 0
        for base, size in sorted(self._rows):
            if base < end and size:
                raise ValueError("arrays of different stages overlap")
            end = max(end, base + 8 * size)

    def _scratch(self) -> tuple[FloatArray, int]:
        memory = np.zeros(self._size + _ALIGNMENT)
        return memory, memory.ctypes.data + -memory.ctypes.data % (8 * _ALIGNMENT)

    # ------------------------------------------------------------------ flying

    def tick(self, step: int, t: float, dt: float) -> int:
        """Step a single stage once; return how many members failed."""
        call = self._call
        self._stages[0].step = step
        call.t = t
        call.dt = dt
        call.n_ticks = 1
        call.next_tile = 0
        failed: int = self._fly(self._at, self._scratches[0][1])
        return failed

    def fly(
        self,
        steps: Sequence[int],
        *,
        tick: int,
        spacing: int,
        n_ticks: int,
        seconds_per_tick: tuple[int, int],
        dt: float,
    ) -> list[Failure]:
        """Step all stages at `n_ticks` ticks from `tick` on; return what failed, in order.

        Parameters
        ----------
        steps : sequence of int
            Per stage, the number under which it draws noise at the first tick.
        tick, spacing : int
            First tick, and from one to the next.
        seconds_per_tick : (int, int)
            Numerator and denominator.
        dt : float
            Length of each step [s].
        """
        call = self._call
        for stage, step in zip(self._stages, steps, strict=True):
            stage.step = step
        numerator, denominator = seconds_per_tick
        call.t = tick * numerator / denominator
        call.dt = dt
        call.tick, call.spacing, call.n_ticks = tick, spacing, n_ticks
        call.numerator, call.denominator = numerator, denominator
        call.next_tile = 0
        others = [
            _pool().submit(self._fly, self._at, scratch) for _, scratch in self._scratches[1:]
        ]
        n_failed = self._fly(self._at, self._scratches[0][1])
        # one that has not begun by now would find nothing to do
        n_failed += sum(other.result() for other in others if not other.cancel())
        return self._failures() if n_failed else []

    def _failures(self) -> list[Failure]:
        failed = self._failed.astype(np.bool_)
        self._failed[:] = 0
        found = sorted(
            {
                (int(t), int(s))
                for t, s in zip(self._failed_tick[failed], self._failed_stage[failed], strict=True)
            }
        )
        return [
            Failure(t, s, failed & (self._failed_tick == t) & (self._failed_stage == s))
            for t, s in found
        ]
