"""The promised numbers of campaigns, measured: one table, with its references in the same run.

    python benchmarks/campaign.py [--quick] [--only NAME]...

Each figure is taken in a process of its own, so that its memory is its own. A time says little
about another machine; its ratio to the hand-written C loop (open_loop.c) of the same mathematics,
flown just before, says more.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SYSTEM = Path(__file__).parents[1] / "examples" / "spacecraft_sar_open_loop.toml"
TICKS = 59_040
FIXES = 72
MEASURES: dict[str, Callable[[float], dict[str, Any]]] = {}


def measure(function: Callable[[float], dict[str, Any]]) -> Callable[[float], dict[str, Any]]:
    """Make a function one line, or a few, of the table."""
    MEASURES[function.__name__] = function
    return function


def _memory() -> float:
    """Peak memory of this process and of the largest of its children [MiB]."""
    import resource

    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return max(resource.getrusage(w).ru_maxrss for w in who) / 1024


def _campaign(runs: int, case: str, *, seed: int = 2008, sets: Any = (), **options: Any) -> Any:
    from terrafix.cosim.campaign.batch import FileSource
    from terrafix.cosim.campaign.campaign import run_campaign

    source = FileSource(str(SYSTEM), (("case", case), *sets))
    return run_campaign(source, runs=runs, seed=seed, **options)


def _with_records() -> Any:
    """The open loop with truth and estimate recorded at 1 Hz."""
    from terrafix.cosim.basics.clock import Rate
    from terrafix.cosim.files.readers import read_system

    system = read_system(SYSTEM, [("case", "TC-1")])
    system.records.clear()
    system.record("second", ["orbit.r_e", "orbit.v_e", "predict.prior"], rate=Rate("1"))
    return system


def _hundred(scale: float, threads: int) -> dict[str, Any]:
    """TC-1, 100 runs with 1 Hz records and statistics: wall and processor time, after imports."""
    os.environ["TERRAFIX_THREADS"] = str(threads)
    import casadi  # noqa: F401
    import scipy.stats  # noqa: F401
    import xarray  # noqa: F401

    from terrafix.cosim.campaign.batch import layouts
    from terrafix.cosim.campaign.statistics.ensemble import Statistics, block_of
    from terrafix.cosim.campaign.verdict import judge
    from terrafix.cosim.engine.simulation import Simulation

    system = _with_records()
    duration = f"{590.4 * scale:.1f}"
    began, processor = time.perf_counter(), time.process_time()
    simulation = Simulation(system, members=100, duration=duration)
    built = time.perf_counter()
    simulation.initialize()
    flight, flying = time.perf_counter(), time.process_time()
    simulation.run_until(duration)
    flown, flew = time.perf_counter(), time.process_time()
    ((path, layout),) = layouts(simulation, simulation.system.duration * 1).items()
    if scale == 1.0:
        _, history = simulation.history(path)
        statistics = Statistics(layout)
        for first in (0, 64):
            part = {k: np.ascontiguousarray(v[:, first : first + 64]) for k, v in history.items()}
            statistics.add(block_of(layout, part, first=first))
        judge(statistics)
    end = time.perf_counter()
    ticks = simulation.master.tick
    samples = simulation.recorders[0].n_samples
    simulation.master.terminate()
    return {
        "wall": end - began,
        "setup": built - began,
        "flight": flown - flight,
        "statistics": end - flown,
        "processor": time.process_time() - processor,
        "per_tick": (flew - flying) / (100 * ticks) * 1e9,
        "kernel": simulation.kernel,
        "samples": samples,
        "memory": _memory(),
    }


@measure
def hundred_runs(scale: float) -> dict[str, Any]:
    """TC-1, 100 runs, as many threads as there are processors."""
    return _hundred(scale, os.cpu_count() or 1)


@measure
def hundred_runs_one_thread(scale: float) -> dict[str, Any]:
    """The same on one thread: processor time per member and tick."""
    return _hundred(scale, 1)


@measure
def hundred_runs_cold(scale: float) -> dict[str, Any]:
    """The same with nothing in the kernel cache."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["TERRAFIX_CACHE"] = folder
        return _hundred(scale, os.cpu_count() or 1)


@measure
def c_loop(scale: float) -> dict[str, Any]:
    """The same mathematics by hand in C, one thread."""
    sys.path.insert(0, str(Path(__file__).parent))
    from open_loop_c import fly

    ticks = int(TICKS * scale)
    seconds = min(fly(100, ticks, 2008, "TC-1")[0] for _ in range(3))
    return {"per_tick": seconds / (100 * ticks) * 1e9}


