"""Platforms that an FMU carries binaries for, and which of them this is."""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass

from terrafix.cosim.basics.errors import ConfigurationError


@dataclass(frozen=True)
class Platform:
    """A platform: its folder in FMI 3 and in FMI 2, and zig's name for it."""

    name: str
    fmi2: str | None
    target: str
    suffix: str

    def folder(self, version: int) -> str:
        """Folder of its binary below ``binaries/``."""
        return self.name if version == 3 else (self.fmi2 or self.name)


PLATFORMS = {
    p.name: p
    for p in (
        Platform("x86_64-linux", "linux64", "x86_64-linux-gnu.2.17", ".so"),
        Platform("aarch64-linux", None, "aarch64-linux-gnu.2.17", ".so"),
        Platform("x86_64-windows", "win64", "x86_64-windows-gnu", ".dll"),
        Platform("x86_64-darwin", "darwin64", "x86_64-macos", ".dylib"),
        Platform("aarch64-darwin", None, "aarch64-macos", ".dylib"),
    )
}
"""By FMI 3's name. FMI 2 names three of them; for the others FMI 3's names are taken there too."""


def host_platform() -> Platform:
    """The platform this runs on.

    Raises
    ------
    ConfigurationError
        If it is none of `PLATFORMS`.
    """
    machine = platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    system = {"win32": "windows"}.get(sys.platform, sys.platform)
    name = f"{machine}-{system}"
    if name not in PLATFORMS:
        raise ConfigurationError(
            f"FMUs cannot be built for this machine, {name}\n  platforms: {', '.join(PLATFORMS)}"
        )
    return PLATFORMS[name]
