"""An FMU for five platforms, made by zig and inspected; the binary for this machine is run.

    python benchmarks/fmu_platforms.py [--component orbit] [--duration 60]

Needs the `ziglang` extra; the first time, zig builds its libraries, which takes minutes. Of each
binary: its format and machine as its own header says, the functions that it shows against those
that FMI's headers declare, what it wants of the machine, and what check-fmu says of the whole.
The one for this machine steps beside the native component, compared as bytes.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import time
from pathlib import Path

import fmpy
import lief
import numpy as np

import terrafix as tf
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.exchange.fmi.check.binary_checks import exported, glibc, parse, required
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.platforms import PLATFORMS, host_platform

OPEN_LOOP = Path(__file__).parents[1] / "examples" / "spacecraft_sar_open_loop.toml"
EXPECTED = {
    "x86_64-linux": ("ELF", "X86_64"),
    "aarch64-linux": ("ELF", "AARCH64"),
    "x86_64-windows": ("PE", "AMD64"),
    "x86_64-darwin": ("MACHO", "X86_64"),
    "aarch64-darwin": ("MACHO", "ARM64"),
}


def functions(fmi: int) -> set[str]:
    """What the standard's header declares."""
    header = Path(fmpy.__file__).parent / "c-code" / f"fmi{fmi}Functions.h"
    return set(re.findall(rf"FMI{fmi}_Export\s+fmi{fmi}\w+TYPE\s+(\w+);", header.read_text()))


def format_and_machine(binary: lief.Binary) -> tuple[str, str]:
    """What the file's header says."""
    if isinstance(binary, lief.ELF.Binary):
        machine = binary.header.machine_type
    elif isinstance(binary, lief.PE.Binary):
        machine = binary.header.machine
    else:
        machine = binary.header.cpu_type
    return binary.format.name, machine.name


def wanted(binary: lief.Binary) -> list[str]:
    """Names that are undefined in it: what it calls of other libraries."""
    found = {str(f.name).lstrip("_") for f in binary.imported_functions}
    return sorted(name for name in found if name)


def flown(name: str, duration: str, file: Path | None = None) -> dict[str, np.ndarray]:
    """All outputs of a component of the open loop, or of an FMU in its place."""
    system = tf.read_system(OPEN_LOOP)
    if file is not None:
        system.replace(name, tf.components.fmu(file=file, rate=system.find(name).rate))
    simulation = Simulation(system)
    simulation.run_until(duration)
    slots = simulation.master.wiring.slots
    found = {n: slots[f"{name}.{n}"].data.copy() for n in system.find(name).outputs()}
    simulation.master.terminate()
    return found


def inspect(file: Path, fmi: int) -> int:
    """Print a row for each binary; how many are not as they should be."""
    wrong = 0
    root = open_archive(file).folder / "binaries"
    print(f"FMI {fmi}: {len(functions(fmi))} functions in the standard's header")
    print(
        f"  {'platform':<15} {'format':<6} {'machine':<8} {'KiB':>5} {'shown':>5} {'missing':>7} "
        f"{'others':>6}  wants (functions)"
    )
    for name, platform in PLATFORMS.items():
        (path,) = (root / platform.folder(fmi)).iterdir()
        binary = parse(path)
        shown, declared = exported(binary), functions(fmi)
        wrong += format_and_machine(binary) != EXPECTED[name]
        wrong += len(shown ^ declared)
        floor = glibc(binary)
        libraries = ", ".join(sorted(required(binary)))
        libraries += f", glibc {floor[0]}.{floor[1]}" if floor else ""
        print(
            f"  {name:<15} {binary.format.name:<6} {format_and_machine(binary)[1]:<8} "
            f"{path.stat().st_size >> 10:>5} {len(shown & declared):>5} "
            f"{len(declared - shown):>7} {len(shown - declared):>6}  {libraries} "
            f"({len(wanted(binary))})"
        )
        print(f"  {'':<15} undefined: {' '.join(wanted(binary))}")
    return wrong


def main() -> None:
    """Make both versions, print the tables, and fly."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--component", default="orbit")
    parser.add_argument("--duration", default="60")
    options = parser.parse_args()
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        for fmi in (2, 3):
            system = tf.read_system(OPEN_LOOP)
            file = Path(folder, f"{options.component}{fmi}.fmu")
            begun = time.perf_counter()
            tf.export_fmu(system, file, component=options.component, fmi=fmi, platforms="all")
            wall = time.perf_counter() - begun
            wrong += inspect(file, fmi)
            report = tf.check_fmu(file)
            complaints = [*report.findings, *report.warnings]
            wrong += len(complaints)
            print(f"  exported in {wall:.1f} s; check-fmu: {complaints or 'nothing'}")
            expected = flown(options.component, options.duration)
            found = flown(options.component, options.duration, file)
            differ = [n for n in expected if expected[n].tobytes() != found[n].tobytes()]
            wrong += len(differ)
            print(
                f"  zig's binary for {host_platform().name} after {options.duration} s against "
                f"native, {len(expected)} outputs, differing: {differ or 'none'}"
            )
    print(f"{wrong} things are not as they should be" if wrong else "all as it should be")
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
