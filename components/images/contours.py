"""Outlines of lakes in an image, made into fixes."""

from __future__ import annotations

import logging
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from terrafix.components.fields import CONTOUR, FRAME, LAKE_FIX, LAKE_MOMENTS, LOOK
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.declare.component import Component
from terrafix.cosim.declare.parameters import Choice, Flag, Parameter
from terrafix.cosim.declare.ports import MessageInput, MessageOutput, Output
from terrafix.models.images.coastline import coastline, gray_moments
from terrafix.models.images.polygons import moment_noise, moments, split_rings

_log = logging.getLogger(__name__)

ELEMENTS = {"six": 6, "three": 3}
"""Which moments are told: all, or area and centroid alone."""

NOISES = ("contour", "given")
"""Where their covariance comes from."""


class _WholeLakes(Component):
    """What takes whole lakes alone: base. A run in which it was never told one says so."""

    look = MessageInput(fields=LOOK, doc="which lake it is, and how well it is seen")

    _BEST: ClassVar[tuple[str, ...]] = ("share", "lake", "t")

    def _initialize_impl(self) -> None:
        self._best = np.zeros((self.n_members, len(self._BEST)))

    def _extra_state(self) -> dict[str, Any]:
        return {"best": self._best}

    def _set_extra_state(self, saved: dict[str, Any]) -> None:
        self._best = saved["best"]

    def terminate(self) -> None:
        """Say which members were never told a whole lake, and what they were told at best."""
        super().terminate()
        flown = self.environment.active
        rows = flown & (self._best[:, 0] > 0.0) & (self._best[:, 0] < 1.0)
        n, among = int(rows.sum()), int(flown.sum())
        if not n or self.step_index == 0:
            return
        share, lake, t = self._best[rows][self._best[rows, 0].argmax()]
        whose = "" if among == 1 else f" in {'any' if n == among else n} of {among} members"
        _log.warning(
            "'%s' takes whole lakes, and never was told one%s: at best %.0f %% of the vertices of "
            "lake %d of the catalog were in the frame, at t = %.4g s\n  fly nearer over it, take a "
            "wider frame (size, or a shorter focal) or a smaller lake, or match the part of the "
            "shore that is seen (shore_matcher)",
            *(self.name, whose, 100 * share, lake, t),
        )

    def whole(self) -> NDArray[np.bool_]:
        """Members that are told of a whole lake now; what was told at best is kept."""
        look = self.look
        better = look.fresh & (look.share > self._best[:, 0])
        told = np.stack([look.share, look.lake, look.t], axis=1)
        self._best[better] = told[better]
        return np.asarray(look.fresh & (look.whole > 0.5))


class ContourMoments(_WholeLakes):
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
    fix = MessageOutput(fields=LAKE_FIX, doc="its moments")

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect."""
        return name != "variance" or self.noise == "given"

    def _step_impl(self, t: float, dt: float) -> None:
        contour, look, n, m = self.contour, self.look, self.n_members, len(LAKE_MOMENTS)
        y, R = np.zeros((n, m)), np.tile(np.eye(m), (n, 1, 1))
        good = contour.fresh & self.whole()
        kinds = np.stack([contour.count, look.lake], axis=1)
        for count, lake in np.unique(kinds[good], axis=0):
            rows = np.flatnonzero(good & (kinds == [count, lake]).all(axis=1))
            outline, starts = split_rings(contour.value[rows, : int(count)])
            y[rows] = moments(outline, starts)[0]
            R[rows], bias = moment_noise(outline, look.sigma[rows], starts)
            if self.unbiased:
                y[rows] -= bias
        if self.noise == "given":
            R = self.variance[:, :, None] * np.eye(m)
        present = np.zeros((n, m))
        present[:, : ELEMENTS[self.elements]] = 1.0
        self.fix.publish(look.t, valid=good, y=y, R=R, lake=look.lake[:, None], present=present)


class ImageMoments(_WholeLakes):
    """Moments of a lake from an image: of the coverage of its pixels by water, as measured.

    An image with no water, or with clouds at the lake's shore, makes no fix. A run of which none
    did says why.
    """

    default_rate = Rate("1/30")

    blur = Parameter(0.5, unit="px", minimum=0.0, doc="the camera's point spread, as calibrated")

    image = MessageInput(**FRAME, doc="codes of the pixels")
    fix = MessageOutput(fields=LAKE_FIX, doc="its moments")
    clear = Output(doc="1 where the shore was seen whole, 0 where not, NaN without an image")

    def _initialize_impl(self) -> None:
        super()._initialize_impl()
        self.clear = np.nan
        self._images = dict.fromkeys(("told", "dry", "hidden"), 0)
        self._dry = ""

    def _extra_state(self) -> dict[str, Any]:
        return super()._extra_state() | {**self._images, "why": self._dry}

    def _set_extra_state(self, saved: dict[str, Any]) -> None:
        super()._set_extra_state(saved)
        self._images = {name: int(saved[name]) for name in self._images}
        self._dry = str(saved["why"])

    def terminate(self) -> None:
        """Say why no image made a fix, if none did."""
        super().terminate()
        if self.step_index == 0:
            return
        told, dry, hidden = self._images.values()
        if told and dry + hidden == told:
            why = f"\n  the first without: {self._dry}" if dry else ""
            _log.warning(
                "'%s' made no fix of %d images: %d show no water, %d the shore behind clouds%s",
                *(self.name, told, dry, hidden, why),
            )

    def _step_impl(self, t: float, dt: float) -> None:
        n, m = self.n_members, len(LAKE_MOMENTS)
        y, R = np.zeros((n, m)), np.tile(np.eye(m), (n, 1, 1))
        told = self.image.fresh & self.whole()
        good = np.zeros(n, dtype=np.bool_)
        for k in np.flatnonzero(told & self.environment.active):
            blur = float(self.blur[k])
            self._images["told"] += 1
            try:
                seen = coastline(self.image.value[k], blur=blur)
            except ValueError as error:  # no water in it
                self._images["dry"] += 1
                self._dry = self._dry or str(error)
                continue
            lake = seen.rings[0]
            if not lake.whole:
                self._images["hidden"] += 1
                continue
            y[k], R[k], bias = gray_moments(
                seen.coverage, seen.noise, seen.band, gain=seen.gain, blur=blur
            )
            y[k] -= bias
            good[k] = True
        self.clear = np.where(self.image.fresh, good, np.nan)
        lakes = self.look.lake[:, None]
        self.fix.publish(self.look.t, valid=good, y=y, R=R, lake=lakes, present=np.ones((n, m)))
