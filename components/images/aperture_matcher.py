"""The matcher of an aircraft: where an aperture's image lies on a reference, as a fix."""

from __future__ import annotations

from typing import Any

import numpy as np

from terrafix.components.fields import APERTURE_IMAGE, MOTION, SHIFT_FIX, XYZ
from terrafix.components.ground import OnGround
from terrafix.components.images.reference import OnReference
from terrafix.cosim.basics.arrays import FloatArray
from terrafix.cosim.basics.clock import Rate
from terrafix.cosim.basics.errors import ConfigurationError
from terrafix.cosim.declare.parameters import Choice, Parameter
from terrafix.cosim.declare.ports import (
    BundleInput,
    Input,
    MessageInput,
    MessageOutput,
    Output,
    SharedInput,
)
from terrafix.models.core.arrays import Single
from terrafix.models.filters.aperture_fix import expected_shift
from terrafix.models.geometry.ground import Ground
from terrafix.models.images.aperture_matching import (
    DRIFT_SHARE,
    REASONS,
    ApertureFix,
    matched_aperture,
    pixel_steps,
    search_reach,
    track_offset,
)
from terrafix.models.images.reference import Reference
from terrafix.models.maps.dem import Dem
from terrafix.models.radar.aperture_image import PixelGrid
from terrafix.models.radar.compensation import StraightLine
from terrafix.models.sensors.aperture import ROWS

_COARSER = 4.0
"""How many times larger than the image's the reference's pixels may be, or smaller."""


