"""The matcher: recognizes an image on a geocoded reference, and makes it a fix."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from terrafix.components.fields import ESTIMATE, FIX, IMAGE
from terrafix.components.images.margins import foreseen_match
from terrafix.components.images.reference import OnReference
from terrafix.cosim.basics.arrays import FloatArray, Mask
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.component import FedBy
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import (
    BundleInput,
    MessageInput,
    MessageOutput,
    Output,
    SharedInput,
    SharedOutput,
)
from terrafix.models.geometry.geodesy import ecef, geodetic
from terrafix.models.geometry.geolocation import ground_point, track_axes
from terrafix.models.images.matching import KINDS, REASONS, Match, Searchable, matched
from terrafix.models.images.reference import Reference
from terrafix.models.maps.dem import Dem


class ImageMatcher(OnReference):
    """Finds the image on the reference, its center's place and height, and publishes the fix.

    The fix is that of the open loop: the boresight's tangents are zero by construction, the range
    is measured, the in-track velocity is the effective one where autofocus named it, and absent
    where it refused. No fix comes of an image that is not recognized.
    """

    default_rate = Rate("8.2", offset="8.2")

    transform = Choice(KINDS, "similarity", doc="between the features of image and reference")
    geolocation_sigma = Parameter(
        5.0,
        shape=(3,),
        unit="m",
        positive=True,
        doc="error of the recognized place: along the track, across it, up",
    )
    range_sigma = Parameter(1.0, unit="m", positive=True, doc="noise of the slant range")

    images = SharedInput((None, None, None), dtype=np.float32, doc="amplitudes of the images")
    image = MessageInput(fields=IMAGE, doc="which image is a member's, and what it measures")
    prior = BundleInput(ESTIMATE, doc="estimate before the fix of this instant")

    fix = MessageOutput(fields=FIX, doc="the fix")
    reason = Output(doc="of the last image: index into terrafix.models.images.matching.REASONS")
    match_sigma = Output(doc="of the last image: standard error of its place [pixels]")
    match_place = Output((2,), labels=("row", "column"), doc="of its center on the reference")
    inliers = SharedOutput((None, 4), doc="features of the first image and of the reference")
    outline = SharedOutput((4, 2), doc="corners of the first image on it; NaN if not found")

    def foreseen(self, fed_by: FedBy) -> Iterator[str]:
        """Tell what the reference has to spare for the image."""
        return foreseen_match(self, fed_by)

    def _step_impl(self, t: float, dt: float) -> None:
        fresh = self.image.fresh & self.environment.active
        if not fresh.any():
            return
        reference, dem = self._covered_reference(), self._dem()
        searchable = Searchable(reference.amplitude)
        found: dict[tuple[int, float, float], Match] = {}
        places = np.zeros((self.n_members, 3))
        valid = np.zeros(self.n_members, np.bool_)
        for m in np.flatnonzero(fresh):
            key = (
                int(self.image.index[m]),
                float(self.image.row[m]),
                float(self.image.column[m]),
            )
            if key not in found:
                chip = Searchable(self.images[key[0]])
                found[key] = matched(chip, searchable, key[1:], kind=self.transform)
            match = found[key]
            self.reason[m] = REASONS.index(match.reason)
            self.match_sigma[m] = match.sigma.max() if match.accepted else np.nan
            self.match_place[m] = match.row, match.column
            if match.accepted:
                try:
                    places[m] = self._placed(reference, dem, match)
                except ValueError as error:
                    self.fail(np.arange(self.n_members) == m, f"cannot place its image: {error}")
                    continue
                valid[m] = True
        first = next(iter(found.values()))
        self.inliers = first.inliers
        rows, columns = self.images.shape[1:]
        corners = [(0, 0, 1), (0, columns - 1, 1), (rows - 1, columns - 1, 1), (rows - 1, 0, 1)]
        self.outline = np.array(corners) @ first.transform.T
        if not valid.any():
            self._require_coverage(reference, fresh)
            return
        self._publish(t, places, valid)

    def _publish(self, t: float, places: FloatArray, valid: Mask) -> None:
        n = self.n_members
        r_f_e, D = np.zeros((n, 3)), np.broadcast_to(np.eye(3), (n, 3, 3)).copy()
        r_f_e[valid] = ecef(*places[valid].T)
        axes = track_axes(r_f_e[valid], self.prior.v_e[valid])
        variance = self.geolocation_sigma[valid] ** 2
        D[valid] = np.einsum("nki,nk,nkj->nij", axes, variance, axes)
        y, R, present = np.zeros((n, 4)), np.zeros((n, 4, 4)), np.ones((n, 4))
        y[:, 2], y[:, 3] = self.image.slant_range, self.image.velocity
        R[:, 2, 2], R[:, 3, 3] = self.range_sigma**2, self.image.velocity_sigma**2
        present[:, 3] = self.image.focused
        self.fix.publish(t, valid=valid, y=y, r_f_e=r_f_e, R=R, D=D, present=present)

    def _placed(self, reference: Reference, dem: Dem, match: Match) -> tuple[float, float, float]:
        """Latitude, longitude [rad] and height of the terrain [m] where an image lies."""
        latitude, longitude, _ = reference.place(match.row, match.column)
        return float(latitude), float(longitude), float(dem.at(latitude, longitude))

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
            p = ground_point(r, v, self.image.slant_range[fresh], self.image.sine[fresh])
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
