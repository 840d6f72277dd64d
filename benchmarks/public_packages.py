"""Public SSP packages here and in other tools, at the same step: a table with a reason each.

    python benchmarks/public_packages.py FOLDER [--steps 200] [--seconds 120] [--only TEXT]
        [--path FOLDER ...]

FOLDER holds repositories; every ``.ssp`` and ``.ssd`` in it is a package, the same content once.
None is part of terrafix. Each runs in processes of its own, in terrafix and in what of ecos, FMPy
(`simulate_ssp`) and OMSimulator can be imported; ``--path`` adds folders to import from.

All FMUs of a package step by the shortest step size among them (10 us where the package's own is
too long for what it connects: this is said). What is compared is every numeric output connector of
every component after every step. Equal means within 1e-9 of the largest value of the connector.

A package is put together first: FMUs that its sources name outside of it are copied in, and an FMU
without a binary for this machine that lists its sources is compiled from them; each is said.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from fractions import Fraction
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree

TOOLS = {"ecos": "ecospy", "FMPy": "fmpy", "OMSimulator": "OMSimulator"}
EQUAL = 1e-9
TOLERANCE = 1e-4
"""That OMSimulator gives to FMUs, whatever their own."""
FINER = Fraction(1, 100_000)
SSD = "{http://ssp-standard.org/SSP1/SystemStructureDescription}"
HERE = str(Path(__file__).resolve())


# ------------------------------------------------------------------ packages


def packages(folder: Path) -> dict[str, Path]:
    """Every package in a folder by its path there, the same content once."""
    found, seen = {}, {}
    for file in sorted(p for s in (".ssp", ".ssd") for p in folder.rglob(f"*{s}")):
        content = hashlib.sha256(file.read_bytes())
        for other in sorted(file.parent.rglob("*.ss[vm]")) if file.suffix == ".ssd" else ():
            content.update(other.read_bytes())
        name = str(file.relative_to(folder)).removesuffix("/SystemStructure.ssd")
        key = content.hexdigest()
        if key not in seen:
            seen[key] = name
            found[name] = file
    return found


def put_together(file: Path, into: Path) -> tuple[Path, list[str]]:
    """The package as an archive with all of its FMUs inside, and what was done to it."""
    folder, notes = into / "package", []
    if file.suffix == ".ssp":
        with zipfile.ZipFile(file) as archive:
            archive.extractall(folder)
        document = folder / "SystemStructure.ssd"
    else:
        shutil.copytree(file.parent, folder)
        document = folder / file.name
    base = document.parent if file.suffix == ".ssp" else file.parent
    text = document.read_text(errors="replace")
    for source in sorted(set(re.findall(r'source="([^"]+\.fmu)"', text))):
        inside = source.partition("?file=")[2] or source
        fmu = next((p for n in (inside, unquote(inside)) if (p := base / n).is_file()), None)
        if fmu is None:
            continue
        plain = f"resources/{fmu.name}" if ".." in inside or inside != source else unquote(inside)
        target = folder / plain
        target.parent.mkdir(parents=True, exist_ok=True)
        if plain != inside:
            notes.append(f"{fmu.name} copied in")
        if not target.is_file():
            shutil.copyfile(fmu, target)
        if compiled(target):
            notes.append(f"{fmu.name} compiled from its sources")
        text = text.replace(f'source="{source}"', f'source="{plain}"')
    document.unlink()
    (folder / "SystemStructure.ssd").write_text(text)
    archive = into / "package.ssp"
    with zipfile.ZipFile(archive, "w") as made:
        for each in sorted(p for p in folder.rglob("*") if p.is_file()):
            if each.suffix != ".ssp":
                made.write(each, str(each.relative_to(folder)))
    return archive, notes


def compiled(file: Path) -> bool:
    """Compile an FMU of FMI 2 that has no binary for this machine and lists its sources."""
    try:
        with zipfile.ZipFile(file) as archive:
            content = {n: archive.read(n) for n in archive.namelist() if not n.endswith("/")}
    except zipfile.BadZipFile:
        return False
    description = ElementTree.fromstring(content["modelDescription.xml"])
    interface = description.find("CoSimulation")
    if interface is None:
        interface = description.find("ModelExchange")
    has = any(n.startswith(("binaries/linux64/", "binaries/x86_64-linux/")) for n in content)
    listed = [f.get("name") for f in description.iter("File")]
    if has or not listed or interface is None or sys.platform != "linux":
        return False
    with tempfile.TemporaryDirectory() as made:
        for name, data in content.items():
            if name.startswith("sources/"):
                target = Path(made, name)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(data)
        library = Path(made, "made.so")
        words = ["cc", "-O2", "-shared", "-fPIC", "-w", "-Isources", "-DNO_FUNCTION_PREFIX"]
        words += [f"sources/{name}" for name in listed] + ["-o", str(library), "-lm"]
        done = subprocess.run(words, cwd=made, capture_output=True, check=False)
        if done.returncode:
            return False
        content[f"binaries/linux64/{interface.get('modelIdentifier')}.so"] = library.read_bytes()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return True


# ------------------------------------------------------------------ in another process


def connectors(archive: str) -> tuple[str, list[tuple[list[str], str, str]]]:
    """Name of the top system; path, connector and type of each numeric output of a component."""
    with zipfile.ZipFile(archive) as opened:
        data = opened.read("SystemStructure.ssd")
    from terrafix.cosim.exchange.ssp.documents import read_document

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "SystemStructure.ssd")
        file.write_bytes(data)
        top = read_document(file, Path(archive))[0].find(f"{SSD}System")
    found = []

    def walk(system: ElementTree.Element, path: list[str]) -> None:
        for element in system.find(f"{SSD}Elements") or ():
            here = [*path, str(element.get("name"))]
            if element.tag == f"{SSD}System":
                walk(element, here)
                continue
            for each in element.iter(f"{SSD}Connector"):
                kind = each[0].tag.rpartition("}")[2] if len(each) else "Real"
                if each.get("kind") == "output" and kind not in ("String", "Binary"):
                    found.append((here, str(each.get("name")), kind))

    walk(top, [])
    return str(top.get("name")), found


def opened(archive: str) -> Any:
    """A package as a system, at 1000 Hz where nobody gives a step size."""
    from terrafix.cosim.exchange.ssp.reading import read_ssp

    try:
        return read_ssp(archive)
    except Exception as error:
        if "--rate" not in str(error):
            raise
        return read_ssp(archive, [("rate", "1000 Hz")])


def in_terrafix(archive: str, options: dict) -> dict:
    from terrafix.cosim.engine.simulation import Simulation
    from terrafix.cosim.exchange.fmi.run.component import Fmu
    from terrafix.cosim.exchange.ssp.reading import read_ssp
    from terrafix.cosim.exchange.ssp.structure import identifier

    system = opened(archive)
    if options["step"] is not None:
        names = [n for n, c in system.nodes.items() if isinstance(c, Fmu)]
        system = read_ssp(archive, [(f"{n}.period", f"{options['step']} s") for n in names])
    fmus = {n: c for n, c in system.nodes.items() if isinstance(c, Fmu)}
    for fmu in fmus.values():
        fmu.hold_start_values = options["hold"]
        if options["tolerance"] and options["step"] is not None:
            fmu.tolerance = options["tolerance"]
    if not fmus:
        raise ValueError("it has no components: nothing runs")
    step = min(f.rate.period for f in fmus.values() if f.rate is not None and f.rate.period)
    simulation = Simulation(system, members=1)
    shown = connectors(archive)[1]
    rows = []
    for k in range(1, options["steps"] + 1):
        simulation.run_until(k * step)
        row = []
        for path, name, _ in shown:
            owner = identifier("_".join(map(identifier, path)))
            port, index = fmus[owner].scalar_names()[name]
            slot = simulation.master.wiring.slots[f"{owner}.{port}"]
            row.append(float(slot.data[0].ravel()[index]))
        rows.append(row)
    return {
        "step": str(step),
        "rows": rows,
        "names": [f"{'.'.join(p)}.{n}" for p, n, _ in shown],
        "notes": list(system.notes),
        "exchange": any(f.interface.kind == "model exchange" for f in fmus.values()),
    }


def in_ecos(archive: str, options: dict) -> dict:
    from ecospy import EcosSimulation

    with EcosSimulation(step_size=float(options["step"]), ssp_path=archive) as simulation:
        simulation.init(options["start"])
        get = {"Integer": simulation.get_integer, "Enumeration": simulation.get_integer,
               "Boolean": simulation.get_bool}  # fmt: skip
        shown = [(f"{p[-1]}::{n}", get.get(k, simulation.get_real))
                 for p, n, k in connectors(archive)[1]]  # fmt: skip
        rows = []
        for _ in range(options["steps"]):
            simulation.step(1)
            rows.append([float(read(name)) for name, read in shown])
    return {"rows": rows}


def in_fmpy(archive: str, options: dict) -> dict:
    from fmpy.ssp.simulation import simulate_ssp

    step = float(options["step"])
    stop = options["start"] + (options["steps"] - 0.5) * step
    found = simulate_ssp(archive, start_time=options["start"], stop_time=stop, step_size=step)
    names = [".".join([*p, n]) for p, n, _ in connectors(archive)[1]]
    return {"rows": [[float(row[n]) for n in names] for row in found]}


def in_omsimulator(archive: str, options: dict) -> dict:
    from OMSimulator import SSP, CRef

    model = SSP(archive).instantiate()
    model.setResultFile("")
    step = float(options["step"])
    if options["exchange"]:  # one set of equations for its CVode
        model.setVariableStepSize(step / 1000, 1e-14, step / 10)
        model.setTolerance(1e-10)
    else:
        model.setFixedStepSize(step)
    model.setStopTime(1e9)
    model.initialize()
    top, shown = connectors(archive)
    rows, early = [], step / (20 if options["exchange"] else 2)  # it ends with the step after
    for k in range(1, options["steps"] + 1):
        model.stepUntil(k * step - early)
        rows.append([float(model.getValue(CRef(top, *p, n))) for p, n, _ in shown])
    return {"rows": rows}


def in_slaves(archive: str, options: dict) -> dict:
    """FMPy's slaves, wired as terrafix reads the package and stepped by the two masters there are.

    After each step outputs are handed on once, or ("again", as OMSimulator does) until nothing
    changes, and read after that: so what depends on an input at once is a step ahead. Initial
    outputs are handed on along their dependencies, or there all at once until nothing changes: FMUs
    whose start depends on what they were asked first tell them apart. Time is exact, or summed up.
    """
    import numpy as np
    from fmpy import extract, read_model_description
    from fmpy.fmi2 import FMU2Slave

    from terrafix.cosim.basics.units import conversion_factor
    from terrafix.cosim.exchange.fmi.run.component import Fmu
    from terrafix.cosim.exchange.ssp import reading
    from terrafix.cosim.exchange.ssp.structure import identifier
    from terrafix.cosim.system.check import check

    links = []
    lend = reading._lend_units
    reading._lend_units = lambda found, fmus: links.extend(found) or lend(found, fmus)
    system = opened(archive)
    slaves, known = {}, {}
    for name, fmu in system.nodes.items():
        if not isinstance(fmu, Fmu):
            continue
        file = str(fmu.given_parameters["file"])
        description = read_model_description(file, validate=False)
        known[name] = {v.name: v for v in description.modelVariables}
        slaves[name] = slave = FMU2Slave(
            guid=description.guid,
            unzipDirectory=extract(file),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName=name,
        )
        slave.instantiate()
        slave.setupExperiment(tolerance=options["tolerance"], startTime=options["start"])
        starts = fmu.given_starts()
        for quantity in fmu.settable().values():
            if quantity.name in starts:
                values = np.ravel(starts[quantity.name])
                for each, value in zip(quantity.scalars(), values, strict=True):
                    put(slave, known[name][each], float(value))
        slave.enterInitializationMode()

    def unit(end: tuple[str, str]) -> str:
        return reading._plain_unit(
            system.nodes[end[0]], reading._port_of(system.nodes[end[0]], end[1])
        )

    wires = []
    for link in links:
        a, b = unit(link.source), unit(link.target)
        same = not link.converted or a == b or "1" in (a, b)
        wires.append((link, 1.0 if same else conversion_factor(a, b)))

    def hand_on(*, at_once: bool = True) -> list[float]:
        sent, later = [], []
        for link, factor in wires:
            (owner, name), (reader, place) = link.source, link.target
            sent.append(link.factor * factor * get(slaves[owner], known[owner][name]) + link.offset)
            later.append((slaves[reader], known[reader][place], sent[-1]))
            if not at_once:
                put(*later.pop())
        for each in later:
            put(*each)
        return sent

    def settle() -> None:
        before = hand_on()
        for _ in range(1000):
            if (now := hand_on()) == before:
                return
            before = now

    order = {name: k for k, name in enumerate(check(system).order)}
    if options["again"]:
        settle()
    else:
        wires.sort(key=lambda wire: order[wire[0].source[0]])
        for _ in range(30):
            hand_on(at_once=False)
    for name in sorted(slaves, key=lambda name: order[name]):
        slaves[name].exitInitializationMode()
        if not options["again"]:  # what has ended its initialization reaches what has not
            hand_on(at_once=False)
    settle()
    step, rows, t = Fraction(options["step"]), [], options["start"]
    shown = [("_".join(map(identifier, p)), n) for p, n, _ in connectors(archive)[1]]
    for k in range(1, options["steps"] + 1):
        later = t + float(step) if options["again"] else options["start"] + float(k * step)
        h = later - t
        for slave in slaves.values():
            slave.doStep(t, h)
        t = later
        if options["again"]:
            settle()
        rows.append([get(slaves[o], known[o][n]) for o, n in shown])
        if not options["again"]:
            hand_on()
    return {"rows": rows}


def get(slave: object, variable: object) -> float:
    kind = {"Real": "Real", "Boolean": "Boolean"}.get(variable.type, "Integer")
    return float(getattr(slave, f"get{kind}")([variable.valueReference])[0])


def put(slave: object, variable: object, value: float) -> None:
    kind = {"Real": "Real", "Boolean": "Boolean"}.get(variable.type, "Integer")
    made = float(value) if kind == "Real" else bool(value) if kind == "Boolean" else int(value)
    getattr(slave, f"set{kind}")([variable.valueReference], [made])


RUNS = {
    "slaves": in_slaves,
    "terrafix": in_terrafix,
    "ecos": in_ecos,
    "FMPy": in_fmpy,
    "OMSimulator": in_omsimulator,
}


def child(tool: str, archive: str, options: str, target: str) -> None:
    """Run a package in one tool and write what came of it."""
    try:
        found = RUNS[tool](archive, json.loads(options))
    except BaseException as error:
        found = {"error": f"{type(error).__name__}: {error}"}
    Path(target).write_text(json.dumps(found))
    os._exit(0)


# ------------------------------------------------------------------ the table


class Runner:
    def __init__(self, archive: Path, options: argparse.Namespace, start: float) -> None:
        self.archive, self.options, self.start = archive, options, start
        self.exchange = False

    def __call__(self, tool: str, step: str | None, *, steps: int = 0, **how: bool) -> dict:
        target = self.archive.with_suffix(".json")
        target.unlink(missing_ok=True)
        what = {"step": step, "steps": steps or self.options.steps, "start": self.start}
        what |= {"hold": False, "again": False, "exchange": self.exchange, "tolerance": None} | how
        path = os.pathsep.join([*self.options.path, os.environ.get("PYTHONPATH", "")])
        words = [sys.executable, HERE, "--child", tool, self.archive, json.dumps(what), target]
        try:
            done = subprocess.run(
                [str(w) for w in words], capture_output=True, text=True, check=False,
                timeout=self.options.seconds, cwd=self.archive.parent,
                env=os.environ | {"PYTHONPATH": path},
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return {"error": f"not done in {self.options.seconds} s"}
        if not target.is_file():
            lines = done.stderr.strip().splitlines()
            return {"error": f"the process ended ({done.returncode}): {' '.join(lines[-1:])}"}
        return json.loads(target.read_text())


def difference(a: list[list[float]], b: list[list[float]], names: list[str]) -> tuple[float, str]:
    """The largest difference of any connector, by its largest value, and whose it is."""
    worst = (0.0, "")
    for k, name in enumerate(names):
        one, other = [r[k] for r in a], [r[k] for r in b]
        scale = max((abs(v) for v in one + other if v == v), default=0.0) or 1.0
        for x, y in zip(one, other, strict=True):
            apart = 0.0 if (x == y or (x != x and y != y)) else abs(x - y) / scale
            if not apart <= worst[0]:
                worst = (apart if apart == apart else float("inf"), name)
    return worst


def start_of(archive: Path) -> float:
    with zipfile.ZipFile(archive) as opened:
        text = opened.read("SystemStructure.ssd").decode(errors="replace")
    found = re.search(r'DefaultExperiment[^>]*startTime="([^"]+)"', text)
    return float(found[1]) if found else 0.0


def first_line(text: str) -> str:
    lines = text.replace("\n", " / ")
    return re.sub(r"'/[^']*/package\.ssp': ", "", lines)[:200]


def one(file: Path, options: argparse.Namespace) -> dict:
    """What became of one package."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            archive, notes = put_together(file, Path(folder))
            run = Runner(archive, options, start_of(archive))
        except (OSError, KeyError, ElementTree.ParseError, zipfile.BadZipFile) as error:
            return {"runs": False, "why": f"cannot be put together: {error}", "notes": []}
        here = run("terrafix", None, steps=20)
        step = here.get("step")
        if "failed" in here.get("error", "") or "not finite" in here.get("error", ""):
            notes.append(f"at its own step: {first_line(here['error'])}")
            step = str(FINER)
        if step is None:
            return {"runs": False, "why": first_line(here["error"]), "notes": notes}
        step = f"{float(Fraction(step)):.12g}"
        here = run("terrafix", step)
        if "error" in here:
            return {"runs": False, "why": first_line(here["error"]), "notes": notes}
        run.exchange = here["exchange"]
        compared = {tool: compare(run, tool, step, here) for tool in options.tools}
        return {
            "runs": True,
            "step": step,
            "connectors": len(here["names"]),
            "compared": compared,
            "notes": [*notes, *here["notes"]],
        }


