"""Constants of the Earth: gravity, rotation and reference ellipsoid."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Earth:
    """A rotating, oblate Earth.

    Parameters
    ----------
    mu : float
        Gravitational parameter [m^3/s^2].
    radius : float
        Equatorial radius, of the gravity model and of the ellipsoid [m].
    j2 : float
        Second zonal coefficient, unnormalized [-].
    rotation_rate : float
        Rotation about the polar axis relative to inertial space [rad/s].
    flattening : float
        Flattening of the reference ellipsoid [-].
    """

    mu: float
    radius: float
    j2: float
    rotation_rate: float
    flattening: float

    @property
    def polar_radius(self) -> float:
        """Semi-minor axis of the reference ellipsoid [m]."""
        return self.radius * (1 - self.flattening)


EARTH = Earth(
    mu=3.986004418e14,
    radius=6378137.0,
    j2=1.08262668e-3,
    rotation_rate=7.2921151467e-5,
    flattening=1 / 298.257223563,
)
"""WGS-84 ellipsoid, rotation and gravitational parameter; J2 of EGM."""
