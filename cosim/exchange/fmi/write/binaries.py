"""Binaries of an FMU: by the host's compiler, or for five platforms by ``zig cc``."""

from __future__ import annotations

import importlib.util
import os
import subprocess
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.basics.machine import processors
from terrafix.cosim.basics.scratch import scratch
from terrafix.cosim.exchange.fmi.run.platforms import PLATFORMS, Platform, host_platform
from terrafix.cosim.kernels.toolchain import FLAGS, working_compiler

LONG = 150_000  # characters of C


def chosen_platforms(text: str) -> tuple[Platform | None, ...]:
    """Read ``host``, ``all`` or a list of names; None is the host with its own compiler.

    Raises
    ------
    ConfigurationError
        If a name is not known.
    """
    names = [n for n in text.replace(",", " ").split() if n]
    if names == ["all"]:
        return tuple(PLATFORMS.values())
    chosen: list[Platform | None] = []
    for name in names:
        if name != "host" and name not in PLATFORMS:
            known = ["host", "all", *PLATFORMS]
            raise ConfigurationError(
                f"there is no platform '{name}'\n  {nearest(name, known, what='platforms')}"
            )
        chosen.append(None if name == "host" else PLATFORMS[name])
    if not chosen:
        raise ConfigurationError(
            f"no platform is named\n  platforms: host, all, {', '.join(PLATFORMS)}"
        )
    return tuple(dict.fromkeys(chosen))


def build(
    files: Mapping[str, str],
    compiled: Sequence[str],
    platforms: Sequence[Platform | None],
) -> dict[Platform, bytes]:
    """Compile the sources for every platform, side by side.

    Parameters
    ----------
    files : mapping of str to str
        Sources and headers by name.
    compiled : sequence of str
        Which of them are compiled.
    platforms : sequence of Platform or None
        None is the host, with its own compiler.

    Raises
    ------
    ConfigurationError
        If there is no compiler, or it refuses.
    """
    targets = [(p or host_platform(), _command(p)) for p in platforms]
    order = sorted(compiled, key=lambda name: -len(files[name]))  # the longest first
    with (
        scratch("compile") as here,
        ThreadPoolExecutor(processors()) as pool,
    ):
        for name, text in files.items():
            (here / name).write_text(text, encoding="utf-8")
        jobs = [(here, name, _flags(name, files[name]), *t) for name in order for t in targets]
        list(pool.map(lambda job: _compile(*job), jobs))
        binaries = list(pool.map(lambda target: _link(here, order, *target), targets))
    return dict(zip([p for p, _ in targets], binaries, strict=True))


def _command(chosen: Platform | None) -> tuple[str, ...]:
    if chosen is None:
        return working_compiler().command
    zig = importlib.util.find_spec("ziglang")
    if zig is not None and zig.submodule_search_locations:
        program = Path(zig.submodule_search_locations[0], "zig" + ".exe" * (os.name == "nt"))
        return (str(program), "cc", "-target", chosen.target)
    raise ConfigurationError(
        f"a binary for {chosen.name} needs zig's compiler\n"
        "  install it with `pip install terrafix[ziglang]`, or take --platforms host"
    )


def _object(name: str, target: Platform) -> str:
    return f"{name}.{target.name}.o"


def _flags(name: str, text: str) -> list[str]:
    """Flags of ensemble kernels; long derivatives are not optimized, which takes ten seconds."""
    plain = name.endswith("_forward.c") and len(text) > LONG
    return ["-O0" if plain and f == "-O1" else f for f in FLAGS]


def _compile(
    folder: Path, name: str, flags: Sequence[str], target: Platform, command: Sequence[str]
) -> None:
    words = [*command, "-std=gnu11", *flags, "-fvisibility=hidden", "-w", "-g0"]
    words += [] if target.suffix == ".dll" else ["-fPIC"]
    words += ["-fno-sanitize=undefined"] if "zig" in Path(command[0]).name else []
    _run([*words, "-c", name, "-o", _object(name, target)], folder, target)


def _link(folder: Path, names: Sequence[str], target: Platform, command: Sequence[str]) -> bytes:
    library = folder / f"{target.name}{target.suffix}"
    words = [*command, "-shared", *(_object(n, target) for n in names), "-o", library.name]
    words += ["-s"] if target.suffix != ".dylib" else []
    words += ["-Wl,--no-undefined", "-lm"] if target.suffix == ".so" else []
    _run(words, folder, target)
    return library.read_bytes()


def _run(words: Sequence[str], folder: Path, target: Platform) -> None:
    done = subprocess.run(
        words, capture_output=True, text=True, errors="replace", check=False, cwd=folder
    )
    if done.returncode:
        said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        errors = [line for line in said if "error" in line.lower()]
        raise ConfigurationError(
            f"the FMU could not be compiled for {target.name}: "
            f"{(errors or said or ['no message'])[0]}"
        )