class ApertureMatcher(OnReference, OnGround):
    """Finds the image on the reference by the estimate's own geometry, and publishes the fix.

    Range and cross-range with the covariance that the correlation surface tells, and what map drift
    read, where it was accepted. No fix comes of an image that is not recognized.
    """

    default_rate = Rate("1", offset="1")

    rows = Choice(ROWS, "shift-and-drift", doc="what is measured: with what map drift reads or not")
    search_sigmas = Parameter(3.0, positive=True, doc="how far is searched, in predicted sigmas")
    map_drift_sigma = Parameter(
        0.0, unit="m/s", minimum=0.0, doc="error of map drift beyond what the image tells"
    )
    force_sigma = Parameter(
        0.001, unit="m/s^2", minimum=0.0, doc="the IMU's white noise in the mean specific force"
    )

    images = SharedInput((None, None, None), dtype=np.float32, doc="amplitudes of members' images")
    image = MessageInput(fields=APERTURE_IMAGE, doc="which image is a member's, where it lies")
    prior = BundleInput(MOTION, doc="estimate of now and of the center, before the fix")
    f_b = Input((3,), unit="m/s^2", frame="b", default=0.0, doc="mean specific force of the IMU")

    fix = MessageOutput(fields=SHIFT_FIX, doc="the fix")
    reason = Output(doc="index into terrafix.models.images.aperture_matching.REASONS")
    quality = Output(doc="of the last image: height of the peak over the rms of the correlation")
    residual = Output(
        (2,), unit="m", labels=("range", "cross_range"), doc="measured, less expected"
    )
    offset = Output((3,), unit="m", frame="e", labels=XYZ, doc="of the track, as the image has it")

    def takes(self, name: str) -> bool:
        """Whether a setting has any effect: of map drift only where it is a row."""
        drift = name in ("map_drift_sigma", "force_sigma")
        return super().takes(name) and (not drift or self.setting("rows") == ROWS[1])

    def _initialize_impl(self) -> None:
        self._begun = False
        self.reason = self.quality = self.residual = self.offset = np.nan

    def _extra_state(self) -> dict[str, np.ndarray]:
        return {"begun": np.array(self._begun)}

    def _set_extra_state(self, saved: dict[str, np.ndarray]) -> None:
        self._begun = bool(saved["begun"])

    def _step_impl(self, t: float, dt: float) -> None:
        fresh = self.image.fresh & self.environment.active
        if not fresh.any():
            return
        self._require_earth(np.where(fresh[:, None], self.image.r_e, np.nan))
        reference, dem, ground = self._reference(), self._dem(), self._ground
        who = [int(m) for m in np.flatnonzero(fresh)]
        grids = {m: pixel_grid(self.image, m, ground) for m in who}
        if not self._begun:
            self._require_maps(reference, dem, grids)
        self._begun = True
        found: dict[int, ApertureFix] = {}
        for m in who:
            try:
                found[m] = self._matched(m, grids[m], reference, dem)
            except ValueError as error:
                self.fail(np.arange(self.n_members) == m, f"cannot place its image: {error}")
                continue
            self.reason[m] = REASONS.index(found[m].reason)
            self.quality[m] = found[m].quality
            self.residual[m] = found[m].residual
            self.offset[m] = track_offset(grids[m], found[m])
        self._publish(t, grids, {m: fix for m, fix in found.items() if fix.accepted})

    def _matched(self, m: int, own: PixelGrid, reference: Reference, dem: Dem) -> ApertureFix:
        rows, columns = self._shape(m)
        image: Single = self.images[int(self.image.index[m]), :rows, :columns]
        middle = own.places((rows - 1) / 2, (columns - 1) / 2, dem.at)
        _, S = self._expected(np.array([m]), middle[None], np.array([own.line.speed]))
        reach = search_reach(S[0], float(self.search_sigmas[m]))
        return matched_aperture(image, own, reference, dem.at, reach, S[0])

    def _publish(
        self, t: float, grids: dict[int, PixelGrid], found: dict[int, ApertureFix]
    ) -> None:
        if not found:
            return
        n, who = self.n_members, np.array(list(found))
        valid = np.zeros(n, np.bool_)
        valid[who] = True
        p_t, speed, R = np.zeros((n, 3)), np.ones(n), np.tile(np.eye(3), (n, 1, 1))
        y, present = np.zeros((n, 3)), np.zeros((n, 3))
        for m, fix in found.items():
            p_t[m], speed[m] = fix.place, grids[m].line.speed
            y[m, :2], R[m, :2, :2] = fix.residual, fix.covariance
        present[who, :2] = 1.0
        drift = self.rows == ROWS[1]
        if drift:
            y[:, 2] = self.image.drift
            told = DRIFT_SHARE * self.image.drift_sigma
            R[who, 2, 2] = (told**2 + self.map_drift_sigma**2)[who]
            present[who, 2] = self.image.focused[who]
            R[present[:, 2] < 1, 2, 2] = 1.0
        y[who] += self._expected(who, p_t[who], speed[who])[0]
        self.fix.publish(
            t,
            valid=valid,
            y=y * present,
            p_t_e=p_t,
            speed=speed[:, None],
            f_b=self.f_b,
            t_center=self.image.t[:, None],
            R=R,
            F=(self.force_sigma**2 if drift else np.zeros(n))[:, None, None] * np.eye(3),
            present=present,
        )

    def _expected(
        self, who: np.ndarray, p_t: FloatArray, speed: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        prior = _Rows(self.prior, who)
        return expected_shift(self.setting("earth"), prior, p_t, speed, self.f_b[who])

    def _shape(self, m: int) -> tuple[int, int]:
        return int(self.image.rows[m]), int(self.image.columns[m])

    def _require_maps(self, reference: Reference, dem: Dem, grids: dict[int, PixelGrid]) -> None:
        """Raise where a reference, or the heights, can be of no use to any of the first images."""
        first: ConfigurationError | None = None
        for m, own in grids.items():
            try:
                self._require_map(reference, dem, own, self._shape(m))
            except ConfigurationError as error:
                first = first or error
                continue
            return
        if first is not None:
            raise first

    def _require_map(
        self, reference: Reference, dem: Dem, own: PixelGrid, shape: tuple[int, int]
    ) -> None:
        """Raise where a reference, or the heights, can be of no use to an image."""
        latitude, longitude, _ = own.ground.geodetic(own.line.r)
        if not dem.covers(latitude, longitude).all():
            raise ConfigurationError(
                f"the elevation model of '{self.name}' does not cover the track, which is at "
                f"latitude {np.degrees(latitude):.4f}, longitude {np.degrees(longitude):.4f} deg\n"
                f"  it covers {dem.described()}"
            )
        self._require_pixels(reference, own, shape)
        try:
            p = own.places((shape[0] - 1) / 2, (shape[1] - 1) / 2, dem.at)
        except ValueError as error:
            raise ConfigurationError(
                f"'{self.name}' cannot tell where its image lies: {error}"
            ) from error
        latitude, longitude, _ = own.ground.geodetic(p)
        if reference.pixel(latitude, longitude)[2].all():
            return
        middle = own.ground.point(
            reference.latitude.mean(), reference.longitude.mean(), reference.height.mean()
        )
        right = -np.cross(own.line.along, own.ground.axes(own.line.r)[2])
        sides = {1: "right", -1: "left"}
        other = int(np.sign(right @ (middle - own.line.r)))
        away = float(np.linalg.norm(middle - p))
        told = (
            f"the image lies to the {sides[own.side]} of the track, and the reference to its "
            f"{sides.get(other, 'middle')}\n  let radar and reference look to the same side"
            if other != own.side
            else f"the image lies about latitude {np.degrees(float(latitude)):.4f}, longitude "
            f"{np.degrees(float(longitude)):.4f} deg, {away:.0f} m from the reference's middle\n"
            f"  the reference covers {reference.described()}\n"
            "  point the beam at it, or use a reference of this place"
        )
        raise ConfigurationError(f"the image is not on the reference of '{self.name}': {told}")

    def _require_pixels(self, reference: Reference, own: PixelGrid, shape: tuple[int, int]) -> None:
        pixels, image = reference.pixel_size(own.ground), pixel_steps(own, shape)
        if not 1 / _COARSER**2 < float(np.prod(pixels) / np.prod(image)) < _COARSER**2:
            raise ConfigurationError(
                f"pixels of the reference of '{self.name}' are {pixels[0]:.2f} by {pixels[1]:.2f} "
                f"m on the ground, those of its images {image[0]:.2f} m along the track by "
                f"{image[1]:.2f} m of range\n  use a reference of about the same resolution"
            )


def pixel_grid(image: Any, m: int, ground: Ground) -> PixelGrid:
    """Where the pixels of a member's image lie, from a message with `APERTURE_IMAGE`."""
    return PixelGrid(
        float(image.first_time[m]),
        float(image.row_time[m]),
        float(image.near_range[m]),
        float(image.spacing[m]),
        float(image.velocity[m]),
        StraightLine(float(image.t[m]), image.r_e[m].copy(), image.v_e[m].copy()),
        ground,
        int(image.side[m]),
    )


class _Rows:
    """Some members of a bundle."""

    def __init__(self, bundle: object, who: np.ndarray) -> None:
        self._bundle, self._who = bundle, who

    def __getattr__(self, name: str) -> FloatArray:
        return np.asarray(getattr(self._bundle, name)[self._who])
