"""Where a satellite starts: in a stated frame, by elements, by two-line elements, over a place."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from terrafix.components.dated import read_epoch
from terrafix.components.fields import START, XYZ
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError, EpochError
from terrafix.cosim.declare.component import Component, Environment
from terrafix.cosim.declare.parameters import Choice, Parameter, Text
from terrafix.cosim.declare.ports import Capabilities, MessageOutput, Output
from terrafix.models.core.batch import over_members
from terrafix.models.core.timescales import DAY, Instant
from terrafix.models.geometry.celestial import (
    DATED,
    FRAMES,
    earth_fixed_from_frame,
    frame_from_earth_fixed,
)
from terrafix.models.geometry.earth import EARTH
from terrafix.models.geometry.geodesy import ecef, local_axes
from terrafix.models.motion.elements import ELEMENTS, state_of_elements
from terrafix.models.motion.orbit import below_surface
from terrafix.models.motion.tle import TwoLines

_TAKEN = {
    "cartesian": ("frame", "r0", "v0"),
    "keplerian": ("frame", *ELEMENTS, "mu"),
    "tle": ("tle", "tle_age"),
    "geodetic": ("latitude", "longitude", "height", "v0_n"),
}
"""Parameters by kind of start."""
_NEEDED = {
    "cartesian": ("r0", "v0"),
    "keplerian": ("semi_major_axis",),
    "tle": ("tle",),
    "geodetic": ("height", "v0_n"),
}
"""Of these, what has no default that makes sense."""

_state_of_elements = over_members(state_of_elements, (6,), ())


class OrbitStart(Component):
    """Position and velocity of a satellite at t = 0, told once, from whatever is known of it.

    Cartesian or Keplerian in a stated frame, two-line elements by SGP4, or latitude, longitude and
    height. What is told is Earth-fixed (ITRF), and `r_i` and `v_i` in GCRF; in a system without an
    epoch in the uniformly turning frame of type `orbit`.
    """

    capabilities: ClassVar[Capabilities] = Capabilities(given=True)
    default_rate = Rate(times=["0"])

    kind = Choice(tuple(_TAKEN), "cartesian", doc="what is known")
    frame = Choice(FRAMES, "uniform", doc="of r0 and v0, or of the elements")
    r0 = Parameter([0.0] * 3, shape=(3,), unit="m", doc="position in `frame` (cartesian)")
    v0 = Parameter([0.0] * 3, shape=(3,), unit="m/s", doc="velocity in `frame` (cartesian)")
    semi_major_axis = Parameter(0.0, unit="m", minimum=0.0, doc="(keplerian)")
    eccentricity = Parameter(0.0, minimum=0.0, maximum=0.999, doc="(keplerian)")
    inclination = Parameter(0.0, unit="rad", doc="(keplerian)")
    node = Parameter(0.0, unit="rad", doc="right ascension of the ascending node (keplerian)")
    argument_of_perigee = Parameter(0.0, unit="rad", doc="from the ascending node (keplerian)")
    true_anomaly = Parameter(0.0, unit="rad", doc="from the perigee, at t = 0 (keplerian)")
    mu = Parameter(
        EARTH.mu, unit="m^3/s^2", positive=True, doc="gravitational parameter (keplerian)"
    )
    tle = Text("", doc="two-line elements, a line with the name before them or not (tle)")
    tle_age = Parameter(
        3 * DAY, unit="s", positive=True, doc="most time between their epoch and t = 0 (tle)"
    )
    latitude = Parameter(0.0, unit="rad", doc="geodetic (geodetic)")
    longitude = Parameter(0.0, unit="rad", doc="east (geodetic)")
    height = Parameter(0.0, unit="m", doc="above the ellipsoid (geodetic)")
    v0_n = Parameter(
        [0.0] * 3,
        shape=(3,),
        unit="m/s",
        frame="n",
        doc="velocity relative to the Earth: north, east, down (geodetic)",
    )
    earth_angle0 = Parameter(
        0.0, unit="rad", doc="uniform x axis to Earth-fixed one at t = 0, without an epoch"
    )

    start = MessageOutput(fields=START, doc="position and velocity at t = 0")
    r_i = Output((3,), unit="m", frame="i", labels=XYZ, doc="position, inertial")
    v_i = Output((3,), unit="m/s", frame="i", labels=XYZ, doc="velocity, inertial")

    _instant: Instant | None = None

    def takes(self, name: str) -> bool:
        """Whether a parameter matters for the kind of start."""
        everyone = name in ("kind", "earth_angle0")
        return super().takes(name) and (everyone or name in _TAKEN[self.setting("kind")])

    def validate(self) -> None:
        """Look whether what its kind of start needs was given."""
        kind = self.setting("kind")
        for name in _NEEDED[kind]:
            if self.is_default(name):
                raise ConfigurationError(
                    f"'{self.name}' needs a value for '{name}' with kind = \"{kind}\": it takes "
                    f"{self.settings()[name].kind()}"
                )
        if kind == "keplerian" and self.setting("frame") == "itrf":
            raise ConfigurationError(
                f"'{self.name}' has elements in the frame 'itrf', which turns with the Earth\n"
                f"  elements are of a frame that does not: {_listed(DATED)}, or uniform"
            )
        if kind == "tle":
            self._lines()

    def _lines(self) -> TwoLines:
        try:
            return TwoLines.read(self.setting("tle"))
        except ValueError as error:
            raise ConfigurationError(f"'{self.name}.tle': {error}") from error

    def validate_epoch(self, epoch: str | None) -> None:
        """Look whether frame and epoch go together, and whether it starts above the ground."""
        kind, frame = self.setting("kind"), self.setting("frame")
        stated = kind in ("cartesian", "keplerian")
        if epoch is None and (kind == "tle" or (stated and frame in DATED)):
            what, says = f"a state in the frame '{frame}'", "says"
            if kind == "tle":
                what, says = "two-line elements", "say"
            raise EpochError(
                f"'{self.name}' has {what}, which {says} nothing about the Earth without a date\n"
                '  give the system its epoch: epoch = "2022-09-18T07:49:21.5 UTC"'
            )
        if epoch is not None and stated and frame == "uniform":
            raise ConfigurationError(
                f"'{self.name}' has a state without a frame, in a system with the epoch '{epoch}': "
                "between what it may mean lie 36 km\n"
                f"  say which: frame = {_listed(DATED)}, or itrf"
            )
        self._instant = None if epoch is None else read_epoch(self, epoch)
        if kind == "tle":
            self._check_age()
        self._check_place()

    def _check_age(self) -> None:
        assert self._instant is not None
        try:
            age = self._instant.minus(self._lines().epoch)
        except ValueError as error:
            raise ConfigurationError(f"'{self.name}.tle': {error}") from error
        limit = float(self.setting("tle_age"))
        if abs(age) > limit:
            when = "old" if age > 0 else "ahead of it"
            raise ConfigurationError(
                f"'{self.name}' has two-line elements of {self._lines().epoch.text(digits=0)}, at "
                f"the epoch {abs(age) / DAY:.3g} days {when}; it takes them up to "
                f"{limit / DAY:.3g} days\n"
                f'  give newer ones, or {self.name}.tle_age = "{np.ceil(abs(age) / DAY):.0f} day"'
            )

    def _check_place(self) -> None:
        nominal = {name: np.asarray(self.setting(name))[None] for name in self._numbers()}
        try:
            r_e, _ = self._earth_fixed(nominal)
        except (ImportError, ValueError) as error:
            raise EpochError(f"'{self.name}' cannot start: {error}") from error
        if below_surface(r_e[0], EARTH.radius):
            raise ConfigurationError(
                f"'{self.name}' starts inside the Earth: {np.linalg.norm(r_e):.6g} m from its "
                'center\n  bare numbers are in meters; write a unit with them, as in "7070 km"'
            )

    def bind(self, environment: Environment) -> None:
        """Read the epoch."""
        super().bind(environment)
        epoch = environment.epoch
        self._instant = None if epoch is None else read_epoch(self, epoch)

    def _initialize_impl(self) -> None:
        r_e, v_e = self._earth_fixed({name: getattr(self, name) for name in self._numbers()})
        self.fail(below_surface(r_e.T, EARTH.radius), "starts inside the Earth")
        self.start.publish(0.0, r_e=r_e, v_e=v_e)
        frame = "uniform" if self._instant is None else "gcrf"
        self.r_i, self.v_i = frame_from_earth_fixed(
            frame, self._instant, r_e, v_e, angle=self.earth_angle0
        )

    def _numbers(self) -> list[str]:
        return [n for n, s in self.settings().items() if isinstance(s, Parameter)]

    def _earth_fixed(self, given: dict[str, Any]) -> tuple[FloatArray, FloatArray]:
        """Position [m] and velocity [m/s] in ITRF axes, two (n, 3), of rows of parameters."""
        kind, frame = self.setting("kind"), self.setting("frame")
        if kind == "geodetic":
            latitude, longitude = given["latitude"], given["longitude"]
            east_north_up = given["v0_n"][:, [1, 0, 2]] * [1.0, 1.0, -1.0]
            axes = local_axes(ecef(latitude, longitude, 0.0))
            v_e = np.einsum("nji,nj->ni", axes, east_north_up)
            return ecef(latitude, longitude, given["height"]), v_e
        if kind == "cartesian":
            r, v = given["r0"], given["v0"]
        elif kind == "keplerian":
            elements = np.stack([given[name] for name in ELEMENTS], axis=-1)
            r, v = _state_of_elements(elements, given["mu"])
        else:
            assert self._instant is not None
            frame = "teme"
            n = len(given["tle_age"])
            r, v = (np.tile(x, (n, 1)) for x in self._lines().state(self._instant))
        return earth_fixed_from_frame(frame, self._instant, r, v, angle=given["earth_angle0"])


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(names)
