"""Other tools' FMUs here and in FMPy, each alone and unconnected: how many agree?

    python benchmarks/public_fmus.py FOLDER [--out reasons.txt] [--only NAME] [--limit 20]

FOLDER holds .fmu files, at any depth; of files with the same content one is run. Every FMU runs
once for each kind that it offers (co-simulation, model exchange), in processes of its own, here and
in FMPy's `simulate_fmu`: from the start time of its default experiment, with its step (else a
hundredth of what it spans), `STEPS` steps or until its stop time. In model exchange both have the
tolerance `TOLERANCE`; in co-simulation what the FMU says. All numeric outputs are compared at every
step, to `SAME` relative and absolute. An FMU without a binary for this machine is counted, not run.

FMPy's k-th time is the product of k and h, rounded; ours is k h, rounded once. Where co-simulation
of FMI 2 differs, FMPy's own classes are stepped at our times too: if they give our numbers, the FMU
depends on the last bit of t (column "rounding"). `simulate_fmu` lets no input clock of FMI 3 tick;
an FMU with one that time lets tick, as it does here, and that differs stands under "clocks".
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import re
import tempfile
import zipfile
from collections import Counter
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from fmpy import extract, read_model_description, simulate_fmu
from fmpy.simulation import Recorder, instantiate_fmu
from fmpy.util import auto_interval
from numpy.typing import NDArray

import terrafix as tf
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.exchange.fmi.run.component import Fmu

FORKS = multiprocessing.get_context("fork")
STEPS = 200
TOLERANCE = 1e-9
SAME = 1e-6
KINDS = {"CoSimulation": "co-simulation", "ModelExchange": "model exchange"}
COLUMNS = (
    *(
        "equal",
        "within",
        "rounding",
        "clocks",
        "differ",
        "only FMPy",
        "only here",
        "neither",
        "no outputs",
    ),
    "FMI 1 ME",
)


def plan(file: Path) -> tuple[Any, Fraction, int, float]:
    """Description, step [s], number of steps, start time [s]."""
    description = read_model_description(str(file), validate=False)
    said = description.defaultExperiment
    start = float((said and said.startTime) or 0.0)
    stop = float((said and said.stopTime) or 0.0)
    stop = stop if stop > start else start + 1.0
    step = float((said and said.stepSize) or 0.0)
    internal = getattr(description.coSimulation, "fixedInternalStepSize", None)
    step = step or float(internal or 0.0) or auto_interval(stop - start)
    exact = Fraction(str(step)).limit_denominator(10**9)
    steps = max(1, min(STEPS, int((stop - start) / float(exact) * (1 + 1e-9))))
    return description, exact, steps, start


def ticks(file: Path) -> bool:
    """Whether it has an input clock that depends on time."""
    variables = plan(file)[0].modelVariables
    clocks = [v for v in variables if v.type == "Clock" and v.causality == "input"]
    return any(v.intervalVariability != "triggered" for v in clocks)


def outputs_of(description: Any) -> list[Any]:
    """Outputs that are numbers."""
    left_out = ("String", "Binary", "Clock")
    found = description.modelVariables
    return [v for v in found if v.causality == "output" and v.type not in left_out]


def run_here(file: Path, kind: str) -> dict[str, NDArray[Any]]:
    """Outputs by the FMU's names, a row for each step."""
    description, h, steps, start = plan(file)
    options = {} if kind == "CoSimulation" else {"tolerance": TOLERANCE}
    system = tf.System("one")
    part = Fmu(file=file, kind=KINDS[kind], rate=Rate(h), start_time=start, **options)
    system.add(part, "part")
    ports = [port for port in part.interface.ports if not port.is_input]
    if not ports:
        tf.simulate(system, duration=h * steps)
        return {}
    system.record("history", [f"part.{port.name}" for port in ports])
    dataset = tf.simulate(system, duration=h * steps).dataset
    found = {}
    for port in ports:
        quantity, _ = port.fields[""]
        rows = dataset[f"part.{port.name}"].values[:, 0]
        names = [v.name for v in quantity.variables]
        columns = np.moveaxis(rows.reshape(len(rows), len(names), -1), 1, 0)
        found |= dict(zip(names, columns, strict=True))
    missing = {v.name for v in outputs_of(description)} - found.keys()
    if missing:
        raise ValueError(f"not among the ports: {', '.join(sorted(missing))}")
    return found


