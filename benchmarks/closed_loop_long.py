"""Ten minutes of the closed loop, 72 images: its end beside the paper's, and what it costs.

    python benchmarks/closed_loop_long.py [--case TC-2] [--members 1] [--duration 590.4]

The paper flew this track with drawn errors (2 to 8 m in a fix, 0.54 m/s in the velocity) and prints
the smallest and the largest sigma of the position at its end, those of x and y.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np

from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system
from terrafix.models.images.matching import REASONS

SYSTEM = Path(__file__).parents[1] / "examples" / "spacecraft_sar_closed_loop_long.toml"
PAPER = {"TC-1": (20.0, 740.0), "TC-2": (12.0, 138.0)}
"""Sigma of x and of y after 72 updates [m]."""
MOST = 300.0
"""Seconds of wall time that the whole may take on two processors."""


def main(case: str, members: int, duration: str) -> None:
    system = read_system(SYSTEM, settings=[("case", case)])
    began, processor = time.perf_counter(), time.process_time()
    data = simulate(system, members=members, duration=duration).dataset
    wall, processor = time.perf_counter() - began, time.process_time() - processor
    reason = data["matcher.reason"].to_numpy()[1:]
    n = len(reason)
    taken = data["correct.innovation.accepted"]
    times = data["matcher.reason"][data["matcher.reason"].dims[0]].to_numpy()[1:]
    taken = taken.sel({taken.dims[0]: times}, method="nearest").to_numpy()
    print(
        f"{case}, {members} members: {n} images, {100 * np.mean(reason == 0):.1f} % recognized, "
        f"{100 * np.mean(taken > 0):.1f} % of updates accepted"
    )
    for k in sorted(set(reason[np.isfinite(reason) & (reason > 0)].astype(int).tolist())):
        print(f"  {np.sum(reason == k)} times: {REASONS[k]}")
    P = data["correct.estimate.P"].to_numpy()[-1]
    sigma = np.sqrt(np.mean(np.diagonal(P, axis1=1, axis2=2), axis=0))
    x, y = PAPER[case]
    print(
        f"  at the end: position sigma x {sigma[0]:.1f}, y {sigma[1]:.1f}, z {sigma[2]:.1f} m "
        f"(paper: x {x:.0f}, y {y:.0f}); velocity {np.round(sigma[3:6], 4)} m/s, misalignment "
        f"{np.round(np.degrees(sigma[6:]), 4)} deg"
    )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"  {wall:.0f} s ({MOST:.0f} on two processors), {processor:.0f} s of processor, "
        f"{processor / n:.2f} an image; peak memory {peak:.2f} GiB"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", choices=PAPER, default="TC-2")
    parser.add_argument("--members", type=int, default=1)
    parser.add_argument("--duration", default="590.4")
    arguments = parser.parse_args()
    main(arguments.case, arguments.members, arguments.duration)
