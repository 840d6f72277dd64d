"""Ensemble kernels: one call steps every member of one symbolic component.

A kernel is built from a function of flat columns, in CasADi's calling convention, and bound to
the arrays it works on. Calling what was bound draws the noise of that step, evaluates the
function for every active member and writes the results of those whose results are all finite; a
member that fails keeps its old values, is marked, and is not stepped again while the mark stands.

There are two kinds with the same meaning: ``"c"``, the function's C compiled together with the
driver ``kernel.c``, and ``"vm"``, CasADi's virtual machine, where no compiler works. They agree
to the last bit on arithmetic and square roots, noise included, and to the accuracy of the
mathematical library on the rest. Callers need not know which they hold.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

from terrafix.cosim import toolchain
from terrafix.cosim.errors import ConfigurationError
from terrafix.cosim.kernel_base import Argument, BoundKernel, Kernel, Result, Specification
from terrafix.cosim.kernel_compiled import CompiledKernel, kernel_source
from terrafix.cosim.kernel_virtual import VirtualMachineKernel

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
        If ``TERRAFIX_KERNEL`` is wrong, or is ``c`` and compilation fails.
    ValueError
        If a declaration does not fit its function.
    """
    virtual: list[Kernel] = [VirtualMachineKernel(s) for s in specifications]
    if toolchain.find_compiler() is None:
        return virtual
    sources = [kernel_source(kernel) for kernel in virtual]
    distinct = list(dict.fromkeys(sources))
    loaded: dict[str, ctypes.CDLL | toolchain.CompilationError] = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        futures = {pool.submit(toolchain.load, source): source for source in distinct}
        for future in as_completed(futures):
            try:
                loaded[futures[future]] = future.result()
            except toolchain.CompilationError as error:
                if toolchain.compilation_required():
                    raise ConfigurationError(
                        f"TERRAFIX_KERNEL=c asks for compiled kernels, which cannot be had: {error}"
                    ) from error
                loaded[futures[future]] = error
            if progress:
                progress(len(loaded), len(distinct))
    kernels: list[Kernel] = []
    for specification, kernel, source in zip(specifications, virtual, sources, strict=True):
        library = loaded[source]
        if isinstance(library, toolchain.CompilationError):
            kernel.note = f"'{kernel.name}' ({library})"
            kernels.append(kernel)
        else:
            kernels.append(CompiledKernel(specification, library))
    return kernels