def compare(run: Runner, tool: str, step: str, here: dict) -> str:
    """What another tool makes of a package, and why it is something else."""
    how = {"tolerance": TOLERANCE} if tool == "OMSimulator" else {}
    other = run(tool, step, **how)
    if "error" in other:
        return f"no: {first_line(other['error'])}"
    mine = here
    if tool == "FMPy" or (how and not run.exchange):
        mine = run("terrafix", step, hold=tool == "FMPy", **how)
    if "error" in mine:
        return f"not here as there: {first_line(mine['error'])}"
    names = here["names"]
    said = apart(mine, other, names)
    if said.startswith("equal"):
        return f"{said}{', start values held' if tool == 'FMPy' else ''}"
    if run.exchange:
        fine = f"{float(step) / 2:.12g}"
        half = run("terrafix", fine, steps=2 * run.options.steps)
        if "error" not in half:
            half = half | {"rows": half["rows"][1::2]}
            return f"differs by {said}; at half the step here by {apart(half, other, names)}"
        return f"differs by {said}"
    again, once = run("slaves", step, again=True, **how), run("slaves", step, **how)
    if "error" in again or "error" in once:
        return f"differs by {said}"
    return (
        f"differs by {said}; slaves of FMPy that hand on once are to terrafix "
        f"{apart(once, mine, names)}, that hand on until nothing changes to {tool} "
        f"{apart(again, other, names)}"
    )


