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
            names = {str(s.name) for s in binary.symbols if _is_shown(s.raw_type)}
        names = {n.removeprefix("_") for n in names}
    return names - _OF_LINKERS


def _is_shown(kind: int) -> bool:
    """Whether a symbol of a Mach-O is defined and external, by the bits of its ``n_type``."""
    debugging_or_private, defined, external = 0xF0, 0x0E, 0x01
    return not kind & debugging_or_private and bool(kind & defined) and bool(kind & external)


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
    wanted = identifiers(archive)
    for platform in platforms:
        files = [p for p in sorted(platform.iterdir()) if p.suffix in (".so", ".dll", ".dylib")]
        for file in files:
            yield from _check_binary(archive, platform.name, file, main=file.stem in wanted)
        same = str.lower if any(f.suffix == ".dll" for f in files) else str  # as Windows has it
        found = {same(f.stem) for f in files}
        for name in sorted(n for n in wanted if same(n) not in found) if files else ():
            have = ", ".join(f.name for f in files)
            yield Finding(
                "library", ERROR, f"binaries/{platform.name}",
                f"it has no '{name}', which is a modelIdentifier of the description, but {have}",
                "no importer finds the binary",
            )  # fmt: skip
    names = ", ".join(p.name for p in platforms)
    if len(platforms) == 1:
        yield Finding("library", NOTE, "binaries", f"there is a binary for {names} alone")


def identifiers(archive: Archive) -> set[str]:
    """What the binaries of the FMU are called."""
    description = archive.description
    names = ("coSimulation", "modelExchange", "scheduledExecution")
    offered = (getattr(description, name, None) for name in names)
    return {str(each.modelIdentifier) for each in offered if each is not None}


def _check_binary(archive: Archive, platform: str, file: Path, *, main: bool) -> Iterator[Finding]:
    where = f"binaries/{platform}/{file.name}"
    binary = parse(file)
    if binary is None:
        yield Finding("library", ERROR, where, "it is no binary", "it cannot be loaded")
        return
    names = exported(binary)
    foreign = {n for n in names if not n.startswith(("fmi2", "fmi3"))}
    if main and names == foreign:
        yield Finding(
            "library", ERROR, where, f"it exports no function of FMI {archive.version}",
            "no importer can call it",
        )  # fmt: skip
    if foreign and main:
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
