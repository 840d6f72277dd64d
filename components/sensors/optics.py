"""What a camera and a filter that knows it have in common: lens, attitude, the Earth's turning."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Input
from terrafix.models.geometry.earth import EARTH
from terrafix.models.sensors.camera import BROWN, CAMERA, POINTINGS

_log = logging.getLogger(__name__)

DISTORTIONS = ("none", "brown")
"""What the lens does to the picture."""


class Optics(Component):
    """A camera's lens, and what it looks at: base of those that show or predict its picture."""

    focal = Parameter(unit="px", positive=True, doc="focal length: width / (2 tan(angle / 2))")
    principal = Parameter([160.0, 128.0], shape=(2,), unit="px", doc="principal point")
    distortion = Choice(DISTORTIONS, "none", doc="of the lens: none, or Brown's polynomial")
    lens = Parameter(
        [0.0] * len(BROWN), shape=(len(BROWN),), doc="k1, k2, k3 (radial), p1, p2 (tangential)"
    )
    pointing = Choice(
        POINTINGS,
        "geocentric",
        doc="down to the center of the Earth or the ellipsoid, flight upward; given: as q_be is",
    )
    mounting = Parameter(
        [0.0] * 3, shape=(3,), unit="rad", doc="roll, pitch, yaw of the camera against the body"
    )
    earth_angle0 = Parameter(0.0, unit="rad", doc="inertial to Earth-fixed x axis at t = 0")
    rotation_rate = Parameter(EARTH.rotation_rate, unit="rad/s", doc="Earth rotation")

    q_be = Input(
        (4,), unit="1", frame="b", optional=True, doc="attitude of the body, where it is given"
    )

    def takes(self, name: str) -> bool:
        """Whether a parameter has any effect: a lens where it distorts."""
        return super().takes(name) and (name != "lens" or self.setting("distortion") == "brown")

    def check_pointing(self) -> None:
        """Look whether an attitude is connected where one is read, and there alone."""
        connected, given = bool(self.q_be.any()), self.pointing == "given"
        if given and not connected:
            raise ConfigurationError(
                f"'{self.name}.pointing' is \"given\", and nothing is connected to "
                f"'{self.name}.q_be'\n  connect an attitude (lvlh_attitude, attitude_sensor), or "
                f"set {self.name}.pointing to geocentric or geodetic"
            )
        if connected and not given:
            raise ConfigurationError(
                f"'{self.name}.q_be' is connected, and {self.name}.pointing = \"{self.pointing}\" "
                f"does not read it\n  set {self.name}.pointing to given, or take the connection out"
            )

    def looking(self, rows: NDArray[np.int64]) -> dict[str, Any]:
        """What members' looks depend on besides their states, `CAMERA` and `POINTING`."""
        law = np.full((len(rows), 1), float(POINTINGS.index(self.pointing)))
        constants = {name: getattr(self, name)[rows] for name in CAMERA}
        return constants | {"pointing": law, "q_be": self.q_be[rows]}


def say_islands_left_out(
    name: str,
    vertices: FloatArray,
    starts: NDArray[np.int64],
    center: FloatArray,
    owner: NDArray[np.int64] | None,
) -> None:
    """Warn of islands of a catalog that a component does not count, with their area."""
    n_lakes, n_rings = len(center), len(starts) - 1
    if owner is not None or n_rings == n_lakes:
        return
    rings = (vertices[starts[k] : starts[k + 1]] for k in range(n_lakes, n_rings))
    area = sum(
        float(np.linalg.norm(np.cross(p - p[0], np.roll(p, -1, axis=0) - p[0]).sum(axis=0))) / 2
        for p in rings
    )
    _log.warning(
        "'%s' leaves out the %d islands of its catalog, %.3g km^2\n  connect the catalog's owner "
        "to camera and filter, or set its islands = false",
        *(name, n_rings - n_lakes, area / 1e6),
    )
