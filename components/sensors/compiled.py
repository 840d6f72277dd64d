"""What radars compute most, compiled where a compiler serves."""

from __future__ import annotations

import ctypes
import warnings
from functools import cache

from terrafix.cosim.kernels import toolchain
from terrafix.models.radar import pulses, speckle, spectra


@cache
def pulse_sums() -> pulses.PulseSums:
    """Sums over pulses: compiled, or with arrays and a warning, once, that says so.

    Raises
    ------
    ConfigurationError
        If ``TERRAFIX_KERNEL`` insists on compiled kernels and none can be had.
    """
    library = _library(pulses.c_source(), "the echo of pulses is summed with NumPy, ten")
    return pulses.CompiledSums(library) if library else pulses.ArraySums()


@cache
def row_operations() -> spectra.Rows:
    """Operations on rows of spectra, likewise."""
    library = _library(spectra.c_source(), "images are formed with NumPy, two")
    return spectra.CompiledRows(library) if library else spectra.ARRAY_ROWS


@cache
def speckle_of_bits() -> speckle.Speckle:
    """Speckle and noise of random bits, likewise."""
    library = _library(speckle.c_source(), "speckle is made with NumPy, five")
    return speckle.CompiledSpeckle(library) if library else speckle.ARRAY_SPECKLE


def _library(source: str, otherwise: str) -> ctypes.CDLL | None:
    try:
        return toolchain.load(source, native=True)
    except toolchain.CompilationError as error:
        if toolchain.compilation_required():
            raise
        warnings.warn(f"{otherwise} times slower: {error}", stacklevel=3)
        return None
