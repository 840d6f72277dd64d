"""Our satellite beside a real one, beside brahe, and what a field costs.

    python benchmarks/real_orbit.py [real] [brahe] [kepler] [speed]

real: states of Sentinel-1A's orbit file (TERRAFIX_DATA), four of them, flown for 10 and 100 min at
70 x 70 with Sun, Moon, tide and radiation pressure, against the later states of the file.
brahe: 24 hours of each force and of all, against brahe (installed with the tests).
kepler: two bodies for ten days at 100 Hz.
speed: kernels compiled, and 100 members of TC-1 under a true field of 20 x 20, against J2.

The surroundings are computed here, by ERFA from the tables of astropy-iers-data.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.engine.run import simulate
from terrafix.cosim.files.readers import read_system
from terrafix.cosim.system.system import System
from terrafix.components.truth.satellite_orbit import SatelliteOrbit
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.quaternion import quaternion_from_matrix_array
from terrafix.models.motion.ephemeris import read_eof
from terrafix.models.motion.gravity_field import SHIPPED, shipped_field
from terrafix.models.motion.kepler import KeplerianElements
from terrafix.models.motion.satellite import Forces, satellite_model

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("TERRAFIX_DATA", ROOT.parent / "shared" / "data"))
ORBIT = DATA / "sentinel1" / (
    "S1A_OPER_AUX_RESORB_OPOD_20220918T093241_V20220918T053155_20220918T084925.EOF"
)
STARTS = (0.0, 1800.0, 3600.0, 5400.0)
"""Of the flights, after the first state of the file [s]."""
SENTINEL = 1.3 * 25.0 / 2157.0
"""Coefficient of radiation pressure times area over mass of Sentinel-1, roughly [m^2/kg]."""
PERIOD = 10.0
"""Of the surroundings [s]."""
