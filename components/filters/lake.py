"""The filter of a satellite that knows lakes, in two sizes: with what it considers, or without."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.components.fields import CENTERS, CORNERS, OWNER, STARTS
from terrafix.components.filters.ensembles import EnsembleCorrect
from terrafix.components.filters.family import FilterPredict
from terrafix.components.sensors.optics import Optics, say_islands_left_out
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import SharedInput
from terrafix.models.filters.lake import CONSIDERED, ORBIT, lake_observation, orbit_process
from terrafix.models.filters.shore import shore_observation
from terrafix.models.geometry.earth import EARTH
from terrafix.models.sensors.camera import above_horizon, ground_in_view


class OrbitPredict(FilterPredict):
    """An orbit between two looks at a lake: position and velocity, inertial."""

    default_rate = Rate("1/30")
    error_state, process, told = ORBIT, orbit_process(), ("r", "v")

    mu = Parameter(EARTH.mu, unit="m^3/s^2", positive=True, doc="gravitational parameter")
    radius = Parameter(EARTH.radius, unit="m", positive=True, doc="equatorial radius")
    j2 = Parameter(EARTH.j2, doc="second zonal coefficient; 0: two bodies")
    accel_psd = Parameter(0.0, unit="m^2/s^3", minimum=0.0, doc="process noise of velocity")


class ConsideredOrbitPredict(OrbitPredict):
    """The same beside errors of camera and catalog that count, and are not estimated."""

    error_state = CONSIDERED

    attitude_sigma0 = Parameter(
        0.0, unit="rad", minimum=0.0, doc="of the camera's misalignment, per axis"
    )
    scale_sigma0 = Parameter(0.0, minimum=0.0, doc="of the scale of outlines in the catalog")
    outline_sigma0 = Parameter(
        0.0, unit="m", minimum=0.0, doc="of the catalog's vertices, each by itself, per axis"
    )


class LakeCorrect(Optics, EnsembleCorrect):
    """Correction of an orbit by the moments of a lake's outline in the frame of a camera."""

    default_rate = Rate("1/30")
    error_state, observation = ORBIT, lake_observation(ORBIT)

    vertices = SharedInput(**CORNERS, doc="of the rings of all lakes")
    starts = SharedInput(**STARTS, doc="of rings in the vertices")
    center = SharedInput(**CENTERS, doc="of each lake")
    owner = SharedInput(**OWNER, optional=True, doc="lake of each ring; where islands are to count")
    prior: Any

    def _initialize_impl(self) -> None:
        self.check_pointing()
        say_islands_left_out(self.name, self.vertices, self.starts, self.center, self.owner)
        super()._initialize_impl()

    def _given(self, who: NDArray[np.int64], n_points: int) -> dict[str, Any]:
        own = {n: np.repeat(v, n_points, axis=0) for n, v in self.looking(who).items()}
        return super()._given(who, n_points) | own

    def _ask(self) -> None:
        """Predict, but for members by whose estimate the lake that was seen cannot be."""
        who = np.flatnonzero(self.fix.fresh & self.environment.active)
        if not len(who):
            return
        given = self._given(who, 1)
        C, o = ground_in_view({"r": self.prior.r[who], "v": self.prior.v[who]}, given)[:2]
        lake = self.fix.lake[who, 0].astype(np.int64)
        lost = who[~above_horizon(C, o, self.center)[np.arange(len(who)), lake]]
        self.fail(
            np.isin(np.arange(self.n_members), lost),
            "the lake that the camera sees is below the horizon of the estimate; start from a "
            "better one, and see that camera and filter share catalog and earth_angle0",
        )
        super()._ask()


class ShoreCorrect(LakeCorrect):
    """Correction of an orbit by the shore of a lake of which a part is in the frame."""

    error_state, observation = ORBIT, shore_observation(ORBIT)


class ConsideredLakeCorrect(LakeCorrect):
    """The same with errors of camera and catalog that count, and are not estimated."""

    error_state, observation = CONSIDERED, lake_observation(CONSIDERED)