@measure
def numpy_loop(scale: float) -> dict[str, Any]:
    """Truth and covariance alone as a NumPy loop over all members."""
    sys.path.insert(0, str(Path(__file__).parent))
    from run import numpy_loop as loop

    ticks = max(int(TICKS * scale * 0.05), 100)
    return {"per_tick": loop(100, ticks) / (100 * ticks) * 1e9}


@measure
def basilisk(scale: float) -> dict[str, Any]:
    """Basilisk, where it is installed: one spacecraft's orbit (J2, RK4) at 100 Hz."""
    try:
        from Basilisk.simulation import spacecraft
        from Basilisk.utilities import SimulationBaseClass, macros, simIncludeGravBody
    except ImportError:
        return {"per_tick": None}
    sim = SimulationBaseClass.SimBaseClass()
    process = sim.CreateNewProcess("truth")
    process.addTask(sim.CreateNewTask("orbit", macros.sec2nano(0.01)))
    vehicle = spacecraft.Spacecraft()
    factory = simIncludeGravBody.gravBodyFactory()
    earth = factory.createEarth()
    earth.isCentralBody = True
    vehicle.gravField.gravBodies = spacecraft.GravBodyVector(list(factory.gravBodies.values()))
    vehicle.hub.r_CN_NInit = [[-1104646.3], [-6096830.4], [3395727.4]]
    vehicle.hub.v_CN_NInit = [[-560.1], [3729.6], [6498.0]]
    sim.AddModelToTask("orbit", vehicle)
    sim.InitializeSimulation()
    ticks = int(TICKS * scale)
    sim.ConfigureStopTime(macros.sec2nano(0.01 * ticks))
    began = time.perf_counter()
    sim.ExecuteSimulation()
    return {"per_tick": (time.perf_counter() - began) / ticks * 1e9}


@measure
def thousand_runs(scale: float) -> dict[str, Any]:
    """TC-2, 1,000 runs: consistency, time and memory."""
    found = {}
    for name, sets in (("P", ()), ("B", (("config", "B"),))):
        result = _campaign(int(1000 * scale), "TC-2", sets=sets)
        (path,) = result.statistics
        s = result.statistics[path]
        nis = s.sums["nis_sum"].sum() / s.sums["nis_n"].sum()
        found[f"nees_{name}"] = float(s["nees"][1:].mean())
        found[f"nis_{name}"] = float(nis)
        found[f"verdict_{name}"] = result.verdicts[path].text
    return found | {"wall": result.wall_s, "memory": _memory()}


@measure
def ten_thousand_runs(scale: float) -> dict[str, Any]:
    """TC-2, 10,000 runs, and their sample sigma against linear covariance."""
    result = _campaign(int(10_000 * scale), "TC-2")
    memory = _memory()
    (path,) = result.statistics
    return {
        "wall": result.setup_s + result.wall_s,
        "memory": memory,
        "verdict": result.verdicts[path].text,
    } | _against_lincov(result, "TC-2", ())


@measure
def wrong_model(scale: float) -> dict[str, Any]:
    """TC-2 with a filter whose transition lacks Coriolis: sample against linear covariance."""
    sets = (("predict.transition", "printed"),)
    result = _campaign(int(4000 * scale), "TC-2", sets=sets)
    (path,) = result.statistics
    return {"verdict": result.verdicts[path].text} | _against_lincov(result, "TC-2", sets)


def _against_lincov(result: Any, case: str, sets: Any) -> dict[str, Any]:
    from terrafix.cosim.files.readers import read_system
    from terrafix.cosim.lincov.deviations import linear_covariance

    began = time.perf_counter()
    found = linear_covariance(read_system(SYSTEM, [("case", case), *sets]))
    wall = time.perf_counter() - began
    s = next(iter(result.statistics.values()))
    predicted = np.sqrt(np.diagonal(s["covariance_predicted"], axis1=1, axis2=2))
    sample = np.sqrt(np.diagonal(s["covariance_sample"], axis1=1, axis2=2))
    return {
        "lincov_wall": wall,
        "lincov_predicted_end": float(np.abs(found.sigma_filter[-1] / predicted[-1] - 1).max()),
        "lincov_predicted": float(np.abs(found.sigma_filter / predicted - 1).max()),
        "lincov_sample_end": float(np.abs(found.sigma[-1] / sample[-1] - 1).max()),
        "lincov_sample": float(np.abs(found.sigma / sample - 1).max()),
        "sample_over_predicted": (sample[-1] / predicted[-1]).round(3).tolist(),
        "lincov_over_predicted": (found.sigma[-1] / found.sigma_filter[-1]).round(3).tolist(),
        "runs": result.runs,
    }


