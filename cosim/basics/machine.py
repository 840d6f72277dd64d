"""What this process may use of the machine: processors, memory, and what the processor is.

A container sees the whole machine in most places; what it is given stands in its control groups.
"""

from __future__ import annotations

import math
import os
import platform
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from terrafix.cosim.basics.errors import ConfigurationError

_GIB = 2.0**30
_PROC, _GROUPS = Path("/proc"), Path("/sys/fs/cgroup")


def processors() -> int:
    """Processors that this process may use: its affinity, and the share its container is given."""
    if hasattr(os, "sched_getaffinity"):
        count = len(os.sched_getaffinity(0))
    else:
        import psutil  # every run asks: where the standard library can tell, it is quicker

        process = psutil.Process()
        told = hasattr(process, "cpu_affinity")  # not on macOS
        count = len(process.cpu_affinity()) if told else psutil.cpu_count() or 1
    for group, unified in _control_groups("cpu"):
        names = ("cpu.max",) if unified else ("cpu.cfs_quota_us", "cpu.cfs_period_us")
        quota, period = _numbers(group, *names)
        if 0 < quota < math.inf:
            count = min(count, math.ceil(quota / period))
    return count


def available_memory() -> float:
    """Memory that can be had without swapping [bytes]: the machine's, or what a container has left.

    What a control group keeps of files it read can be had again, as in the machine's number.
    """
    import psutil

    available = float(psutil.virtual_memory().available)
    for group, unified in _control_groups("memory"):
        if unified:
            files, kept = ("memory.max", "memory.current"), "inactive_file"
        else:
            files, kept = ("memory.limit_in_bytes", "memory.usage_in_bytes"), "total_inactive_file"
        limit, used = _numbers(group, *files)
        found = re.search(rf"^{kept} (\d+)$", _text(group / "memory.stat"), re.MULTILINE)
        again = float(found[1]) if found else 0.0
        available = min(available, max(limit - used + again, 0.0))
    return available


def require_memory(name: str, needed: float, what: str, remedy: str) -> None:
    """Raise ConfigurationError if component `name` needs more memory [bytes] than there is."""
    available = available_memory()
    if needed > available:
        raise ConfigurationError(
            f"'{name}' needs about {needed / _GIB:.1f} GiB for {what}, and "
            f"{available / _GIB:.1f} GiB are available\n  {remedy}"
        )


def cpu_name() -> str:
    """Type of the processor, as far as the system tells."""
    for line in _text(_PROC / "cpuinfo").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@cache
def cpu_features() -> str:
    """What this processor can do, as far as the system tells: native code is for it alone."""
    lines = _text(_PROC / "cpuinfo").splitlines()
    told = {line for line in lines if line.startswith(("model name", "flags", "Features"))}
    return "\n".join(sorted(told)) if lines else platform.processor()


def _control_groups(controller: str) -> Iterator[tuple[Path, bool]]:
    """Folders of the groups this process is in, its own first; whether they are of version 2.

    Where a container sees the paths of the machine outside, its own group is what lies on top.
    """
    for line in _text(_PROC / "self" / "cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        if not controllers:
            top = _GROUPS
        elif controller in controllers.split(","):
            top = _GROUPS / controller
        else:
            continue
        group = top / path.lstrip("/")
        while group != top:
            yield group, not controllers
            group = group.parent
        yield top, not controllers


def _numbers(group: Path, *files: str) -> list[float]:
    """Two numbers, in one file or two; no limit where there is none."""
    words = " ".join(_text(group / file) for file in files).replace("max", "inf").split()
    return [float(w) for w in words] if len(words) == 2 else [math.inf, 1.0]


def _text(file: Path) -> str:
    """What stands in a file of the system's, if it is there."""
    try:
        return file.read_text(errors="replace")
    except OSError:
        return ""
