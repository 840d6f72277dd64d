"""Outlines of lakes in an image, made into fixes."""

from __future__ import annotations

import numpy as np

from terrafix.components.fields import CONTOUR, LOOK
from terrafix.components.filters.family import fix_fields
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Flag, Parameter
from terrafix.cosim.declare.ports import MessageInput, MessageOutput
from terrafix.models.filters.lake import MOMENTS, ORBIT, lake_observation
from terrafix.models.images.polygons import moment_noise, moments

ELEMENTS = {"six": 6, "three": 3}
"""Which moments are told: all, or area and centroid alone."""

NOISES = ("contour", "given")
"""Where their covariance comes from."""


class ContourMoments(Component):
    """Moments of a lake's outline, with the covariance that the noise of its vertices gives them.

    An outline that is not wholly in the frame has other moments than the lake, and makes no fix.
    """

    default_rate = Rate("1/30")

    elements = Choice(tuple(ELEMENTS), "six", doc="area and centroid, or second moments too")
    noise = Choice(NOISES, "contour", doc="contour: of the noise of vertices; given: `variance`")
    variance = Parameter(
        [2500.0, 50.0, 50.0, 1e6, 1e6, 1e6],
        shape=(6,),
        unit=("px^4", "px^2", "px^2", "px^4", "px^4", "px^4"),
        positive=True,
        doc="of the moments, where it is given",
    )
    unbiased = Flag(True, doc="without what the noise of vertices adds to second moments")

    contour = MessageInput(**CONTOUR, doc="outline in the frame")
    look = MessageInput(fields=LOOK, doc="which lake it is of, and how well it is seen")
    fix = MessageOutput(fields=fix_fields(lake_observation(ORBIT)), doc="its moments")

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect."""
        return name != "variance" or self.noise == "given"

    def _step_impl(self, t: float, dt: float) -> None:
        contour, look, n, m = self.contour, self.look, self.n_members, len(MOMENTS)
        y, R = np.zeros((n, m)), np.tile(np.eye(m), (n, 1, 1))
        good = contour.fresh & look.fresh & (look.whole > 0.5)
        for count in np.unique(contour.count[good]):
            rows = np.flatnonzero(good & (contour.count == count))
            outline = contour.value[rows, :count]
            y[rows] = moments(outline)[0]
            R[rows], bias = moment_noise(outline, look.sigma[rows])
            if self.unbiased:
                y[rows] -= bias
        if self.noise == "given":
            R = self.variance[:, :, None] * np.eye(m)
        present = np.zeros((n, m))
        present[:, : ELEMENTS[self.elements]] = 1.0
        self.fix.publish(look.t, valid=good, y=y, R=R, lake=look.lake[:, None], present=present)