def run(name: str, scale: float) -> dict[str, Any]:
    """Take one measure in a process of its own."""
    command = [sys.executable, __file__, "--measure", name, "--scale", str(scale)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def _table(results: dict[str, dict[str, Any]]) -> list[tuple[str, str, str]]:
    rows: list[tuple[str, str, str]] = []
    reference = results.get("c_loop", {}).get("per_tick")

    def ratio(value: float | None) -> str:
        return "" if not reference or not value else f"; {value / reference:.2f} x the C loop"

    if r := results.get("hundred_runs"):
        rows.append(
            (
                "TC-1, 100 runs x 59,040 ticks x 72 updates, 1 Hz records, statistics",
                f"{r['wall']:.2f} s (set up {r['setup']:.2f}, fly {r['flight']:.2f}, "
                f"statistics {r['statistics']:.2f}), kernel {r['kernel']}",
                "<= 2 s",
            )
        )
        rows.append(("  peak memory", f"{r['memory']:.0f} MiB", "< 400 MiB"))
    if r := results.get("hundred_runs_one_thread"):
        rows.append(
            (
                "  processor time per member and tick, one thread",
                f"{r['per_tick']:.0f} ns{ratio(r['per_tick'])}",
                "<= 200 ns",
            )
        )
    if reference:
        rows.append(("  hand-written C loop, one thread", f"{reference:.0f} ns", "slower"))
    if r := results.get("numpy_loop"):
        text = f"{r['per_tick']:.0f} ns{ratio(r['per_tick'])}"
        rows.append(("  NumPy loop of truth and P = F P F' alone", text, ""))
    if r := results.get("basilisk"):
        text = f"{r['per_tick']:.0f} ns{ratio(r['per_tick'])}" if r["per_tick"] else "not installed"
        rows.append(("  Basilisk, truth alone", text, ""))
    if r := results.get("hundred_runs_cold"):
        rows.append(("  nothing in the kernel cache", f"{r['wall']:.1f} s", "<= 20 s"))
    thousand = results.get("thousand_runs")
    if r := thousand:
        for config in ("P", "B"):
            text = f"NEES {r[f'nees_{config}']:.3f}, NIS {r[f'nis_{config}']:.3f}, "
            rows.append(
                (
                    f"TC-2, 1,000 runs, configuration {config}",
                    text + r[f"verdict_{config}"],
                    "[8.74, 9.26], [3.95, 4.05]",
                )
            )
    if r := results.get("ten_thousand_runs"):
        more = f", {r['memory'] / thousand['memory']:.2f} x that of 1,000" if thousand else ""
        rows.append(("TC-2, 10,000 runs", f"{r['wall']:.0f} s, {r['verdict']}", "< 180 s"))
        rows.append(("  peak memory of a process", f"{r['memory']:.0f} MiB{more}", "< 1.5 x"))
        rows.append(
            (
                "  linear covariance against them",
                f"predicted sigma {r['lincov_predicted_end']:.2%} at the end, "
                f"{r['lincov_predicted']:.2%} at worst; sample {r['lincov_sample_end']:.2%}, "
                f"{r['lincov_sample']:.2%}; {r['lincov_wall']:.1f} s",
                "0.5 %, 3 %",
            )
        )
    if r := results.get("wrong_model"):
        rows.append(
            (
                f"filter without Coriolis, {r['runs']} runs",
                f"sample over linear covariance {r['lincov_sample_end']:.2%} at the end, "
                f"{r['lincov_sample']:.2%} at worst; {r['verdict']}; sample/predicted "
                f"{max(r['sample_over_predicted'])}, foretold {max(r['lincov_over_predicted'])}",
                "5 %",
            )
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a twentieth of everything")
    parser.add_argument("--only", action="append", default=[], choices=list(MEASURES))
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    parser.add_argument("--scale", type=float, default=1.0, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(MEASURES[arguments.measure](arguments.scale)))
        return
    from terrafix.cosim.basics.machine import cpu_name
    from terrafix.cosim.records.results import versions

    print(f"{cpu_name()}, {os.cpu_count()} processors; {versions()}")
    scale = 0.05 if arguments.quick else 1.0
    results = {}
    for name in arguments.only or MEASURES:
        results[name] = run(name, scale)
        print(f"{name}: {json.dumps(results[name])}", file=sys.stderr)
    rows = _table(results)
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    for row in rows:
        print("  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)).rstrip())


if __name__ == "__main__":
    main()
