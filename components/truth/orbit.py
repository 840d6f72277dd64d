"""Orbit truth: a satellite integrated in the inertial frame."""

from __future__ import annotations

from terrafix.components.fields import XYZ
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.parameters import Choice, Flag, Parameter
from terrafix.cosim.declare.ports import Output
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.gravity import GRAVITY_MODELS
from terrafix.models.motion.orbit import orbit_model


class OrbitTruth(SymbolicComponent):
    """Satellite under gravity and drag, integrated by fourth-order Runge-Kutta steps."""

    default_rate = Rate(hz=100)

    gravity = Choice(GRAVITY_MODELS, "j2", doc="gravity field")
    drag = Flag(False, doc="add drag of an atmosphere of the given density")
    r0_i = Parameter(shape=(3,), unit="m", doc="position at t = 0, inertial")
    v0_i = Parameter(shape=(3,), unit="m/s", doc="velocity at t = 0, inertial")
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

    def build_model(self) -> Model:
        """Build the model for the chosen gravity and drag."""
        return orbit_model(self.gravity, drag=self.drag)
