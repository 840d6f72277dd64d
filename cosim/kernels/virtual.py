"""Kernels interpreted by CasADi's virtual machine, for machines without a compiler."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.noise import NormalBlocks, NormalStream
from terrafix.cosim.kernels.base import BoundArrays, BoundKernel, Kernel


class VirtualMachineKernel(Kernel):
    """The function interpreted by CasADi, one buffered call per member."""

    kind = "vm"

    def _bind(self, arrays: BoundArrays) -> BoundKernel:
        return _VirtualMachineBinding(self, arrays)


class _VirtualMachineBinding(BoundKernel):
    def __init__(self, kernel: Kernel, arrays: BoundArrays) -> None:
        n_members = len(arrays.members)
        self._kept = arrays
        self._active = arrays.active
        self._failed = arrays.failed
        rows = dict(arrays.arguments)
        self._noise = []
        for argument in kernel.noise:
            stream = NormalStream.from_key(arrays.noise_keys[argument.name], arrays.members)
            rows[argument.name] = np.zeros((n_members, argument.size))
            self._noise.append((rows[argument.name], NormalBlocks(stream, argument.size)))
        self._next = np.zeros((n_members, sum(r.size for r in kernel.results)))
        ends = np.cumsum([r.size for r in kernel.results])
        self._columns = [
            slice(end - result.size, end) for end, result in zip(ends, kernel.results, strict=True)
        ]
        self._copies = [
            (target, self._next[:, columns])
            for target, columns in zip(arrays.results.values(), self._columns, strict=True)
        ]
        self._buffers = []  # kept, because what evaluates them does not keep them
        self._evaluations = []
        for member in range(n_members):
            buffer, evaluate = kernel.function.buffer()
            for i, argument in enumerate(kernel.arguments):
                row = 0 if len(rows[argument.name]) == 1 else member
                buffer.set_arg(i, rows[argument.name][row].data)
            for i, columns in enumerate(self._columns):
                buffer.set_res(i, self._next[member, columns].data)
            self._buffers.append(buffer)
            self._evaluations.append(evaluate)

    def __call__(self, step: int) -> int:
        for drawn, blocks in self._noise:
            drawn[:] = blocks.draw(step)
        chosen = (self._active != 0) & (self._failed == 0)
        self._next.fill(np.nan)  # stands where nothing is computed: inactive members, failures
        for member in chosen.nonzero()[0].tolist():
            self._evaluations[member]()
        good: NDArray[np.bool_] = np.all(np.isfinite(self._next), axis=1)
        for target, source in self._copies:
            np.copyto(target, source, where=good[:, None])
        bad = chosen & ~good
        self._failed[bad] = 1
        return int(bad.sum())
