"""What a machine has: whether a computation fits into its memory, asked before it starts."""

from __future__ import annotations

import os
from pathlib import Path

from terrafix.cosim.basics.errors import ConfigurationError

_GIB = 2.0**30


def available_memory() -> float:
    """Memory that can be had [bytes]; infinite where it cannot be told."""
    info = Path("/proc/meminfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024.0 * float(line.split()[1])
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):
        return float("inf")


def require_memory(name: str, needed: float, what: str, remedy: str) -> None:
    """Raise ConfigurationError if component `name` needs more memory [bytes] than there is."""
    available = available_memory()
    if needed > available:
        raise ConfigurationError(
            f"'{name}' needs about {needed / _GIB:.1f} GiB for {what}, and "
            f"{available / _GIB:.1f} GiB are available\n  {remedy}"
        )
