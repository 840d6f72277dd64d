r"""A satellite that flies as real ones do, in axes that turn with the Earth.

.. math::
    \dot r = v, \qquad
    \dot v = g_0(r) + a(r, v, t) - 2\, \omega \times v - \omega \times (\omega \times r),

about the rotation vector :math:`\omega` of the Earth-fixed axes, which is not along z: by polar
motion, and where the surroundings are known by precession and nutation too. :math:`g_0` is central
gravity and J2, :math:`a` everything else: higher harmonics, Sun, Moon, tide, radiation, drag.

A step is split [1]_: half a step under :math:`g_0` and the rotation, by the classical Runge-Kutta
method of order four; the velocity increment of :math:`a` over the whole step, taken in its middle;
the other half. It is symmetric, of order two in :math:`a` alone, and costs one evaluation of the
field, where a Runge-Kutta method of order four costs four.

Where :math:`\omega` is published anew it has changed by :math:`\Delta \omega`, and the velocity
relative to the Earth by :math:`-\Delta \omega \times r`: what continues is the velocity in inertial
space. (The acceleration :math:`-\dot \omega \times r` is 2e-9 m/s^2, by nutation.)

References
----------
.. [1] J. Wisdom and M. Holman, "Symplectic maps for the n-body problem", Astronomical Journal 102,
       1991; G. Strang, "On the construction and comparison of difference schemes", SIAM J. Numer.
       Anal. 5, 1968.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import nan
from typing import Any

import casadi as ca

from terrafix.models.core.model import Model, rk4
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.frames import rotate_about_pole
from terrafix.models.geometry.quaternion import rotation_matrix
from terrafix.models.motion.forces import (
    MOON_MU,
    SUN_MU,
    WINDS,
    air_drag_acceleration,
    density_near,
    exponential_density,
    radiation_pressure_acceleration,
    solid_tide_acceleration,
    third_body_acceleration,
)
from terrafix.models.motion.gravity import gravity_acceleration, j2_acceleration
from terrafix.models.motion.gravity_field import GravityField
from terrafix.models.motion.harmonics import harmonics_beyond_j2
from terrafix.models.motion.maneuvers import Maneuver, burned, radial_axes, thrust
from terrafix.models.motion.orbit import below_surface
from terrafix.models.motion.surroundings import (
    Surroundings,
    orientation_at,
    published_inputs,
    published_symbols,
    surroundings_at,
    turned,
)

DRAGS = ("none", "exponential", "atmosphere")
"""Where the density of the air comes from."""

AIR = {"r_e": 3, "log_density": 1, "gradient": 3}
"""What an atmosphere publishes, by name, and its number of elements."""


@dataclass(frozen=True)
class Forces:
    """Which forces there are.

    Parameters
    ----------
    gravity : {"two-body", "j2"} or GravityField
        The Earth's.
    sun, moon : bool
        Third bodies.
    tide : bool
        Of the solid Earth.
    radiation : bool
        Pressure of sunlight.
    drag : {"none", "exponential", "atmosphere"}
    wind : {"corotating", "none"}
    maneuvers : tuple of Maneuver

    Raises
    ------
    ValueError
        If a choice is not known, or a tide has no gravity field to go with.
    """

    gravity: str | GravityField = "j2"
    sun: bool = False
    moon: bool = False
    tide: bool = False
    radiation: bool = False
    drag: str = "none"
    wind: str = "corotating"
    maneuvers: tuple[Maneuver, ...] = ()

    def __post_init__(self) -> None:
        if self.drag not in DRAGS:
            raise ValueError(f"drag must be one of {DRAGS}, got '{self.drag}'")
        if self.wind not in WINDS:
            raise ValueError(f"wind must be one of {WINDS}, got '{self.wind}'")
        if isinstance(self.gravity, str):
            gravity_acceleration(self.gravity)
            if self.tide:
                raise ValueError(
                    "a tide changes the coefficients of a gravity field, and goes with "
                    'gravity = "harmonics"'
                )

    @property
    def field(self) -> GravityField | None:
        """The gravity field from a file, tide-free where a tide goes with it."""
        if isinstance(self.gravity, str):
            return None
        return self.gravity.without_permanent_tide() if self.tide else self.gravity

    @property
    def surrounded(self) -> bool:
        """Whether it needs to know where the Sun and the Moon are."""
        return self.sun or self.moon or self.tide or self.radiation

    @property
    def felt(self) -> bool:
        """Whether there is a force that an accelerometer feels."""
        return self.radiation or self.drag != "none" or bool(self.maneuvers)

    @property
    def split(self) -> bool:
        """Whether there is more than central gravity and J2."""
        return not isinstance(self.gravity, str) or self.surrounded or self.felt


def central_gravity(forces: Forces) -> tuple[Callable[[Any, Any], Any], tuple[str, ...]]:
    """Central gravity and J2 as a function of position and constants, and names of the latter.

    The constants of a field from a file are numbers.
    """
    field = forces.field
    if field is not None:
        mu, radius, j2 = field.mu, field.radius, field.j2
        return lambda r, _: j2_acceleration(r, mu, radius, j2), ()
    assert isinstance(forces.gravity, str)
    gravity = gravity_acceleration(forces.gravity)
    names = ("mu", "radius", "j2")
    return lambda r, given: gravity(r, *(given[name] for name in names)), names


def further_gravity(r: Any, forces: Forces, around: Surroundings) -> Any:
    """Gravity beyond the central term and J2, (3,) [m/s^2]: harmonics, Sun, Moon, tide.

    Parameters
    ----------
    r : SX, shape (3,)
        Position [m], Earth-fixed.
    forces : Forces
    around : Surroundings
        Where Sun and Moon are, if they are among the forces.
    """
    total = ca.SX.zeros(3)
    field = forces.field
    if field is not None:
        total += harmonics_beyond_j2(r, field)
    if forces.tide and field is not None:
        total += solid_tide_acceleration(r, around.sun_e, around.moon_e, field.mu, field.radius)
    if forces.sun:
        total += third_body_acceleration(r, around.sun_e, SUN_MU)
    if forces.moon:
        total += third_body_acceleration(r, around.moon_e, MOON_MU)
    return total


def felt_acceleration(
    r: Any, v: Any, omega: Any, forces: Forces, given: dict[str, Any], around: Surroundings | None
) -> Any:
    """What an accelerometer feels but for maneuvers, (3,) [m/s^2]: radiation and drag.

    Parameters
    ----------
    r, v : SX, shape (3,)
        Position [m] and velocity relative to the Earth [m/s], Earth-fixed.
    omega : SX, shape (3,)
        Rotation of the Earth [rad/s].
    forces : Forces
    given : dict of str to SX
        Parameters, and what the atmosphere publishes.
    around : Surroundings or None
        None where nothing needs them.
    """
    total = ca.SX.zeros(3)
    if forces.radiation and around is not None:
        total += radiation_pressure_acceleration(r, around.sun_e, given["radiation_coefficient"])
    if forces.drag == "none":
        return total
    if forces.drag == "exponential":
        air = ("density", "density_height", "scale_height")
        density = exponential_density(r, *(given[name] for name in air))
    else:
        known = ("r_e", "log_density", "gradient")
        density = density_near(r, *(given[f"atmosphere.{name}"] for name in known))
    return total + air_drag_acceleration(
        r, v, omega, density, given["ballistic_coefficient"], forces.wind
    )


def satellite_model(
    forces: Forces | None = None, *, surrounded: bool = False, told: bool = False
) -> Model:
    """Satellite in Earth-fixed axes under forces of choice.

    Parameters
    ----------
    forces : Forces, optional
        Central gravity and J2 unless said otherwise.
    surrounded : bool
        Whether the surroundings are published, inputs ``surroundings.*``. Otherwise the Earth turns
        uniformly about its pole, with the parameters ``rotation_rate`` [rad/s], ``pole`` (2,)
        [rad], its x and y as of the IERS, and ``earth_angle0`` [rad].
    told : bool
        Whether the start comes as a message, inputs ``start.r_e`` and ``start.v_e``; otherwise it
        is the parameters ``r0_e`` (3,) [m] and ``v0_e`` (3,) [m/s].

    Returns
    -------
    Model
        Outputs ``r_i``, ``v_i``, ``r_e``, ``v_e``, (3,) each, and ``delta_v_e`` (3,) [m/s], the
        non-gravitational velocity increment over the last step in the Earth-fixed axes at its end.
        Parameters besides: ``mu``, ``radius``, ``j2`` without a gravity field from a file;
        ``ballistic_coefficient`` [m^2/kg] with drag, and of exponential air ``density`` [kg/m^3],
        ``density_height``, ``scale_height`` [m]; ``radiation_coefficient`` [m^2/kg]. Inside the
        Earth ``r_e`` is not a number.

    Raises
    ------
    ValueError
        If a force needs the surroundings and there are none.
    """
    forces = forces or Forces()
    if forces.surrounded and not surrounded:
        raise ValueError("Sun, Moon, tide and radiation need the surroundings (surrounded = true)")
    gravity, constants = central_gravity(forces)
    r, v = ca.SX.sym("r_e", 3), ca.SX.sym("v_e", 3)
    dt, time = ca.SX.sym("dt"), ca.SX.sym("time")
    start = {name: ca.SX.sym(name, 3) for name in ("r0_e", "v0_e")}
    inputs = dict(zip(("start.r_e", "start.v_e"), start.values(), strict=True)) if told else {}
    parameters = {} if told else dict(start)
    parameters |= {name: ca.SX.sym(name) for name in constants}
    parameters |= {name: ca.SX.sym(name) for name in _parameters_of(forces)}
    published = published_symbols()
    turning = {"rotation_rate": ca.SX.sym("rate"), "pole": ca.SX.sym("pole", 2)}
    if surrounded:
        inputs |= published_inputs(published)
        omega = published["omega_e"]
    else:
        parameters |= {**turning, "earth_angle0": ca.SX.sym("earth_angle0")}
        pole = turning["pole"]
        omega = turning["rotation_rate"] * ca.vertcat(pole[0], -pole[1], 1)
    if forces.drag == "atmosphere":
        inputs |= {f"atmosphere.{name}": ca.SX.sym(name, size) for name, size in AIR.items()}
    given = {**parameters, **inputs}

    def around(t: Any) -> Surroundings | None:
        return surroundings_at(published, t) if forces.surrounded else None

    def freely(r: Any, v: Any) -> Any:
        turned_once = ca.cross(omega, r)
        return gravity(r, given) - 2 * ca.cross(omega, v) - ca.cross(omega, turned_once)

    def flown(r: Any, v: Any, h: Any) -> tuple[Any, Any]:
        end = rk4(lambda _, x: ca.vertcat(x[3:], freely(x[:3], x[3:])), ca.vertcat(r, v), h)
        return end[:3], end[3:]

    # the field is long: it is written once, and put in where it is needed
    sun, moon = ca.SX.sym("sun", 3), ca.SX.sym("moon", 3)
    pull = ca.Function(
        "pull", [r, sun, moon], [further_gravity(r, forces, Surroundings(omega, sun, moon))]
    )

    def pulled(r: Any, t: Any) -> Any:
        now = around(t)
        return pull(r, now.sun_e, now.moon_e) if now else pull(r, 0, 0)

    def rates(t: Any) -> dict[str, Any]:
        a = freely(r, v) + pulled(r, t)
        a += felt_acceleration(r, v, omega, forces, given, around(t))
        if forces.maneuvers:
            axes = radial_axes(r, v + ca.cross(omega, r))
            a += ca.mtimes(axes, thrust(forces.maneuvers, t))
        return {"r_e": v, "v_e": a}

    states = {"r_e": r, "v_e": v}
    initial = dict(zip(states, start.values(), strict=True))
    following: dict[str, Any] = {}
    continued = v
    if surrounded:
        # what goes on is the inertial velocity, also where the rotation is published anew
        before = states["omega_e"] = ca.SX.sym("omega_e_before", 3)
        initial["omega_e"] = following["omega_e"] = omega
        continued = v + ca.cross(before - omega, r)
    felt = ca.SX.zeros(3)
    flow: dict[str, Any] = {}
    if forces.split:
        middle = time - dt / 2
        r_m, v_m = flown(r, continued, dt / 2)
        impulse = dt * felt_acceleration(r_m, v_m, omega, forces, given, around(middle))
        pushed = r_m
        if forces.maneuvers:
            axes = radial_axes(r_m, v_m + ca.cross(omega, r_m))
            increment, displacement = burned(forces.maneuvers, time - dt, time)
            impulse += ca.mtimes(axes, increment)
            pushed = r_m + ca.mtimes(axes, displacement)
        kicked = v_m + impulse + dt * pulled(r_m, middle)
        flow = dict(zip(("r_e", "v_e"), flown(pushed, kicked, dt / 2), strict=True))
        if forces.felt:
            felt = states["felt_v_e"] = ca.SX.sym("felt_v_e", 3)
            following["felt_v_e"] = impulse - ca.cross(omega, impulse) * dt / 2
    elif surrounded:
        flow = dict(zip(("r_e", "v_e"), flown(r, continued, dt), strict=True))
    if any(each.impulsive for each in forces.maneuvers):
        derivatives, following, flow = {}, following | flow, {}
    else:
        derivatives = rates(time)
    if surrounded:
        q_ei = orientation_at(published, time)
        inertial = [
            ca.mtimes(rotation_matrix(q_ei).T, each) for each in (r, v + ca.cross(omega, r))
        ]
    else:
        inertial = [
            _uniformly(each, omega, parameters["earth_angle0"], time)
            for each in (r, v + ca.cross(omega, r))
        ]
    outside = 1 + ca.if_else(below_surface(r, EARTH.radius), nan, 0.0)
    return Model(
        "satellite",
        inputs=inputs,
        states=states,
        parameters=parameters,
        derivatives=derivatives,
        flow=flow,
        next=following,
        initial=initial,
        outputs={
            "r_i": inertial[0],
            "v_i": inertial[1],
            "r_e": r * outside,
            "v_e": v,
            "delta_v_e": felt,
        },
        step=dt,
        time=time,
    )


def _parameters_of(forces: Forces) -> list[str]:
    """Names of the parameters of forces, but for gravity's."""
    names = ["radiation_coefficient"] if forces.radiation else []
    if forces.drag == "exponential":
        names += ["density", "density_height", "scale_height"]
    return names + (["ballistic_coefficient"] if forces.drag != "none" else [])


def _uniformly(vector: Any, omega: Any, angle0: Any, time: Any) -> Any:
    """Components (3,) in axes that do not turn, and that differ at t = 0 by an angle about z."""
    rate = ca.sqrt(ca.dot(omega, omega))
    return rotate_about_pole(-angle0, turned(omega / rate, -rate * time, vector))
