"""The matcher: recognizes an image on a geocoded reference, and makes it a fix."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import numpy as np

from terrafix.components.fields import ESTIMATE, FIX, IMAGE
from terrafix.components.images.margins import foreseen_match
from terrafix.components.images.reference import OnReference
from terrafix.cosim.basics.arrays import FloatArray, Mask
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import FedBy
from terrafix.cosim.declare.parameters import Parameter
from terrafix.cosim.declare.ports import (
    BundleInput,
    MessageInput,
    MessageOutput,
    Output,
    SharedInput,
    SharedOutput,
)
from terrafix.models.core.parallel import over
from terrafix.models.geometry.geodesy import geodetic
from terrafix.models.geometry.geolocation import ground_point
from terrafix.models.images.matching import (
    REASONS,
    Match,
    Searchable,
    misplaced,
    refused,
)
from terrafix.models.images.placing import View, placed, predicted, recognized
from terrafix.models.images.reference import Reference
from terrafix.models.maps.dem import Dem

_log = logging.getLogger(__name__)


class ImageMatcher(OnReference):
    """Finds the image on the reference, its center's place and height, and publishes the fix.

    Where the image lies on the reference, and how far off that can be, is predicted with the prior.
    The fix is that of the open loop: the boresight's tangents are zero by construction, the range
    is measured, the in-track velocity is the effective one where autofocus named it, and absent
    where it refused. No fix comes of an image that is not recognized: `reason` says why.

    The covariance D of the place is that of the match and of the reference: see
    `terrafix.models.images.placing`. That of y, R, has the noise of the slant range, and of the
    first tangent how far the antenna moves in the standard error of the image's time.
    """

    default_rate = Rate("8.2", offset="8.2")

    reference_sigma = Parameter(
        [5.0, 5.0, 10.0],
        shape=(3,),
        unit="m",
        minimum=0.0,
        doc="error of the reference's places along the track and across it, and of the heights, "
        "their datum included",
    )
    range_sigma = Parameter(1.0, unit="m", positive=True, doc="noise of the slant range")

    images = SharedInput((None, None, None), dtype=np.float32, doc="amplitudes of the images")
    image = MessageInput(fields=IMAGE, doc="which image is a member's, and what it measures")
    prior = BundleInput(ESTIMATE, doc="estimate before the fix of this instant")

    fix = MessageOutput(fields=FIX, doc="the fix")
    reason = Output(doc="of the last image: index into terrafix.models.images.matching.REASONS")
    match_sigma = Output(doc="of the last image: largest standard error of its place [pixels]")
    match_place = Output((2,), labels=("row", "column"), doc="of its center on the reference")
    inliers = SharedOutput(
        (None, 4), doc="middles of the parts of the first image that agree, on it and the reference"
    )
    outline = SharedOutput((4, 2), doc="corners of the first image on it; NaN if not found")

    def foreseen(self, fed_by: FedBy) -> Iterator[str]:
        """Tell what the reference has to spare for the image."""
        return foreseen_match(self, fed_by)

    def _initialize_impl(self) -> None:
        self._told = False

    def _step_impl(self, t: float, dt: float) -> None:
        fresh = self.image.fresh & self.environment.active
        if not fresh.any():
            return
        reference, dem = self._covered_reference(), self._dem()
        searchable = Searchable(reference.amplitude)
        members = [int(m) for m in np.flatnonzero(fresh)]
        indices = {m: int(self.image.index[m]) for m in members}
        chips = {k: Searchable(self.images[k]) for k in sorted(set(indices.values()))}
        n = self.n_members
        places, D = np.zeros((n, 3)), np.broadcast_to(np.eye(3), (n, 3, 3)).copy()
        valid = np.zeros(n, np.bool_)
        views = {m: self._view(m) for m in members}
        matches: dict[int, Match] = {}

        def match_one(m: int) -> None:
            matches[m] = self._matched(m, views[m], chips[indices[m]], searchable, reference, dem)

        over(members, match_one)
        for m in members:
            match, view = matches[m], views[m]
            if match.accepted:
                try:
                    sigma = self.reference_sigma[m]
                    places[m], D[m] = placed(reference, dem.at, match, view, sigma)
                    valid[m] = True
                except ValueError:
                    match = refused("its place has no height")
            self.reason[m] = REASONS.index(match.reason)
            self.match_sigma[m] = match.sigma.max() if match.accepted else np.nan
            self.match_place[m] = match.row, match.column
        first = matches[members[0]]
        self.inliers, self.outline = first.blocks, first.outline
        if not valid.any():
            self._require_coverage(reference, fresh)
            self._tell_misplaced(int(np.argmax(fresh)), chips, searchable, reference, dem)
            return
        self._publish(t, places, D, valid)

    def _view(self, m: int) -> View:
        """How a member's image was seen, as its estimate has it."""
        image = self.image
        return View(
            self.prior.r_e[m],
            self.prior.v_e[m],
            float(image.row[m]),
            float(image.column[m]),
            float(image.row_time[m]),
            float(image.slant_range[m]),
            float(image.column_range[m]),
            float(image.sine[m]),
            1 if image.side[m] > 0 else -1,
            float(image.time_sigma[m]),
            float(self.range_sigma[m]),
        )

    def _matched(
        self,
        m: int,
        view: View,
        chip: Searchable,
        searchable: Searchable,
        reference: Reference,
        dem: Dem,
    ) -> Match:
        """Match of a member's image, where its estimate predicts it."""
        P = np.asarray(self.prior.P[m])[:6, :6]
        try:
            return recognized(chip, searchable, view, P, reference, dem.known_at)
        except ValueError:
            return refused("what is estimated sees no ground")

    def _tell_misplaced(
        self,
        m: int,
        chips: dict[int, Searchable],
        searchable: Searchable,
        reference: Reference,
        dem: Dem,
    ) -> None:
        """Say once whether an image is recognized that is turned, or of another spacing."""
        if self._told:
            return
        self._told = True
        P, chip = np.asarray(self.prior.P[m])[:6, :6], chips[int(self.image.index[m])]
        try:
            where = predicted(self._view(m), P, reference, dem.known_at, chip.shape)
        except ValueError:
            return
        found = misplaced(chip, searchable, where)
        if found is not None:
            _log.warning(
                "'%s' recognizes its image on the reference turned by %.0f deg and with pixels "
                "%+.0f %% of the size that its tie points say: they do not belong to what it shows",
                *(self.name, np.degrees(found[0]), 100 * found[1]),
            )

    def _publish(self, t: float, r_f_e: FloatArray, D: FloatArray, valid: Mask) -> None:
        n, image = self.n_members, self.image
        y, R, present = np.zeros((n, 4)), np.zeros((n, 4, 4)), np.ones((n, 4))
        y[:, 2], y[:, 3] = image.slant_range, image.velocity
        speed = np.linalg.norm(self.prior.v_e, axis=1)
        R[:, 0, 0] = (speed * image.time_sigma / image.slant_range) ** 2
        R[:, 2, 2], R[:, 3, 3] = self.range_sigma**2, image.velocity_sigma**2
        present[:, 3] = image.focused
        self.fix.publish(t, valid=valid, y=y, r_f_e=r_f_e, R=R, D=D, present=present)

    def _covered_reference(self) -> Reference:
        reference = self._reference()
        dem = self._dem()
        covered = dem.covers(reference.latitude, reference.longitude)
        if not covered.all():
            raise ConfigurationError(
                f"the elevation model does not cover the reference of '{self.name}'\n"
                f"  the reference covers {reference.described()}\n"
                f"  the elevation model {dem.described()}\n"
                "  use another elevation model, or mirror this one (mirrored = true)"
            )
        return reference

    def _require_coverage(self, reference: Reference, fresh: Mask) -> None:
        """Raise where nothing was recognized because the reference is of another place."""
        r, v, P = (getattr(self.prior, k)[fresh] for k in ("r_e", "v_e", "P"))
        try:
            side = 1 if self.image.side[fresh][0] > 0 else -1
            p = ground_point(
                *(r, v, self.image.slant_range[fresh], self.image.sine[fresh]), side=side
            )
        except ValueError:  # an estimate that sees no ground says nothing of the reference
            return
        latitude, longitude, _ = geodetic(p)
        longitude = reference.own_turn(longitude)
        sigma = np.sqrt(np.trace(P[:, :3, :3], axis1=1, axis2=2))
        sigma += self.image.slant_range[fresh] * np.sqrt(np.trace(P[:, 6:, 6:], axis1=1, axis2=2))
        reach = 3 * sigma / 6.371e6
        outside = (latitude < reference.latitude.min() - reach) | (
            latitude > reference.latitude.max() + reach
        )
        reach = reach / np.cos(latitude)
        outside |= (longitude < reference.longitude.min() - reach) | (
            longitude > reference.longitude.max() + reach
        )
        if outside.all():
            raise ConfigurationError(
                f"the reference of '{self.name}' does not cover the image: it lies about latitude "
                f"{np.degrees(latitude[0]):.3f}, longitude {np.degrees(longitude[0]):.3f} deg\n"
                f"  the reference covers {reference.described()}\n"
                "  use a reference of this place, or list no image here"
            )
