"""Ensemble kernels: one call steps every member of one symbolic component.

A kernel is built from a function of flat columns, in CasADi's calling convention, and bound to
the arrays it works on. Calling what was bound draws the noise of that step, evaluates the
function for every active member and writes the results of those whose results are all finite; a
member that fails keeps its old values, is marked, and is not stepped again while the mark stands.

There are three kinds with the same meaning: ``"vector"``, C of vectors whose lanes are members;
``"c"``, the C that CasADi generates, a member at a time, for functions that are not made of scalar
instructions; ``"vm"``, CasADi's virtual machine, where no compiler works. They agree to the last
bit on arithmetic and square roots, noise included, and to the accuracy of the mathematical library
on the rest (in practice they call the same one). Callers need not know which they hold.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any, NamedTuple

from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.basics.machine import processors
from terrafix.cosim.kernels import toolchain
from terrafix.cosim.kernels.base import Argument, BoundKernel, Kernel, Result, Specification
from terrafix.cosim.kernels.compiled import CompiledKernel, kernel_source
from terrafix.cosim.kernels.vector import NoVectorsError, VectorKernel, vector_source
from terrafix.cosim.kernels.virtual import VirtualMachineKernel

__all__ = [
    "Argument",
    "BoundKernel",
    "Kernel",
    "Result",
    "Specification",
    "build_kernel",
    "build_kernels",
]


def build_kernel(function: Any, arguments: Sequence[Argument], results: Sequence[Result]) -> Kernel:
    """Build one kernel; see `build_kernels`."""
    return build_kernels([Specification(function, arguments, results)])[0]


def build_kernels(
    specifications: Sequence[Specification],
    progress: Callable[[int, int], None] | None = None,
) -> list[Kernel]:
    """Build several kernels, compiling those that are not in the cache side by side.

    Parameters
    ----------
    specifications : sequence of Specification
        Function, arguments and results of each. The function is a CasADi function of dense
        columns; its name must not be that of a C keyword or function.
    progress : callable, optional
        Called with (sources done, sources in all) as compilations end.

    Raises
    ------
    ConfigurationError
        If ``TERRAFIX_KERNEL`` is wrong, or asks for what cannot be compiled.
    ValueError
        If a declaration does not fit its function.
    """
    virtual: list[Kernel] = [VirtualMachineKernel(s) for s in specifications]
    if toolchain.find_compiler() is None:
        return virtual
    candidates = [_candidates(kernel) for kernel in virtual]
    loaded: dict[str, _Loaded] = {}
    with ThreadPoolExecutor(processors()) as pool:
        todo = {c.source: c for found in candidates for c in found[:1]}
        while todo:
            futures = {
                pool.submit(toolchain.load, source, native=c.native): source
                for source, c in todo.items()
            }
            for done, future in enumerate(as_completed(futures), 1):
                try:
                    loaded[futures[future]] = future.result()
                except toolchain.CompilationError as error:
                    loaded[futures[future]] = error
                if progress:
                    progress(done, len(futures))
            todo = {}
            for kernel, found in zip(virtual, candidates, strict=True):
                refused = isinstance(loaded[found[-1].source], toolchain.CompilationError)
                if refused and found[-1].native and toolchain.wanted_kernel() != "vector":
                    found.append(_plain(kernel))
                    if found[-1].source not in loaded:
                        todo[found[-1].source] = found[-1]
    return [_made(*each, loaded) for each in zip(specifications, virtual, candidates, strict=True)]


_Loaded = ctypes.CDLL | toolchain.CompilationError


class _Candidate(NamedTuple):
    """One way to make a kernel: its source, and whether it is for this processor alone."""

    source: str
    native: bool
    make: Callable[[Specification, ctypes.CDLL], Kernel]


def _candidates(kernel: Kernel) -> list[_Candidate]:
    """Choose the best way to make a kernel, alone in a list; others follow if it is refused."""
    wanted = toolchain.wanted_kernel()
    if wanted == "c":
        return [_plain(kernel)]
    try:
        source, n_invariants = vector_source(kernel)
    except NoVectorsError as error:
        if wanted == "vector":
            raise ConfigurationError(
                f"TERRAFIX_KERNEL=vector asks for vector kernels, and '{kernel.name}' cannot be "
                f"one: {error}"
            ) from error
        return [_plain(kernel)]

    def make(specification: Specification, library: ctypes.CDLL) -> Kernel:
        return VectorKernel(specification, library, n_invariants)

    return [_Candidate(source, True, make)]


def _plain(kernel: Kernel) -> _Candidate:
    return _Candidate(kernel_source(kernel), False, CompiledKernel)


def _made(
    specification: Specification,
    virtual: Kernel,
    candidates: list[_Candidate],
    loaded: dict[str, _Loaded],
) -> Kernel:
    """The best kernel that could be made; the virtual machine if none could."""
    for candidate in candidates:
        library = loaded[candidate.source]
        if not isinstance(library, toolchain.CompilationError):
            return candidate.make(specification, library)
    error = loaded[candidates[-1].source]
    assert isinstance(error, toolchain.CompilationError)
    if toolchain.compilation_required():
        raise ConfigurationError(
            f"TERRAFIX_KERNEL={toolchain.wanted_kernel()} asks for compiled kernels, which cannot "
            f"be had: {error}"
        ) from error
    virtual.note = f"'{virtual.name}' ({error})"
    return virtual
