"""Orbit truth in the real world: a satellite integrated in Earth-fixed axes, forces of choice."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from terrafix.components.fields import AIR, ENVIRONMENT, START
from terrafix.components.truth.orbit import OrbitTruth
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, nearest
from terrafix.cosim.declare.parameters import (
    Choice,
    Count,
    Flag,
    OptionalFilePath,
    Parameter,
    Table,
)
from terrafix.cosim.declare.ports import BundleInput, MessageInput, Port
from terrafix.cosim.kernels.symbolic import SymbolicComponent
from terrafix.models.core.model import Model
from terrafix.models.geometry.earth import EARTH
from terrafix.models.motion.forces import WINDS
from terrafix.models.motion.gravity import GRAVITY_MODELS
from terrafix.models.motion.gravity_field import GravityField, chosen_field
from terrafix.models.motion.maneuvers import Maneuver
from terrafix.models.motion.orbit import below_surface
from terrafix.models.motion.satellite import DRAGS, Forces, satellite_model

_NEAR = 1.001
"""Where an orbit that is not finite a step later has come to the surface, in radii."""

_OF_MANEUVERS = {
    "start": Parameter(unit="s", minimum=0.0),
    "duration": Parameter(0.0, unit="s", minimum=0.0),
    "delta_v": Parameter(shape=(3,), unit="m/s", frame="rtn"),
}


class SatelliteOrbit(SymbolicComponent):
    """Satellite under gravity of any degree, Sun, Moon, tide, radiation, drag and maneuvers.

    Integrated in Earth-fixed axes about the rotation vector that the surroundings tell, or about
    `pole`. A step evaluates the field once. A member that comes to the surface of the Earth fails.
    """

    default_rate = Rate(hz=100)

    gravity = Choice(
        (*GRAVITY_MODELS, "harmonics"), "harmonics", doc="gravity field: harmonics of a file"
    )
    degree = Count(20, minimum=2, doc="and order of the harmonics")
    gravity_file = OptionalFilePath(doc="field (.gfc) in place of EGM2008 to degree 70")
    surrounded = Flag(False, doc="whether surroundings are connected: an environment")
    sun = Flag(False, doc="pull of the Sun")
    moon = Flag(False, doc="pull of the Moon")
    tide = Flag(False, doc="tide of the solid Earth")
    radiation = Flag(False, doc="pressure of sunlight, with shadow")
    drag = Choice(DRAGS, "none", doc="where the density of the air comes from")
    wind = Choice(WINDS, "corotating", doc="how the air moves")
    start_from = Choice(
        ("message", "parameters"), "message", doc="a component's `start`, or r0_e and v0_e"
    )
    maneuvers = Table(
        doc="by name: { start, duration (0: impulse), delta_v: radial, transverse, normal }"
    )
    r0_e = Parameter(0.0, shape=(3,), unit="m", frame="e", doc="position at t = 0")
    v0_e = Parameter(0.0, shape=(3,), unit="m/s", frame="e", doc="velocity at t = 0")
    mu = Parameter(EARTH.mu, unit="m^3/s^2", positive=True, doc="gravitational parameter")
    radius = Parameter(EARTH.radius, unit="m", positive=True, doc="equatorial radius")
    j2 = Parameter(EARTH.j2, doc="second zonal coefficient")
    rotation_rate = Parameter(EARTH.rotation_rate, unit="rad/s", doc="Earth rotation")
    pole = Parameter(0.0, shape=(2,), unit="rad", doc="polar motion x, y")
    earth_angle0 = Parameter(0.0, unit="rad", doc="inertial to Earth-fixed x axis at t = 0")
    radiation_coefficient = Parameter(
        0.0,
        unit="m^2/kg",
        minimum=0.0,
        doc="coefficient of radiation pressure times area over mass",
    )
    ballistic_coefficient = Parameter(
        0.0, unit="m^2/kg", minimum=0.0, doc="drag coefficient times area over mass"
    )
    density = Parameter(0.0, unit="kg/m^3", minimum=0.0, doc="at density_height (exponential)")
    density_height = Parameter(700e3, unit="m", doc="above the ellipsoid (exponential)")
    scale_height = Parameter(90e3, unit="m", positive=True, doc="in which air thins by e")

    start = MessageInput(fields=START, needed_at_start=True, doc="where it is at t = 0")
    surroundings = BundleInput(ENVIRONMENT, doc="rotation, Sun and Moon of an environment")
    atmosphere = BundleInput(AIR, at="start", doc="density of an atmosphere")

    r_i = OrbitTruth.r_i
    v_i = OrbitTruth.v_i
    r_e = OrbitTruth.r_e
    v_e = OrbitTruth.v_e
    delta_v_e = OrbitTruth.delta_v_e

    def prepare(self) -> None:
        """Keep the inputs that are read, as the choices are."""
        read = {
            "start": self.setting("start_from") == "message",
            "surroundings": self.setting("surrounded"),
            "atmosphere": self.setting("drag") == "atmosphere",
        }
        self.ports = {
            name: port
            for name, port in self.declarations.items()
            if isinstance(port, Port) and read.get(name, True)
        }

    def takes(self, name: str) -> bool:
        """Whether a parameter has any effect, as the choices are now."""
        if name in ("degree", "gravity_file"):
            return bool(self.setting("gravity") == "harmonics")
        if name == "wind":
            return bool(self.setting("drag") != "none")
        return super().takes(name)

    def validate(self) -> None:
        """Look whether it starts outside the Earth, and what its maneuvers are."""
        self._maneuvers()
        super().validate()
        if self.setting("start_from") == "parameters" and below_surface(
            self.setting("r0_e"), EARTH.radius
        ):
            raise ConfigurationError(
                f"'{self.name}.r0_e' lies inside the Earth: "
                f"{np.linalg.norm(self.setting('r0_e')):.6g} m from its center\n"
                f'  say where it starts: {self.name}.r0_e = "[7070, 0, 0] km"'
            )

    def validate_epoch(self, epoch: str | None) -> None:
        """Refuse a date without surroundings: r_i and v_i are then of axes that have none."""
        if epoch is not None and not self.setting("surrounded"):
            raise ConfigurationError(
                f"'{self.name}' puts out 'r_i' and 'v_i' in axes from which the Earth turns "
                f"uniformly, in a system with the epoch '{epoch}': taken for GCRF they lie "
                "kilometers off\n"
                f"  set {self.name}.surrounded = true and connect a component of type environment; "
                "or leave the epoch out"
            )

    def validate_duration(self, duration: float) -> None:
        """Look whether the maneuvers lie within the run."""
        for name, each in self._maneuvers().items():
            if each.start + each.duration > duration:
                raise ConfigurationError(
                    f"maneuver '{name}' of '{self.name}' ends at "
                    f"{each.start + each.duration:g} s, outside the run of {duration:g} s\n"
                    "  fly longer (--duration), or take it out"
                )

    def fail(self, mask: ArrayLike, reason: str) -> None:
        """Exclude members; where a satellite has come to the Earth, that is the reason."""
        mask = np.asarray(mask, np.bool_)
        if self.step_index:
            r = self.state_arrays["r_e"] + self.state_arrays["v_e"] * self._dt[0]
            with np.errstate(over="ignore", invalid="ignore"):
                down = mask & below_surface(r.T, EARTH.radius * _NEAR)
            super().fail(down, "the orbit is inside the Earth")
            mask = mask & ~down
        super().fail(mask, reason)

    def build_model(self) -> Model:
        """Build the model for the chosen forces."""
        forces = Forces(
            gravity=self._gravity(),
            sun=self.sun,
            moon=self.moon,
            tide=self.tide,
            radiation=self.radiation,
            drag=self.drag,
            wind=self.wind,
            maneuvers=tuple(self._maneuvers().values()),
        )
        return satellite_model(
            forces, surrounded=self.surrounded, told=self.start_from == "message"
        )

    def _gravity(self) -> str | GravityField:
        if self.gravity != "harmonics":
            return str(self.gravity)
        return chosen_field(self.gravity_file, self.degree)

    def _maneuvers(self) -> dict[str, Maneuver]:
        found = {}
        for name, table in self.setting("maneuvers").items():
            where = f"'{self.name}.maneuvers.{name}'"
            if not isinstance(table, dict):
                raise ConfigurationError(
                    f"{where} is {table!r}, not a maneuver\n"
                    '  write { start = "100 s", duration = "20 s", delta_v = "[0, 0.1, 0] m/s" }'
                )
            for key in table:
                if key not in _OF_MANEUVERS:
                    raise ConfigurationError(
                        f"{where} has no '{key}'\n  {nearest(key, _OF_MANEUVERS)}"
                    )
            missing = [k for k, p in _OF_MANEUVERS.items() if p.required and k not in table]
            if missing:
                raise ConfigurationError(f"{where} does not say its {missing[0]}")
            values = {
                key: setting.read(table.get(key, setting.default), where=f"{where} {key}")
                for key, setting in _OF_MANEUVERS.items()
            }
            x, y, z = (float(v) for v in values["delta_v"])
            found[name] = Maneuver(float(values["start"]), float(values["duration"]), (x, y, z))
        return found
