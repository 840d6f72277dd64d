"""What interpolation between the states of an orbit file errs by: the tables of the docs.

    python benchmarks/orbit_interpolation.py

Against orbits under J2 that SciPy integrates, and, where TERRAFIX_DATA is, against states of the
Sentinel-1 orbit file that are left out.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.ephemeris import Ephemeris, read_eof

OMEGA = np.array([0.0, 0.0, EARTH.rotation_rate])
ORBITS = {  # position [m] and inertial velocity [m/s] on the equator, how long [s]
    "low": ((7.07e6, 0.0, 0.0), (0.0, -1.06e3, 7.43e3), 12000.0),
    "GNSS": ((2.656e7, 0.0, 0.0), (0.0, 2.22e3, 3.17e3), 43200.0),
}
SPACINGS = (10.0, 60.0, 300.0, 900.0)
STEPS = (2, 6, 12, 18, 30, 60, 90)
DATA = Path(os.environ.get("TERRAFIX_DATA", Path(__file__).parents[2] / "shared" / "data"))


def fall(_t: float, x: np.ndarray) -> np.ndarray:
    """Motion relative to the Earth under two-body gravity and J2."""
    r, v = x[:3], x[3:]
    d = np.sqrt(r @ r)
    flat = 1.5 * EARTH.j2 * (EARTH.radius / d) ** 2
    pull = -EARTH.mu / d**3 * r * (1 + flat * (np.array([1, 1, 3]) - 5 * (r[2] / d) ** 2))
    return np.concatenate([v, pull - 2 * np.cross(OMEGA, v) - np.cross(OMEGA, np.cross(OMEGA, r))])


def worst(orbit: Ephemeris, t: np.ndarray, r: np.ndarray, v: np.ndarray) -> tuple[float, ...]:
    """Largest errors of position and velocity, everywhere and away from the ends."""
    found_r, found_v = orbit.at(t)
    e_r, e_v = (np.linalg.norm(a - b, axis=1) for a, b in ((found_r, r), (found_v, v)))
    inner = (t > orbit.t[min(4, len(orbit.t) // 3)]) & (t < orbit.t[-min(5, len(orbit.t) // 3)])
    return float(e_r.max()), float(e_v.max()), float(e_r[inner].max())


def main() -> None:
    print("orbit   spacing  states       position     velocity   inner pos.    stated")
    for name, (r0, v0, span) in ORBITS.items():
        start = np.concatenate([r0, np.array(v0) - np.cross(OMEGA, r0)])
        options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-6, "dense_output": True}
        truth = solve_ivp(fall, (0.0, span), start, **options).sol
        for spacing in SPACINGS:
            t = np.arange(min(200, int(span // spacing) + 1)) * spacing
            x = truth(t).T
            between = np.concatenate([t[:-1] + spacing * f for f in (0.25, 0.5, 0.75)])
            known = truth(between).T
            tags = np.datetime64(0, "ns") + (t * 1e9).astype("timedelta64[ns]")
            for velocities in (True, False):
                orbit = Ephemeris(tags, t, x[:, :3], x[:, 3:] if velocities else None)
                r, v, inner = worst(orbit, between, known[:, :3], known[:, 3:])
                kind = "r and v" if velocities else "r alone"
                print(
                    f"{name:6} {spacing:6.0f} s  {kind}  {r:10.2g} m {v:10.2g} m/s {inner:9.2g} m "
                    f"{orbit.error():9.2g} m"
                )
    for path in sorted((DATA / "sentinel1").glob("*.EOF"))[:1]:
        whole = read_eof(path)
        assert whole.v_e is not None
        for step in STEPS:
            kept = slice(None, None, step)
            for velocities in (True, False):
                orbit = Ephemeris(
                    whole.tags[kept],
                    whole.t[kept],
                    whole.r_e[kept],
                    whole.v_e[kept] if velocities else None,
                )
                within = whole.t <= orbit.t[-1]
                r, v, inner = worst(orbit, whole.t[within], whole.r_e[within], whole.v_e[within])
                kind = "r and v" if velocities else "r alone"
                print(
                    f"real   {10 * step:6.0f} s  {kind}  {r:10.2g} m {v:10.2g} m/s {inner:9.2g} m "
                    f"{orbit.error():9.2g} m"
                )


if __name__ == "__main__":
    main()
