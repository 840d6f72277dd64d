"""The C compiler: which one serves, and the libraries it made.

A compiler is looked for in this order: the command in ``TERRAFIX_CC``, alone if it is given;
``cc``, ``gcc``, ``clang`` on the path; the clang of the ``ziglang`` wheel. One that turns out not
to work is passed over. ``TERRAFIX_KERNEL=vm`` does without, ``vector`` and ``c`` insist. None is
required: CasADi's virtual machine computes the same.

Libraries are kept in ``TERRAFIX_CACHE``, or the user's cache directory, under a name made of the
hash of everything they were made from and the hash of what they contain. So a changed source,
compiler or flag finds nothing, a damaged file is recognized before it is loaded, and processes
that build the same library at the same time do not disturb one another.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.util
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Protocol

from terrafix.cosim.basics.errors import ConfigurationError, TerrafixError
from terrafix.cosim.basics.machine import cpu_features
from terrafix.cosim.basics.scratch import scratch, scratch_folder

FLAGS = ("-O1", "-ftree-vectorize", "-fno-math-errno", "-ffp-contract=off")
"""No contraction, no reassociation: the virtual machine's bits.

Straight-line generated code runs as fast at ``-O1`` as at ``-O3`` (within 2 % at 2,500 and 7,600
operations, gcc 12 and clang 22), and gcc compiles it up to four times faster; vectors are for the
loops of the driver. ``-march=native`` bought nothing for scalars and would tie the cache to a
processor.
"""

VECTOR_FLAGS = ("-O3", "-fno-math-errno", "-ffp-contract=off", "-march=native")
"""For vectors, where the order of instructions matters: ``-O1`` runs two to three times
longer, ``-O2`` a sixth.
Registers are as wide as this processor's, whose name is part of the cache's key."""

_LIBRARY = ("-shared", "-fvisibility=hidden", "-w")
_SUFFIX = ".dll" if sys.platform == "win32" else ".so"
_PROBE = (
    "#include <math.h>\n#include <stdint.h>\n#include <string.h>\n"
    "double probe(double x) { return sqrt(x); }\n"
)


class CompilationError(TerrafixError):
    """A compiler that does not work, or a source that it refused."""


@dataclass(frozen=True)
class Compiler:
    """A command that compiles C.

    Attributes
    ----------
    command : tuple of str
        The command and its first arguments.
    name : str
        Family and version, ``gcc 12.2.0``.
    version : str
        The first line of what it says of its version.
    """

    command: tuple[str, ...]
    name: str
    version: str

    def options(self, *, native: bool) -> tuple[str, ...]:
        """What is written between the command and the source."""
        position = () if sys.platform == "win32" else ("-fPIC",)
        return (*(VECTOR_FLAGS if native else FLAGS), *position, *_LIBRARY)

    def compile(self, source: str, *, native: bool = False) -> bytes:
        """Compile `source` to a shared library, for this processor alone if `native`.

        Raises
        ------
        CompilationError
            With the compiler's first complaint.
        """
        with scratch("compile") as directory:
            file, library = Path(directory, "kernel.c"), Path(directory, f"kernel{_SUFFIX}")
            file.write_text(source)
            command = [
                *self.command,
                *self.options(native=native),
                str(file),
                "-o",
                str(library),
                "-lm",
            ]
            try:
                done = subprocess.run(
                    command, capture_output=True, text=True, errors="replace", check=False
                )
                if done.returncode == 0:
                    return library.read_bytes()
            except OSError as error:
                raise CompilationError(f"'{shlex.join(self.command)}' failed: {error}") from error
        said = [line.strip() for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        errors = [line for line in said if "error" in line.lower()]
        complaint = (errors or said or ["no message"])[0]
        raise CompilationError(
            f"'{shlex.join(self.command)}' failed with exit status {done.returncode}: {complaint}"
        )


# ------------------------------------------------------------------------- which compiler serves


_defects: dict[tuple[str, ...], str] = {}
"""Compilers of this process that turned out not to work, and what they said."""
_probing = threading.Lock()


def find_compiler() -> Compiler | None:
    """Find the compiler that serves; None if the virtual machine does.

    Raises
    ------
    ConfigurationError
        If ``TERRAFIX_KERNEL`` names no kind of kernel, or a compiled one and no compiler works.
    """
    if wanted_kernel() == "vm":
        return None
    for command in _commands():
        compiler = _identify(command)
        if compiler and command not in _defects:
            return compiler
    if compilation_required():
        raise ConfigurationError(
            f"TERRAFIX_KERNEL={wanted_kernel()} asks for compiled kernels, which cannot be had: "
            f"{_why_none()}"
        )
    return None


def working_compiler() -> Compiler:
    """The compiler that serves, whether or not kernels are compiled.

    Raises
    ------
    ConfigurationError
        If none works.
    """
    for command in _commands():
        compiler = _identify(command)
        if compiler and _works(compiler):
            return compiler
    raise ConfigurationError(
        "there is no C compiler that works\n"
        "  install one, or `pip install terrafix[ziglang]`, which brings its own"
    )


class _Kernel(Protocol):
    kind: str
    note: str


_KINDS = {"vector": "vectors of members", "c": "plain C"}


def _kinds(kernels: Iterable[_Kernel]) -> str:
    """What the compiled ones of `kernels` are; without any, what they would be."""
    kinds = {k.kind for k in kernels} & set(_KINDS) or {wanted_kernel() or "vector"}
    return " and ".join(_KINDS[kind] for kind in _KINDS if kind in kinds)


def describe(kernels: Iterable[_Kernel] = ()) -> str:
    """Say in one line for the user what serves, and why it is not better.

    A compiler's defect shows when it is first used: describe kernels after they are built. Those
    of `kernels` that were refused by a compiler that otherwise works are named.
    """
    compiler = find_compiler()
    if compiler is None:
        return f"kernels: CasADi virtual machine ({_why_none()})"
    kernels = list(kernels)
    refused = [kernel.note for kernel in kernels if kernel.note]
    rest = f"; CasADi virtual machine for {', '.join(refused)}" if refused else ""
    return f"kernels: {compiler.name}, {_kinds(kernels)}{rest}"


def compilation_required() -> bool:
    """Whether the user insists on compiled kernels."""
    return wanted_kernel() in ("vector", "c")


def c_source(name: str) -> str:
    """C of ours that kernels and FMUs are compiled with, such as ``"noise.c"``."""
    return Path(__file__).with_name(name).read_text()


def wanted_kernel() -> str:
    """Kind of kernel that the user asks for; empty for the best there is."""
    wanted = os.environ.get("TERRAFIX_KERNEL", "")
    if wanted not in ("", "vector", "c", "vm"):
        raise ConfigurationError(
            f"TERRAFIX_KERNEL is '{wanted}'; write 'vector' for vectors of members, 'c' for plain "
            "C, 'vm' for CasADi's virtual machine, or leave it unset to take the best there is"
        )
    return wanted


def _commands() -> Iterator[tuple[str, ...]]:
    chosen = os.environ.get("TERRAFIX_CC", "")
    if chosen:
        whole = shutil.which(chosen)
        yield (whole,) if whole else tuple(shlex.split(chosen, posix=os.name != "nt"))
        return
    for name in ("cc", "gcc", "clang"):
        path = shutil.which(name)
        if path:
            yield (path,)
    if importlib.util.find_spec("ziglang"):
        yield (sys.executable, "-m", "ziglang", "cc")


@functools.cache
def _identify(command: tuple[str, ...]) -> Compiler | None:
    """Ask a command for its version; None if it cannot be run at all."""
    try:
        done = subprocess.run(
            [*command, "--version"], capture_output=True, text=True, errors="replace", check=False
        )
    except OSError:
        return None
    text = done.stdout.strip() or done.stderr.strip() or "unknown"
    version = text.splitlines()[0]
    number = re.search(r"\d+\.\d+(\.\d+)?", re.sub(r"\([^)]*\)", "", version))
    family = Path(command[0]).stem
    if "clang" in version:
        family = "clang (ziglang)" if "ziglang" in command else "clang"
    elif family == "cc" and "Free Software Foundation" in text:
        family = "gcc"
    return Compiler(command, f"{family} {number[0]}" if number else family, version)


def _works(compiler: Compiler) -> bool:
    """Try a small program, and remember what is wrong."""
    with _probing:
        if compiler.command not in _defects:
            try:
                _open(_keep(compiler.compile(_PROBE), "probe", _session_directory()))
            except (CompilationError, OSError) as error:
                _defects[compiler.command] = str(error)
    return compiler.command not in _defects


def _why_none() -> str:
    if wanted_kernel() == "vm":
        return "TERRAFIX_KERNEL=vm"
    chosen = os.environ.get("TERRAFIX_CC", "")
    defects = [_defects[command] for command in _commands() if command in _defects]
    if defects:
        return "; ".join(defects)
    if chosen:
        return f"TERRAFIX_CC names '{chosen}', which cannot be run"
    return "no C compiler found; install one or `pip install terrafix[ziglang]`"


# ---------------------------------------------------------------------- libraries and their cache


def cache_directory() -> Path:
    """Directory of compiled libraries: ``TERRAFIX_CACHE``, or the user's cache directory.

    Raises
    ------
    RuntimeError
        If the user has no home.
    """
    chosen = os.environ.get("TERRAFIX_CACHE")
    if chosen:
        return Path(chosen) / "kernels"
    from platformdirs import user_cache_path

    return user_cache_path("terrafix", appauthor=False, opinion=False) / "kernels"


def _directories() -> Iterator[Path]:
    with contextlib.suppress(RuntimeError):  # a user without a home
        yield cache_directory()
    yield _session_directory()


def load(source: str, *, native: bool = False) -> ctypes.CDLL:
    """Load the library made from `source`, from the cache if it is there.

    The library carries its key, defined as ``TERRAFIX_KEY``, in a string ``terrafix_key``.

    Raises
    ------
    CompilationError
        If no compiler serves or the source is refused.
    ConfigurationError
        As `find_compiler`.
    """
    while compiler := find_compiler():
        try:
            return _load(source, compiler, native=native)
        except CompilationError:
            if _works(compiler):
                raise
        except OSError as error:
            raise CompilationError(f"cannot keep a library: {error}") from error
    raise CompilationError(_why_none())


def _load(source: str, compiler: Compiler, *, native: bool) -> ctypes.CDLL:
    options = compiler.options(native=native)
    parts = (source, compiler.version, *options, sys.platform, platform.machine())
    parts += (cpu_features(),) if native else ()
    key = sha256("\0".join(parts).encode()).hexdigest()
    for directory in _directories():
        for path in directory.glob(f"{key}-*{_SUFFIX}"):
            library = _open_kept(path, key)
            if library:
                return library
    made = compiler.compile(f'#define TERRAFIX_KEY "{key}"\n{source}', native=native)
    for directory in _directories():
        try:
            path = _keep(made, key, directory)
        except OSError:
            continue  # read-only or full: the process's own directory serves
        return _open(path)
    raise OSError(f"cannot write to {' or '.join(map(str, _directories()))}")


def _keep(library: bytes, key: str, directory: Path) -> Path:
    """Write a library under its hashes, at once or not at all."""
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{key}-{sha256(library).hexdigest()[:16]}{_SUFFIX}"
    with tempfile.NamedTemporaryFile(dir=directory, delete=False) as file:
        file.write(library)
    try:
        Path(file.name).replace(path)
    except OSError:  # on Windows, another process has the same library loaded
        Path(file.name).unlink()
        if not path.exists():
            raise
    return path


def _open(path: Path) -> ctypes.CDLL:
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise CompilationError(f"the compiled library cannot be loaded: {error}") from error


def _open_kept(path: Path, key: str) -> ctypes.CDLL | None:
    """Open a library of the cache, or remove it if it is not what its name says."""
    try:
        content = path.read_bytes()
        if path.stem == f"{key}-{sha256(content).hexdigest()[:16]}":
            library = ctypes.CDLL(str(path))
            found = (ctypes.c_char * len(key)).in_dll(library, "terrafix_key").value
            if found == key.encode():
                return library
    except (OSError, ValueError):
        pass  # unreadable, not a library of this machine, or without a key
    with contextlib.suppress(OSError):  # read-only, in use, or already removed by another process
        path.unlink()
    return None


@functools.cache
def _session_directory() -> Path:
    """Directory of this process alone, removed at its end."""
    return scratch_folder("kernels")
