"""Whether campaigns call filters by their names: each case flown many times, and counted.

    python benchmarks/verdicts.py [--campaigns 100] [--runs 100] [--only NAME]...

A right filter is to be accused by at most 5 campaigns of 100, each wrong one to be named for what
it is by at least 95. All cases are of the open loop, TC-2; seeds are 1, 2, 3, ...
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

SYSTEM = str(Path(__file__).parents[1] / "examples" / "spacecraft_sar_open_loop.toml")

# what the radar's error is, and what the filter is told of it: R and D are those of the fix, so
# that scaling the truth by 1/k is scaling the filter's R and D by k^2
CASES: dict[str, tuple[str, dict[str, str]]] = {
    "right, configuration P": ("consistent", {}),
    "right, configuration B": ("consistent", {"config": "B"}),
    "misalignment process noise / 10, B": (
        "overconfident",
        {"config": "B", "predict.misalignment_psd": "3.4e-14 rad^2/s"},
    ),
    "R and D x 4": ("conservative", {"sar.error_scale": "0.5"}),
    "R and D / 4": ("overconfident", {"sar.error_scale": "2"}),
    "wrong sign of the misalignment Jacobian": (
        "overconfident",
        {"correct.jacobian": "wrong-sign"},
    ),
    "geolocation bias of 10 m": ("biased", {"sar.geolocation_bias": "[10, 0, 0] m"}),
    "pixels of the nominal boresight": ("overconfident", {"sar.boresight": "nominal"}),
}


def fly(settings: dict[str, str], runs: int, seed: int) -> tuple[str, float, float]:
    """Verdict, mean NEES and mean NIS of one campaign."""
    import numpy as np

    from terrafix.cosim.campaign.batch import FileSource
    from terrafix.cosim.campaign.campaign import run_campaign

    source = FileSource(SYSTEM, (("case", "TC-2"), *settings.items()))
    result = run_campaign(source, runs=runs, seed=seed, workers=1)
    (path,) = result.statistics
    statistics = result.statistics[path]
    nis = statistics.sums["nis_sum"].sum() / statistics.sums["nis_n"].sum()
    return result.verdicts[path].text, float(np.nanmean(statistics["nees"][1:])), float(nis)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=100)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--only", action="append", default=[])
    arguments = parser.parse_args()
    print(f"{arguments.campaigns} campaigns of {arguments.runs} runs each")
    seeds = range(1, arguments.campaigns + 1)
    os.environ["TERRAFIX_THREADS"] = "1"
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        for name, (word, settings) in CASES.items():
            if arguments.only and not any(o in name for o in arguments.only):
                continue
            began = time.perf_counter()
            n = len(seeds)
            done = list(pool.map(fly, [settings] * n, [arguments.runs] * n, seeds))
            counts = Counter(text for text, _, _ in done)
            right = sum(c for text, c in counts.items() if word in text.split(" and "))
            nees = sum(x for _, x, _ in done) / n
            nis = sum(x for _, _, x in done) / n
            print(
                f"{name:42} {word:14} {right:3} of {n}   NEES {nees:8.3f}  NIS {nis:7.3f}   "
                f"{dict(counts)}  ({time.perf_counter() - began:.0f} s)",
                flush=True,
            )


if __name__ == "__main__":
    main()
