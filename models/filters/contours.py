r"""Terrain contour matching: the clearance over the ground against an elevation model.

A radar altimeter measures how far the ground is below,

.. math::
    z = h(r) - h_g(\varphi, \lambda), \qquad
    H = [\, -\partial_N h_g \;\; -\partial_E h_g \;\; -1 \,]\; C_{ne} ,

so that every measurement is a point of a profile, and slopes tell where it was flown [1]_. Slopes
are central differences over one step of the grid to either side. That holds while the error of the
estimate is small beside hills; `terrafix.models.maps.contours` finds it from further away.

References
----------
.. [1] L. D. Hostetler, R. D. Andreas, "Nonlinear Kalman filtering techniques for terrain-aided
       navigation", IEEE Trans. Automatic Control 28(3), 1983.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from terrafix.models.core.arrays import FloatArray
from terrafix.models.filters.ensembles import Arrays, EnsembleObservation
from terrafix.models.filters.error_state import ErrorState, vector
from terrafix.models.filters.measurement import Observation
from terrafix.models.maps.charts import ORIGIN, geodetic_of, level_axes_of, scales_of
from terrafix.models.maps.dem import Dem, dem_from
from terrafix.models.motion.strapdown import level_axes, rotation_rate

SHARED = ("height", "grid")
"""Arrays of an elevation model: heights, and where they lie."""


def clearance_observation(state: ErrorState, earth: str) -> EnsembleObservation:
    """The clearance over the ground of an elevation model; NaN where that is not known.

    Parameters
    ----------
    state : ErrorState
        With a block ``r_e``.
    earth : {"wgs84", "flat"}
        Of the flat one the parameters ``latitude0`` and ``longitude0`` [rad] tell the origin.
    """
    rotation_rate(earth)
    place = state.places["r_e"]

    def where(estimate: Arrays, told: Arrays) -> tuple[Dem, FloatArray, FloatArray, FloatArray]:
        origin = tuple(np.reshape(told[name], -1) for name in ORIGIN)
        dem = dem_from(told["height"], told["grid"])
        return dem, *geodetic_of(estimate["r_e"], earth, (origin[0], origin[1]))

    def predict(estimate: Arrays, told: Arrays) -> NDArray[Any]:
        dem, latitude, longitude, height = where(estimate, told)
        return np.asarray(height - dem.known_at(latitude, longitude))[:, None]

    def derivative(estimate: Arrays, told: Arrays) -> NDArray[Any]:
        dem, latitude, longitude, _ = where(estimate, told)
        north, east = scales_of(latitude if rotation_rate(earth) else told[ORIGIN[0]].reshape(-1))
        by_level = np.stack(
            [
                -_rise(dem, latitude, longitude, dem.latitude_step, 0.0) / north,
                -_rise(dem, latitude, longitude, 0.0, dem.longitude_step) / east,
                np.full(len(latitude), -1.0),
            ],
            axis=1,
        )
        H = np.zeros((len(latitude), 1, state.size))
        axes = level_axes_of(estimate["r_e"], earth)
        H[:, 0, place] = np.einsum("ki,kij->kj", by_level, axes)
        return H

    return EnsembleObservation(
        predict,
        {"clearance": "m"},
        derivative=derivative,
        shared=SHARED,
        parameters=dict.fromkeys(ORIGIN, 1),
    )


def _rise(
    dem: Dem, latitude: FloatArray, longitude: FloatArray, d_lat: float, d_lon: float
) -> FloatArray:
    """Rise per radian along a step of the grid to both sides."""
    ahead = dem.known_at(latitude + d_lat, longitude + d_lon)
    behind = dem.known_at(latitude - d_lat, longitude - d_lon)
    return np.asarray((ahead - behind) / (2 * (d_lat + d_lon)))


def place_observation(earth: str) -> Observation:
    """Position north and east of a place that the fix tells (``p_e``): of a matched profile.

    Parameters
    ----------
    earth : {"wgs84", "flat"}
    """
    rotation_rate(earth)
    return Observation(
        lambda x, given: ca.mtimes(level_axes(given["p_e"], earth), x["r_e"] - given["p_e"])[:2],
        {"north": "m", "east": "m"},
        fields=[vector("p_e", unit="m", frame="e")],
    )
