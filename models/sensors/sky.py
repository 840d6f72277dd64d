r"""Sun, Moon and stars as a satellite sees them, between publications of what surrounds it.

What is published holds for an instant; :math:`s` seconds later, with the Earth's rotation
:math:`\omega` and the inertial velocity :math:`u` of a body, both in Earth-fixed axes,

.. math::
    C = e^{-[\omega s \times]}, \qquad
    r_{sun}(s) = C\,(r_{sun} + u s), \qquad
    q_{ei}(s) = q(\omega s) \otimes q_{ei}.

The Earth is a sphere of its equatorial radius where it hides something or is looked at: its limb
lies :math:`\arcsin(R / r)` off its center.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.quaternion import from_rotation_vector, product, rotation_matrix

FIELDS = {
    "time": 1,
    "omega_e": 3,
    "q_ei": 4,
    "sun_e": 3,
    "sun_rate_e": 3,
    "moon_e": 3,
    "moon_rate_e": 3,
}
"""Sizes of what is published, by name."""


class Sky:
    """Where things in the sky are at a time.

    Parameters
    ----------
    time : SX
        [s]
    """

    def __init__(self, time: Any) -> None:
        self.symbols = {name: ca.SX.sym(name, size) for name, size in FIELDS.items()}
        self._since = time - self.symbols["time"]
        self._turn = from_rotation_vector(self._since * self.symbols["omega_e"])

    def of(self, body: str) -> Any:
        """Position (3,) [m] of the "sun" or "moon" from the Earth's center, Earth-fixed."""
        there, rate = self.symbols[f"{body}_e"], self.symbols[f"{body}_rate_e"]
        return ca.mtimes(rotation_matrix(self._turn), there + self._since * rate)

    @property
    def q_ei(self) -> Any:
        """Inertial to Earth-fixed axes, (4,)."""
        return product(self._turn, self.symbols["q_ei"])

    def read(self, *names: str) -> dict[str, Any]:
        """Inputs of a model that reads some of what is published, by name of field."""
        return {f"surroundings.{n}": self.symbols[n] for n in ("time", "omega_e", *names)}


def unit(vector: Any) -> Any:
    """Direction of a vector (3,)."""
    return vector / ca.sqrt(ca.dot(vector, vector))


def limb_angle(r_e: Any) -> Any:
    """Angle [rad] of the Earth's limb off its center, seen from a position (3,) [m]."""
    return ca.asin(ca.fmin(EARTH.radius / ca.sqrt(ca.dot(r_e, r_e)), 1.0))


def angle_between(a: Any, b: Any) -> Any:
    """Angle [rad] between unit vectors (3,); its derivative exists but at 0 and half a turn."""
    cross = ca.cross(a, b)
    return ca.atan2(ca.sqrt(ca.dot(cross, cross)), ca.dot(a, b))


def hidden(direction: Any, r_e: Any) -> Any:
    """1 where the Earth hides a far point in a direction (3,) from a position (3,), else 0."""
    return angle_between(direction, -unit(r_e)) < limb_angle(r_e)
