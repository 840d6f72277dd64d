"""A campaign whose dispersed orbit is an FMU against the native one: the same bits?

    python benchmarks/fmu_campaign.py [--runs 1000] [--duration 60]

The spacecraft's open loop flies with position and velocity of its orbit dispersed: as it is, and
with the orbit replaced by its own export as FMI 2 and as FMI 3. Every number of the result, and
every dispersed value as it reached the component, is compared as bytes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import terrafix as tf
from terrafix.cosim.campaign.campaign import run_campaign
from terrafix.cosim.system.dispersion import Dispersion

OPEN_LOOP = Path(__file__).parents[1] / "examples" / "spacecraft_sar_open_loop.toml"


def dispersed(orbit: Path | None = None) -> tf.System:
    """The open loop with another start for each member, its orbit from an FMU if one is given."""
    system = tf.read_system(OPEN_LOOP)
    system.disperse(Dispersion("position", ("orbit.r0_i",), "[100, 200, 300] m"))
    system.disperse(
        Dispersion("velocity", ("orbit.v0_i",), "0.1 m/s", design="latin_hypercube"),
    )
    if orbit is not None:
        rate = system.find("orbit").rate
        system.replace("orbit", tf.components.fmu(file=orbit, rate=rate))
    return system


def main() -> None:
    """Fly the three campaigns and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--duration", default="60")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        files: dict[str, Path | None] = {"native": None}
        for fmi in (2, 3):
            files[f"FMI {fmi}"] = file = Path(folder, f"orbit{fmi}.fmu")
            tf.export_fmu(tf.read_system(OPEN_LOOP), file, component="orbit", fmi=fmi)
        native: dict[str, bytes] = {}
        for name, orbit in files.items():
            begun = time.perf_counter()
            result = run_campaign(
                dispersed(orbit), runs=options.runs, duration=options.duration, workers=1
            )
            wall = time.perf_counter() - begun
            found = {
                str(n): v.values.tobytes()
                for n, v in result.dataset().variables.items()
                if v.dtype.kind in "fiu"
            }
            native = native or found
            differ = sorted(n for n in native if native[n] != found.get(n))
            size = sum(len(v) for v in found.values())
            print(
                f"{name}: {options.runs} members, {wall:.1f} s, {result.n_excluded} excluded, "
                f"{len(found)} variables of {size} bytes, differing: {differ or 'none'}"
            )


if __name__ == "__main__":
    main()
