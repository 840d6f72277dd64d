"""The promised numbers, measured: one table, each figure beside a reference taken in the same run.

    python benchmarks/run.py [--quick]

A single time says little about another machine; the ratio to the reference does.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.machine import cpu_name
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.ports import Input, Output
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.engine.simulation import Simulation
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.records.results import versions
from terrafix.cosim.system.system import System

SYSTEM = Path(__file__).parents[1] / "examples" / "spacecraft_sar_open_loop.toml"


class Nothing(Component):
    """A component that does nothing, with three ports of width 3."""

    default_rate = Rate(hz=100)
    a = Input((3,), default=0.0)
    b = Input((3,), default=0.0)
    c = Output((3,))

    def _initialize_impl(self) -> None:
        self.c = 0.0

    def _step_impl(self, t: float, dt: float) -> None:
        """Do nothing."""


def seconds(action: Callable[[], object]) -> float:
    started = time.perf_counter()
    action()
    return time.perf_counter() - started


def process(*command: str, repeat: int = 7) -> float:
    """Median wall time of a command [s]."""

    def once() -> None:
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    once()
    return median(seconds(once) for _ in range(repeat))


def overhead(n_components: int = 20, n_ticks: int = 20_000) -> tuple[float, float]:
    """Master's time per no-op component step, and that of a bare method call [s]."""
    system = System("chain", duration=n_ticks)
    previous = None
    for i in range(n_components):
        component = system.add(Nothing(), f"n{i:02d}")
        if previous is not None:
            system.connect(previous["c"], component["a"])
        previous = component
    simulation = Simulation(system)
    simulation.initialize()
    simulation.master.run_until(100)
    whole = seconds(lambda: simulation.master.run_until(100 + n_ticks))
    bare = previous._step_impl

    def calls() -> None:
        for _ in range(n_components * n_ticks):
            bare(0.0, 0.0)

    reference = seconds(calls)
    simulation.master.terminate()
    return whole / (n_components * n_ticks), reference / (n_components * n_ticks)


def numpy_loop(n_members: int, n_ticks: int) -> float:
    """The same truth and filter covariance mathematics as a plain vectorized NumPy loop [s].

    Two-body RK4 of all members and one P = F P F' per tick: less than the components do.
    """
    rng = np.random.default_rng(0)
    r = np.tile([7.07e6, 0.0, 0.0], (n_members, 1)) + rng.normal(size=(n_members, 3))
    v = np.tile([0.0, 7.5e3, 0.0], (n_members, 1))
    P = np.tile(np.eye(9), (n_members, 1, 1))
    F = np.eye(9)
    F[:3, 3:6] = np.eye(3) * 0.01
    mu, h = 3.986004418e14, 0.01

    def gravity(r: np.ndarray) -> np.ndarray:
        return -mu * r / np.sqrt((r * r).sum(axis=1, keepdims=True)) ** 3

    def loop() -> None:
        nonlocal r, v, P
        for _ in range(n_ticks):
            k1v = gravity(r)
            k2v = gravity(r + h / 2 * v)
            k3v = gravity(r + h / 2 * (v + h / 2 * k1v))
            k4v = gravity(r + h * (v + h / 2 * k2v))
            r = r + h * v + h * h / 6 * (k1v + k2v + k3v)
            v = v + h / 6 * (k1v + 2 * k2v + 2 * k3v + k4v)
            P = F @ P @ F.T

    return seconds(loop)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a tenth of the open loop")
    arguments = parser.parse_args()
    rows: list[tuple[str, str, str, str]] = []

    python = sys.executable
    terrafix = str(Path(python).with_name("terrafix"))
    bare = process(python, "-c", "pass")
    numbers = process(python, "-c", "import numpy, casadi, pint")
    help_time = process(terrafix, "--help")
    check_time = process(terrafix, "check", str(SYSTEM))
    rows.append(
        (
            "terrafix --help",
            f"{help_time:.3f} s",
            "< 0.3 s",
            f"{help_time / bare:.1f} x bare python",
        )
    )
    rows.append(
        (
            "terrafix check (open loop)",
            f"{check_time:.2f} s",
            "< 2 s",
            f"{check_time / numbers:.1f} x importing numpy, casadi, pint",
        )
    )
    step, call = overhead()
    rows.append(
        (
            "master, per no-op component step",
            f"{step * 1e6:.2f} us",
            "<= 3 us",
            f"{step / call:.1f} x a bare method call",
        )
    )

    duration = "57.4" if arguments.quick else None
    with tempfile.TemporaryDirectory() as cache:
        os.environ["TERRAFIX_CACHE"] = cache
        system = read_system(SYSTEM, [("case", "TC-1")])
        cold = Simulation(system, members=100)
        cold.master.terminate()
        result = simulate(system, members=100, duration=duration)
    reference = numpy_loop(100, 2000) / 2000 * result.ticks
    label = f"TC-1, 100 members, {result.ticks} ticks, {len(result.evaluation['fixes'])} fixes"
    rows.append(
        (
            label,
            f"{result.wall_s:.1f} s",
            "< 60 s",
            f"{result.wall_s / reference:.2f} x NumPy loop of truth and P = F P F' alone",
        )
    )
    per = result.wall_s / (100 * result.ticks) * 1e9
    rows.append(("  per member and tick", f"{per:.0f} ns", "", f"kernel: {result.kernel}"))
    rows.append(("  kernels compiled from nothing", f"{cold.setup_s:.1f} s", "", ""))

    print(
        f"{cpu_name()}, {os.cpu_count()} cores, {platform.system()}, "
        + ", ".join(f"{k} {v}" for k, v in versions().items())
    )
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    for row in rows:
        print(
            "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        )


if __name__ == "__main__":
    main()