def apart(a: dict, b: dict, names: list[str]) -> str:
    worst, whose = difference(a["rows"], b["rows"], names)
    if worst == 0.0:
        return "equal to the bit"
    return f"equal to {worst:.0e}" if worst <= EQUAL else f"{worst:.1e} ({whose})"


def known(tool: str) -> str:
    try:
        return version(TOOLS[tool])
    except PackageNotFoundError:
        return "of a folder"


def main() -> None:
    """Run every package and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=120)
    parser.add_argument("--only", default="")
    parser.add_argument("--path", action="append", default=[])
    options = parser.parse_args()
    options.path = [str(Path(p).resolve()) for p in options.path]
    sys.path += options.path
    options.tools = [t for t, module in TOOLS.items() if importlib.util.find_spec(module)]
    print(f"terrafix {version('terrafix')}", *(f"{t} {known(t)}" for t in options.tools), sep=", ")
    print(f"{options.steps} steps\n")
    running = total = 0
    for name, file in packages(options.folder).items():
        if options.only not in name:
            continue
        found = one(file, options)
        total += 1
        running += found["runs"]
        print(f"{name}: ", end="")
        print(f"runs, step {found['step']} s, {found['connectors']} connectors"
              if found["runs"] else f"no: {found['why']}")  # fmt: skip
        for tool, said in found.get("compared", {}).items():
            print(f"    {tool}: {said}")
        for note in dict.fromkeys(found["notes"]):
            print(f"    ({note})")
        sys.stdout.flush()
    print(f"\n{running} of {total} packages run")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(*sys.argv[2:])
    else:
        main()