def run_there(file: Path, kind: str) -> dict[str, NDArray[Any]]:
    """The same, from FMPy."""
    description, h, steps, start = plan(file)
    names = [v.name for v in outputs_of(description)]
    events = kind == "CoSimulation" and getattr(description.coSimulation, "hasEventMode", False)
    events = bool(events) and any(
        v.type == "Clock" or (v.causality == "input" and v.variability == "discrete")
        for v in description.modelVariables
    )
    found = simulate_fmu(
        str(file), validate=False, start_time=start, stop_time=start + float(h * steps),
        step_size=float(h), output_interval=float(h), record_events=False, fmi_type=kind,
        output=names, relative_tolerance=None if kind == "CoSimulation" else TOLERANCE,
        use_event_mode=events, early_return_allowed=events,
    )  # fmt: skip
    times = start + np.arange(steps + 1) * float(h)
    chosen = [np.flatnonzero(np.abs(found["time"] - t) < 1e-6 * float(h)) for t in times]
    rows = [int(at[-1]) for at in chosen if at.size]
    return {name: found[name][rows].reshape(len(rows), -1) for name in names}


def run_at_our_times(file: Path, kind: str) -> dict[str, NDArray[Any]]:
    """The same, from FMPy's classes at times that are rounded once (co-simulation, FMI 2)."""
    description, h, steps, start = plan(file)
    names = [v.name for v in outputs_of(description)]
    said = description.defaultExperiment
    tolerance = float(said.tolerance) if said is not None and said.tolerance else None
    times = [start + float(h * k) for k in range(steps + 1)]
    fmu = instantiate_fmu(extract(str(file)), description, kind)
    fmu.setupExperiment(tolerance=tolerance, startTime=start)
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    recorder = Recorder(fmu, description, names, interval=0)
    recorder.sample(start, force=True)
    for t, end in pairwise(times):
        fmu.doStep(currentCommunicationPoint=t, communicationStepSize=end - t)
        recorder.sample(end, force=True)
    found = recorder.result()
    return {name: found[name].reshape(len(times), -1) for name in names}


def one_side(side: str, file: Path, kind: str, target: Path) -> None:
    """Run one side and keep what it found, or what it said; in a process of its own."""
    os.setsid()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        found = SIDES[side](file, kind)
    except Exception as error:
        text = str(error).strip() or type(error).__name__
        target.with_suffix(".txt").write_text(" | ".join(text.splitlines())[:400])
        return
    np.savez(target, **{f"v{k}": v for k, v in enumerate(found.values())})
    target.with_suffix(".json").write_text(json.dumps(list(found)))


SIDES = {"here": run_here, "there": run_there, "at_our_times": run_at_our_times}


def in_a_process(
    side: str, file: Path, kind: str, folder: Path, limit: float
) -> dict[str, Any] | str:
    """What one side found, or why it found nothing."""
    target = folder / f"{side}.npz"
    process = FORKS.Process(target=one_side, args=(side, file, kind, target))
    process.start()
    process.join(limit)
    if process.is_alive():
        process.kill()
        process.join()
        return f"not done after {limit:g} s"
    said, names = target.with_suffix(".txt"), target.with_suffix(".json")
    if said.exists():
        return said.read_text()
    if not names.exists():
        return f"its process ended with status {process.exitcode}"
    with np.load(target) as arrays:
        return dict(zip(json.loads(names.read_text()), arrays.values(), strict=True))


def compare(here: dict[str, Any], there: dict[str, Any]) -> tuple[str, str]:
    """How near two results are, and the worst of what is not equal."""
    worst, where, equal = 0.0, "", True
    for name, ours in here.items():
        theirs = there[name].astype(float)
        mine = ours.astype(float)
        ended = np.isnan(mine).all(axis=1)
        mine = mine[: int(np.argmax(ended)) if ended.any() else len(mine)]
        n = min(len(mine), len(theirs))
        if abs(len(mine) - len(theirs)) > 1:
            return "differ", f"{name}: {len(mine)} rows here, {len(theirs)} there"
        mine, theirs = mine[:n], theirs[:n]
        equal &= bool(((mine == theirs) | (np.isnan(mine) & np.isnan(theirs))).all())
        off = np.abs(mine - theirs) / (SAME + SAME * np.abs(theirs))
        off[np.isnan(mine) & np.isnan(theirs)] = 0.0
        off[np.isnan(off)] = np.inf
        if off.size and off.max() > worst:
            worst = float(off.max())
            k, e = np.unravel_index(int(off.argmax()), off.shape)
            first = int(np.argmax((off > 1).any(axis=1)))
            where = f"{name}[{e}] step {k}: {mine[k, e]!r} here, {theirs[k, e]!r} there"
            where += f"; first beyond at step {first} of {n - 1}" if worst > 1 else ""
    if equal:
        return "equal", ""
    return ("within" if worst <= 1.0 else "differ"), where


