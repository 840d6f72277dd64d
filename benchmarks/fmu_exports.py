"""What validators say of our exports, and whether what is compiled from their sources is the same.

    python benchmarks/fmu_exports.py [orbit imu predict correct truth]

Four components of the spacecraft's open loop and its truth as one FMU, as FMI 2, FMI 3, and FMI 3
with scalars: problems that FMPy's validation and check-fmu find; the sources that the description
lists, compiled by `gcc -shared -fPIC` and by FMPy (which takes cmake), and run in FMPy; and the
tools that are installed. All numbers after 100 steps are compared as bytes with those of our binary
in our own binding.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import io
import subprocess
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import fmpy
import numpy as np
from fmpy.model_description import read_build_description
from fmpy.validation import validate_fmu

import terrafix as tf
from terrafix.cosim.exchange.fmi.check.checks import Subject
from terrafix.cosim.exchange.fmi.run.archive import open_archive
from terrafix.cosim.exchange.fmi.run.binding import CO_SIMULATION

OPEN_LOOP = Path(__file__).parents[1] / "examples" / "spacecraft_sar_open_loop.toml"
COMPONENTS = ("orbit", "imu", "predict", "correct", "truth")
VERSIONS = ((2, False), (3, False), (3, True))
N, STEP = 100, 0.01


def truth() -> tf.System:
    """Orbit and attitude of the spacecraft, and the mounting of its antenna."""
    system = tf.read_system(OPEN_LOOP)
    for name in set(system.nodes) - {"orbit", "attitude", "antenna"}:
        system.remove(name)
    for port in ("orbit.r_e", "orbit.v_e", "attitude.q_be", "attitude.delta_v_b", "antenna.q_mu"):
        system.expose(port.partition(".")[2], port)
    return system


def export(name: str, file: Path, fmi: int, *, scalars: bool) -> None:
    """Write one FMU."""
    if name == "truth":
        tf.export_fmu(truth(), file, fmi=fmi, scalars=scalars, name="truth")
    else:
        system = tf.read_system(OPEN_LOOP)
        tf.export_fmu(system, file, component=name, fmi=fmi, scalars=scalars)


def stepped(file: Path, n: int = N) -> dict[str, list[float]]:
    """Outputs after some steps, by our own binding."""
    subject = Subject(open_archive(file), CO_SIMULATION)
    instance = subject.started()
    for k in range(n):
        instance.step(k * STEP, STEP)
    found = {v.name: subject.get(instance, [v]).tolist() for v in subject.outputs()}
    instance.free()
    return found


def in_fmpy(file: Path, names: list[str]) -> dict[str, list[float]]:
    """The same by FMPy, of a file or a folder."""
    rows = fmpy.simulate_fmu(str(file), stop_time=N * STEP, step_size=STEP, output_interval=STEP,
                             fmi_type="CoSimulation")  # fmt: skip
    return {n: np.ravel(rows[n][-1]).tolist() for n in names}


def unpacked(file: Path, folder: Path) -> tuple[Path, Path]:
    """The FMU's folder without its binary, and the path of that."""
    with zipfile.ZipFile(file) as archive:
        archive.extractall(folder)
    (binary,) = (folder / "binaries").glob("*/*")
    binary.unlink()
    return folder, binary


def listed(folder: Path, fmi: int) -> list[str]:
    """The sources that a tool is told to compile."""
    if fmi == 3:
        (configuration,) = read_build_description(str(folder))
        return list(configuration.sourceFileSets[0].sourceFiles)
    root = ElementTree.parse(folder / "modelDescription.xml").getroot()
    return [f.get("name", "") for f in root.iterfind("CoSimulation/SourceFiles/File")]


def by_gcc(folder: Path, binary: Path, fmi: int) -> None:
    """Compile what is listed, the header's folder beside, and say nothing else."""
    words = ["gcc", "-shared", "-fPIC", "-I.", *listed(folder, fmi), "-o", str(binary), "-lm"]
    subprocess.run(words, cwd=folder / "sources", check=True)


