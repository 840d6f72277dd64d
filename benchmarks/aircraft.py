"""The aircraft at the level of measurements: 200 flights of 50 s at 100 Hz, and NumPy beside them.

    python benchmarks/aircraft.py [--members 200] [--workers 2]

The reference is what a filter of 24 states cannot do without, in batched NumPy and in the same run:
the covariance of every member carried over every step, P <- F P F' + Q, with F and Q ready made. It
is timed over some steps and multiplied. Processor time is that of one process; a campaign shares it
among workers. On a machine that others use, processor times mean more than wall times.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from terrafix.cosim.basics.machine import cpu_name
from terrafix.cosim.campaign.campaign import run_campaign
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system

SYSTEM = Path(__file__).parents[1] / "examples" / "aircraft_sar_measurements.toml"
STATES, STEPS, TIMED = 24, 5000, 50
REPEATS = 3  # of which each time is the least


def timed(action: Callable[[], object]) -> tuple[float, float]:
    """Least wall and processor time [s]."""
    found = []
    for _ in range(REPEATS):
        wall, cpu = time.perf_counter(), time.process_time()
        action()
        found.append((time.perf_counter() - wall, time.process_time() - cpu))
    return min(w for w, _ in found), min(c for _, c in found)


def reference(members: int) -> tuple[float, float]:
    """Of carrying all covariances over all steps in NumPy."""
    rng = np.random.default_rng(0)
    F = np.eye(STATES) + 1e-3 * rng.standard_normal((members, STATES, STATES))
    Q = 1e-6 * np.eye(STATES)

    def carry() -> None:
        P = np.tile(np.eye(STATES), (members, 1, 1))
        for _ in range(TIMED):
            P = F @ P @ F.transpose(0, 2, 1) + Q

    wall, cpu = timed(carry)
    return wall * STEPS / TIMED, cpu * STEPS / TIMED


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    system = read_system(SYSTEM)
    simulate(system, members=options.members)  # kernels are built and kept
    wall, cpu = timed(lambda: simulate(system, members=options.members))
    found = {"one process": (wall, cpu), "covariances alone, NumPy": reference(options.members)}
    began = time.perf_counter()
    run_campaign(SYSTEM, runs=options.members, workers=options.workers)
    campaign = time.perf_counter() - began
    print(f"{cpu_name()}; {options.members} members, {STEPS} steps")
    for name, (wall, cpu) in found.items():
        print(f"{name:<28} {wall:7.2f} s wall {cpu:7.2f} s of processor")
    ratio = found["covariances alone, NumPy"][1] / found["one process"][1]
    print(f"the whole system takes 1/{ratio:.1f} of what NumPy takes for its covariances")
    print(f"campaign, {options.workers} workers, started anew {campaign:7.2f} s wall")


if __name__ == "__main__":
    main()
