"""The sums over pulses, compiled where a compiler serves."""

from __future__ import annotations

import warnings
from functools import cache

from terrafix.cosim.kernels import toolchain
from terrafix.models.radar.pulses import ArraySums, CompiledSums, PulseSums, c_source


@cache
def pulse_sums() -> PulseSums:
    """Sums over pulses: compiled, or with arrays and a warning, once, that says so.

    Raises
    ------
    ConfigurationError
        If ``TERRAFIX_KERNEL`` insists on compiled kernels and none can be had.
    """
    try:
        return CompiledSums(toolchain.load(c_source(), native=True))
    except toolchain.CompilationError as error:
        if toolchain.compilation_required():
            raise
        warnings.warn(
            f"the echo of pulses is summed with NumPy, ten times slower: {error}", stacklevel=2
        )
        return ArraySums()
