"""Orbit truth: a satellite integrated in the inertial frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from terrafix.components.fields import XYZ
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import Choice, Flag, Parameter
from terrafix.cosim.declare.ports import Output
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.gravity import GRAVITY_MODELS
from terrafix.models.motion.orbit import below_surface, orbit_model

_NEAR = 1.001
"""Where an orbit that is not finite a step later has come to the surface, in radii."""


class OrbitTruth(SymbolicComponent):
    """Satellite under gravity and drag, integrated by fourth-order Runge-Kutta steps.

    Its inertial frame is one from which the Earth turns uniformly about its z axis, of no date, and
    whose x axis is `earth_angle0` west of the Earth-fixed one at t = 0; a system with an epoch has
    none such. A member that comes to the surface of the Earth fails.
    """

    default_rate = Rate(hz=100)

    gravity = Choice(GRAVITY_MODELS, "j2", doc="gravity field")
    drag = Flag(False, doc="add drag of an atmosphere of the given density")
    r0_i = Parameter(shape=(3,), unit="m", frame="i", doc="position at t = 0, inertial")
    v0_i = Parameter(shape=(3,), unit="m/s", frame="i", doc="velocity at t = 0, inertial")
    mu = Parameter(EARTH.mu, unit="m^3/s^2", positive=True, doc="gravitational parameter")
    radius = Parameter(EARTH.radius, unit="m", positive=True, doc="equatorial radius")
    j2 = Parameter(EARTH.j2, doc="second zonal coefficient")
    rotation_rate = Parameter(EARTH.rotation_rate, unit="rad/s", doc="Earth rotation")
    earth_angle0 = Parameter(0.0, unit="rad", doc="inertial to Earth-fixed x axis at t = 0")
    density = Parameter(0.0, unit="kg/m^3", minimum=0.0, doc="of the atmosphere (drag)")
    ballistic_coefficient = Parameter(
        0.0, unit="m^2/kg", minimum=0.0, doc="drag coefficient times area over mass (drag)"
    )

    r_i = Output((3,), unit="m", frame="i", labels=XYZ, doc="position, inertial")
    v_i = Output((3,), unit="m/s", frame="i", labels=XYZ, doc="velocity, inertial")
    r_e = Output((3,), unit="m", frame="e", labels=XYZ, doc="position, Earth-fixed")
    v_e = Output((3,), unit="m/s", frame="e", labels=XYZ, doc="velocity relative to the Earth")
    delta_v_e = Output(
        (3,), unit="m/s", frame="e", labels=XYZ, doc="non-gravitational increment of the last step"
    )

    def validate(self) -> None:
        """Look whether it starts outside the Earth."""
        super().validate()
        r0_i, radius = self.setting("r0_i"), float(self.setting("radius"))
        if below_surface(r0_i, radius):
            raise ConfigurationError(
                f"'{self.name}.r0_i' lies inside the Earth: {np.linalg.norm(r0_i):.6g} m from its "
                f"center, of a radius of {radius:.6g} m\n"
                "  a bare number is in meters; write a unit with it: "
                f'{self.name}.r0_i = "[7070, 0, 0] km"'
            )

    def validate_epoch(self, epoch: str | None) -> None:
        """Refuse a date: the frame of r0_i and v0_i has none."""
        if epoch is not None:
            raise ConfigurationError(
                f"'{self.name}.r0_i' and 'v0_i' are of no frame that has a date, in a system with "
                f"the epoch '{epoch}': taken for GCRF or TEME they lie up to 36 km off\n"
                "  take a component of type satellite and one of type orbit_start, which is told "
                "the frame; or leave the epoch out"
            )

    def fail(self, mask: ArrayLike, reason: str) -> None:
        """Exclude members; where an orbit has come to the Earth, that is the reason."""
        mask = np.asarray(mask, np.bool_)
        # results that are not finite are not kept: those of the step before lie above
        if self.step_index:
            r = self.state_arrays["r_i"] + self.state_arrays["v_i"] * self._dt[0]
        else:
            r = self.r0_i
        with np.errstate(over="ignore"):
            down = mask & below_surface(r.T, self.radius * _NEAR)
        super().fail(down, "the orbit is inside the Earth")
        super().fail(mask & ~down, reason)

    def build_model(self) -> Model:
        """Build the model for the chosen gravity and drag."""
        return orbit_model(self.gravity, drag=self.drag)
