"""The Earth that an aircraft's radar, its images and its map have in common."""

from __future__ import annotations

from typing import Any

import numpy as np

from terrafix.components.shared import require_earth, shared_setting
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.models.geometry.ground import EllipsoidGround, FlatGround, Ground, seen_on_terrain
from terrafix.models.maps.charts import ORIGIN
from terrafix.models.maps.dem import Dem
from terrafix.models.motion.strapdown import EARTHS
from terrafix.models.radar.compensation import StraightLine

_POLE = np.pi / 2


class OnGround(Component):
    """Base of components that need to know on what Earth tracks and maps lie."""

    earth = Choice(EARTHS, "wgs84", doc="that of the motion")
    latitude0 = Parameter(0.0, unit="rad", minimum=-_POLE, maximum=_POLE, doc="origin (flat)")
    longitude0 = Parameter(
        0.0, unit="rad", minimum=-2 * np.pi, maximum=2 * np.pi, doc="origin (flat)"
    )

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect: an origin has on a flat Earth alone."""
        return super().takes(name) and (name not in ORIGIN or self.setting("earth") == "flat")

    def _require_earth(self, r_e: FloatArray) -> None:
        """Raise ConfigurationError if positions (n_members, 3) [m] are of the other Earth."""
        require_earth(self, self.setting("earth"), r_e)

    @property
    def _ground(self) -> Ground:
        if self.setting("earth") == "flat":
            return FlatGround(*(float(shared_setting(self, name)) for name in ORIGIN))
        return EllipsoidGround()


def height_in_swath(
    ground: Ground, line: StraightLine, distance: float, dem: Dem, side: int
) -> float:
    """Height of the terrain [m] abeam of a line's middle, at a slant range [m]."""
    p: Any = seen_on_terrain(ground, line.r, line.v, distance, 0.0, dem.at, side)
    return float(ground.geodetic(p)[2])
