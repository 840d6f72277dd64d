"""The shore of a lake in a frame, matched to the catalog from the filter's own estimate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from terrafix.components.fields import (
    CENTERS,
    CONTOUR,
    CORNERS,
    LOOK,
    ORBIT_ESTIMATE,
    SHORE_FIX,
    SHORE_VERTICES,
    STARTS,
)
from terrafix.components.sensors.optics import Optics
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import (
    BundleInput,
    MessageInput,
    MessageOutput,
    Output,
    SharedInput,
)
from terrafix.models.filters.shore import SHORE_REASONS, Shore, match_shores
from terrafix.models.images.shore import ELEMENTS, Weights


class ShoreMatcher(Optics):
    """Finds what a frame shows of a lake's shore on the catalog's outline, and makes it a fix.

    It needs no whole lake in the frame. What lies outside of the frame is not used, nor where the
    shore leaves it, nor islands.
    """

    default_rate = Rate("1/30")

    size = Parameter([320.0, 256.0], shape=(2,), unit="px", positive=True, doc="of the frame")
    least_sigma = Parameter(
        0.05, unit="px", positive=True, doc="of a vertex, where the contour claims less"
    )

    contour = MessageInput(**CONTOUR, doc="outline in the frame")
    look = MessageInput(fields=LOOK, doc="which lake it is of, and how well it is seen")
    prior = BundleInput(ORBIT_ESTIMATE, doc="estimate before the fix of this instant")
    vertices = SharedInput(**CORNERS, doc="of the rings of all lakes")
    starts = SharedInput(**STARTS, doc="of rings in the vertices")
    center = SharedInput(**CENTERS, doc="of each lake")

    fix = MessageOutput(fields=SHORE_FIX, doc="weighted sums of the shore's pixels")
    reason = Output(
        doc="of the last look: index into terrafix.models.filters.shore.SHORE_REASONS, 0 for a fix"
    )

    def _initialize_impl(self) -> None:
        self.check_pointing()
        self.reason = np.nan
        longest = int(np.diff(self.starts[: len(self.center) + 1]).max())
        if longest > SHORE_VERTICES:
            raise ConfigurationError(
                f"'{self.name}' matches outlines of {SHORE_VERTICES} vertices at most; its catalog "
                f"has one of {longest}\n  select smaller lakes, or a coarser source"
            )

    def _step_impl(self, t: float, dt: float) -> None:
        fresh = self.contour.fresh & self.look.fresh & self.environment.active
        if not fresh.any():
            return
        n = self.n_members
        y, present = np.zeros((n, ELEMENTS)), np.zeros((n, ELEMENTS))
        W = np.zeros((n, ELEMENTS, SHORE_VERTICES, 2))
        good = np.zeros(n, np.bool_)
        for lake in np.unique(self.look.lake[fresh]):
            rows = np.flatnonzero(fresh & (self.look.lake == lake))
            for m, found in zip(rows, self._match(rows, int(lake)), strict=True):
                if isinstance(found, str):
                    self.reason[m] = SHORE_REASONS.index(found)
                    continue
                y[m], present[m] = found.value, found.told
                W[m, :, : found.of_vertices.shape[1]] = found.of_vertices
                self.reason[m], good[m] = 0, True
        self.fix.publish(
            self.look.t,
            valid=good,
            y=y,
            lake=self.look.lake[:, None],
            weights=W.reshape(n, -1),
            R=np.tile(np.eye(ELEMENTS), (n, 1, 1)),
            present=present,
        )

    def _match(self, rows: NDArray[np.int64], lake: int) -> list[Weights | str]:
        begin, end = self.starts[lake : lake + 2]
        return match_shores(
            np.concatenate([self.prior.r[rows], self.prior.v[rows]], axis=1),
            self.prior.P[rows],
            self.looking(rows) | {"t": self.look.t[rows]},
            self.vertices[begin:end],
            self.center[lake],
            [self._shore(m) for m in rows],
        )

    def _shore(self, m: int) -> Shore:
        """Of the lake itself, as a member saw it: rings of islands come after it."""
        rings = self.contour.value[m, : self.contour.count[m]]
        separators = np.flatnonzero(np.isnan(rings[:, 0]))
        contour = rings[: separators[0]] if separators.size else rings
        inside = ((contour > -0.5) & (contour < self.size[m] - 0.5)).all(axis=1)
        sigma = max(float(self.look.sigma[m]), float(self.least_sigma[m]))
        return Shore(contour, inside & np.roll(inside, -1), sigma)
