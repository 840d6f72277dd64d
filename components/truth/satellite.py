"""A satellite that stares at a place on the ground, near its nominal orbit."""

from __future__ import annotations

from math import pi

import numpy as np

from terrafix.components.fields import VIEW, XYZ
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import Output
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.elements import ELEMENTS, check_orbit
from terrafix.models.motion.kepler import KeplerianElements
from terrafix.models.sensors.staring import (
    GEOMETRIES,
    NADIR,
    NORTH_EAST,
    ever_in_view,
    staring_satellite_model,
)


class StaringSatellite(SymbolicComponent):
    """Where a satellite is, where it should be, and where its target lies in the frame.

    It flies the nominal orbit of its elements but for errors of its start and white acceleration,
    and points its camera as if it flew the nominal one; pitch and roll wander.
    """

    default_rate = Rate("1")

    geometry = Choice(
        GEOMETRIES,
        "wgs84",
        doc="sphere, wgs84: aimed at the nominal nadir; stars: at a place, pointed by the stars",
    )
    semi_major_axis = Parameter(unit="m", positive=True, doc="of the nominal orbit")
    eccentricity = Parameter(minimum=0.0, maximum=0.999, doc="of the nominal orbit")
    inclination = Parameter(unit="rad", doc="of the nominal orbit")
    node = Parameter(unit="rad", doc="right ascension of the ascending node")
    argument_of_perigee = Parameter(unit="rad", doc="from the ascending node")
    true_anomaly = Parameter(pi, unit="rad", doc="from the perigee, at t = 0")
    mu = Parameter(EARTH.mu, unit="m^3/s^2", positive=True, doc="gravitational parameter")
    radius = Parameter(EARTH.radius, unit="m", positive=True, doc="equatorial, or of the sphere")
    j2 = Parameter(EARTH.j2, doc="second zonal coefficient; 0: two bodies")
    position_sigma = Parameter(
        0.0, shape=(3,), unit="m", minimum=0.0, doc="of the true position at t = 0"
    )
    velocity_sigma = Parameter(
        0.0, shape=(3,), unit="m/s", minimum=0.0, doc="of the true velocity at t = 0"
    )
    accel_psd = Parameter(0.0, unit="m^2/s^3", minimum=0.0, doc="of white acceleration")
    attitude_sigma = Parameter(
        0.0, unit="rad", minimum=0.0, doc="of pitch and of roll, at all times"
    )
    attitude_time = Parameter(600.0, unit="s", positive=True, doc="that they are correlated over")
    pixel = Parameter(100.0, unit="m", positive=True, doc="its size on the ground (nadir)")
    pixel_angle = Parameter(1e-4, unit="rad", positive=True, doc="that a pixel sees (stars)")
    latitude = Parameter(0.0, unit="rad", doc="of the place (stars)")
    longitude = Parameter(0.0, unit="rad", doc="of the place (stars)")
    earth_angle0 = Parameter(0.0, unit="rad", doc="inertial to Earth-fixed x axis at t = 0 (stars)")
    rotation_rate = Parameter(EARTH.rotation_rate, unit="rad/s", doc="Earth rotation (stars)")

    r = Output((3,), unit="m", frame="i", labels=XYZ, doc="true position")
    v = Output((3,), unit="m/s", frame="i", labels=XYZ, doc="true velocity")
    pitch = Output((1,), unit="rad", doc="true error of pointing to the north of the frame")
    roll = Output((1,), unit="rad", doc="true error of pointing to its east")
    target = Output((2,), unit="px", labels=NORTH_EAST, doc="true place of the target in the frame")
    view = Output(**VIEW, doc="true scale and turn of the frame")
    r_nominal = Output((3,), unit="m", frame="i", labels=XYZ, doc="position that it should have")
    v_nominal = Output((3,), unit="m/s", frame="i", labels=XYZ, doc="velocity, likewise")
    aim = Output((3,), unit="m", frame="i", labels=XYZ, doc="point that the camera is aimed at")
    nominal_view = Output(**VIEW, doc="scale and turn of the frame, from the nominal position")
    q_be = Output((4,), frame="b", doc="turn off the commanded attitude: what a star tracker sees")
    delta_theta_b = Output((3,), unit="rad", frame="b", labels=XYZ, doc="of it, in the last step")
    delta_v_b = Output((3,), unit="m/s", frame="b", labels=XYZ, doc="that is felt: none")
    off_nadir = Output(unit="rad", doc="of the nominal line of sight; pi below the horizon")

    def validate(self) -> None:
        """Look whether the orbit stays above the ground, and whether its place is ever in view."""
        super().validate()
        elements = KeplerianElements(*(float(self.setting(name)) for name in ELEMENTS))
        try:
            check_orbit(elements, float(self.setting("radius")))
        except ValueError as error:
            raise ConfigurationError(f"'{self.name}': {error}") from error

    def validate_duration(self, duration: float) -> None:
        """Look whether its place is above the horizon at any time."""
        if self.geometry in NADIR:
            return
        model = self.build_model()
        given = {name: self.setting(name) for name in model.parameters}
        if not ever_in_view(model, given, duration):
            latitude, longitude = (np.degrees(float(given[n])) for n in ("latitude", "longitude"))
            raise ConfigurationError(
                f"the target of '{self.name}', latitude {latitude:.3f}, longitude {longitude:.3f} "
                f"deg, is never in view: it is below the horizon for all of {duration:g} s\n"
                "  choose another node or true_anomaly, or the angle of the Earth at t = 0"
            )

    def build_model(self) -> Model:
        """Build the model for the chosen geometry."""
        return staring_satellite_model(self.geometry)