def by_fmpy(folder: Path, binary: Path, fmi: int) -> None:
    """Let FMPy compile it."""
    del binary, fmi
    with tempfile.TemporaryDirectory() as build:
        call = "from fmpy.build import build_platform_binary as b; import sys; b(*sys.argv[1:])"
        words = [sys.executable, "-c", call, str(folder), build]
        subprocess.run(words, check=True, capture_output=True)


def in_ecos(file: Path, names: list[str]) -> dict[str, list[float]]:
    """The same by ecos."""
    from ecospy import EcosSimulation, EcosSimulationStructure

    with EcosSimulationStructure() as structure:
        structure.add_model("part", str(file))
        with EcosSimulation(step_size=STEP, structure=structure) as simulation:
            simulation.init(0.0)
            simulation.step(N)
            return {n: [simulation.get_real(f"part::{n}")] for n in names}


def in_pathsim(file: Path, names: list[str]) -> dict[str, list[float]]:
    """The same by pathsim, whose block makes its first step at t = 0."""
    from pathsim import Simulation
    from pathsim.blocks import CoSimulationFMU

    block = CoSimulationFMU(str(file))
    Simulation([block], [], dt=STEP, log=False).run((N - 1.5) * STEP)
    return dict(zip(names, ([v] for v in block.outputs.to_array().tolist()), strict=False))


Tool = Callable[[Path, list[str]], dict[str, list[float]]]
TOOLS: dict[str, Tool] = {"ecospy": in_ecos, "pathsim": in_pathsim}
COMPILERS: dict[str, Callable[[Path, Path, int], None]] = {"gcc": by_gcc, "fmpy": by_fmpy}


def same(found: dict[str, list[float]], expected: dict[str, list[float]]) -> str:
    """Whether the bytes are the same, or by how much the worst differs."""
    a, b = (np.concatenate([x[n] for n in expected]) for x in (found, expected))
    if a.shape != b.shape:
        return "no arrays"
    return "same" if a.tobytes() == b.tobytes() else f"{np.max(np.abs(a - b)):.2g} off"


def tried(action: Callable[[], dict[str, list[float]]], expected: dict[str, list[float]]) -> str:
    """What comes of a tool, in a word."""
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            return same(action(), expected)
    except Exception as error:
        return f"fails ({type(error).__name__})"


def row(name: str, fmi: int, folder: Path, *, scalars: bool) -> list[str]:
    """One FMU: what is found, what is compiled, what tools give."""
    file = folder / f"{name}{fmi}{'s' * scalars}.fmu"
    begun = time.perf_counter()
    export(name, file, fmi, scalars=scalars)
    wall = time.perf_counter() - begun
    report = tf.check_fmu(file)
    cells = [f"{len(validate_fmu(str(file)))}", f"{len(report.findings)}+{len(report.warnings)}"]
    expected = stepped(file)
    names = list(expected)
    cells.append(same(in_fmpy(file, names), expected))
    for label, compiled in COMPILERS.items():
        at, binary = unpacked(file, folder / f"{file.stem}_{label}")
        compiled(at, binary, fmi)
        cells.append(same(in_fmpy(at, names), expected))
    for module, tool in TOOLS.items():
        installed = importlib.util.find_spec(module) is not None
        cells.append(tried(lambda t=tool: t(file, names), expected) if installed else "-")  # type: ignore[misc]
    return [f"{name}, FMI {fmi}{' scalars' * scalars}", f"{wall:.1f} s", *cells]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("components", nargs="*", default=COMPONENTS)
    options = parser.parse_args()
    heads = ["FMU", "export", "FMPy's validation", "check-fmu", "FMPy", *COMPILERS, *TOOLS]
    print("| " + " | ".join(heads) + " |")
    with tempfile.TemporaryDirectory() as folder:
        for name in options.components:
            for fmi, scalars in VERSIONS:
                cells = row(name, fmi, Path(folder), scalars=scalars)
                print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