def judge(file: Path, kind: str, version: str, limit: float) -> tuple[str, str]:
    """The column of a run, and what is to be said of it."""
    if version == "1.0" and kind == "ModelExchange":
        return "FMI 1 ME", ""
    with tempfile.TemporaryDirectory() as folder:
        here = in_a_process("here", file, kind, Path(folder), limit)
        there = in_a_process("there", file, kind, Path(folder), limit)
        if not isinstance(here, str) and not isinstance(there, str):
            column, said = compare(here, there)
            if column == "differ" and (version, kind) == ("2.0", "CoSimulation"):
                again = in_a_process("at_our_times", file, kind, Path(folder), limit)
                near = "" if isinstance(again, str) else compare(here, again)[0]
                if near in ("equal", "within"):
                    column, said = "rounding", f"at our times {near} in FMPy; {said}"
            if column == "differ" and ticks(file):
                column = "clocks"
            return (column, said) if there else ("no outputs", "")
    if isinstance(here, str) and isinstance(there, str):
        return "neither", f"here: {here} || FMPy: {there}"
    if isinstance(here, str):
        return "only FMPy", here
    return "only here", str(there)


def kinds_of(file: Path) -> tuple[str, str, list[str], str]:
    """Version of FMI, tool, kinds, and why it is not run, if it is not."""
    try:
        with zipfile.ZipFile(file) as archive:
            xml = archive.read("modelDescription.xml").decode(errors="replace")
            names = archive.namelist()
    except (zipfile.BadZipFile, KeyError, OSError) as error:
        return "?", "?", [], f"no FMU: {error}"
    version = (re.search(r'fmiVersion\s*=\s*"([^"]*)"', xml) or ["", "?"])[1]
    tool = (re.search(r'generationTool\s*=\s*"([^"]*)"', xml) or ["", "not said"])[1]
    tool = re.split(r"[\s-]*(?:Version|[vR]?\d|\(|\.py)", tool)[0].strip() or "not said"
    if not any(re.match(r"binaries/(linux64|x86_64-linux)/.", n) for n in names):
        return version, tool, [], "no binary for x86-64 Linux"
    if version == "1.0":
        return version, tool, ["CoSimulation" if "Implementation" in xml else "ModelExchange"], ""
    kinds = [k for k in KINDS if re.search(rf"<{k}\b", xml)]
    return version, tool, kinds, "" if kinds else "neither co-simulation nor model exchange"


def main() -> None:
    """Run all, print the table, and write the reasons."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("public_fmus.txt"))
    parser.add_argument("--only", default="")
    parser.add_argument("--limit", type=float, default=20.0, help="of one side [s]")
    options = parser.parse_args()
    seen: set[str] = set()
    table: dict[str, Counter[str]] = {}
    not_run: Counter[str] = Counter()
    with options.out.open("w") as out:
        for file in sorted(options.folder.rglob("*.fmu")):
            digest = hashlib.sha256(file.read_bytes()).hexdigest()
            if digest in seen or options.only not in str(file):
                continue
            seen.add(digest)
            name = str(file.relative_to(options.folder))
            version, tool, kinds, why = kinds_of(file)
            if not kinds:
                not_run[why] += 1
                print(f"not run | {name} | FMI {version} | {tool} | {why}", file=out, flush=True)
            for kind in kinds:
                column, said = judge(file, kind, version, options.limit)
                table.setdefault(tool, Counter())[column] += 1
                what = f"{name} | FMI {version} | {kind} | {tool} | {said}"
                print(f"{column} | {what}", file=out, flush=True)
    print(f"{len(seen)} FMUs of different content; not run: {dict(not_run)}\n")
    print(f"| tool | {' | '.join(COLUMNS)} |\n|{' --- |' * (len(COLUMNS) + 1)}")
    for tool, row in [*sorted(table.items()), ("all", sum(table.values(), Counter()))]:
        print(f"| {tool} | {' | '.join(str(row[c]) for c in COLUMNS)} |")


if __name__ == "__main__":
    main()
