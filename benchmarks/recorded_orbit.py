"""How the process noise has to change when the truth is a real orbit: the table of the docs.

    python benchmarks/recorded_orbit.py [--members 100]

Needs the Sentinel-1 orbit file (TERRAFIX_DATA). Minutes on two cores.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import inertial_from_earth_fixed_array
from terrafix.models.motion.ephemeris import Ephemeris, read_eof
from terrafix.models.motion.orbit import orbit_model

SYSTEM = Path(__file__).parents[1] / "examples" / "spacecraft_sar_recorded_orbit.toml"
NOISE = (3.5e-11, 1e-8, 1e-7, 3e-7, 7e-7, 1e-6, 2.7e-6, 1e-5)


def unmodelled_acceleration(orbit: Ephemeris, start: float, duration: float) -> np.ndarray:
    """Mean acceleration between states that J2 gravity does not explain, (n, 3) [m/s^2]."""
    model = orbit_model("j2")
    found = []
    for k in np.flatnonzero((orbit.t >= start - 10) & (orbit.t <= start + duration)):
        h = orbit.t[k + 1] - orbit.t[k]
        rate = EARTH.rotation_rate
        r, v = inertial_from_earth_fixed_array(orbit.r_e[k], orbit.v_e[k], 0.0, rate)
        _, v_end = inertial_from_earth_fixed_array(
            orbit.r_e[k + 1], orbit.v_e[k + 1], rate * h, rate
        )
        for _ in range(20):
            _, state = model.advance(
                r_i=r, v_i=v, mu=EARTH.mu, radius=EARTH.radius, j2=EARTH.j2, step=h / 20
            )
            r, v = state["r_i"], state["v_i"]
        found.append((v_end - v) / h)
    return np.array(found)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--members", type=int, default=100)
    members = parser.parse_args().members
    system = read_system(SYSTEM)
    orbit = system.find("orbit")
    duration = float(system.duration)
    felt = unmodelled_acceleration(
        read_eof(orbit.setting("orbit_file")), float(orbit.setting("start")), duration
    )
    rms = float(np.sqrt((felt**2).mean()))
    print(f"acceleration beyond J2: rms per axis {rms:.2e} m/s^2, mean {np.abs(felt.mean(axis=0))}")
    print(
        f"white noise that moves velocity as far in {duration:g} s if it were constant: "
        f"{rms**2 * duration:.1e} m^2/s^3"
    )
    print(f"{'accel_psd':>10} {'NEES':>7} {'inside':>7} {'NIS':>6}  sample/predicted r    v")
    for psd in NOISE:
        result = simulate(read_system(SYSTEM, [("predict.accel_psd", str(psd))]), members=members)
        e = result.evaluation
        ratios = [
            np.mean(np.divide(e[q]["sigma_sample"], e[q]["sigma_predicted"]))
            for q in ("position", "velocity")
        ]
        print(
            f"{psd:10.1e} {e['nees']['mean']:7.2f} {e['nees']['fraction_inside']:7.0%} "
            f"{e['nis']['mean']:6.2f}  {ratios[0]:18.2f} {ratios[1]:4.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
