"""What the binaries of an FMU require of a machine, and what they show it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from terrafix.cosim.exchange.fmi.check.findings import ERROR, NOTE, WARNING, Finding
from terrafix.cosim.exchange.fmi.run.archive import Archive

GLIBC_FLOOR = (2, 28)
"""Newest C library that is assumed of a user's Linux: that of manylinux_2_28."""
_SYSTEM = re.compile(
    r"^(lib(c|m|dl|rt|pthread|gcc_s|stdc\+\+)\.so|ld-linux|linux-vdso|.*libSystem|.*/usr/lib/"
    r"|/System/Library/"
    r"|(api|ext)-ms-win|kernel32|kernelbase|user32|advapi32|gdi32|gdiplus|ole32|oleaut32|shell32"
    r"|shlwapi|comctl32|comdlg32|ws2_32|wsock32|mswsock|winmm|rpcrt4|dbghelp|psapi|version|iphlpapi"
    r"|setupapi|crypt32|secur32|userenv|winspool|imm32|netapi32|mpr|uxtheme|powrprof|opengl32"
    r"|wininet|winhttp|msvcrt|msvcr\d|msvcp\d|concrt|vcomp|ucrtbase|vcruntime|ntdll|bcrypt)",
    re.IGNORECASE,
)
_OF_LINKERS = {  # in every shared library, of whatever content
    *("_init", "_fini", "__bss_start", "_edata", "_end"),
    *("_mh_dylib_header", "__dso_handle"),
}


def parse(path: Path) -> Any:
    """Read a binary of any platform."""
    import lief

    lief.logging.disable()
    return lief.parse(str(path))


def exported(binary: Any) -> set[str]:
    """Names a binary shows to whoever loads it."""
    import lief

    if isinstance(binary, lief.PE.Binary):
        found = binary.get_export()
        return {str(e.name) for e in found.entries} if found is not None else set()
    names = {str(s.name) for s in binary.exported_symbols}
    if isinstance(binary, lief.MachO.Binary):
        if not names:  # older linkers write no list of exports, only the table of symbols
            undefined = lief.MachO.Symbol.TYPE.UNDEFINED
            named = (s for s in binary.symbols if s.is_external and s.type != undefined)
            names = {str(s.name) for s in named}
        names = {n.removeprefix("_") for n in names}
    return names - _OF_LINKERS


def required(binary: Any) -> set[str]:
    """Libraries a binary wants."""
    import lief

    if isinstance(binary, lief.ELF.Binary):
        return {str(name) for name in binary.libraries}
    if isinstance(binary, lief.PE.Binary):
        return {str(i.name) for i in binary.imports}
    own = lief.MachO.LoadCommand.TYPE.ID_DYLIB  # the name that the library has itself
    return {str(x.name) for x in binary.libraries if "/" in str(x.name) and x.command != own}


def glibc(binary: Any) -> tuple[int, int] | None:
    """Oldest C library of GNU that serves a Linux binary."""
    import lief

    if not isinstance(binary, lief.ELF.Binary):
        return None
    versions = [
        tuple(int(n) for n in match[1].split(".")[:2])
        for requirement in binary.symbols_version_requirement
        for symbol in requirement.get_auxiliary_symbols()
        if (match := re.match(r"GLIBC_([\d.]+)", str(symbol.name)))
    ]
    return max(versions, default=None)  # type: ignore[return-value]


def check_binaries(archive: Archive) -> Iterator[Finding]:
    """Look at every binary in the archive."""
    root = archive.folder / "binaries"
    platforms = sorted(p for p in root.iterdir() if p.is_dir()) if root.is_dir() else []
    if not platforms:
        sources = (archive.folder / "sources").is_dir()
        yield Finding(
            "library", WARNING if sources else ERROR, "binaries",
            "there is no binary, only sources" if sources else "there is no binary",
            "an importer must compile it" if sources else "nothing can run it",
        )  # fmt: skip
        return
    for platform in platforms:
        for file in sorted(platform.iterdir()):
            if file.suffix in (".so", ".dll", ".dylib"):
                yield from _check_binary(archive, platform.name, file)
    names = ", ".join(p.name for p in platforms)
    if len(platforms) == 1:
        yield Finding("library", NOTE, "binaries", f"there is a binary for {names} alone")


def _check_binary(archive: Archive, platform: str, file: Path) -> Iterator[Finding]:
    where = f"binaries/{platform}/{file.name}"
    binary = parse(file)
    if binary is None:
        yield Finding("library", ERROR, where, "it is no binary", "it cannot be loaded")
        return
    names = exported(binary)
    prefix = f"fmi{archive.version}"
    shown = {n for n in names if n.startswith(prefix)}
    foreign = names - shown
    if not shown:
        yield Finding(
            "library", ERROR, where, f"it exports no function of FMI {archive.version}",
            "no importer can call it",
        )  # fmt: skip
    if foreign:
        few = ", ".join(sorted(foreign)[:4]) + (", ..." if len(foreign) > 4 else "")
        yield Finding(
            "library", WARNING, where, f"it shows {len(foreign)} symbols besides FMI's: {few}",
            "two FMUs that show the same name can call each other's function",
        )  # fmt: skip
    floor = glibc(binary)
    if floor is not None and floor > GLIBC_FLOOR:
        yield Finding(
            "library", WARNING, where, f"it needs glibc {floor[0]}.{floor[1]}",
            "it does not load on Linux distributions that are a few years old",
        )  # fmt: skip
    elif floor is not None:
        yield Finding("library", NOTE, where, f"it needs glibc {floor[0]}.{floor[1]}")
    beside = {p.name for p in file.parent.iterdir()}
    for library in sorted(required(binary)):
        if not _SYSTEM.search(library) and Path(library).name not in beside:
            yield Finding(
                "library", WARNING, where, f"it needs {library}, which is not in the archive",
                "it does not load where that library is not installed",
            )  # fmt: skip
