"""Make the numbers of `test_flight.REFERENCE`: our increments, integrated by pyins.

    PYTHONPATH=<pyins and numba> python tests/models/motion/pyins_reference.py

pyins 1.0.1, https://github.com/nmayorov/pyins at 8377ede. Its gravity is Somigliana's times
1 - 2 h / a, ours the series of TR8350.2: at 1000 m they differ by 1.1e-5 m/s^2, some meters of
height after 600 s. Its function is replaced by ours in the integrator (in its source, before it is
compiled); nothing else is touched. Its algorithm is of low order: at 100, 200 and 400 Hz it ends
0.30, 0.08 and 0.02 m from us, so it is asked at 400 Hz.
"""

from __future__ import annotations

import inspect
import sys
import types
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parent))

from test_flight import CALM, FLOWN_BY_PYINS, KEYS, SAMPLES, START, fly, view

from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.flight import flight_model

DT = 0.0025

OURS = """
def gravity(lat, alt):
    sin2 = np.sin(lat * transform.DEG_TO_RAD) ** 2
    f, a = {f!r}, earth.A
    m = {m!r}
    return (earth.GE * (1 + earth.F * sin2) / (1 - earth.E2 * sin2) ** 0.5
            * (1 - 2 / a * (1 + f + m - 2 * f * sin2) * alt + 3 * alt * alt / (a * a)))
"""


def integrator() -> types.ModuleType:
    """The integrator of pyins with our gravity."""
    import pyins.strapdown
    from pyins import _numba_integrate

    m = EARTH.rotation_rate**2 * EARTH.radius**2 * EARTH.polar_radius / EARTH.mu
    source = inspect.getsource(_numba_integrate)
    start, end = source.index("def gravity"), source.index("@numba.njit\ndef mat_from_rotvec")
    source = source[:start] + OURS.format(f=EARTH.flattening, m=m).lstrip() + "\n\n" + source[end:]
    module = types.ModuleType("pyins._ours")
    module.__package__ = "pyins"
    exec(compile(source, "pyins._ours", "exec"), module.__dict__)
    pyins.strapdown.integrate = module.integrate
    return pyins.strapdown


def main() -> None:
    """Print the reference."""
    strapdown = integrator()
    n = round(SAMPLES[-1] / DT)
    truth = fly(flight_model(FLOWN_BY_PYINS, "wgs84", "none", START), n, DT, **CALM)
    level = view(truth, "wgs84")
    first = {k: level[k][0] for k in level}
    degrees = np.degrees([first["latitude"], first["longitude"]])
    pva = pd.Series(
        [*degrees, first["height"], *first["v_n"], *np.degrees(first["angles"])],
        ["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"],
        name=0.0,
    )
    names = [f"{kind}_{axis}" for kind in ("gyro", "accel") for axis in "xyz"]
    readings = np.hstack([truth["delta_theta_b"], truth["delta_v_b"]])
    readings[0] = readings[1]  # "the first sample is duplicated", as pyins.sim does
    imu = pd.DataFrame(readings, np.arange(n + 1) * DT, names)
    increments = strapdown.compute_increments_from_imu(imu, "increment")
    found = strapdown.Integrator(pva).integrate(increments)
    for t in SAMPLES:
        row = found.iloc[round(t / DT)]
        print(f"    ({', '.join(repr(float(row[key])) for key in KEYS)}),")


if __name__ == "__main__":
    main()
