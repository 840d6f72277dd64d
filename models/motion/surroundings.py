r"""What surrounds a satellite, as published now and then, and turned to any time nearby.

The rotation vector of the Earth-fixed axes :math:`\omega`, their orientation, and the Sun and the
Moon hold for a time of publication :math:`t_0`. At :math:`t = t_0 + s` the axes have turned by
:math:`\omega s`, and the bodies have moved on straight lines in inertial space,

.. math::
    \odot(t) = e^{-[\omega \times] s} \left( \odot_0 + s\, \dot\odot_0 \right), \qquad
    q_{ei}(t) = \delta q(\omega s) \otimes q_{ei}.

Left out is the curvature of the path of the Moon: 0.14 m after 10 s, 5 m after a minute.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from terrafix.models.geometry.quaternion import from_rotation_vector, product, rotation_matrix

SIZES = {
    "time": 1,
    "omega_e": 3,
    "q_ei": 4,
    "sun_e": 3,
    "sun_rate_e": 3,
    "moon_e": 3,
    "moon_rate_e": 3,
}
"""What is published, by name, and its number of elements."""


@dataclass(frozen=True)
class Surroundings:
    """What surrounds a satellite at one time, in Earth-fixed axes.

    Parameters
    ----------
    omega_e : SX, shape (3,)
        Rotation vector of the Earth-fixed axes [rad/s].
    sun_e, moon_e : SX, shape (3,)
        From the center of the Earth [m].
    """

    omega_e: Any
    sun_e: Any
    moon_e: Any


def published_symbols() -> dict[str, Any]:
    """A symbol for each of `SIZES`."""
    return {name: ca.SX.sym(name, size) for name, size in SIZES.items()}


def published_inputs(published: dict[str, Any], *names: str) -> dict[str, Any]:
    """Inputs ``surroundings.*`` of a model that reads what is published, or some of it by name."""
    return {f"surroundings.{name}": published[name] for name in names or SIZES}


def turned(axis: Any, angle: Any, vector: Any) -> Any:
    r"""Components (3,) in axes turned by `angle` about a unit axis: :math:`e^{-[n \times] a} x`."""
    c, s = ca.cos(angle), ca.sin(angle)
    return c * vector - s * ca.cross(axis, vector) + (1 - c) * ca.dot(axis, vector) * axis


def surroundings_at(published: dict[str, Any], time: Any) -> Surroundings:
    """What was published, turned to a time [s]; `published` has the names of `SIZES`."""
    since = time - published["time"]
    omega = published["omega_e"]
    turn = rotation_matrix(from_rotation_vector(omega * since))
    sun, moon = (
        ca.mtimes(turn, published[f"{body}_e"] + since * published[f"{body}_rate_e"])
        for body in ("sun", "moon")
    )
    return Surroundings(omega, sun, moon)


def orientation_at(published: dict[str, Any], time: Any) -> Any:
    """Quaternion (4,) from inertial to Earth-fixed axes at a time [s]."""
    turn = from_rotation_vector(published["omega_e"] * (time - published["time"]))
    return product(turn, published["q_ei"])
