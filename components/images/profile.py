"""Terrain contour matching of whole profiles: finds an aircraft that does not know where it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafix.components.fields import CLEARANCE_FIX, GRID, HEIGHT, PLACE_FIX
from terrafix.components.shared import require_earth
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component, Environment
from terrafix.cosim.declare.parameters import Choice, Count, Parameter
from terrafix.cosim.declare.ports import (
    Input,
    MessageInput,
    MessageOutput,
    Output,
    SharedInput,
    State,
)
from terrafix.models.maps.charts import ORIGIN, geodetic_of
from terrafix.models.maps.contours import match_profile
from terrafix.models.maps.dem import dem_from
from terrafix.models.motion.strapdown import EARTHS

_POLE = np.pi / 2


class ProfileMatcher(Component):
    """Matches rows of clearances with an elevation model until one is found, then lets them pass.

    A profile is matched when it is full; if it is refused, the next one begins. Once a member is
    found, its clearances go on to the filter one by one (`clearance`), which then holds it.
    """

    default_rate = Rate("1", offset="1")

    earth = Choice(EARTHS, "wgs84", doc="that of the filter")
    points = Count(60, minimum=10, doc="clearances of a profile")
    reach = Parameter(1000.0, unit="m", positive=True, doc="of the search, to each side")
    spacing = Parameter(
        45.0, unit="m", positive=True, doc="of its first grid: half a step of the map"
    )
    sigma = Parameter(7.0, unit="m", positive=True, doc="of a height: noise, map, bent track")
    height_sigma = Parameter(5.0, unit="m", positive=True, doc="of the height common to a profile")
    latitude0 = Parameter(0.0, unit="rad", minimum=-_POLE, maximum=_POLE, doc="origin (flat)")
    longitude0 = Parameter(
        0.0, unit="rad", minimum=-2 * np.pi, maximum=2 * np.pi, doc="origin (flat)"
    )

    r_e = Input((3,), unit="m", frame="e", doc="estimated position")
    fix = MessageInput(fields=CLEARANCE_FIX, doc="measured clearance")
    height = SharedInput(**HEIGHT, doc="heights of the ground")
    grid = SharedInput(**GRID, doc="where they lie")
    place = MessageOutput(fields=PLACE_FIX, doc="where a profile was flown, north and east")
    clearance = MessageOutput(fields=CLEARANCE_FIX, doc="the clearance, once the member was found")
    reason = Output(doc="index into terrafix.models.maps.contours.REASONS, of the last profile")
    found = State(dtype=np.bool_, start=False, doc="whether a profile was matched")
    gathered = State(start=0.0, doc="clearances of the profile so far")

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect: an origin has on a flat Earth alone."""
        return super().takes(name) and (name not in ORIGIN or self.setting("earth") == "flat")

    def bind(self, environment: Environment) -> None:
        """Get an array for profiles: latitude, longitude, height of the ground."""
        super().bind(environment)
        self.state_arrays["profile"] = np.zeros((environment.n_members, self.points, 3))

    def _initialize_impl(self) -> None:
        require_earth(self, self.setting("earth"), self.r_e)
        self.reason = np.nan

    def _step_impl(self, t: float, dt: float) -> None:
        fresh = self.fix.fresh & self.environment.active
        told = {n: getattr(self.fix, n) for n in CLEARANCE_FIX}
        self.clearance.publish(t, valid=fresh & self.found, **told)
        who = np.flatnonzero(fresh & ~self.found)
        if not len(who):
            return
        latitude, longitude, height = geodetic_of(
            self.r_e, self.setting("earth"), (self.latitude0, self.longitude0)
        )
        row = np.stack([latitude, longitude, height - self.fix.y[:, 0]], axis=1)
        profile = self.state_arrays["profile"]
        profile[who, self.gathered[who].astype(np.intp)] = row[who]
        self.gathered[who] += 1.0
        full = who[self.gathered[who] >= self.points]
        if len(full):
            self._match(t, full, profile)

    def _match(self, t: float, members: NDArray[np.intp], profile: FloatArray) -> None:
        """Match the profiles of members, and publish those that were found."""
        y, R = np.zeros((self.n_members, 2)), np.tile(np.eye(2), (self.n_members, 1, 1))
        dem, matched = dem_from(self.height, self.grid), np.zeros(self.n_members, np.bool_)
        for m in map(int, members):
            match = match_profile(
                dem,
                *profile[m].T,
                sigma=float(self.sigma[m]),
                height_sigma=float(self.height_sigma[m]),
                reach=float(self.reach[m]),
                step=float(self.spacing[m]),
            )
            self.reason[m] = match.reason
            matched[m] = match.reason == 0
            y[m], R[m] = match.shift, match.covariance
            self.gathered[m] = 0.0
        self.found[matched] = True
        self.place.publish(
            t, valid=matched, y=y, p_e=self.r_e, R=R, present=np.ones((self.n_members, 2))
        )
